# SPDX-License-Identifier: Apache-2.0
"""How well the keyframes tell an end: drawn evidence, and ray-cast images of free, hidden and cut ends."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.refinement import end_posterior as end_posterior_module
from pipeprog_detect.refinement.axial_evidence import AxialEvidence
from pipeprog_detect.refinement.end_posterior import EndPosterior, contour_odds, end_posterior
from pipeprog_detect.refinement.pipe_ends import SECTORS
from pipeprog_detect.types import Cylinder, View
from tests.unit.detect.pipe_and_wall import PIPE

# Rates of edges on a pipe and beside it, views, and the spacing of the contour samples [m].
ON, BESIDE, VIEWS, STEP = 0.4, 0.2, 3, 0.02


def drawn(true_end: float, shown: FloatArray, rng: np.random.Generator) -> AxialEvidence:
    """What the contour of a pipe tells that ends at `true_end` [m] beyond the given end; unseen where not `shown`."""
    along = np.arange(-0.3, 0.3, STEP, dtype=float) + 0.5 * STEP
    seen = np.where(shown, VIEWS, 0)
    hits = rng.binomial(seen, np.where(along < true_end, ON, BESIDE))
    odds = hits * np.log(ON / BESIDE) + (seen - hits) * np.log((1.0 - ON) / (1.0 - BESIDE))
    return AxialEvidence(along, odds.astype(float), seen.astype(float))


@pytest.mark.parametrize("hidden", [0.0, 0.2])
def test_the_spread_of_ends_is_the_stated_sigma(hidden: float) -> None:
    """Ends drawn evenly, with the contour hidden along a part: the mean squares agree as far as 2000 draws tell."""
    rng = np.random.default_rng(1)
    position = np.arange(-0.3, 0.3, 0.5 * STEP, dtype=float)
    shown = np.abs(np.arange(-0.3, 0.3, STEP) + 0.5 * STEP) >= 0.5 * hidden
    ends = rng.uniform(-0.3, 0.3, 2000)
    stated = [
        EndPosterior.of_odds(position, contour_odds(drawn(end, shown, rng), position), 0.0, True).sigma()
        for end in ends
    ]
    ratio = ends**2 - np.square(stated)
    assert abs(ratio.mean()) < 4.0 * ratio.std() / np.sqrt(len(ends))
    assert np.mean(np.abs(ends) < 3.0 * np.array(stated)) > 0.98


def test_what_lies_behind_a_wall_ends_at_it() -> None:
    position = np.arange(101, dtype=float) / 100.0
    flat = EndPosterior.of_odds(position, np.zeros(101), 1e-3, True)
    assert flat.sigma() == pytest.approx(np.sqrt(1.0 / 3.0), rel=0.01)
    assert flat.sigma(0.1) == pytest.approx(np.sqrt(0.9 * 0.01 + 0.1 * 0.01 / 3.0), rel=0.02)
    assert flat.sigma(0.0) == 1e-3


@pytest.mark.parametrize("at_end", [False, True])
@pytest.mark.parametrize("error", [-0.03, 0.0, 0.03])
def test_an_end_that_the_images_show_is_known_to_millimetres_and_a_wrong_one_says_so(
    pipe_views: list[View], at_end: bool, error: float
) -> None:
    start = PIPE.start - (0.0 if at_end else error) * PIPE.axis
    end = PIPE.end + (error if at_end else 0.0) * PIPE.axis
    sigma = end_posterior(Cylinder(start, end, PIPE.radius), at_end, pipe_views, []).sigma()
    assert abs(error) < 3.0 * sigma < 3.0 * abs(error) + 0.03


def test_what_is_hidden_or_out_of_view_may_go_on(pipe_views: list[View]) -> None:
    """A thick pipe across hides the end and 0.13 m behind it: the sigma is of that size."""
    assert end_posterior(PIPE, True, pipe_views, []).sigma() < 4e-3
    middle = PIPE.end + np.array([0.0, -0.25, 0.02])
    across = Cylinder(middle - np.array([0.6, 0.0, 0.0]), middle + np.array([0.6, 0.0, 0.0]), 0.05)
    assert 0.13 / 3.0 < end_posterior(PIPE, True, pipe_views, [across]).sigma() < 0.13
    far = Cylinder(PIPE.start, PIPE.start + 3.0 * PIPE.axis, PIPE.radius)
    nowhere = end_posterior(far, True, pipe_views, [])
    assert not nowhere.in_view
    assert nowhere.sigma() > 0.3


def test_an_edge_right_before_what_hides_the_rest_may_be_a_clamps(
    pipe_views: list[View], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pipe across hides 0.3 m behind an edge all around; behind that is the wall."""
    known = PIPE.cut(0.0, 0.5 * PIPE.length)
    middle = known.end + 0.12 * PIPE.axis + np.array([0.0, -0.25, 0.0])
    across = Cylinder(middle - np.array([0.6, 0.0, 0.0]), middle + np.array([0.6, 0.0, 0.0]), 0.12)

    def edge(barrel: Cylinder, along: FloatArray, *_: object) -> tuple[FloatArray, NDArray[np.bool_]]:
        strength = np.tile(0.9 * (np.abs(along) < 2e-3), (4 * SECTORS, 1)).astype(float)
        return strength, np.ones(strength.shape, bool)

    monkeypatch.setattr(end_posterior_module, "rim_strength", edge)
    assert end_posterior(known, True, pipe_views, [across]).sigma() > 0.3 / 6.0
    assert end_posterior(PIPE, True, pipe_views, []).sigma() < 4e-3, "where nothing hides the rest it is the end"


def test_an_end_on_a_wall_may_lie_anywhere_in_the_hidden_stretch_before_it(pipe_views: list[View]) -> None:
    """The pipe was continued by 0.3 m to a wall behind a pipe across; of that 0.21 m are hidden."""
    continued = Cylinder(PIPE.start, PIPE.end + 0.3 * PIPE.axis, PIPE.radius)
    middle = PIPE.end + 0.15 * PIPE.axis + np.array([0.0, -0.25, 0.02])
    across = Cylinder(middle - np.array([0.6, 0.0, 0.0]), middle + np.array([0.6, 0.0, 0.0]), 0.13)
    posterior = end_posterior(continued, True, pipe_views, [across])
    assert posterior.position[0] == pytest.approx(-0.21, abs=STEP)
    place = np.minimum(posterior.position, 0.0)
    hidden = posterior.probability[(posterior.position > -0.21 + STEP) & (place < 0.0)]
    assert hidden.min() == pytest.approx(hidden.max(), rel=0.1)
    assert posterior.sigma(0.0) == pytest.approx(np.sqrt(posterior.probability @ place**2), rel=0.05)
