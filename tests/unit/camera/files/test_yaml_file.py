# SPDX-License-Identifier: Apache-2.0
"""YAML from outside: plain values with their lines, or an InputError that names file, line and remedy."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from pipeprog_camera.errors import InputError
from pipeprog_camera.files.yaml_file import line_of, parse_yaml, read_yaml
from pipeprog_camera.limits import MAX_DEPTH, MAX_DIGITS, MAX_NODES, MAX_TEXT, MAX_YAML


def laughs(levels: int, width: int = 9) -> str:
    """Lists that name the one before: width^levels values once written out."""
    rows = ["a0: &a0 [" + ",".join(["x"] * width) + "]"]
    rows += [f"a{i}: &a{i} [" + ",".join([f"*a{i - 1}"] * width) + "]" for i in range(1, levels)]
    return "\n".join(rows)


@pytest.mark.parametrize(
    ("text", "content"),
    [
        ("", None),
        ("# a comment\n", None),
        ("a: 1\nb: 2.5\nc: yes\nd: ~\ne: text", {"a": 1, "b": 2.5, "c": True, "d": None, "e": "text"}),
        ("\n- [1, -2]\n- {x: '1'}\n", [[1, -2], {"x": "1"}]),
        ("a: !!str 5\nb: !!int '5'", {"a": "5", "b": 5}),
        ("size: 2001-99-99", {"size": "2001-99-99"}),
        ("a: &x {b: 1, c: 2}\nd: {<<: *x, c: 3}", {"a": {"b": 1, "c": 2}, "d": {"b": 1, "c": 3}}),
        ("a: &x [1, 2]\nb: *x", {"a": [1, 2], "b": [1, 2]}),
        ("a: .inf", {"a": math.inf}),
        ("'<<': 1\nb: =", {"<<": 1, "b": "="}),
    ],
)
def test_plain_values_are_read(text: str, content: Any) -> None:
    assert parse_yaml(text, "bill.yaml") == content


def test_values_know_their_lines() -> None:
    content = parse_yaml("classes:\n- name: a\n  size: 3\n\n- name: b\n", "bill.yaml")
    assert [line_of(content["classes"], k) for k in (0, 1)] == [", line 2", ", line 5"]
    assert line_of(content["classes"][0], "size") == ", line 3"
    assert line_of(content["classes"][1]) == ", line 5"
    assert line_of(content["classes"][1], "missing") == ", line 5"
    assert line_of({"name": "made here"}) == ""


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("a: 1\nb: 2\na: 3", "line 3: the key 'a' stands on line 1 already"),
        ("1: a\ntrue: b", "line 2: the key True stands on line 1 already"),
        ("a:\n- &x [*x]", r"line 2: the alias \*x has no anchor above that is complete"),
        ("a: *b", r"line 1: the alias \*b has no anchor"),
        ("\nn: !!int x", "line 2: 'x' is no int"),
        ("n: !!bool x", "line 1: 'x' is no bool"),
        ("n: !!float ''", "line 1: '' is no float"),
        ("n: 0x_", "line 1: '0x_' is no int"),
        ("n: 0b_", "line 1: '0b_' is no int"),
        ("n: 1" + "0" * 400, "line 1: a number of 401 characters"),
        ("n: " + "1" * 5000, "line 1: a number of 5000 characters"),
        ("n: " + "1" * MAX_DIGITS + ".5", "a number of 102 characters"),
        ("n: !!int '" + "1" * 5000 + "'", "a number of 5000 characters"),
        ("[" * 100_000, f"line 1: more than {MAX_DEPTH} lists or mappings"),
        ("- " * 100_000, "more than"),
        ("{a: " * 100_000, "more than"),
        ("\n".join(" " * k + "a:" for k in range(100)), "line 33: more than"),
        (laughs(11), f"line 7: more than {MAX_NODES} values"),
        ("\n" + 'a: "\\0"', r"line 2: a text holds the control character '\\x00'"),
        ('a: "\\e[31m"', "control character"),
        ("a\n\nb: \x07", "line 3: holds the control character"),
        ("a: \ud800", "line 1: holds the control character"),
        ('a: "\\uD800"', "is no YAML"),
        ("a: " + "x" * (MAX_TEXT + 1), "line 1: a text of 65537 characters"),
        ("a: !!python/object/apply:os.system [x]", "line 1: the tag .*python.* has no meaning here"),
        ("a: !!binary aGk=", "the tag"),
        ("a: !!seq 5", "the tag"),
        ("a: !!map [1]", "the tag"),
        ("a: !!timestamp x", "the tag"),
        ("%TAG ! x\n---\na", "line 1: %TAG"),
        ("a\n--- b", "line 2: a second document"),
        ("a: [\nb: [", "line 3: is no YAML"),
        ("a: b: c", "line 1: is no YAML"),
        ("\ta: 1", "line 1: is no YAML"),
        ("? [1]\n: 2", "a list or mapping stands where a key belongs"),
        ("? &x {a: 1}\n: 2", "a list or mapping stands where a key belongs"),
        ("<<: 1", "<< is 1: give it a mapping"),
        ("<<: [1, {a: 1}]", "<< is 1: give it a mapping"),
    ],
    ids=lambda text: repr(text)[:30],
)
def test_what_is_refused_is_named_with_its_line(text: str, error: str) -> None:
    with pytest.raises(InputError, match=f"^bill.yaml, {error}" if error.startswith("line") else error):
        parse_yaml(text, "bill.yaml")


def test_the_limits_themselves_are_taken() -> None:
    assert parse_yaml("[" * MAX_DEPTH + "]" * MAX_DEPTH, "x")
    assert parse_yaml("1" * MAX_DIGITS, "x") == int("1" * MAX_DIGITS)
    assert parse_yaml("x" * MAX_TEXT, "x") == "x" * MAX_TEXT
    assert len(parse_yaml(laughs(6), "x")) == 6  # 598 000 values


def test_no_text_of_the_greatest_size_takes_long() -> None:
    hard = ["[" + "1," * (MAX_YAML // 2 - 1) + "]", "%TAG !a! x\n" * 100_000, "- &a x\n" * 150_000, "---\n" * 250_000]
    start = time.process_time()
    for text in hard:
        with contextlib.suppress(InputError):
            parse_yaml(text, "x")
    assert time.process_time() - start < 20.0


def test_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "bill.yaml"
    path.write_bytes("\ufeffname: Rohr Ø 50\r\n".encode())
    assert read_yaml(path) == {"name": "Rohr Ø 50"}
    link = tmp_path / "link.yaml"
    link.symlink_to(path)
    assert read_yaml(link) == read_yaml(path)


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
    for path, what in (
        (tmp_path, "a folder"),
        (tmp_path / "pipe", "a pipe between processes"),
        (tmp_path / "socket", "a socket"),
        (Path("/dev/zero"), "a device"),
        (tmp_path / "none", "no such file"),
        (tmp_path / "a\0b", "is no path"),
        (tmp_path / ("x" * 300), "cannot read the file"),
    ):
        with pytest.raises(InputError, match=what):
            read_yaml(path)


def test_sizes_and_encodings_of_files_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "bill.yaml"
    path.write_bytes(b"#" * (MAX_YAML + 1))
    with pytest.raises(InputError, match="larger than 1 MiB"):
        read_yaml(path)
    path.write_bytes(b"#" * MAX_YAML)
    assert read_yaml(path) is None
    for content in ("name: Rohr Ø".encode("latin-1"), "\nname: a".encode("utf-16"), b"a: \xed\xa0\x80"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"bill.yaml, line 1: .*UTF-8"):
            read_yaml(path)
