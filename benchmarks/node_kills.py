# SPDX-License-Identifier: Apache-2.0
"""Nodes and workers killed at random moments of live surveys of the demo, under a supervisor that starts them anew.

    .venv/bin/python -m benchmarks.node_kills [--kills 50] [--seed 1] [--only NODE] [--frames N]

One graph does all surveys. The first is left alone: it tells how long a survey takes and which pipes there are. In each
of the others one process is killed (SIGKILL), the node of the action among them, at a moment drawn from the whole of
that time; one that is over before that counts as no kill. A survey counts where it ends with a result; a pipe counts as
kept where one of the result has its class and its axis within 20 mm and 3 degrees in the middle. Writes
results/node_kills.json after each survey, with `--only` results/node_kills_NODE.json.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from action_msgs.msg import GoalStatus

from benchmarks.live_graph import COARSE, LiveGraph, Robot, demo_frames
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import Pipe

VICTIMS = (("frames", False), ("sfm", False), ("sfm", True), ("detect", False), ("detect", True), ("survey", False))
NEAR, PARALLEL = 0.02, np.cos(np.radians(3.0))  # m and cosine: a pipe is thicker, and its neighbours farther
STAGES = {getattr(Survey.Feedback, name): name for name in ("STARTING", "FILMING", "RECONSTRUCTING", "MEASURING")}
STAGES[Survey.Feedback.WRITING] = "WRITING"


def killed_survey(graph: LiveGraph, robot: Robot, name: str, victim: tuple[str, bool], moment: float) -> dict[str, Any]:
    """A row of the result: one survey in which a process is killed after `moment` seconds."""
    started = time.monotonic()
    at: list[str] = []

    def strike() -> None:
        if not at and time.monotonic() - started > moment and graph.kill(*victim):
            at.append(STAGES[robot.feedback[-1].state] if robot.feedback else "STARTING")

    answer = robot.survey(name, strike)
    return {
        **({"killed": " ".join((victim[0], "worker" * victim[1])).strip()} if at else {}),
        **({"moment [s]": round(moment, 1), "stage": at[0]} if at else {}),
        "status": int(answer.status),
        "error_code": int(answer.result.error_code),
        "error_msg": answer.result.error_msg,
        "seconds": round(time.monotonic() - started, 1),
        "keyframes": int(answer.result.sfm.keyframes_seen),
        "registered": int(answer.result.sfm.keyframes_registered),
        "pipes": [pipe.class_name for pipe in answer.result.pipes.pipes],
        "answer": answer,
    }


def kept(before: list[Pipe], after: list[Pipe]) -> int:
    """How many pipes of an earlier survey of the same frame are there again."""
    return sum(any(_is_same(one, other) for other in after) for one in before)


def _is_same(one: Pipe, other: Pipe) -> bool:
    (start, end), (first, last) = (
        (np.array([p.start.x, p.start.y, p.start.z]), np.array([p.end.x, p.end.y, p.end.z])) for p in (one, other)
    )
    along, across = (end - start) / np.linalg.norm(end - start), (last - first) / np.linalg.norm(last - first)
    offset = (first + last - start - end) / 2
    near = np.linalg.norm(offset - along * (along @ offset)) < NEAR
    return bool(one.class_name == other.class_name and abs(along @ across) > PARALLEL and near)


def figures(alone: dict[str, Any], killed: Sequence[dict[str, Any]], options: str) -> dict[str, Any]:
    """The result as a page shows it: one row a survey, the one that was left alone first."""
    ended = sum(each["status"] == GoalStatus.STATUS_SUCCEEDED for each in killed)
    struck = sum("killed" in each for each in killed)
    shown = ("killed", "moment [s]", "stage", "seconds", "keyframes", "registered", "kept")
    rows = [{**{key: each.get(key, "-") for key in shown}, "pipes": len(each["pipes"])} for each in (alone, *killed)]
    return {
        "title": "Nodes killed during live surveys",
        "command": f"python -m benchmarks.node_kills --kills {struck} {options}",
        "commit": commit(),
        "ended with a result": f"{ended} of {len(killed)}",
        "over before the kill": len(killed) - struck,
        "rows": rows,
    }


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.node_kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=sorted({name for name, _ in VICTIMS}), help="the node that is killed")
    parser.add_argument("--frames", type=int, help="of the demo, for shorter surveys")
    options = parser.parse_args()
    victims = [victim for victim in VICTIMS if options.only in (None, victim[0])]
    given = {"seed": options.seed, "only": options.only, "frames": options.frames}
    told = " ".join(f"--{name} {value}" for name, value in given.items() if value is not None)
    result = RESULTS / f"node_kills{f'_{options.only}' if options.only else ''}.json"
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as scratch, private_network(Path(scratch)):
        rclpy.init()
        with LiveGraph(Path(scratch), COARSE) as graph:
            robot = Robot(graph, demo_frames()[: options.frames])
            robot.activate()
            robot.survey("warm_up")  # compiles, and reads what the disk has
            alone = killed_survey(graph, robot, "alone", VICTIMS[0], float("inf"))
            pipes = alone.pop("answer").result.pipes.pipes
            print(json.dumps(alone), flush=True)
            rows: list[dict[str, Any]] = []
            for number in itertools.count():
                if sum("killed" in each for each in rows) == options.kills:
                    break
                victim, moment = victims[number % len(victims)], rng.uniform(0.0, alone["seconds"])
                row = killed_survey(graph, robot, f"kill_{number}", victim, moment)
                answer = row.pop("answer")
                row["kept"] = f"{kept(pipes, answer.result.pipes.pipes)} of {len(pipes)}"
                rows.append(row)
                print(json.dumps(row), flush=True)
                result.write_text(json.dumps(figures(alone, rows, told), indent=1) + "\n")


if __name__ == "__main__":
    main()
