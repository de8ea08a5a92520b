# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeprog_bringup.playback.session import State
from pipeprog_bringup.playback.state_file import state_file
from pipeprog_camera.errors import InputError


def test_the_file_holds_the_last_stage_and_its_counts(tmp_path: Path) -> None:
    shown: list[State] = []
    with state_file(tmp_path / "state.json", shown.append) as report:
        report(State("starting", 9, 0, 0, 0))
        report(State("reconstructing", 9, 9, 4, 3))
    expected = {"stage": "reconstructing", "frames": 9, "considered": 9, "keyframes": 4, "registered": 3}
    assert json.loads((tmp_path / "state.json").read_text()) == expected
    assert len(shown) == 2


def test_the_file_tells_bad_input_from_other_ends(tmp_path: Path) -> None:
    with pytest.raises(InputError), state_file(tmp_path / "state.json", lambda _: None):
        raise InputError("no frames")
    assert json.loads((tmp_path / "state.json").read_text()) == {"failed": "InputError"}


def test_without_a_file_states_are_passed_on(tmp_path: Path) -> None:
    shown: list[State] = []
    with state_file(None, shown.append) as report:
        report(State("starting", 9, 0, 0, 0))
    assert len(shown) == 1
