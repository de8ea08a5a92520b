# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.atomic_output import OutputFolder
from pipeprog_bringup.results.result_files import Scale
from pipeprog_bringup.results.setting_overrides import as_parameters, effective
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.pipe_runs import Joint, PipeRun
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd
from pipeprog_frames.frame_decision import FULL

PIPE = Pipe(
    "p03",
    Cylinder(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 4.42]), 0.0575),
    0.0003,
    "DN100",
    0.99,
    2.6,
    0.0011,
    20411,
    "DN125",
    (PipeEnd(0.001, "free"), PipeEnd(0.0008, "wall")),
)
SCALE = Scale("board", 0.0004)
CLASSES = [ClassProgress("DN100", 0.0575, 24.0, 11.3, 100 * 11.3 / 24)]
PRODUCT = Product([PIPE], CLASSES, [PipeRun("r01", ("p03",), (), 1.42, 1.42)], 0.0004)


def test_pipes_json_has_the_fields_that_were_agreed(tmp_path: Path) -> None:
    result_files.write_pipes(tmp_path / "pipes.json", PRODUCT, SCALE)
    assert json.loads((tmp_path / "pipes.json").read_text()) == {
        "frame_id": "map",
        "scale": {"source": "board", "sigma": 0.0004},
        "pipes": [
            {
                "id": "p03",
                "start": [1.0, 2.0, 3.0],
                "end": [1.0, 2.0, 4.42],
                "radius": 0.0575,
                "radius_sigma": 0.0003,
                "length": 1.42,
                "class": "DN100",
                "class_probability": 0.99,
                "class_kmeans": "DN125",
                "ambiguous": False,
                "visible_arc_deg": 149.0,
                "rmse": 0.0011,
                "points": 20411,
                "length_sigma": 0.001401,
                "ends": [{"state": "free", "sigma": 0.001}, {"state": "wall", "sigma": 0.0008}],
            }
        ],
        "classes": [
            {
                "class": "DN100",
                "outer_radius": 0.0575,
                "planned_m": 24.0,
                "installed_m": 11.3,
                "percent": 47.08,
                "installed_sigma_m": 0.001401,
            }
        ],
        "runs": [
            {"id": "r01", "pipes": ["p03"], "barrel_length": 1.42, "centre_line_length": 1.42, "joints": []},
        ],
    }


def test_a_class_name_is_no_formula_of_a_spreadsheet(tmp_path: Path) -> None:
    name = "=cmd|' /C calc'!A0"
    product = Product([replace(PIPE, class_name=name)], [replace(CLASSES[0], name=name)], [])
    result_files.write_progress(tmp_path / "progress.csv", product)
    with (tmp_path / "progress.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    assert (row["class"], row["pipes"]) == (f"'{name}", "1")
    result_files.write_pipes(tmp_path / "pipes.json", product, SCALE)
    assert json.loads((tmp_path / "pipes.json").read_text())["pipes"][0]["class"] == name


def test_only_files_of_the_folder_are_removed_with_an_earlier_run(tmp_path: Path) -> None:
    out, mine = tmp_path / "out", tmp_path / "mine"
    out.mkdir()
    mine.mkdir()
    (mine / "a.txt").write_text("keep")
    (out / "link").symlink_to(mine)
    (out / "old.csv").write_text("old")
    names = ["old.csv", "link/a.txt", "../mine/a.txt", str(mine / "a.txt"), "a\0b", "x" * 5000, "", ".", 3]
    (out / "run.json").write_text(json.dumps({"files": names}))
    with OutputFolder(out, True) as folder:
        folder.file("new.csv").write_text("new")
    assert (mine / "a.txt").read_text() == "keep"
    assert not (out / "old.csv").exists()


@pytest.mark.parametrize("stamp", ["1e999999999", "inf", "nan", "-1e30", "1" * 5000])
def test_a_stamp_beyond_all_times_is_refused_at_once(tmp_path: Path, stamp: str) -> None:
    (tmp_path / "trajectory.tum").write_text(f"{stamp} 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="line 1"):
        result_files.read_trajectory(tmp_path / "trajectory.tum")


def test_what_is_not_known_is_null(tmp_path: Path) -> None:
    pipe = Pipe("p01", PIPE.cylinder, float("nan"), None, 0.0, 2.6, 0.001, 3)
    result_files.write_pipes(tmp_path / "pipes.json", Product([pipe], CLASSES, []), Scale("board", None))
    content = json.loads((tmp_path / "pipes.json").read_text())
    (row,) = content["pipes"]
    assert row["class"] is row["radius_sigma"] is row["length_sigma"] is content["scale"]["sigma"] is None
    assert row["ends"] == 2 * [{"state": "unknown", "sigma": None}]


def test_what_two_classes_explain_is_ambiguous(tmp_path: Path) -> None:
    unsure = replace(PIPE, class_name=None, class_probability=0.6)
    result_files.write_pipes(tmp_path / "pipes.json", Product([unsure, PIPE], CLASSES, []), SCALE)
    content = json.loads((tmp_path / "pipes.json").read_text())
    assert [pipe["ambiguous"] for pipe in content["pipes"]] == [True, False]


def test_runs_and_their_joints(tmp_path: Path) -> None:
    elbow = Joint("elbow", ("p03", "p04"), 0.5 * np.pi, 0.31415926, 0.00123456)
    run = PipeRun("r07", ("p03", "p04"), (elbow,), 2.42, 2.73415926)
    result_files.write_pipes(tmp_path / "pipes.json", Product([PIPE, replace(PIPE, id="p04")], CLASSES, [run]), SCALE)
    assert json.loads((tmp_path / "pipes.json").read_text())["runs"] == [
        {
            "id": "r07",
            "pipes": ["p03", "p04"],
            "barrel_length": 2.42,
            "centre_line_length": 2.734159,
            "joints": [
                {"kind": "elbow", "pipes": ["p03", "p04"], "angle_deg": 90.0, "length": 0.314159, "miss": 0.001235}
            ],
        }
    ]


def test_progress_csv(tmp_path: Path) -> None:
    result_files.write_progress(tmp_path / "progress.csv", Product([PIPE, PIPE], CLASSES, [], 0.0))
    with (tmp_path / "progress.csv").open() as stream:
        row = next(csv.DictReader(stream))
    assert row == {
        "class": "DN100",
        "outer_radius_mm": "57.50",
        "planned_m": "24.000",
        "installed_m": "11.300",
        "percent": "47.1",
        "pipes": "2",
        "installed_sigma_m": "0.0018",
    }


@settings(deadline=None)  # files on a busy disk
@given(st.integers(0, 2**62))
def test_stamps_survive_the_trajectory_to_the_nanosecond(tmp_path_factory: pytest.TempPathFactory, stamp: int) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    result_files.write_trajectory(path, [stamp], np.array([[1.0, -2.0, 3.0]]), np.array([[0.5, 0.5, 0.5, 0.5]]))
    stamps, poses = result_files.read_trajectory(path)
    assert stamps.tolist() == [stamp]
    np.testing.assert_allclose(poses[0], [[0, 0, 1, 1], [1, 0, 0, -2], [0, 1, 0, 3], [0, 0, 0, 1]], atol=1e-9)


def test_run_json_lists_its_files(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "out") as folder:
        folder.file("pipes.json").write_text("{}")
        result_files.write_run(folder, {"command": "detect"})
    content = json.loads((tmp_path / "out" / "run.json").read_text())
    assert content["files"] == ["pipes.json", "run.json"]
    assert content["versions"]["numpy"] == np.__version__


def row(stamp: int, chosen: bool = False, reason: str = "why") -> result_files.FrameRow:
    return result_files.FrameRow(stamp, chosen, reason)


def test_the_frame_log_counts_what_is_on_its_way() -> None:
    log = FrameLog()
    for stamp in (1, 2, 3):
        log.play(stamp)
    log.skip(4, "damaged message")
    log.decide(row(2, True))
    assert (log.in_flight, log.considered, log.chosen) == (2, 2, 1)
    log.decide(row(1))
    log.decide(row(3))
    assert [(r.stamp, r.chosen) for r in log.rows()] == [(1, False), (2, True), (3, False), (4, False)]


def test_a_second_decision_revokes_the_first() -> None:
    log = FrameLog()
    log.play(1)
    log.decide(row(1))
    log.decide(row(1, True, "bridges"))
    log.overlap(1, 0.8, 0.7, 90, True)
    log.overlap(1, 0.9, 0.75, 100, True)
    expected = result_files.FrameRow(
        1, True, "bridges", registered=True, overlap_n=0.9, cell_overlap=0.75, tie_points=100
    )
    assert log.rows() == [expected]


def test_frames_of_one_stamp_each_get_a_decision() -> None:
    log = FrameLog()
    log.play(1)
    log.play(1)
    log.decide(row(1, True))
    assert log.in_flight == 1
    log.decide(row(1, False, "stamp repeats"))
    assert [(r.chosen, r.reason) for r in log.rows()] == [(True, "why"), (False, "stamp repeats")]
    assert log.common_reasons() == "1 x stamp repeats"


def test_faulty_frames_are_distinguished_from_frames_not_needed() -> None:
    log = FrameLog()
    for stamp, reason in ((1, "overlap suffices"), (2, "damaged image"), (3, "damaged image")):
        log.play(stamp)
        log.decide(row(stamp, False, reason))
    log.skip(4, "damaged message")
    assert log.faults() == ["2 frames left out: damaged image", "1 frames left out: damaged message"]


def test_frames_that_a_full_map_does_not_take_are_told() -> None:
    log = FrameLog()
    for stamp, reason in ((1, "overlap suffices"), (2, FULL), (3, FULL)):
        log.play(stamp)
        log.decide(row(stamp, False, reason))
    assert log.beyond_limit == 2
    assert log.faults() == [f"2 frames left out: {FULL} (frame 2, the first of them)"]
    log.decide(row(2, True, "bridges to a keyframe that did not register"))  # once there is room
    assert log.beyond_limit == 1


def test_settings_are_checked_before_anything_starts() -> None:
    configs = effective(["sfm.mapper.max_features=1000", "detect.front_end = planes"])
    assert as_parameters(configs)["sfm"]["mapper.max_features"] == 1000
    assert configs["detect"].front_end == "planes"
    for text, expected in (
        ("sfm.maper.max_features=3", "sfm.mapper.max_features"),
        ("sfm.mapper.max_features=many", "whole number"),
        ("sfm.mapper.max_features=3", "out of range"),
        ("detect.front_end=guess", "none of its choices"),
        ("sfm.mapper.max_features", "node.param=value"),
    ):
        with pytest.raises(InputError, match=expected):
            effective([text])
    with pytest.raises(InputError, match="unknown"):
        effective(["sfm.mapper.max_features=1000"], ("detect",))


def test_trajectory_is_position_then_x_y_z_w(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.tum"
    result_files.write_trajectory(path, [1_000_000_005], np.array([[1.0, 2.0, 3.0]]), np.array([[0.1, 0.2, 0.3, 0.9]]))
    assert [float(word) for word in path.read_text().split()[1:]] == [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.9]
    assert path.read_text().split()[0] == "1.000000005"
