# SPDX-License-Identifier: Apache-2.0
"""The recordings that the benchmarks measure: made once by the generator in bags/, kept in out/recordings."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "recordings"


@dataclass(frozen=True)
class Recording:
    """An mcap file with its truth, bill of quantities and board beside it; `made_by` is the command that makes it."""

    bag: Path
    made_by: str

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.bag.stem

    def beside(self, kind: str) -> Path:
        """The file NAME.kind, such as truth.json."""
        return self.bag.with_suffix(f".{kind}")


DEMO = Recording(ROOT / "bags" / "demo.mcap", "bags/make_site.py lab bags/demo.mcap --seed 7 --seconds 13 --quality 85")


def site(layout: str, seed: int, *options: str, folder: Path = FOLDER) -> Recording:
    """A generated site: `lab` or `field`, its seed, and further options of bags/make_site.py."""
    slug = "_".join(option.removeprefix("--").replace("=", "").replace(",", "+") for option in options)
    bag = folder / f"{'_'.join(filter(None, (layout, str(seed), slug)))}.mcap"
    command = ["bags/make_site.py", layout, str(bag.relative_to(ROOT)), "--seed", str(seed), *options, "--surface"]
    return Recording(bag, " ".join(command))


def named(text: str) -> Recording:
    """What the command lines call `demo`, `lab:SEED[:OPTION...]`, `field:SEED[:OPTION...]`, or the path of a bag."""
    kind, *rest = text.split(":")
    if kind == "demo":
        return DEMO
    if kind in ("lab", "field"):
        return site(kind, int(rest[0]), *(f"--{option}" for option in rest[1:]))
    return Recording(Path(text).resolve(), "")


def made(recording: Recording) -> Recording:
    """The recording, made now if it is not there; the generator shows its progress."""
    if not recording.bag.exists():
        arguments = recording.made_by.split()
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True)
    return recording


def one_recording(
    module: str, description: str | None, arguments: Sequence[str] | None = None
) -> tuple[Recording, str, str]:
    """The recording that a command line names (made if it is not there), its result's name, and the command to repeat.

    Args:
        module: name of the benchmark's module, such as `stage_cost`.
        description: its docstring.
        arguments: of the command line; the process's own where None.
    """
    command = f"python -m benchmarks.{module}"
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog=command, description=description, formatter_class=formatter)
    parser.add_argument("recording", nargs="?", default="demo")
    parser.add_argument("--name", default="", help="of the result; the recording's name where it is left out")
    given = parser.parse_args(arguments)
    recording = made(named(given.recording))
    shown = given.recording if recording.made_by else recording.bag.name
    return recording, given.name or recording.name, f"{command} {shown}"
