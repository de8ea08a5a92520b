# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import tempfile
from collections import namedtuple
from pathlib import Path

import pytest

from pipeprog_bringup.playback import scratch
from pipeprog_bringup.playback.scratch import check_room
from pipeprog_camera.errors import InputError

Usage = namedtuple("Usage", "total used free")


@pytest.mark.parametrize("folder", [False, True])
def test_a_recording_needs_its_size_in_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: bool
) -> None:
    recording = tmp_path / "recording"
    if folder:
        recording.mkdir()
    (recording / "part.mcap" if folder else recording).write_bytes(bytes(1000))
    needed = 1000 + scratch._LOGS
    monkeypatch.setattr(scratch.shutil, "disk_usage", lambda _: Usage(10**9, 0, needed))
    check_room(recording)
    monkeypatch.setattr(scratch.shutil, "disk_usage", lambda _: Usage(10**9, 0, needed - 1))
    with pytest.raises(InputError, match=f"{recording}.*TMPDIR"):
        check_room(recording)


def test_a_missing_temporary_folder_is_said_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(InputError, match="TMPDIR"):
        check_room(tmp_path)
