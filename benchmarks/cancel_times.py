# SPDX-License-Identifier: Apache-2.0
"""Live surveys of the demo that are cancelled, one in each state: time to the answer, and what is written.

    .venv/bin/python -m benchmarks.cancel_times

Writes results/cancel_times.json.
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus

from benchmarks.live_graph import LiveGraph, Robot, demo_frames
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_msgs.action import Survey

STATES = ("STARTING", "FILMING", "RECONSTRUCTING", "MEASURING", "WRITING")
FILMED = 10  # keyframes after which a survey that films is cancelled


def cancelled(robot: Robot, state: str) -> dict[str, Any]:
    """A row of the result: a survey that is cancelled once its feedback tells of a state."""
    wanted = getattr(Survey.Feedback, state)
    asked: list[float] = []

    def cancel() -> None:
        told = robot.feedback[-1] if robot.feedback else Survey.Feedback(state=Survey.Feedback.STARTING)
        is_early = state == "FILMING" and told.keyframes < FILMED
        if not asked and told.state == wanted and not is_early:
            robot.cancel()
            asked.append(time.monotonic())

    answer = robot.survey(state.lower(), cancel)
    folder = Path(answer.result.folder) if answer.result.folder else None
    return {
        "state": state,
        "cancelled": bool(asked) and answer.status == GoalStatus.STATUS_CANCELED,
        "seconds to the result": round(time.monotonic() - asked[0], 1) if asked else "-",
        "keyframes": int(answer.result.sfm.keyframes_seen),
        "pipes": len(answer.result.pipes.pipes),
        "files": sum(file.is_file() for file in folder.rglob("*")) if folder else 0,
    }


def main() -> None:
    """Measures and writes."""
    with tempfile.TemporaryDirectory() as scratch, private_network(Path(scratch)):
        rclpy.init()
        with LiveGraph(Path(scratch), {}) as graph:
            robot = Robot(graph, demo_frames())
            robot.activate()
            rows = []
            for state in STATES:
                rows.append(cancelled(robot, state))
                print(json.dumps(rows[-1]), flush=True)
    content = {
        "title": "Live surveys cancelled in each state",
        "command": "python -m benchmarks.cancel_times",
        "commit": commit(),
        "rows": rows,
    }
    RESULTS.joinpath("cancel_times.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
