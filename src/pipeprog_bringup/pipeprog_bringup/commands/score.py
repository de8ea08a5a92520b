# SPDX-License-Identifier: Apache-2.0
"""`pipeprog score`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import AsJson
from pipeprog_bringup.commands.speech import say_json


def score(
    pipes: Annotated[
        Path, typer.Argument(help="pipes.json of a run, or its folder. Example: `out/demo`", metavar="DIR/pipes.json")
    ],
    truth: Annotated[Path, typer.Argument(help="Ground truth. Example: `bags/demo.truth.json`", metavar="TRUTH.json")],
    as_json: AsJson = False,
) -> None:
    """Compare a result with ground truth: found, classified, radius, length, scale, trajectory.

    `pipeprog score out/demo bags/demo.truth.json`
    """
    from pipeprog_bringup.console import print_score
    from pipeprog_bringup.results.scoring import score_files

    figures = score_files(pipes, truth)
    if as_json:
        say_json(figures)
    else:
        print_score(figures)
