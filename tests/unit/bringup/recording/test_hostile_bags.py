# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeprog_camera.errors import InputError
from tests.fuzz.bag_reading import Reading, read
from tests.fuzz.hostile_bags import cases
from tests.fuzz.mutated_bags import mutated_bag

CASES = cases()
QUICK = [name for name, case in CASES.items() if case.quick]
LINE = 5000  # characters of an error that can still be read: 20 topics of 200 characters


def outcome(path: Path) -> Reading | str:
    """What was read, or the error in one line; anything else is a failure."""
    try:
        return read(path)
    except InputError as error:
        text = str(error)
        choices = "choose one with" in text
        assert choices or "\n" not in text, text
        assert len(text) < LINE, text[:LINE]
        assert text.isprintable() or choices, text
        assert path.name in text, text
        return text


@pytest.mark.parametrize("family", sorted({name.partition(":")[0] for name in QUICK}))
def test_hostile_recordings_are_read_or_refused_by_name(tmp_path: Path, family: str) -> None:
    for number, name in enumerate(name for name in QUICK if name.startswith(f"{family}:")):
        case = CASES[name]
        result = outcome(case.write(tmp_path / f"bag{number}"))
        if case.refused:
            assert isinstance(result, str), name
            assert re.search(case.refused, result), f"{name}: {result}"
        if case.usable is not None:
            assert isinstance(result, Reading), f"{name}: {result}"
            assert result.sent == case.usable, f"{name}: {result}"


def test_mutated_recordings_are_read_or_refused_by_name(tmp_path: Path) -> None:
    for seed in range(100):
        path = tmp_path / "bag.mcap"
        path.write_bytes(mutated_bag(seed))
        outcome(path)
