# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeprog_bringup.results.result_files import FrameRow, write_frames, write_trajectory
from pipeprog_bringup.results.scored_files import Result, Segment, Truth, read_result
from pipeprog_bringup.results.scoring import score, score_files
from pipeprog_bringup.results.truth_alignment import Alignment, align
from pipeprog_camera.errors import InputError

CLASSES = {"DN65": 0.0365, "DN100": 0.0575}


def segment(
    x: float, length: float = 2.0, radius: float = 0.0365, name: str = "p", klass: str | None = None
) -> Segment:
    """A vertical cylinder at x."""
    return Segment(np.array([x, 0.0, 0.0]), np.array([x, 0.0, length]), radius, length, name, klass)


TRUE_PIPES = (segment(0.0, name="a"), segment(1.0, name="b"), segment(2.0, radius=0.0575, name="c"))
PERFECT = tuple(
    dataclasses.replace(pipe, class_name=name) for pipe, name in zip(TRUE_PIPES, ("DN65", "DN65", "DN100"), strict=True)
)
NO_POSES = np.empty((0, 4, 4))


def scored(*pipes: Segment, ignore: tuple[Segment, ...] = (), trajectory: Alignment | None = None) -> dict[str, Any]:
    return score(Result(pipes, CLASSES), Truth(TRUE_PIPES, ignore, NO_POSES), trajectory)


def counts(rates: dict[str, Any]) -> tuple[int, int, int]:
    return rates["true_positives"], rates["false_positives"], rates["false_negatives"]


def test_a_perfect_result() -> None:
    figures = scored(*PERFECT)
    for kind in ("detection", "planned", "classification"):
        assert figures[kind]["f_measure"] == 1.0
    assert figures["radius"]["rmse_mm"] == 0.0
    assert figures["length"]["mean_error_percent"] == 0.0
    assert [entry["error_percent"] for entry in figures["length"]["per_class"]] == [0.0, 0.0]
    assert figures["missed"] == figures["false"] == []


def test_errors_over_their_sigmas() -> None:
    """Two lengths of three within three sigmas; of the radii one has no sigma and one lies outside."""
    sigmas = [(1e-4, 2e-3), (1e-4, 1e-3), (None, 1e-3)]
    off = [(0.0, 0.0), (4e-4, -2.9e-3), (0.0, 4e-3)]
    found = [
        dataclasses.replace(pipe, radius=pipe.radius + dr, length=pipe.length + dl, radius_sigma=sr, length_sigma=sl)
        for pipe, (sr, sl), (dr, dl) in zip(PERFECT, sigmas, off, strict=True)
    ]
    figures = scored(*found)
    assert figures["radius"]["within_3_sigma"] == 0.5
    assert figures["length"]["within_3_sigma"] == pytest.approx(2 / 3)
    assert [pipe["radius_error_sigmas"] for pipe in figures["pipes"]] == [0.0, pytest.approx(4.0), None]
    assert [pipe["length_error_sigmas"] for pipe in figures["pipes"]] == pytest.approx([0.0, -2.9, 4.0])
    assert scored(*PERFECT)["length"]["within_3_sigma"] is None


def test_a_swapped_class_is_found_but_not_classified() -> None:
    figures = scored(PERFECT[0], PERFECT[1], dataclasses.replace(PERFECT[2], class_name="DN65"))
    assert counts(figures["detection"]) == (3, 0, 0)
    assert counts(figures["classification"]) == (2, 1, 1)
    assert figures["classification"]["right_of_matched"] == pytest.approx(2 / 3)
    assert {e["class"]: e["error_percent"] for e in figures["length"]["per_class"]} == {"DN65": 50.0, "DN100": -100.0}


def test_missed_and_false_pipes() -> None:
    figures = scored(*PERFECT[:2], segment(5.0, name="ghost", klass="DN65"))
    assert counts(figures["detection"]) == (2, 1, 1)
    assert figures["detection"]["f_measure"] == pytest.approx(2 / 3)
    assert figures["detection"]["accuracy"] == pytest.approx(0.5)
    assert (figures["missed"], figures["false"]) == (["c"], ["ghost"])


def test_a_cylinder_left_without_class_is_false_among_all_but_not_among_the_planned() -> None:
    figures = scored(*PERFECT, segment(5.0, radius=0.2))
    assert counts(figures["detection"]) == (3, 1, 0)
    assert counts(figures["planned"]) == (3, 0, 0)
    assert counts(figures["classification"]) == (3, 0, 0)


def test_a_pipe_left_without_class_is_found_but_missing_among_the_planned() -> None:
    figures = scored(*PERFECT[:2], TRUE_PIPES[2])
    assert counts(figures["detection"]) == (3, 0, 0)
    assert counts(figures["planned"]) == (2, 0, 1)


def test_classes_are_counted_true_against_found() -> None:
    """One right, one left without a class, one missed, one false, and one whose radius no planned class has."""
    found = (
        PERFECT[0],
        dataclasses.replace(PERFECT[1], class_name=None),
        segment(9.0, name="false", klass="DN100"),
        segment(3.0, radius=0.2, name="d", klass="DN100"),
    )
    truth = Truth((*TRUE_PIPES, segment(3.0, radius=0.2, name="d")), (), NO_POSES)
    confusion = score(Result(found, CLASSES), truth)["confusion"]
    assert confusion["labels"] == ["DN65", "DN100", "unplanned", "none"]
    assert confusion["matrix"] == [
        [1, 0, 1, 0],  # DN65
        [0, 0, 0, 1],  # DN100: missed
        [0, 1, 0, 0],  # unplanned
        [0, 1, 0, 0],  # none: a false pipe
    ]
    assert np.array(scored()["confusion"]["matrix"])[:, -1].tolist() == [2, 1, 0, 0]
    assert np.sum(score(Result((), CLASSES), Truth((), (), NO_POSES))["confusion"]["matrix"]) == 0


def test_of_classes_that_share_a_radius_either_is_right() -> None:
    classes = {"hot": 0.0365, "cold": 0.0365}
    found = tuple(
        dataclasses.replace(pipe, class_name=name) for pipe, name in zip(TRUE_PIPES[:2], classes, strict=True)
    )
    confusion = score(Result(found, classes), Truth(TRUE_PIPES[:2], (), NO_POSES))["confusion"]
    assert np.diag(confusion["matrix"]).tolist() == [1, 1, 0, 0]


def test_ignored_cylinders_count_neither_way() -> None:
    stub = segment(3.0, length=0.12)
    found = dataclasses.replace(stub, start=stub.start + np.array([0, 0, 0.02]), length=0.1, class_name="DN65")
    figures = scored(*PERFECT, found, ignore=(stub,))
    assert counts(figures["detection"]) == (3, 0, 0)
    assert figures["ignored"] == 1
    assert figures["length"]["per_class"][0]["error_percent"] == 0.0
    assert counts(scored(*PERFECT, ignore=(stub,))["detection"]) == (3, 0, 0)


@pytest.mark.parametrize(
    ("change", "matched"),
    [
        ({"start": np.array([0.019, 0, 0]), "end": np.array([0.019, 0, 2.0])}, True),
        ({"start": np.array([0.038, 0, 0]), "end": np.array([0.038, 0, 2.0])}, False),
        ({"start": np.array([-0.045, 0, 0]), "end": np.array([0.045, 0, 2.0])}, True),
        ({"start": np.array([-0.06, 0, 0]), "end": np.array([0.06, 0, 2.0])}, False),
        ({"end": np.array([0, 0, 1.1]), "length": 1.1}, True),
        ({"end": np.array([0, 0, 0.9]), "length": 0.9}, False),
        ({"end": np.array([0, 0, 4.2]), "length": 4.2}, False),
        ({"start": np.array([0, 0, 2.0]), "end": np.zeros(3)}, True),
        ({"radius": 0.08}, True),
    ],
)
def test_what_counts_as_the_same_pipe(change: dict[str, Any], matched: bool) -> None:
    figures = scored(dataclasses.replace(PERFECT[0], **change))
    assert figures["detection"]["true_positives"] == int(matched)


def test_matching_is_one_to_one() -> None:
    figures = scored(*PERFECT, dataclasses.replace(PERFECT[0], id="again"))
    assert counts(figures["detection"]) == (3, 1, 0)


def test_radius_and_length_errors() -> None:
    figures = scored(
        dataclasses.replace(PERFECT[0], radius=0.0395),
        dataclasses.replace(PERFECT[1], radius=0.0325),
        dataclasses.replace(PERFECT[2], length=2.2),
    )
    assert figures["radius"]["rmse_mm"] == pytest.approx(np.sqrt((3**2 + 4**2) / 3))
    assert figures["radius"]["bias_mm"] == pytest.approx(-1 / 3)
    assert [entry["rmse_mm"] for entry in figures["radius"]["per_class"]] == pytest.approx([np.sqrt(12.5), 0.0])
    assert figures["length"]["mean_error_percent"] == pytest.approx(10 / 3)


def poses(count: int, seed: int, flat: bool = False) -> np.ndarray:
    """A walk; `flat` keeps it on one straight line."""
    rng = np.random.default_rng(seed)
    result = np.tile(np.eye(4), (count, 1, 1))
    result[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3))).as_matrix()
    result[:, 0, 3] = np.linspace(0, 5, count)
    if not flat:
        result[:, :3, 3] += rng.normal(0, 0.3, (count, 3))
    return result


@given(st.integers(0, 1000), st.floats(0.98, 1.02), st.booleans())
def test_alignment_finds_the_motion_and_the_scale(seed: int, scale: float, straight: bool) -> None:
    true = poses(12, seed, straight)
    map_from_world = np.eye(4)
    map_from_world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    map_from_world[:3, 3] = [3.0, -2.0, 1.0]
    estimated = map_from_world @ true
    centre = estimated[:, :3, 3].mean(0)
    estimated[:, :3, 3] = centre + scale * (estimated[:, :3, 3] - centre)
    trajectory = align(estimated, true)
    assert trajectory.scale_error == pytest.approx(scale - 1, abs=1e-9)
    assert trajectory.rms_similarity == pytest.approx(0, abs=1e-9)
    # A wrong scale pulls a little on the rotation of the rigid fit.
    turn = (trajectory.world_from_map @ map_from_world)[:3, :3]
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-7 + 0.1 * abs(scale - 1))
    if scale == 1:
        np.testing.assert_allclose(trajectory.world_from_map @ map_from_world, np.eye(4), atol=1e-7)


def test_position_noise_is_reported_as_its_rms() -> None:
    true = poses(2000, 5)
    noisy = true.copy()
    noisy[:, :3, 3] += np.random.default_rng(1).normal(0, 0.001, (2000, 3))
    trajectory = align(noisy, true)
    assert trajectory.rms_rigid == pytest.approx(0.001 * np.sqrt(3), rel=0.05)
    assert trajectory.rms_similarity <= trajectory.rms_rigid


def write_case(folder: Path, world_from_map: np.ndarray, keyframes: list[int]) -> tuple[Path, Path]:
    """A run whose map lies elsewhere, with some of its 20 frames as keyframes."""
    world_from_camera = poses(20, 3)
    map_from_world = np.linalg.inv(world_from_map)
    map_from_camera = map_from_world @ world_from_camera
    stamps = [1_700_000_000_000_000_000 + 33_333_333 * number for number in range(20)]
    chosen = map_from_camera[keyframes]
    quaternions = Rotation.from_matrix(chosen[:, :3, :3]).as_quat()
    write_trajectory(folder / "trajectory.tum", [stamps[k] for k in keyframes], chosen[:, :3, 3], quaternions)
    write_frames(folder / "frames.csv", [FrameRow(stamp, k in keyframes, "x") for k, stamp in enumerate(stamps)])
    ends = [np.array([p.start, p.end]) @ map_from_world[:3, :3].T + map_from_world[:3, 3] for p in PERFECT]
    content = {
        "frame_id": "map",
        "scale": {"source": "board", "sigma": 1e-4},
        "pipes": [
            {
                "id": p.id,
                "start": list(e[0]),
                "end": list(e[1]),
                "radius": p.radius,
                "length": p.length,
                "class": p.class_name,
            }
            for p, e in zip(PERFECT, ends, strict=True)
        ],
        "classes": [{"class": name, "outer_radius": radius} for name, radius in CLASSES.items()],
    }
    (folder / "pipes.json").write_text(json.dumps(content))
    truth = {
        "pipes": [{"id": p.id, "start": list(p.start), "end": list(p.end), "radius": p.radius} for p in TRUE_PIPES],
        "camera_to_world": world_from_camera.tolist(),
    }
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder / "pipes.json", folder / "truth.json"


WORLD_FROM_MAP = np.eye(4)
WORLD_FROM_MAP[:3, :3] = Rotation.from_euler("xyz", [10, 20, 130], degrees=True).as_matrix()
WORLD_FROM_MAP[:3, 3] = [4, 5, 6]


def test_files_are_aligned_by_their_trajectory(tmp_path: Path) -> None:
    figures = score_files(*write_case(tmp_path, WORLD_FROM_MAP, [1, 4, 5, 9, 15, 19]))
    assert figures["alignment"] == "trajectory"
    assert counts(figures["classification"]) == (3, 0, 0)
    assert figures["trajectory"]["poses"] == 6
    assert figures["trajectory"]["rms_rigid_mm"] < 1e-4
    assert abs(figures["scale"]["error_percent"]) < 1e-6
    json.dumps(figures, allow_nan=False)


def test_a_results_folder_is_scored_as_its_pipes_json(tmp_path: Path) -> None:
    pipes, truth = write_case(tmp_path, WORLD_FROM_MAP, [1, 4, 5, 9, 15, 19])
    assert score_files(tmp_path, truth) == score_files(pipes, truth)
    pipes.unlink()
    with pytest.raises(InputError, match=r"no such file: .*pipes\.json"):
        score_files(tmp_path, truth)


def test_without_a_trajectory_the_frames_are_taken_as_one(tmp_path: Path) -> None:
    pipes, truth = write_case(tmp_path, np.eye(4), [0, 1, 2])
    (tmp_path / "trajectory.tum").unlink()
    figures = score_files(pipes, truth)
    assert figures["alignment"] == "identity"
    assert counts(figures["detection"]) == (3, 0, 0)


def test_frames_are_found_by_the_stamps_of_the_truth_in_whatever_order_they_came(tmp_path: Path) -> None:
    pipes, truth = write_case(tmp_path, WORLD_FROM_MAP, [1, 4, 5, 9, 15, 19])
    lines = (tmp_path / "frames.csv").read_text().splitlines(keepends=True)
    stamps = [int(line.partition(",")[0]) for line in lines[1:]]
    content = json.loads(truth.read_text()) | {"stamps": stamps}
    (tmp_path / "frames.csv").write_text("".join([lines[0], *reversed(lines[2:])]))  # the first one was lost
    assert score_files(pipes, truth)["trajectory"]["rms_rigid_mm"] > 1.0
    truth.write_text(json.dumps(content))
    assert score_files(pipes, truth)["trajectory"]["rms_rigid_mm"] < 1e-4
    truth.write_text(json.dumps(content | {"stamps": [stamp + 10**12 for stamp in stamps]}))
    assert score_files(pipes, truth)["trajectory"]["rms_rigid_mm"] > 1.0


@pytest.mark.parametrize("stamps", [3, [1], ["a"] * 20, [-1] * 20, [1 << 63] * 20])
def test_stamps_of_a_truth_that_are_none_are_an_error(tmp_path: Path, stamps: object) -> None:
    pipes, truth = write_case(tmp_path, np.eye(4), [0, 5, 9])
    truth.write_text(json.dumps(json.loads(truth.read_text()) | {"stamps": stamps}))
    with pytest.raises(InputError, match="stamps"):
        score_files(pipes, truth)


def test_the_truth_of_another_recording_is_an_error(tmp_path: Path) -> None:
    pipes, truth = write_case(tmp_path, np.eye(4), [0, 5, 9])
    content = json.loads(truth.read_text())
    content["camera_to_world"] = content["camera_to_world"][:7]
    truth.write_text(json.dumps(content))
    with pytest.raises(InputError, match="truth of another recording"):
        score_files(pipes, truth)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("pipes.json", "{", "not JSON"),
        ("pipes.json", "[]", "holds a list"),
        ("pipes.json", '{"pipes": []}', "'classes' is missing"),
        ("pipes.json", '{"pipes": [{"id": 1}], "classes": []}', "'start' is missing"),
        ("truth.json", '{"pipes": 3}', "no truth file"),
        ("truth.json", '{"pipes": [{"start": [0, 0, 0], "end": [0, 0, 0], "radius": 1}]}', "no length"),
        ("trajectory.tum", "1 2 3\n", "line 1"),
        ("trajectory.tum", "", "holds no poses"),
        ("frames.csv", "a,b\n1,2\n", "no frames.csv"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path: Path, name: str, text: str, expected: str) -> None:
    pipes, truth = write_case(tmp_path, np.eye(4), [0, 5, 9])
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=expected) as caught:
        score_files(pipes, truth)
    assert str(tmp_path / name) in str(caught.value)


def test_a_result_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_result(tmp_path / "pipes.json")
