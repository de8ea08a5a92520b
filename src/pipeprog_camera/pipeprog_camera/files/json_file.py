# SPDX-License-Identifier: Apache-2.0
"""The one reader of JSON from outside: an object within limits, or an InputError with file, line and remedy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_text
from pipeprog_camera.limits import MAX_DIGITS, MAX_JSON
from pipeprog_camera.outside_text import shown


def read_json(path: str | Path, most: int = MAX_JSON) -> dict[str, Any]:
    """The object in a JSON file of at most `most` bytes; its numbers are finite.

    Raises InputError, naming the file, the line and the remedy, where there is none.
    """
    return parse_json(read_text(path, most), str(path))


def parse_json(text: str, source: str) -> dict[str, Any]:
    """As read_json, of a text; `source` names it in errors."""
    try:
        content = json.loads(text, parse_constant=_constant, parse_int=_integer, parse_float=_finite)
    except json.JSONDecodeError as error:
        raise InputError(f"{source}, line {error.lineno}: is not JSON ({error.msg}): write the file again") from None
    except RecursionError:
        raise InputError(f"{source}: lists within lists beyond all measure: write the file again") from None
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    if not isinstance(content, dict):
        kind = type(content).__name__
        raise InputError(f"{source} holds a {kind} where a JSON object belongs: write the file again")
    return content


def _constant(text: str) -> Any:
    raise InputError(f"{text} is no number of JSON: write null where a value is not known")


def _integer(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise InputError(f"a number of {len(text)} digits: write {MAX_DIGITS} at most")
    return int(text)


def _finite(text: str) -> float:
    number = float(text)
    if number - number != 0.0:  # infinite: 1e400
        raise InputError(f"{shown(text)} is beyond all numbers of double precision: write it again")
    return number
