# SPDX-License-Identifier: Apache-2.0
"""What commands say: results on stdout, notes and errors on stderr."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import typer

from pipeprog_camera.files.json_file import read_json
from pipeprog_camera.outside_text import for_terminal

_NAMED = 3  # of the largest files


def say(message: str) -> None:
    """A sentence about the result."""
    typer.echo(for_terminal(message))


def say_json(content: Any) -> None:
    """The result for a program; NaN and infinity, which JSON lacks, must not be in it."""
    typer.echo(json.dumps(content, indent=1, allow_nan=False))


def note(message: str) -> None:
    """What a user should know, although the command goes on."""
    typer.secho(for_terminal(f"Note: {message}"), fg=typer.colors.YELLOW, err=True)


def fail(message: str) -> None:
    """Why the command ends without a result."""
    typer.secho(for_terminal(f"Error: {message}"), fg=typer.colors.RED, err=True)


def say_results(folder: Path) -> None:
    """The results in a folder as one JSON object: those of pipes.json, the folder, the notes and losses of the run."""
    run = read_json(folder / "run.json")
    told = {key: run.get(key, []) for key in ("notes", "losses")}
    say_json({"folder": str(folder), **told, **read_json(folder / "pipes.json")})


def say_sizes(folder: Path) -> None:
    """How much the files of a run take, and the largest of them: `111.0 MB in out (cloud.las 47.1, ...)`."""
    names = read_json(folder / "run.json")["files"]
    found = sorted(((folder / name).stat().st_size, name) for name in names)
    largest = ", ".join(f"{name} {size / 1e6:.1f}" for size, name in found[: -_NAMED - 1 : -1])
    say(f"{sum(size for size, _ in found) / 1e6:.1f} MB in {folder} ({largest})")
