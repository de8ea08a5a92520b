# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

pytest.importorskip("fsspec", reason="the packages of pipeprog fleet are not installed: make setup FLEET=1")

from pipeprog_bringup.console import FleetDisplay
from pipeprog_bringup.fleet.task import Outcome


def test_a_fleet_has_a_line_for_each_recording_that_runs_and_for_what_became_of_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with FleetDisplay() as display:
        display.begin(3, 1)
        counts = {"frames": 10, "considered": 4, "keyframes": 3, "registered": 2}
        display.tell({"name": "a", "stage": "fetching"})
        display.tell({"name": "a", "stage": "choosing keyframes", **counts})
        display.tell({"name": "[red]b", "stage": "replay"})
        display.end(Outcome("[red]b", "refused", "no [bold] file"))
    shown = capsys.readouterr().err
    assert "4/10 frames, 2/3 keyframes, choosing keyframes" in shown
    assert "[red]b: refused: no [bold] file" in shown
    assert "2/3" in shown
