# SPDX-License-Identifier: Apache-2.0
"""Goals of a survey that cannot be used: paths, URIs and durations that a client might send."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from pipeprog_bringup.survey.goal import MAX_TIME
from pipeprog_camera.outside_text import for_terminal

BAGS = Path(__file__).parents[2] / "bags"
NAMES = [
    *("../up", "..", ".", "/etc/cron.d/x", "a/../../b", "~", "~root", "a/b", "\\\\host\\share", "C:\\x", "-rf"),
    *("--help", "%2e%2e%2f", "..\u2215up", "a\0b", "a\nb", "\x1b[2J", "\u202egnp", "$(reboot)", "`id`", "; rm -rf /"),
    *("|", "*", "?", " ", "x" * 65, "x" * 100_000, "é", "\U0001f600", ".hidden", "file:///tmp/x", "s3://bucket/x", "'"),
]
FILES = [
    *("/", "..", "/nowhere/x.yaml", "/dev/null", "/dev/zero", "/proc/self/mem", "/proc/self/environ", "/etc/passwd"),
    *("s3://bucket/boq.yaml", "http://host/x", "ftp://x", "gopher://x", "javascript:alert(1)", "file://", "file:///"),
    *("a\0b", "x" * 5000, "/" * 3000, "../" * 500 + "etc/passwd", "%00", "$HOME/boq.yaml", "|cat", "\n", "-", "~"),
]
TIMES = [-1.0, -1e-9, MAX_TIME + 1e-3, 1e18, -1e18, float("nan"), float("inf"), float("-inf"), 2.0**31]  # s
REFERENCES = ["last_week", "/surveys/monday", "../..", "s3://x", "\0", "x" * 10_000]
VALUES: dict[str, list[Any]] = {
    "survey_id": NAMES,
    "boq": FILES,
    "board": FILES,
    "time_limit": TIMES,
    "reference": REFERENCES,
}


def absurd_goal(rng: random.Random) -> dict[str, Any]:
    """The fields of a goal, `time_limit` [s] among them, of which one at least cannot be used."""
    goal = {
        "survey_id": "level2",
        "boq": str(BAGS / "demo.boq.yaml"),
        "board": str(BAGS / "demo.board.yaml"),
        "time_limit": 60.0,
        "reference": "",
    }
    for field in rng.sample(list(VALUES), rng.randint(1, 3)):
        goal[field] = rng.choice(VALUES[field])
    if goal["survey_id"] != "level2" and rng.random() < 0.3:
        goal["survey_id"] = f"../{goal['survey_id']}"
    return goal


def is_named(goal: dict[str, Any], message: str) -> bool:
    """Whether a refusal names a field of a goal, or the file that it gives."""
    files = [str(Path(goal[key].removeprefix("file://")))[:12] for key in ("boq", "board")]
    return any(word in message for word in (*VALUES, *map(for_terminal, files), *files))
