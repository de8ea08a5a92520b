# SPDX-License-Identifier: Apache-2.0
"""JSON from outside: an object of finite numbers, or an InputError that names file, line and remedy."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.json_file import read_json


def test_an_object_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, -2.5, 1e3, null, true, "\\u00f8"]}')
    assert read_json(path) == {"a": [1, -2.5, 1e3, None, True, "ø"]}


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "a.json, line 1: is not JSON"),
        ('{"a": 1,\n"b": }', "a.json, line 2: is not JSON"),
        ("[1]", "holds a list where a JSON object belongs"),
        ("3", "holds a int where a JSON object belongs"),
        ('{"a": NaN}', "NaN is no number of JSON"),
        ('{"a": -Infinity}', "-Infinity is no number of JSON"),
        ('{"a": 1e400}', "'1e400' is beyond all numbers"),
        ('{"a": 1' + "0" * 400 + "}", "a number of 401 digits"),
        ('{"a": ' + "1" * 5000 + "}", "a number of 5000 digits"),
        ('{"a":' * 100_000, "lists within lists"),
        ('{"a": ' + "[" * 100_000, "lists within lists"),
        ('{"a": "\x00"}', "is not JSON"),
    ],
    ids=lambda text: repr(text)[:30],
)
def test_what_is_refused_is_named(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=error) as caught:
        read_json(path)
    assert str(caught.value).startswith(str(path))


def test_only_regular_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(InputError, match="give a regular file"):
            read_json(path)
    (tmp_path / "a.json").write_text('{"a": 1}')
    assert read_json(tmp_path / "a.json", most=8) == {"a": 1}
    with pytest.raises(InputError, match="is larger than"):
        read_json(tmp_path / "a.json", most=7)
