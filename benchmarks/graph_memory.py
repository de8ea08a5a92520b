# SPDX-License-Identifier: Apache-2.0
"""Surveys one after another in one graph: what memory each leaves behind.

    .venv/bin/python -m benchmarks.graph_memory [--surveys 20]

One graph does all surveys, each of the same first frames of the demo. What each node's process holds for itself is
read after each of them, when the node has begun anew. Growth is the slope of a line through the second half, as a
share of its mean: the first surveys compile code and fill caches. Writes results/graph_memory.json.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

from benchmarks.live_graph import COARSE, LiveGraph, Robot, demo_frames
from benchmarks.survey import RESULTS, commit
from pipeprog_bringup.playback.private_network import private_network

FRAMES = 14  # of the demo: enough for a map with pipes


def growth(memory: Sequence[float]) -> float:
    """Percent a survey, over the second half of the surveys."""
    later = np.asarray(memory[len(memory) // 2 :])
    return float(100.0 * np.polyfit(np.arange(len(later)), later, 1)[0] / later.mean())


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.graph_memory", description=__doc__)
    parser.add_argument("--surveys", type=int, default=20)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as scratch, private_network(Path(scratch)):
        rclpy.init()
        with LiveGraph(Path(scratch), COARSE) as graph:
            robot = Robot(graph, demo_frames()[:FRAMES])
            robot.activate()
            for number in range(options.surveys):
                answer = robot.survey(f"survey_{number}")
                held = {name: round(value, 1) for name, value in graph.memory().items()}
                rows.append(
                    {
                        "survey": number + 1,
                        "seconds": int(answer.result.total_elapsed_time.sec),
                        "error_code": int(answer.result.error_code),
                        "pipes": len(answer.result.pipes.pipes),
                        **{f"{name} [MB]": value for name, value in held.items()},
                        "all [MB]": round(sum(held.values()), 1),
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
    columns = [name for name in rows[0] if name.endswith("[MB]")]
    result = {
        "title": "Memory over surveys in one graph",
        "command": f"python -m benchmarks.graph_memory --surveys {options.surveys}",
        "commit": commit(),
        "findings": {
            f"growth of {name.removesuffix(' [MB]')}, a survey [%]": round(growth([row[name] for row in rows]), 2)
            for name in columns
        },
        "rows": rows,
    }
    (RESULTS / "graph_memory.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
