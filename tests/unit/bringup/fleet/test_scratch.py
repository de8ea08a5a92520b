# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from pipeprog_bringup.fleet.scratch import scratch_folder


def test_what_a_killed_cluster_left_goes_and_what_another_holds_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "pipeprog-fleet-killed" / "worker").mkdir(parents=True)
    (tmp_path / "others").mkdir()
    with scratch_folder() as held, scratch_folder() as own:
        assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "others", held, own])
    assert list(tmp_path.iterdir()) == [tmp_path / "others"]
