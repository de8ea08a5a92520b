# SPDX-License-Identifier: Apache-2.0
"""The gate: a fixed small set of recordings through the graph, held against the bounds in bounds.yaml."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks.recordings import DEMO, Recording, made, site
from benchmarks.survey import line, measure

BOUNDS = yaml.safe_load((Path(__file__).parent / "bounds.yaml").read_text())
# The demo, and two more layouts at the size of a robot's camera.
RECORDINGS = (DEMO, site("lab", 21, "--size=480p"), site("lab", 22, "--size=480p"))

# Every lab has five pipes wider than this [m], and one of 8.6 mm.
WIDE, WIDE_PIPES = 0.03, 5


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, float]:
    """The recordings' figures taken together, named as in bounds.yaml."""
    surveys = [_survey(recording, tmp_path_factory.mktemp(recording.name)) for recording in RECORDINGS]
    scores = [survey["score"] for survey in surveys]
    pipes = [pipe for score in scores for pipe in score["pipes"]]
    sigmas = [survey["radius_sigmas"][pipe["id"]] for survey in surveys for pipe in survey["score"]["pipes"]]
    radius_errors = np.array([pipe["radius_error_mm"] for pipe in pipes])
    true, false, missed = (
        sum(score["detection"][kind] for score in scores)
        for kind in ("true_positives", "false_positives", "false_negatives")
    )
    return {
        "f_measure": 2 * true / (2 * true + false + missed),
        "wide_pipes_found": sum(pipe["true_radius"] > WIDE for pipe in pipes) / (WIDE_PIPES * len(RECORDINGS)),
        "right_class": sum(score["classification"]["true_positives"] for score in scores) / true,
        "radius_rmse_mm": float(np.sqrt(np.mean(radius_errors**2))),
        "radius_worst_mm": float(np.abs(radius_errors).max()),
        "length_mean_percent": _length_error(pipes),
        "wide_length_mean_percent": _length_error([pipe for pipe in pipes if pipe["true_radius"] > WIDE]),
        "scale_percent": max(abs(score["scale"]["error_percent"]) for score in scores),
        "camera_rms_mm": max(score["trajectory"]["rms_rigid_mm"] for score in scores),
        "sigma_chi_square": float(np.mean((radius_errors / (1e3 * np.array(sigmas))) ** 2)),
    }


def _length_error(pipes: Sequence[dict[str, Any]]) -> float:
    return float(np.mean([abs(pipe["length_error_percent"]) for pipe in pipes]))


def _survey(recording: Recording, out: Path) -> dict[str, Any]:
    survey = measure(made(recording), (), out)
    print(line(recording.name, survey))
    return survey


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", BOUNDS)
def test_figure_is_within_its_bound(figures: dict[str, float], name: str) -> None:
    bound, value = BOUNDS[name], figures[name]
    print(f"{name}: {value:.4g}, bound {bound}")
    assert bound.get("at_least", -np.inf) <= value <= bound.get("at_most", np.inf), bound["reason"]
