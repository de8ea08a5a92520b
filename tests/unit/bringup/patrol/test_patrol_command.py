# SPDX-License-Identifier: Apache-2.0
"""`pipeprog patrol` against the action over real DDS."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.unit.bringup.patrol.fake_robot import fake_robot

PIPEPROG = [sys.executable, "-c", "from pipeprog_bringup.cli import main; main()"]


def patrol(tmp_path: Path) -> subprocess.CompletedProcess[str]:
    command = [*PIPEPROG, "patrol", str(tmp_path / "site.yaml"), "--out", str(tmp_path / "monday")]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_a_round_goes_on_where_it_has_failed(tmp_path: Path) -> None:
    (tmp_path / "site.yaml").write_text("film: ['true']\nplaces: [{name: one}, {name: two}]\n")
    with fake_robot() as robot:
        robot.failing = ["no board", "", "no board"]
        first = patrol(tmp_path)
        assert first.returncode == 1
        assert "1 places have no survey (one)" in " ".join(first.stderr.split())
        assert "two: done: /surveys/monday_two" in first.stdout
        second = patrol(tmp_path)
        assert (second.returncode, second.stderr) == (0, "")
        surveys = [said for said in robot.said if said != "end"]
    assert surveys == ["survey monday_one", "survey monday_two", "survey monday_one_2", "survey monday_one_3"]
    places = json.loads((tmp_path / "monday" / "patrol.json").read_text())["places"]
    assert {name: (place["state"], place["folder"]) for name, place in places.items()} == {
        "one": ("done", "/surveys/monday_one_3"),
        "two": ("done", "/surveys/monday_two"),
    }
