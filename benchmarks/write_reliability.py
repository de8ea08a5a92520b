# SPDX-License-Identifier: Apache-2.0
"""Writes docs/reliability.md from results/hostile_*.json and from the limits in pipeprog_camera/limits.py.

.venv/bin/python -m benchmarks.write_reliability
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.markdown import bullets, cell, table
from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS
from pipeprog_camera import limits

PAGE = ROOT / "docs" / "reliability.md"
_LIMIT = re.compile(r"([A-Z_]+) = [^#]+?  # (.+)")

DOOR = """## What comes in

A file is compared with limits before it is opened further: its size, the sizes that it declares for chunks, images and clouds, the depth and number of its values.
What cannot be used ends the command with one sentence that names the file, the value and the remedy; a damaged recording gives what is still whole in it.
LAZ is decompressed in a process of its own: its decoder recurses as deep as the compressed bits say, which no check of sizes bounds.

A node has one door, `pipeprog_node.intake.Intake`.
Each type of message is checked in one function of the room `pipeprog_node/received`: finite numbers, sizes that fit their data, unit quaternions, counts, stamps that are times, the size of an image from its header before a pixel is decoded.
Settings are read-only parameters; a request that cannot be met is answered with the reason.

A message that fails is dropped.
It is counted by topic and kind in `/diagnostics` (`dropped on TOPIC: KIND`, level WARN), and the first of each kind is said in the node's log, in words.
What the network loses before it arrives is counted by topic, too (`lost on the way to TOPIC`), where the middleware notices it.
Reconstruction and detection run in child processes: one that ends is started again, and what it was working on is not given to it again.
A latched message that ends a worker is remembered by its digest, so that the middleware's copy of it does no harm either.

A replay talks over the loopback interface alone, at ports that no other graph uses: no foreign message reaches it ([security](security.md)).
"""  # noqa: E501

PLACES = """## Where it runs

Neither a home folder nor an installation that can be written is needed, nor the rights of root.

Libraries keep files between runs: Numba compiled functions (beside the sources where these can be written, else in `XDG_CACHE_HOME`), Matplotlib a list of fonts (`XDG_CONFIG_HOME`, `XDG_CACHE_HOME`), ROS logs (`ROS_HOME`).
A variable whose folder cannot be written, or has less than 32 MB left, is set to a private folder `pipeprog-home-*` among the temporary files, by `pipeprog_camera.files.user_folders`; the next run uses the same one.
Compiled functions are programs: a folder there is used only where it belongs to the user and nobody else may write it.
The first run in it compiles for some minutes.

| lacking | what happens |
|---|---|
| home folder, or `HOME` not set | as above; the results have the same bytes |
| a folder for temporary files | a command that needs one says so before it reads anything: let `TMPDIR` name one |
| room there | a replay holds its recording's images there, and says before it begins where they do not fit |
| room for the results | said before the work begins; what the folder held stays |

Nodes on a robot keep the journal of their keyframes among the temporary files, in a survey of the action in its folder, and their logs in `ROS_LOG_DIR` or `ROS_HOME`.
"""  # noqa: E501

OPEN = (
    "A message that is well formed and wrong is believed: who may publish is a matter of SROS2 "
    "([security](security.md)), not of a check.",
    "rclpy converts a message before the door sees it: a large one of many parts costs the node its time, some 20 "
    "microseconds each.",
    "Damaged CDR bytes are dropped by the middleware (Fast DDS), which writes lines to stderr and counts nothing.",
    "What ends a worker by its sheer size costs the time until the machine is out of memory: limits are for one "
    "message, not for what all of them add up to.",
    "The native decoders of images, recordings and E57 run in the process that reads: what ends one ends the command "
    "or the worker, and nothing but what was tried here says that no file does.",
    "The fuzzer follows no coverage, and its recordings are small.",
)


def main() -> None:
    """Write the page."""
    PAGE.write_text(reliability(read_hostile()))


def read_hostile() -> dict[str, dict[str, Any]]:
    """The JSON files of what was tried with hostile input, by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(RESULTS.glob("hostile_*.json"))}


def reliability(results: Mapping[str, Mapping[str, Any]]) -> str:
    """The text of docs/reliability.md."""
    parts = [
        "# Reliability\n",
        "Nothing that comes from outside - a file, a message, a request, a name - may end a node or leave a command "
        "without an answer.\n",
        "## What was tried, what failed\n",
        table(
            ("what", "tried", "failed", "worst time [s]", "largest memory [MiB]", "limits", "commit"),
            [_row(result) for result in results.values()],
        ),
        "Each row is made by the command of its name: "
        + ", ".join(f"`{result['command']}`" for result in results.values() if "command" in result)
        + ".\nMemory is that of the largest process, with Python and its libraries.\n",
        *_failures(results),
        DOOR,
        PLACES,
        "## Limits\n",
        "From `pipeprog_camera/limits.py`.\n",
        table(("limit", "value", "unit and reason"), _limits(Path(limits.__file__).read_text())),
        "## What remains open\n",
        bullets(OPEN),
        "Written by `python -m benchmarks.write_reliability` from `hostile_*.json` in `benchmarks/results/`.\n",
    ]
    return "\n".join(parts)


def _row(result: Mapping[str, Any]) -> tuple[str, ...]:
    bounds = result.get("limits", {})
    seconds, size = bounds.get("seconds"), bounds.get("bytes")
    parts = [f"{seconds:g} s" if seconds else "", f"{size / 2**30:g} GiB" if size else ""]
    allowed = ", ".join(part for part in parts if part)
    return (
        result["what"],
        cell(result["tried"]),
        cell(result["failed"]),
        cell(result["worst_seconds"]),
        str(result["worst_bytes"] >> 20),
        allowed or "-",
        cell(result.get("commit")),
    )


def _failures(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    failures = [failure for result in results.values() for failure in result["failures"]]
    if not failures:
        return []
    return ["What failed:\n", bullets(f"{failure['name']}: {failure['reason']}" for failure in failures)]


def _limits(source: str) -> list[tuple[str, str, str]]:
    """Name, value and comment of each limit of the module's source."""
    rows = []
    for line in source.splitlines():
        if match := _LIMIT.fullmatch(line):
            rows.append((f"`{match[1]}`", f"{getattr(limits, match[1]):,}".replace(",", " "), match[2]))
    return rows


if __name__ == "__main__":
    main()
