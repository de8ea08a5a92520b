# SPDX-License-Identifier: Apache-2.0
"""`pipeprog compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import AsJson
from pipeprog_bringup.commands.speech import say_json


def compare(
    folders: Annotated[
        list[Path],
        typer.Argument(
            help="Results of two surveys of one site, or of more. Example: `out/monday out/friday`",
            metavar="DIR DIR [DIR ...]",
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Tell what became of each pipe from survey to survey: kept, longer, shorter, new, gone, not seen.

    `pipeprog compare out/monday out/friday`
    """
    from pipeprog_bringup.comparison.comparison import as_json as rows
    from pipeprog_bringup.comparison.comparison import compare as run
    from pipeprog_bringup.console import print_steps
    from pipeprog_bringup.report.survey_reader import read_surveys
    from pipeprog_camera.errors import InputError

    if len(folders) < 2:
        raise InputError("pipeprog compare needs the results of at least two surveys: give two folders or more")
    steps = run([survey.results for survey in read_surveys(folders)])
    if as_json:
        say_json(rows(steps))
    else:
        print_steps(steps)
