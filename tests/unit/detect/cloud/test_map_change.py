# SPDX-License-Identifier: Apache-2.0
"""What a map shows that the one before did not, and the detector that seeks only there."""

from unittest.mock import patch

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_detect.cloud import axis_voting
from pipeprog_detect.cloud.map_change import MapChange
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.product.boq import BillOfQuantities, PipeClass
from pipeprog_detect.types import Cloud, Cylinder
from pipeprog_detect.verification.measurement_cache import MeasurementCache

BOQ = BillOfQuantities(tuple(PipeClass(f"{1e3 * r:g}", r, 4.0, (1.0, 0.0, 0.0), 0.01 * r) for r in (0.0365, 0.0575)))
NOISE = 2e-3
DENSITY = 40_000  # points a square metre


def wall(start: float, end: float, seed: int = 0) -> np.ndarray:
    """A wall at y = 0, 1 m high."""
    rng = np.random.default_rng(seed)
    count = int(DENSITY * (end - start))
    return rng.uniform((start, 0, 0), (end, 0, 1), (count, 3)) + rng.normal(0.0, NOISE, (count, 3))


def pipe(place: float, radius: float = 0.0365, high: float = 0.9) -> tuple[Cylinder, np.ndarray]:
    """An upright pipe before the wall, and the points of its front."""
    rng = np.random.default_rng(int(1000 * place))
    cylinder = Cylinder(np.array([place, -0.1, 0.1]), np.array([place, -0.1, high]), radius)
    count = int(DENSITY * 2.6 * radius * cylinder.length)
    angle = rng.uniform(-1.3, 1.3, count)
    points = cylinder.start + np.stack(
        [radius * np.sin(angle), -radius * np.cos(angle), rng.uniform(0, cylinder.length, count)], axis=1
    )
    return cylinder, points + rng.normal(0.0, NOISE, points.shape)


@settings(max_examples=10, deadline=None)
@given(st.tuples(*[st.floats(-0.02, 0.02)] * 3), st.integers(0, 99))
def test_a_map_that_an_adjustment_moved_is_no_news(shift: tuple[float, float, float], seed: int) -> None:
    novelty = MapChange()
    assert novelty.fresh(wall(0, 1)).all()
    assert not novelty.fresh(wall(0, 1, seed) + shift).any()


def test_news_are_what_is_new_and_what_is_near_it() -> None:
    novelty = MapChange()
    novelty.fresh(wall(0, 1))
    points = np.concatenate([wall(0, 1), wall(1, 1.5, 1)])
    news = novelty.fresh(points)
    assert news[points[:, 0] > 1.0].all()
    assert not news[points[:, 0] < 0.4].any()


def test_a_place_that_is_seen_better_is_news() -> None:
    novelty = MapChange()
    novelty.fresh(wall(0, 1)[::2])
    assert novelty.fresh(wall(0, 1)).all()


def found(cloud: np.ndarray, memory: MeasurementCache) -> list[Cylinder]:
    return [pipe.cylinder for pipe in detect(Cloud(cloud), BOQ, DetectConfig(), memory=memory)]


def near(cylinder: Cylinder, truth: Cylinder) -> bool:
    ends = min(np.abs(cylinder.start - truth.start).max(), np.abs(cylinder.start - truth.end).max())
    return ends < 0.02 and abs(cylinder.length - truth.length) < 0.03 and abs(cylinder.radius - truth.radius) < 1e-3


def test_pipes_of_a_growing_map_are_those_of_the_whole() -> None:
    """Known pipes stay, new ones come, one that grows is grown, one that is gone goes; the old is not sought again."""
    memory = MeasurementCache()
    (first, first_points), (half, half_points), (whole, whole_points) = pipe(0.3), pipe(0.7, high=0.5), pipe(0.7)
    assert all(map(near, found(np.concatenate([wall(0, 1), first_points, half_points]), memory), (first, half)))
    last, last_points = pipe(1.5, 0.0575)
    grown = np.concatenate([wall(0, 2), first_points, whole_points, last_points])
    cylinders = found(grown, memory)
    assert len(cylinders) == 3
    assert all(map(near, cylinders, (first, whole, last)))
    with patch.object(axis_voting, "patch_votes", side_effect=AssertionError("nothing is new")):
        again = found(grown, memory)
    assert all(near(one, other) for one, other in zip(again, cylinders, strict=True))
    gone = found(np.concatenate([wall(0, 2), whole_points, last_points]), memory)
    assert len(gone) == 2
    assert all(map(near, gone, (whole, last)))
