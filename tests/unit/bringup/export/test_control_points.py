# SPDX-License-Identifier: Apache-2.0
"""Control points: results in site coordinates, and a wrong point is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from pipeprog_bringup.commands.export import export as command
from pipeprog_bringup.export.control_points import ControlPoint, ControlPointFile, align, load_control_points
from pipeprog_bringup.export.formats import export, site_alignment
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError
from pipeprog_camera.similarity import similarity
from tests.unit.bringup.report.filmed import CAMERA, LEVEL, looking_along_y, run

PLACES = np.array([[0.0, 0, 0], [9.0, 0.5, 0.2], [8.5, 6.0, 1.5], [0.5, 5.5, 2.8]])  # corners of a room, in the map
SITE_FROM_MAP = np.eye(4)
SITE_FROM_MAP[:3, :3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.7]).as_matrix()
SITE_FROM_MAP[:3, 3] = [691_234.5, 5_334_567.25, 512.125]


def on_site(points: FloatArray) -> FloatArray:
    return np.asarray(points @ SITE_FROM_MAP[:3, :3].T + SITE_FROM_MAP[:3, 3])


def points_at(xyz: FloatArray) -> ControlPointFile:
    return ControlPointFile(tuple(ControlPoint(f"P{k}", place, circle="A/1") for k, place in enumerate(xyz, 1)))


@pytest.mark.parametrize("seed", range(20))
def test_four_points_with_noise_of_2_mm_place_the_results_within_3_mm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = align(points_at(on_site(PLACES) + rng.normal(0, 0.002, (4, 3))), PLACES)
    inside = rng.uniform(PLACES.min(axis=0), PLACES.max(axis=0), (200, 3))
    errors = np.linalg.norm(found.site.place(inside) - on_site(inside), axis=1)
    assert np.sqrt((errors**2).mean()) <= 0.003
    assert found.residuals.max() < 0.01
    assert found.scale == pytest.approx(1.0, abs=0.001)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("wrong", range(4))
def test_a_wrong_point_is_named(seed: int, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = on_site(PLACES) + rng.normal(0, 0.002, (4, 3))
    xyz[wrong] += 0.06 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8]])[seed % 4]
    with pytest.raises(InputError, match=f"^control point 'P{wrong + 1}'"):
        align(points_at(xyz), PLACES)


def four_points(rng: np.random.Generator, error: float) -> tuple[ControlPointFile, FloatArray, str]:
    """Points of a room with noise of 2 mm, 1 m apart, one `error` m wrong; places in the map, name of the wrong one."""
    while True:
        places = rng.uniform([0.0, 0.0, 0.0], [6.0, 4.0, 2.5], (4, 3))
        gaps = np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(4, 1)]
        if gaps.min() > 1.0 and np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] > 0.5:
            break
    direction = rng.normal(size=3)
    wrong = int(rng.integers(4))
    xyz = on_site(places) + rng.normal(0, 0.002, (4, 3))
    xyz[wrong] += error * direction / np.linalg.norm(direction)
    return points_at(xyz), places, f"P{wrong + 1}"


def test_of_four_points_one_that_is_50_mm_wrong_is_refused_though_the_fit_of_all_hides_it() -> None:
    rng = np.random.default_rng(0)
    hidden, alone = 0, 0
    for _ in range(200):
        points, places, name = four_points(rng, 0.05)
        xyz = np.array([point.xyz for point in points.points])
        fit = similarity(places, xyz, scaled=False)
        hidden += np.linalg.norm(places @ fit[:3, :3].T + fit[:3, 3] - xyz, axis=1).max() < 0.015
        with pytest.raises(InputError, match=f"^control point .*'{name}'") as caught:
            align(points, places)
        alone += str(caught.value).startswith(f"control point '{name}' lies")
    assert hidden > 10
    assert alone > 180


def test_right_points_are_not_refused() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        points, places, _ = four_points(rng, 0.0)
        align(points, places)


def test_where_two_points_may_be_the_wrong_one_both_are_named() -> None:
    """Four corners of a floor: whichever one is left out, the other three fit at any height."""
    floor = np.array([[0.0, 0, 0], [5.0, 0, 0], [5.0, 4.0, 0], [0.0, 4.0, 0]])
    xyz = on_site(floor)
    xyz[2, 2] += 0.05
    with pytest.raises(
        InputError, match=r"^control point ('P[1-4]'( or )?){4} is wrong, without which the others agree"
    ):
        align(points_at(xyz), floor)


def test_a_point_beside_a_line_of_others_is_named_without_a_distance() -> None:
    places = np.array([[0.0, 0, 0], [3.0, 0.01, 0], [6.0, 0, 0], [3.0, 3.0, 1.0]])
    xyz = on_site(places)
    xyz[3] += 0.2 * SITE_FROM_MAP[:3, 0]
    with pytest.raises(InputError, match="control point 'P4' is wrong, without which the others agree"):
        align(points_at(xyz), places)


SWAPPED = "easting and northing are swapped"
MIRRORED = f"{SWAPPED}, or one of them has the wrong sign"


@pytest.mark.parametrize("count", [3, 4])
@pytest.mark.parametrize(
    ("order", "signs", "told"),
    [
        ([1, 0, 2], [1, 1, 1], MIRRORED),
        ([0, 1, 2], [-1, 1, 1], MIRRORED),
        ([1, 0, 2], [1, 1, -1], f"{SWAPPED}, and the heights have the wrong sign"),
        ([0, 1, 2], [1, 1, -1], "the heights have the wrong sign"),
    ],
)
def test_axes_that_are_swapped_or_mirrored_are_told_and_no_point_is_blamed(
    count: int, order: list[int], signs: list[int], told: str
) -> None:
    with pytest.raises(InputError, match=f"where {told}:"):
        align(points_at(on_site(PLACES)[:count, order] * signs), PLACES[:count])


def test_of_points_on_a_floor_swapped_axes_are_told_and_do_not_turn_the_map_upside_down() -> None:
    floor = PLACES * [1.0, 1.0, 0.0]
    with pytest.raises(InputError, match=f"where {MIRRORED}:"):
        align(points_at(on_site(floor)[:, [1, 0, 2]]), floor)


def test_of_three_points_those_further_off_than_three_times_the_noise_are_warned_of() -> None:
    xyz = on_site(PLACES)[:3]
    assert align(points_at(xyz), PLACES[:3]).warning == ""
    away = xyz[1] - xyz[0]
    xyz[1] += 0.02 * away / np.linalg.norm(away)
    warning = align(points_at(xyz), PLACES[:3]).warning
    assert "further off than 9 mm" in warning
    assert "a fourth point would tell which is wrong" in warning


def test_swapped_points_and_three_wrong_ones_are_told_with_their_distances() -> None:
    xyz = on_site(PLACES)
    with pytest.raises(InputError, match=r"do not agree with the map \(P1 \d+ mm, P2 \d+ mm"):
        align(points_at(xyz[[1, 0, 2, 3]]), PLACES)
    with pytest.raises(InputError, match="add points until the wrong one shows"):
        align(points_at(xyz[:3] + np.diag([0.0, 0.5, 0.0])), PLACES[:3])


def test_points_in_line_are_refused() -> None:
    line = np.outer([0.0, 1, 2, 3], [1.0, 2, 0.5])
    with pytest.raises(InputError, match="nearly in line"):
        align(points_at(on_site(line)), line)


def written(folder: Path, content: object) -> Path:
    path = folder / "points.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def seen(place: FloatArray, pose: FloatArray) -> list[float]:
    """The pixel at which a camera sees a point."""
    x, y, z = pose[:3, :3].T @ (place - pose[:3, 3])
    ideal = [[CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy]]
    return [float(value) for value in CAMERA.distort_points(ideal)[0]]


POSES = [looking_along_y(x) for x in (-0.4, 0.0, 0.5)]


def clicked() -> tuple[FloatArray, list[dict[str, Any]]]:
    """Four places in the map, and the points of a file that shows them by pixels of all keyframes of POSES."""
    places = np.array([[-0.5, 2.0, -0.4], [0.6, 2.2, -0.3], [0.5, 1.9, 0.5], [-0.4, 2.1, 0.4]])
    points = [
        {
            "name": f"P{k}",
            "pixel": [[number, *seen(place, pose)] for number, pose in enumerate(POSES, 1)],
            "xyz": on_site(place[None])[0].tolist(),
        }
        for k, place in enumerate(places)
    ]
    return places, points


def test_the_command_warns_of_points_that_are_too_far_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = run(tmp_path, POSES)
    places, points = clicked()
    points[0]["xyz"] = on_site(places[:1] - [0.02, 0.0, 0.0])[0].tolist()
    command(folder, ["csv"], tmp_path / "out", written(tmp_path, {"points": points[:3]}))
    assert "Note: control points lie further off than 9 mm" in capsys.readouterr().err
    assert (tmp_path / "out" / "classes.csv").exists()


def test_pixels_of_keyframes_give_the_site_s_coordinates(tmp_path: Path) -> None:
    folder = run(tmp_path, POSES)
    places, points = clicked()
    path = written(tmp_path, {"crs": "EPSG:25832", "points": points})
    found, told = site_alignment(folder, path, None)
    assert found.site.crs == "EPSG:25832"
    np.testing.assert_allclose(found.site.place(places), on_site(places), atol=1e-5)
    assert told[0] == "control point P0: 0.0 mm off"
    _, pipes = export(folder, ["csv"], tmp_path / "out", alignment=found)
    row = pipes.read_text().splitlines()[2].split(",")
    assert np.array(row[7:10], int) == pytest.approx(np.round(1e3 * on_site(LEVEL.start[None])[0]), abs=1)
    points[1]["pixel"][0][2] += 30.0
    with pytest.raises(InputError, match=r"control point 'P1': in keyframe \d it lies \d+ px from"):
        site_alignment(folder, written(tmp_path, {"points": points}), None)
    points[1]["pixel"] = [[1, 5, 5], [7, 5, 5]]
    with pytest.raises(InputError, match=r"there is no keyframe 7: they are lines 1 to 3 of trajectory\.tum"):
        site_alignment(folder, written(tmp_path, {"points": points}), None)


POINT = {"name": "P1", "circle": "A/1", "xyz": [1, 2, 3]}
OTHERS = [{**POINT, "name": "P2"}, {**POINT, "name": "P3"}]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({}, "holds no list 'points'"),
        ({"points": OTHERS}, "2 points: give 3 to 1000"),
        ({"points": [POINT, POINT, *OTHERS]}, "the name 'P1' is given to two points"),
        ({"points": [{**POINT, "xyz": [1, 2]}, *OTHERS]}, "xyz is [1, 2]: write 3 numbers"),
        ({"points": [{**POINT, "xyz": [1, 2, "3,5"]}, *OTHERS]}, "with a decimal point"),
        ({"points": [{**POINT, "pixel": [[1, 2, 3]]}, *OTHERS]}, "needs either circle or pixel"),
        ({"points": [{"name": "P1", "pixel": [[1, 2, 3]], "xyz": [1, 2, 3]}, *OTHERS]}, "in two keyframes or more"),
        ({"points": [{**POINT, "xzy": 1}, *OTHERS]}, "unknown key 'xzy': did you mean 'xyz'"),
        ({"points": [POINT, *OTHERS], "src": "x"}, "unknown key 'src': did you mean 'crs'"),
        ({"points": [POINT, *OTHERS, 3]}, "point 4 is 3: write name"),
    ],
)
def test_a_wrong_file_is_reported_with_its_remedy(tmp_path: Path, content: object, told: str) -> None:
    path = written(tmp_path, content)
    with pytest.raises(InputError) as caught:
        load_control_points(path)
    assert told in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_circle_that_no_keyframe_shows_is_told(tmp_path: Path) -> None:
    folder = run(tmp_path, [looking_along_y(x) for x in (-0.4, 0.5)])
    path = written(tmp_path, {"points": [POINT, *OTHERS]})
    with pytest.raises(
        InputError, match="circle 'A/1' was not found in the keyframes; found were: none; give the boards"
    ):
        site_alignment(folder, path, None)
