# SPDX-License-Identifier: Apache-2.0
"""Recordings that are damaged at random or made to break a reader: read or refused, in seconds and little memory.

    .venv/bin/python -m benchmarks.hostile_bags [--mutated 2000] [--replays]

Each is read as a replay reads it, up to the doors of the nodes, in a child process that is watched; with --replays the
nastiest go through `pipeprog replay` as well. Writes results/hostile_bags.json, or results/hostile_replays.json.
"""

from __future__ import annotations

import argparse
import json
import resource
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.recordings import ROOT
from benchmarks.survey import COMMAND, RESULTS, commit
from tests.fuzz.hostile_bags import cases
from tests.fuzz.mutated_bags import mutated_bag

SECONDS = 20.0
BYTES = 2 << 30
REPLAY_SECONDS = 120.0  # the nodes take 10 to start, on a busy machine up to 90
REPLAYED = (
    "bombs: a good recording before a bomb",
    "bombs: zstd of 6 GiB that declares 6442450944",
    "pictures: one PNG of 100000 x 100000",
    "pictures: one JPEG of 3000 scans",
    "resolutions: changed with its CameraInfo",
    "resolutions: changed without its CameraInfo",
    "calibrations: one of focal length nan",
    "times: one stamp of 2147483647 s + 999999999 ns",
    "times: all stamps of 2147483647 s + 0 ns",
    "image_messages: 4294967295 at byte 32",
    "motions: TF that claims 50 million transforms",
    "motions: Odometry of noise",
)


@dataclass(frozen=True)
class Measured:
    """One recording: time [s], peak of resident memory [bytes], failure (empty: none), whether it was refused."""

    seconds: float
    bytes: int
    failure: str
    refused: bool


@dataclass
class Tally:
    """What became of the recordings."""

    seconds: float  # limits
    bytes: int
    tried: int = 0
    refused: int = 0
    failures: list[dict[str, str]] = field(default_factory=list)
    worst: dict[str, tuple[float, str]] = field(default_factory=lambda: {"seconds": (0.0, ""), "bytes": (0.0, "")})

    def add(self, name: str, measured: Measured) -> None:
        """One recording was read, refused, or failed."""
        self.tried += 1
        self.refused += measured.refused
        self.worst["seconds"] = max(self.worst["seconds"], (measured.seconds, name))
        self.worst["bytes"] = max(self.worst["bytes"], (measured.bytes, name))
        failure = measured.failure
        if measured.seconds > self.seconds:
            failure = failure or f"{measured.seconds:.0f} s"
        if measured.bytes > self.bytes:
            failure = failure or f"{measured.bytes >> 20} MiB"
        if failure:
            self.failures.append({"name": name, "reason": failure})
            print(f"{name}: {failure}", flush=True)

    def document(self, what: str) -> dict[str, Any]:
        """The content of the JSON file."""
        return {
            "what": what,
            "commit": commit(),
            "tried": self.tried,
            "refused": self.refused,
            "failed": len(self.failures),
            "failures": self.failures,
            "limits": {"seconds": self.seconds, "bytes": self.bytes},
            "worst_seconds": round(self.worst["seconds"][0], 2),
            "worst_seconds_name": self.worst["seconds"][1],
            "worst_bytes": int(self.worst["bytes"][0]),
            "worst_bytes_name": self.worst["bytes"][1],
        }


class Reader:
    """A child process that reads one recording after another; another one takes over where it ends."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, path: Path) -> Measured:
        """What became of one recording."""
        process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        started = time.monotonic()
        print(path, file=process.stdin, flush=True)
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            answered = bool(selector.select(3 * SECONDS))
        line = process.stdout.readline() if answered else ""
        seconds = time.monotonic() - started
        if not line:
            self.close()
            how = "ended" if answered else "did not end"
            return Measured(seconds, 0, f"its reader {how}", refused=False)
        return Measured(seconds, **json.loads(line))

    def close(self) -> None:
        """End the child."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _start(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "benchmarks.hostile_bags", "--reader"]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self._process.stdout.readline()  # its imports are done
        return self._process


def answer() -> None:
    """The reader's side: a path a line in, an answer a line out."""
    from pipeprog_camera.errors import InputError
    from tests.fuzz.bag_reading import read

    print("ready", flush=True)
    for line in sys.stdin:
        Path("/proc/self/clear_refs").write_text("5")  # the peak of resident memory begins anew
        failure, refused = "", False
        try:
            read(Path(line.rstrip("\n")))
        except InputError:
            refused = True
        except Exception as error:  # what it fails with is the result
            failure = f"{type(error).__name__}: {error}"[:200]
        peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) << 10
        print(json.dumps({"bytes": peak, "failure": failure, "refused": refused}), flush=True)


def recordings(folder: Path, mutated: int) -> Iterator[tuple[str, Path]]:
    """Name and path of each; the file is there until the next one is asked for."""
    for number, (name, case) in enumerate(cases().items()):
        yield name, case.write(folder / f"built{number}")
    path = folder / "mutated.mcap"
    for seed in range(mutated):
        path.write_bytes(mutated_bag(seed))
        yield f"mutated, seed {seed}", path


def replay(path: Path, folder: Path) -> Measured:
    """A whole replay; it fails where it neither gives results nor says what is wrong with the recording."""
    started = time.monotonic()
    boq = ROOT / "bags" / "demo.boq.yaml"
    command = [str(COMMAND), "replay", str(path), "--boq", str(boq), "--out", str(folder / "out"), "--force"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    said = " ".join((ended.stderr + ended.stdout).split())
    print(f"{path.name}: {said[-300:]}", flush=True)
    of_its_own = any(words in said for words in ("Traceback", "the node ", "waited ", "nothing has moved"))
    failed = of_its_own or ended.returncode not in (0, 1)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss << 10
    return Measured(time.monotonic() - started, peak, said[-200:] if failed else "", ended.returncode == 1)


def main() -> None:
    """Read all, or replay the nastiest, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutated", type=int, default=2000)
    parser.add_argument("--replays", action="store_true", help="a full replay of the nastiest instead")
    parser.add_argument("--reader", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.reader:
        answer()
        return
    tally = Tally(REPLAY_SECONDS if arguments.replays else SECONDS, BYTES)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if arguments.replays:
            known = cases()
            for number, name in enumerate(REPLAYED):
                tally.add(name, replay(known[name].write(folder / f"{number}.mcap"), folder))
        else:
            reader = Reader()
            for name, path in recordings(folder, arguments.mutated):
                tally.add(name, reader.read(path))
            reader.close()
    replayed = f"{len(REPLAYED)} of the recordings built by hand, each through `pipeprog replay`"
    read = f"recordings: {len(cases())} built by hand, {arguments.mutated} mutated, read up to the nodes' doors"
    file = RESULTS / ("hostile_replays.json" if arguments.replays else "hostile_bags.json")
    file.write_text(json.dumps(tally.document(replayed if arguments.replays else read), indent=1) + "\n")


if __name__ == "__main__":
    main()
