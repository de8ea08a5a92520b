# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pkgutil

import pytest

from benchmarks.mutation_testing import MUTANTS, Mutant, apply
from benchmarks.recordings import ROOT


@pytest.mark.parametrize("mutant", MUTANTS.values(), ids=list(MUTANTS))
def test_every_mutant_finds_its_place_and_its_tests(mutant: Mutant) -> None:
    """So that no rename leaves a mutant without effect."""
    function = pkgutil.resolve_name(mutant.place)
    original = function.__code__
    try:
        apply(mutant)
        assert function.__code__ != original
    finally:
        function.__code__ = original
    assert (ROOT / "tests" / "unit" / mutant.tests).exists()


def test_the_mutants_are_of_all_packages() -> None:
    packages = {mutant.place.split(".")[0] for mutant in MUTANTS.values()}
    assert packages >= {f"pipeprog_{name}" for name in ("frames", "sfm", "detect", "node", "bringup")}
    assert len(MUTANTS) >= 20


def test_a_mutant_whose_text_is_gone_is_an_error() -> None:
    mutant = next(iter(MUTANTS.values()))
    with pytest.raises(ValueError, match="0 times"):
        apply(Mutant(mutant.place, "no such text", "", ""))
