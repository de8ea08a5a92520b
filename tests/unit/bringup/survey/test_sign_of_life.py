# SPDX-License-Identifier: Apache-2.0
"""What a process that was killed tells of when it lived, through clocks that are set and computers that are started."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from pipeprog_bringup.survey import sign_of_life
from pipeprog_bringup.survey.sign_of_life import is_alive, sign


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "active"


@pytest.mark.parametrize("hours", [-5.0, 5.0])
def test_a_clock_that_is_set_changes_nothing(file: Path, monkeypatch: pytest.MonkeyPatch, hours: float) -> None:
    sign(file)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3600.0 * hours)
    assert is_alive(file)


@pytest.mark.parametrize(("later", "alive"), [(50.0, True), (70.0, False), (-70.0, False)])
def test_a_sign_holds_for_a_minute(file: Path, monkeypatch: pytest.MonkeyPatch, later: float, alive: bool) -> None:
    now = sign_of_life._now()
    monkeypatch.setattr(sign_of_life, "_now", lambda: now)
    sign(file)
    monkeypatch.setattr(sign_of_life, "_now", lambda: now + later)
    assert is_alive(file) == alive


def test_a_sign_from_before_the_computer_was_started_again_is_none(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sign_of_life, "_boot", lambda: "00000000-0000-0000-0000-000000000000")
    sign(file)
    assert is_alive(file)
    monkeypatch.undo()
    assert not is_alive(file)


def test_the_last_sign_counts(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = sign_of_life._now()
    monkeypatch.setattr(sign_of_life, "_now", lambda: now - 3600.0)
    sign(file)
    monkeypatch.undo()
    assert not is_alive(file)
    sign(file)
    assert is_alive(file)


@pytest.mark.parametrize("content", [b"", b"\xff" * 64, b"here", b"a b c", b"boot nan", b"boot -inf"])
def test_a_file_that_is_no_sign_is_none(file: Path, monkeypatch: pytest.MonkeyPatch, content: bytes) -> None:
    monkeypatch.setattr(sign_of_life, "_boot", lambda: "boot")
    file.write_bytes(content)
    assert not is_alive(file)
    file.unlink()
    assert not is_alive(file)
