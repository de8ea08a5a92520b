# SPDX-License-Identifier: Apache-2.0
"""What a survey has changed, as a message."""

from __future__ import annotations

from pathlib import Path

from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from pipeprog_bringup.survey.progress import site_progress
from pipeprog_msgs.msg import PipeChange, SiteProgress
from tests.unit.bringup.comparison.surveyed import survey
from tests.unit.detect.coverage.wall import upright


def test_each_state_goes_over_the_wire(tmp_path: Path) -> None:
    """Serialisation ends the process where a field has another type than the message's, an int for a float, too."""
    earlier = survey(tmp_path / "a", 0, [upright(-0.6), upright(0.0), upright(1.0)])
    later = survey(tmp_path / "b", 7, [upright(0.0), upright(0.3)])
    told = deserialize_message(serialize_message(site_progress(earlier, later, Header(frame_id="map"))), SiteProgress)
    assert {change.id: change.state for change in told.pipes} == {
        "p01": PipeChange.GONE,
        "p02": PipeChange.KEPT,
        "p03": PipeChange.NOT_SEEN,
        "p04": PipeChange.NEW,
    }
    counted = {change.id: change.counted for change in told.pipes}
    assert counted["p01"] == 0.0
    assert counted["p03"] > 0.0  # what nobody has seen to be gone still counts
