# SPDX-License-Identifier: Apache-2.0
"""Pipes of a survey that lies in the frame of an earlier one: each keeps its id for life."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.comparison.comparison import as_json, compare
from pipeprog_bringup.playback.survey_writer import complete_map
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_camera.errors import InputError
from pipeprog_detect.coverage.survey import views_of
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd, View
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map, write_map
from pipeprog_sfm.alignment.survey_map import MappedPipe, SurveyMap
from tests.unit.bringup.comparison.surveyed import survey
from tests.unit.detect.coverage.wall import CAMERA, poses, upright, wall_and_curtain


def mapped(frame: str, aligned_by: str, pipes: Sequence[MappedPipe] = ()) -> SurveyMap:
    """The map of a survey of one keyframe without features."""
    return SurveyMap(
        frame=frame,
        aligned_by=aligned_by,
        scale_sigma=0.001,
        stamps=np.array([1]),
        cameras=(CAMERA,),
        map_from_camera=np.eye(4)[None],
        offsets=np.array([0, 0]),
        pixels=np.empty((0, 2), np.float32),
        descriptors=np.empty((0, 128), np.uint8),
        point_of=np.empty(0, np.int64),
        points=np.empty((0, 3)),
        pipes=tuple(pipes),
    )


def known(life: str, cylinder: Cylinder) -> MappedPipe:
    return MappedPipe(life, "DN100", np.stack([cylinder.start, cylinder.end]), cylinder.radius, 0.004)


def measured(*cylinders: Cylinder) -> Product:
    end = PipeEnd(0.002, "free")
    pipes = [
        Pipe(f"p{k:02d}", c, 1e-4, "DN100", 1.0, 2.5, 1e-3, 900, "DN100", (end, end))
        for k, c in enumerate(cylinders, 1)
    ]
    return Product(pipes, [], [], 0.0004)


@pytest.fixture
def views() -> list[View]:
    return views_of([CAMERA] * len(poses()), poses(), wall_and_curtain())


def test_pipes_keep_their_ids_and_new_ones_get_the_next(tmp_path: Path, views: list[View]) -> None:
    """One is measured again, one is gone, one stands behind the curtain, one is new."""
    earlier = [known("p02", upright(0.0)), known("p04", upright(-0.6)), known("p07", upright(1.0))]
    write_map(tmp_path / MAP_FILE, mapped("1a", "places"))
    product = measured(upright(0.0), upright(0.3))
    lives = complete_map(tmp_path / MAP_FILE, product, views, mapped("1a", "", earlier))
    assert lives == {"p01": "p02", "p02": "p08"}
    # Whoever comes next knows of the one that nobody has seen since.
    assert [pipe.life for pipe in read_map(tmp_path / MAP_FILE).pipes] == ["p02", "p08", "p07"]


def test_a_survey_in_a_frame_of_its_own_begins_lives(tmp_path: Path, views: list[View]) -> None:
    write_map(tmp_path / MAP_FILE, mapped("1a", ""))
    assert complete_map(tmp_path / MAP_FILE, measured(upright(0.0)), views, mapped("2b", "")) is None
    assert [pipe.life for pipe in read_map(tmp_path / MAP_FILE).pipes] == ["p01"]
    assert complete_map(tmp_path / "absent.npz", measured(upright(0.0)), views, None) is None


def test_surveys_of_one_frame_are_compared_without_a_board(tmp_path: Path) -> None:
    earlier = survey(tmp_path / "a", 0, [upright(0.0)], source="odometry", boards=())
    later = survey(tmp_path / "b", 7, [upright(0.0), upright(0.3)], source="reference", boards=())
    write_map(earlier / MAP_FILE, mapped("1a", ""))
    for frame, aligned in (("1a", True), ("2b", False)):
        write_map(later / MAP_FILE, mapped(frame, "places"))
        results = [read_results(folder) for folder in (earlier, later)]
        if aligned:
            states = [row["state"] for row in as_json(compare(results))[0]["pipes"]]
            assert states == ["kept", "new"]
        else:
            with pytest.raises(InputError, match="replay it with --reference"):
                compare(results)
