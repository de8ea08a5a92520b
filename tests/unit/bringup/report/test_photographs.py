# SPDX-License-Identifier: Apache-2.0
"""Photographs of pipes, from keyframes of an upright camera and of one that is mounted on its side."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeprog_bringup.report.photographs import best_views, outline, photographs, sight
from pipeprog_bringup.results.results_reader import read_results
from pipeprog_camera.rolling_shutter import RowMotion
from tests.unit.bringup.report.filmed import CAMERA, PAINT, UPRIGHT, looking_along_y, run

END = 8  # px; an end is a circle of 12 px that is seen at up to 17 degrees, and the line has 4 px


@pytest.mark.parametrize("roll", [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi])
def test_a_photograph_shows_its_pipe_upright_and_outlined(tmp_path: Path, roll: float) -> None:
    results = read_results(run(tmp_path, [looking_along_y(0.0, roll), looking_along_y(0.9, roll)]))
    found, why = photographs(results, np.empty((0, 3)), [(1.0, 1.0, 0.0)] * 2)
    assert why == ""
    for number, proofs in enumerate(found):
        first = proofs[0]
        image = np.asarray(cv2.imdecode(np.frombuffer(first.jpeg, np.uint8), cv2.IMREAD_COLOR)).astype(int)
        assert image.shape[:2] == (first.height, first.width)
        rows, columns = np.nonzero(np.abs(image - PAINT[number]).max(axis=2) < 60)
        assert len(rows) > 400
        assert (np.ptp(rows) > 4 * np.ptp(columns)) == (number == 0), "what stands in the map stands in the picture"
        yellow = (image[..., 0] < 120) & (image[..., 1] > 170) & (image[..., 2] > 170)
        outlined = np.nonzero(yellow)
        assert len(outlined[0]) > 100
        for painted_at, drawn_at in ((rows, outlined[0]), (columns, outlined[1])):
            assert abs(painted_at.min() - drawn_at.min()) <= END
            assert abs(painted_at.max() - drawn_at.max()) <= END
        assert (first.keyframe, first.share) == (1, 1.0)


def test_outlines_follow_the_rows_of_a_rolling_shutter(tmp_path: Path) -> None:
    """Read out in 0.1 s at 3 m/s, an upright pipe leans by 40 px, and its outline with it."""
    motion = RowMotion(0.1, CAMERA.height, np.array([3.0, 0.0, 0.0]), np.zeros(3))
    results = read_results(run(tmp_path, [looking_along_y(0.0)], motion))
    proof = photographs(results, np.empty((0, 3)), [(1.0, 1.0, 0.0)] * 2)[0][0][0]
    image = np.asarray(cv2.imdecode(np.frombuffer(proof.jpeg, np.uint8), cv2.IMREAD_COLOR)).astype(int)
    painted = np.abs(image - PAINT[0]).max(axis=2) < 60
    outlined = (image[..., 0] < 120) & (image[..., 1] > 170) & (image[..., 2] > 170)
    rows = np.flatnonzero(painted.any(axis=1))[10:-10]
    middles = np.array([[np.flatnonzero(part[row]).mean() for part in (painted, outlined)] for row in rows])
    assert np.ptp(middles[:, 0]) > 25
    np.testing.assert_allclose(middles[:, 1], middles[:, 0], atol=3)


def test_the_whole_pipe_comes_before_a_part_and_what_hides_it_counts() -> None:
    views = [(CAMERA, looking_along_y(x)) for x in (0.0, 1.8, 0.7)]
    wall = np.random.default_rng(0).uniform([-0.3, 1.0, -0.1], [0.3, 1.01, 0.1], (20_000, 3))
    free, hidden = (sight(views, [UPRIGHT], points) for points in (np.empty((0, 3)), wall))
    assert free.seen[0, 0].all()
    assert not free.seen[1, 0].any(), "beside the image"
    assert hidden.seen[0, 0].mean() == pytest.approx(0.54, abs=0.07), (
        "0.4 m and up to two cells of 16 px, 0.13 m, are hidden"
    )
    assert best_views(free.seen[:, 0], free.size[:, 0], free.direction[:, 0])[0] in (0, 2)
    assert best_views(hidden.seen[:, 0], hidden.size[:, 0], hidden.direction[:, 0])[0] == 2
    assert best_views(free.seen[1:2, 0], free.size[1:2, 0], free.direction[1:2, 0]) == []


def test_no_outline_from_inside_a_pipe() -> None:
    assert len(outline(UPRIGHT, UPRIGHT.at(np.array([0.5]))[0])) == 0


def test_without_keyframes_the_reason_is_told(tmp_path: Path) -> None:
    folder = run(tmp_path, [looking_along_y(0.0)])
    (folder / "out.mcap").write_bytes(b"torn")
    assert "not an mcap file" in photographs(read_results(folder), np.empty((0, 3)), [(1, 1, 0)] * 2)[1]
    (folder / "out.mcap").unlink()
    assert photographs(read_results(folder), np.empty((0, 3)), [(1, 1, 0)] * 2) == (
        [[], []],
        "This run has kept no keyframes (out.mcap, trajectory.tum)",
    )
