# SPDX-License-Identifier: Apache-2.0
"""Texts and values from outside where they go out: shortened, on one line, without an effect of their own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sized
from itertools import islice
from typing import Any

_SHOWN = 80  # characters of a value in a message; a line of a terminal has as many
_SHOWN_ITEMS = 4  # of a list or mapping; a row of numbers in a board or bill has two to four
_SHOWN_DEPTH = 2  # lists within lists that are shown, such as the rows of a board


def shown(value: Any) -> str:
    """A value as an error message shows it, on one line of at most 80 characters; control characters as escapes."""
    text = _shown(value, _SHOWN_DEPTH)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


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
