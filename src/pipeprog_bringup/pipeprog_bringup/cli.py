# SPDX-License-Identifier: Apache-2.0
"""The command `pipeprog`: its commands are in `commands`, one a module.

Modules that take long to import are imported inside the commands, so that --help answers at once.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Annotated

import click
import typer

from pipeprog_bringup.commands.board import board
from pipeprog_bringup.commands.calibrate import calibrate
from pipeprog_bringup.commands.check import check
from pipeprog_bringup.commands.compare import compare
from pipeprog_bringup.commands.detect import detect
from pipeprog_bringup.commands.export import export
from pipeprog_bringup.commands.fleet import fleet
from pipeprog_bringup.commands.ingest import ingest
from pipeprog_bringup.commands.patrol import patrol
from pipeprog_bringup.commands.policy import policy
from pipeprog_bringup.commands.replay import replay
from pipeprog_bringup.commands.report import report
from pipeprog_bringup.commands.score import score
from pipeprog_bringup.commands.simulate_patrol import simulate_patrol
from pipeprog_bringup.commands.speech import fail
from pipeprog_bringup.commands.view import view
from pipeprog_bringup.playback.interruption import repeated_signals

_INTERRUPTED = 130  # exit status after Ctrl-C, as shells have it
_KEEPING = {"patrol", "simulate-patrol"}  # commands that cancel a survey after Ctrl-C, which leaves its folder

app = typer.Typer(
    name="pipeprog",
    help="From video of a construction site to the metres of each planned pipe class that are installed.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)
for panel, commands in {
    "From recordings": (check, replay, fleet, detect),
    "On a robot": (patrol, simulate_patrol, policy),
    "To recordings": (ingest, board, calibrate),
    "From results": (score, report, compare, view, export),
}.items():
    for command in commands:
        app.command(rich_help_panel=panel)(command)


@app.callback(invoke_without_command=True)
def options(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    """Options of the command itself."""
    if version:
        from importlib import metadata

        typer.echo(f"pipeprog {metadata.version('pipeprog')}")
        raise typer.Exit


def main() -> None:
    """Entry point: exit 0 when done, 1 after a clear error, 2 after wrong usage, 130 after Ctrl-C."""
    from pipeprog_bringup.playback.node_processes import NodeFailure
    from pipeprog_camera.errors import InputError
    from pipeprog_camera.files.user_folders import provide_user_folders

    # As for Ctrl-C, what was started is ended and what was half written is removed.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        with repeated_signals():
            provide_user_folders()
            code = app(prog_name="pipeprog", standalone_mode=False)
    except (InputError, NodeFailure) as error:
        fail(str(error))
        sys.exit(1)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        from typer.rich_utils import rich_format_error

        rich_format_error(error)
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        code = _INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has left (`pipeprog ... | head`).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        fail(f"{error.filename or 'input or output'}: {error.strerror or error}")
        sys.exit(1)
    if code == _INTERRUPTED:  # typer makes an exit status of Ctrl-C
        is_kept = not _KEEPING.isdisjoint(sys.argv[1:2])
        left = "what there is of the survey was kept" if is_kept else "nothing was written"
        typer.secho(f"Interrupted: {left}.", fg=typer.colors.YELLOW, err=True)
    sys.exit(code or 0)


if __name__ == "__main__":
    main()
