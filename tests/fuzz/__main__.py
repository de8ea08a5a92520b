# SPDX-License-Identifier: Apache-2.0
"""Fuzzing: spoiled input for every reader, each input within limits of time and memory (`make fuzz`).

    .venv/bin/python -m tests.fuzz [TARGET ...] [--seconds 600] [--seed 1] [--record]
    .venv/bin/python -m tests.fuzz --repeat out/fuzz/FILE

A failure is an exception other than InputError, or the end of the process that reads. Its input, with as few bytes as
still fail, is kept in out/fuzz, and the command that repeats it is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.survey import RESULTS, commit
from tests.fuzz.attempts import MAX_BYTES, MAX_SECONDS, Outcome, Target, fuzz, read_limited
from tests.fuzz.targets import targets

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "out" / "fuzz"


def main() -> int:
    """Fuzz for a time, or repeat one failure; 1 where something fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"some of: {', '.join(targets())}")
    parser.add_argument("--seconds", type=float, default=600.0, help="for all targets together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--repeat", type=Path, metavar="FILE", help="read this input of an earlier failure again")
    parser.add_argument("--record", action="store_true", help="write benchmarks/results/hostile_fuzz_SEED.json")
    arguments = parser.parse_args()
    if arguments.repeat:
        problem = read_limited(targets()[_name_of(arguments.repeat)], arguments.repeat)
        print(problem or "passes")
        return bool(problem)
    outcomes = _fuzz_all(
        [targets()[name] for name in arguments.targets or targets()], arguments.seed, arguments.seconds
    )
    if arguments.record:
        _record(outcomes, arguments)
    failures = [(problem, path) for outcome in outcomes.values() for problem, path in outcome.failures.items()]
    for problem, path in failures:
        print(f"\n{problem}\n  repeat: .venv/bin/python -m tests.fuzz --repeat '{path.relative_to(ROOT)}'")
    print(f"\n{sum(one.tried for one in outcomes.values())} inputs, {len(failures)} failures")
    return bool(failures)


def _fuzz_all(chosen: list[Target], seed: int, seconds: float) -> dict[str, Outcome]:
    """Each target for its share of the time, as many at once as there are processors."""
    workers = min(os.cpu_count() or 1, len(chosen))
    share = seconds * workers / len(chosen)
    outcomes = {}
    with ThreadPoolExecutor(workers) as pool:
        done = pool.map(lambda target: fuzz(target, seed, share, FOLDER), chosen)
        for target, outcome in zip(chosen, done, strict=True):
            outcomes[target.name] = outcome
            print(
                f"{target.name:28} {outcome.tried:7d} inputs  {len(outcome.failures)} failures  "
                f"worst {outcome.worst_seconds:.2f} s, {outcome.worst_bytes >> 20} MiB",
                flush=True,
            )
    return outcomes


def _name_of(path: Path) -> str:
    """The target of a kept input: its file's name begins with it."""
    return path.stem.rpartition("-")[0].replace("_", " ")


def _record(outcomes: dict[str, Outcome], arguments: argparse.Namespace) -> None:
    failures = [{"name": name, "reason": problem} for name, outcome in outcomes.items() for problem in outcome.failures]
    content = {
        "what": f"make fuzz on seed {arguments.seed} for {arguments.seconds:.0f} s: {', '.join(outcomes)}",
        "command": f"python -m tests.fuzz --seconds {arguments.seconds:.0f} --seed {arguments.seed} --record",
        "commit": commit(),
        "tried": sum(outcome.tried for outcome in outcomes.values()),
        "failed": len(failures),
        "failures": failures,
        "limits": {"seconds": MAX_SECONDS, "bytes": MAX_BYTES},
        "worst_seconds": round(max(outcome.worst_seconds for outcome in outcomes.values()), 2),
        "worst_bytes": max(outcome.worst_bytes for outcome in outcomes.values()),
    }
    (RESULTS / f"hostile_fuzz_{arguments.seed}.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
