# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from tests.fuzz import attempts
from tests.fuzz.attempts import Target, fuzz, read_limited


def make(rng: random.Random) -> bytes:
    return bytes(rng.randrange(256) for _ in range(40))


def read(path: Path) -> None:
    data = path.read_bytes()
    if data in (b"crash", b"memory"):
        bytearray(4 << 30) if data == b"memory" else os.abort()
    if 7 in data:
        raise ValueError("seven")
    raise InputError("not a seven")


TARGET = Target("sevens", ".bin", make, read)


def test_a_failure_is_kept_with_the_bytes_that_matter_and_repeats(tmp_path: Path) -> None:
    outcome = fuzz(TARGET, seed=1, seconds=0.5, kept=tmp_path)
    ((problem, path),) = outcome.failures.items()
    assert problem.startswith("ValueError at test_attempts.py:")
    assert path.read_bytes() == b"\x07"
    assert outcome.tried >= attempts.BATCH
    assert read_limited(TARGET, path) == problem


@pytest.mark.parametrize(("data", "said"), [(b"crash", "SIGABRT"), (b"memory", "MemoryError"), (b"fine", "")])
def test_the_end_of_a_process_is_a_failure_of_its_input(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "input.bin"
    path.write_bytes(data)
    problem = read_limited(TARGET, path)
    assert said in problem
    assert bool(said) == bool(problem)
