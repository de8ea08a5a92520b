# SPDX-License-Identifier: Apache-2.0
"""Whether harm is noticed: each deliberate mistake below is put into the code at run time, and the tests must fail.

    .venv/bin/python -m benchmarks.harms

Writes results/harms.json: for each harm the test that caught it. The file is a pytest plugin, too: a run of the tests
with HARM set works on the harmed code.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS


@dataclass(frozen=True)
class Harm:
    """What is changed: `module.name` becomes what `harmed` makes of it; `tests` are those asked first."""

    place: str
    harmed: Callable[[Any], Any]
    tests: str


def _centres_as_imaged(_: Any) -> Any:
    """The middles of the ellipses in place of the images of the circles' centres."""

    def centres(conics: Any, *_: Any) -> Any:
        return np.linalg.solve(conics[:, :2, :2], -conics[:, :2, 2:])[..., 0]

    return centres


def _shifted(project: Any) -> Any:
    """Pixel centres at half numbers where the rest of the code has them at whole ones."""

    def shifted(*arguments: Any) -> Any:
        pixels, depths = project(*arguments)
        return pixels + 0.5, depths

    return shifted


HARMS = {
    "eccentricity of the circles left in": Harm(
        "pipeprog_sfm.boards.placed_board.circle_centre_images", _centres_as_imaged, "sfm"
    ),
    "half a pixel between COLMAP and ROS": Harm(
        "pipeprog_sfm.sparse.colmap._pixels", lambda _: lambda pixels: pixels.astype(float), "sfm"
    ),
    "half a pixel in the projection of rims": Harm("pipeprog_detect.silhouette.pipe_ends.project", _shifted, "detect"),
    "no sector of the normals in the detector": Harm(
        "pipeprog_detect.cloud.candidate._facing", lambda _: lambda points, *_: points, "detect"
    ),
    "the mean of the errors for their root mean square": Harm(
        "pipeprog_bringup.results.scoring._rms",
        lambda _: lambda values: float(np.mean(np.abs(values))),
        "bringup/test_score.py",
    ),
    "no end from rims": Harm(
        "pipeprog_detect.silhouette.pipe_ends.find_end", lambda _: lambda *_, **__: None, "detect"
    ),
}


def main() -> None:
    """Try all harms."""
    rows = []
    for name, harm in HARMS.items():
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "benchmarks.harms", f"tests/unit/{harm.tests}"]
        done = subprocess.run(command, cwd=ROOT, env={**os.environ, "HARM": name}, capture_output=True, text=True)
        caught = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
        rows.append({"harm": name, "caught by": caught[1].rpartition("/")[2] if caught else "NOT CAUGHT"})
        print(f"{name}: {rows[-1]['caught by']}", flush=True)
    content = {"title": "Deliberate harms, and the tests that notice them", "rows": rows}
    (RESULTS / "harms.json").write_text(json.dumps(content, indent=1) + "\n")


def pytest_configure() -> None:
    """Put the harm in, before the tests are imported."""
    if name := os.environ.get("HARM"):
        module_name, _, attribute = HARMS[name].place.rpartition(".")
        module = importlib.import_module(module_name)
        setattr(module, attribute, HARMS[name].harmed(getattr(module, attribute)))


if __name__ == "__main__":
    main()
