# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("fsspec", reason="the packages of pipeprog fleet are not installed: make setup FLEET=1")

from pipeprog_bringup.fleet.fleet_file import read_fleet_file
from pipeprog_bringup.fleet.recordings import Inputs, listed, require_distinct
from pipeprog_camera.errors import InputError


@pytest.fixture
def night(tmp_path: Path) -> Path:
    """Two files, a rosbag2 folder of two files, and something else."""
    folder = tmp_path / "night"
    for name in ("one.mcap", "robot 2/two.db3", "robot 3/bag/bag_0.mcap", "robot 3/bag/bag_1.mcap", "notes.txt"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    (folder / "robot 3/bag/metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    return folder


def test_a_folder_is_its_files_and_rosbag2_folders_named_by_their_places(night: Path) -> None:
    found = listed(str(night), Inputs())
    assert [one.name for one in found] == ["one", "robot 2_two", "robot 3_bag"]
    assert sorted(found[2].files) == ["bag_0.mcap", "bag_1.mcap", "metadata.yaml"]
    assert found[1].uri == f"{night}/robot 2/two.db3"
    assert found[0].size == len("one.mcap")


def test_a_rosbag2_folder_is_one_recording(night: Path) -> None:
    assert [one.name for one in listed(str(night / "robot 3/bag"), Inputs())] == ["bag"]


def test_a_file_is_a_recording_whatever_it_holds(night: Path) -> None:
    assert [one.name for one in listed(str(night / "notes.txt"), Inputs())] == ["notes"]


def test_a_glob_finds_files_and_folders(night: Path) -> None:
    assert [one.name for one in listed(f"{night}/robot*/*", Inputs())] == ["two", "bag"]


@pytest.mark.parametrize("name", ["", "none.mcap", "*.mp4"])
def test_where_there_is_no_recording_the_address_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"holds no recording"):
        listed(f"{tmp_path}/{name}", Inputs())


def test_an_unknown_protocol_is_an_error() -> None:
    with pytest.raises(InputError, match="no storage can be reached"):
        listed("carrier-pigeon://loft/one.mcap", Inputs())


def test_names_are_fit_for_paths_and_pages(tmp_path: Path) -> None:
    (tmp_path / "..<b>\n.mcap").write_text("")
    assert listed(f"{tmp_path}/*", Inputs())[0].name == "_b__"


def test_two_recordings_of_one_name_are_refused(night: Path) -> None:
    (night / "robot 4").mkdir()
    (night / "robot 4/two.mcap").write_text("")
    with pytest.raises(InputError, match=r"both have their results in 'two'"):
        require_distinct(listed(f"{night}/robot*/two.*", Inputs()))


def test_a_fleet_file_says_what_each_is_surveyed_with(night: Path) -> None:
    (night / "fleet.yaml").write_text(
        "boq: boq.yaml\n"
        "settings: {sfm.seed: 3}\n"
        "recordings:\n"
        "  - one.mcap\n"
        "  - {path: 'robot*/*', board: b.yaml, settings: {frames.policy: network}, reference: one, image_topic: /l}\n"
        "  - {path: one.mcap, name: again, boq: 's3://plans/b.yaml'}\n"
    )
    found = read_fleet_file(night / "fleet.yaml", Inputs(board="standard.yaml", settings=("sfm.seed=2",)))
    require_distinct(found)
    first, second, _, last = (one.inputs for one in found)
    assert [one.name for one in found] == ["one", "two", "bag", "again"]
    assert (first.boq, first.board, first.settings) == (
        f"{night}/boq.yaml",
        "standard.yaml",
        ("sfm.seed=2", "sfm.seed=3"),
    )
    assert (second.board, second.settings[2:]) == (f"{night}/b.yaml", ("frames.policy=network",))
    assert (second.reference, second.topics) == ("one", {"image_topic": "/l"})
    assert last.boq == "s3://plans/b.yaml"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[]", "begins with 'recordings:'"),
        ("recordings: []", "list at least one"),
        ("recordings: [one.mcap]\nbil: x", "unknown key 'bil': did you mean"),
        ("recordings:\n  - {path: one.mcap, sets: {}}", "line 2: unknown key 'sets'"),
        ("recordings:\n  - {path: one.mcap, settings: {sfm.sed: 1}}", "line 2: --set sfm.sed=1: unknown"),
        ("recordings:\n  - {path: one.mcap, settings: [a]}", "write node.param: value"),
        ("recordings:\n  - {name: one}", "line 2: path is None"),
        ("recordings:\n  - {path: 'robot*/*', name: x}", "stands for 2 recordings"),
        ("recordings:\n  - {path: one.mcap, reference: two}", "reference 'two' is no recording"),
    ],
)
def test_what_is_wrong_in_a_fleet_file_is_named(night: Path, text: str, says: str) -> None:
    (night / "fleet.yaml").write_text(text)
    with pytest.raises(InputError, match=says):
        require_distinct(read_fleet_file(night / "fleet.yaml", Inputs()))
