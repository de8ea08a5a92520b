# SPDX-License-Identifier: Apache-2.0
"""`pipeprog board`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeprog_bringup.commands.options import Force
from pipeprog_bringup.commands.speech import say


def board(
    boards: Annotated[
        Path, typer.Argument(help="Target boards (YAML). Example: `boards/a4.yaml`", metavar="BOARD.yaml")
    ],
    paper: Annotated[
        str,
        typer.Option(
            "--paper",
            help="A4, A3, A2, A1, A0, letter or tabloid. Example: `--paper A4`",
            metavar="SIZE",
            autocompletion=lambda: ["A4", "A3", "A2", "A1", "A0", "letter", "tabloid"],
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="The file to write. Example: `--out board.pdf`", metavar="BOARD.pdf")
    ],
    force: Force = False,
) -> None:
    """Write target boards and marks to print at true size, each with a ruler to check the print.

    `pipeprog board boards/a4.yaml --paper A4 --out board.pdf`
    """
    from pipeprog_bringup.results.atomic_output import output_file
    from pipeprog_sfm.boards.board_file import load_board_file
    from pipeprog_sfm.boards.board_print import board_pdf

    content = load_board_file(boards)
    pages = [*content.boards, *(disc for bar in content.scale_bars for disc in bar.discs)]
    document = board_pdf(pages, paper)
    with output_file(out, force) as file:
        file.write_bytes(document)
    say(f"{len(pages)} page{'s' * (len(pages) > 1)}, to be printed at 100 %: {out}")
