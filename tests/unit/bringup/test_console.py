# SPDX-License-Identifier: Apache-2.0
"""Tables of the command with names from outside: neither markup nor control characters have an effect."""

from __future__ import annotations

import numpy as np
import pytest

from pipeprog_bringup.console import print_progress, print_score
from pipeprog_bringup.results.scored_files import Result, Segment, Truth
from pipeprog_bringup.results.scoring import score
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product

NAMES = ["[/red]x", "[red]x", "[link=file:///]x", "$x$", ":smile:"]


@pytest.mark.parametrize("name", NAMES)
def test_progress_shows_names_as_they_are(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    print_progress(Product([], [ClassProgress(name, 0.05, 2.0, 1.0, 50.0)], []))
    assert name in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_scores_show_names_as_they_are(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = Segment(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.05, 1.0, name, name)
    far = Segment(np.full(3, 9.0), np.full(3, 8.0), 0.05, 1.7, name, name)
    print_score(score(Result((pipe, far), {name: 0.05}), Truth((pipe,), (), np.empty((0, 4, 4)))))
    out = capsys.readouterr().out
    assert f"false: {name}" in out
    assert f"metres of {name}" in out


def test_no_escape_sequence_reaches_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    print_progress(Product([], [ClassProgress("a\x1b[2Jb\x9bc\ud800", 0.05, 2.0, 1.0, 50.0)], []))
    out = capsys.readouterr().out
    assert r"a\x1b[2Jb\x9bc\ud800" in out
    assert "\x1b" not in out
