# SPDX-License-Identifier: Apache-2.0
"""Texts and values from outside where they go out: shortened, on one line, without an effect of their own."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sized
from itertools import islice
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_NAME

# Line breaks, terminal sequences, what turns the direction of writing, and halves of surrogate pairs.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_CONTROL_IN_LINES = re.compile(f"(?!\n){_CONTROL.pattern}")
_SHOWN = 80  # characters of a value in a message; a line of a terminal has as many
_SHOWN_ITEMS = 4  # of a list or mapping; a row of numbers in a board or bill has two to four
_SHOWN_DEPTH = 2  # lists within lists that are shown, such as the rows of a board


def shown(value: Any) -> str:
    """A value as an error message shows it, on one line of at most 80 characters; control characters as escapes."""
    text = _shown(value, _SHOWN_DEPTH)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def for_terminal(text: str) -> str:
    """A text for a terminal or log: control characters as escapes, so that none moves the cursor or hides a part."""
    return _CONTROL_IN_LINES.sub(_escape, text)


def for_plot(text: str) -> str:
    """A text for matplotlib, which would read formulas between dollars and leave `_name` out of legends."""
    plain = _CONTROL.sub(_escape, text).replace("$", r"\$")
    return f" {plain}" if plain.startswith("_") else plain


def for_spreadsheet(text: str) -> str:
    """A cell of a CSV file; an apostrophe stands before what a spreadsheet would take for a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def _escape(found: re.Match[str]) -> str:
    return repr(found[0])[1:-1]


def nearest(value: Any, names: Iterable[str]) -> str:
    """The name that a wrong text comes closest to, for `did you mean`."""
    return difflib.get_close_matches(str(value)[:MAX_NAME], list(names), n=1, cutoff=0.0)[0]


def name_of(value: Any, where: str) -> str:
    """A name that a file gives as a text or number, without spaces around it.

    Raises InputError, which begins with `where`, for what is no text, empty, longer than MAX_NAME or not one line.
    """
    if not isinstance(value, str | int | float) or isinstance(value, bool) or not str(value).strip():
        raise InputError(f"{where} is {shown(value)}: write a name")
    name = str(value).strip()
    if len(name) > MAX_NAME:
        raise InputError(f"{where} is a name of {len(name)} characters: write {MAX_NAME} at most")
    if _CONTROL.search(name):
        raise InputError(f"{where} is {shown(name)}: write a name on one line, without control characters")
    return name


def _shown(value: Any, depth: int) -> str:
    if isinstance(value, str):
        return repr(value if len(value) <= _SHOWN else value[:_SHOWN] + "…")
    if isinstance(value, int) and value.bit_length() > 256:  # repr() of integers of 4300 digits raises ValueError
        return f"an integer of about {round(value.bit_length() * 0.30103)} digits"
    if isinstance(value, Mapping):
        pairs = islice(value.items(), _SHOWN_ITEMS)
        return (
            "{" + _joined((f"{_shown(key, 0)}: {_shown(item, depth - 1)}" for key, item in pairs), value, depth) + "}"
        )
    if isinstance(value, list | tuple):
        return "[" + _joined((_shown(item, depth - 1) for item in value[:_SHOWN_ITEMS]), value, depth) + "]"
    return repr(value) if value is None or isinstance(value, float | int) else f"a {type(value).__name__}"


def _joined(items: Iterable[str], value: Sized, depth: int) -> str:
    """Items of a list or mapping with commas, and what is left out as an ellipsis."""
    if not len(value):
        return ""
    if depth <= 0:
        return "…"
    return ", ".join(items) + (", …" if len(value) > _SHOWN_ITEMS else "")
