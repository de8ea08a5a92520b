# SPDX-License-Identifier: Apache-2.0
"""YAML and JSON that do harm: each is used, or refused in one line that names the file."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from benchmarks.hostile_yaml import NAMED, VALID, judged, read_and_use
from benchmarks.limited import Outcome
from pipeprog_camera.errors import InputError

pytestmark = pytest.mark.usefixtures("little_memory")


@pytest.mark.parametrize("kind", VALID)
def test_a_valid_file_is_used(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"valid.{kind}"
    path.write_text(VALID[kind])
    read_and_use(path)


@pytest.mark.parametrize("name", NAMED)
def test_a_hostile_file_is_used_or_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    NAMED[name](path)
    started = time.process_time()
    refusal = refused(path)
    assert time.process_time() - started < 10.0  # s; half of what a command may take
    if refusal:
        assert judged(path, Outcome("refused", refusal, 0.0, 0)) == ""


def refused(path: Path) -> str:
    """The error of a file, empty where it is used."""
    try:
        read_and_use(path)
    except InputError as error:
        return str(error)
    return ""
