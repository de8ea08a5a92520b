# SPDX-License-Identifier: Apache-2.0
"""Recordings of ROS 2 Humble: .db3 files, whole, torn, damaged and hostile."""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path

import pytest

from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.sqlite_file import SqliteFile
from pipeprog_camera.errors import InputError
from tests.unit.bringup.recordings import camera_messages, sqlite_bytes, write_bag

COUNT = 40
IMAGES = [data for _, _, _, data in camera_messages(COUNT)[1::2]]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk_0.db3"
    path.write_bytes(sqlite_bytes(camera_messages(COUNT)))
    return path


def images(path: Path) -> list[bytes]:
    return [frame.data for frame in Bag.open(path)]


def test_gives_the_same_frames_as_mcap(recording: Path) -> None:
    same = write_bag(recording.with_suffix(".mcap"), camera_messages(COUNT))
    assert list(Bag.open(recording)) == list(Bag.open(same))
    assert Bag.open(recording).losses == []


def test_messages_come_in_the_order_of_their_times(tmp_path: Path) -> None:
    path = tmp_path / "late.db3"
    path.write_bytes(sqlite_bytes(camera_messages(COUNT)[::-1]))
    assert images(path) == IMAGES


def test_folders_are_read_by_their_metadata_or_by_the_names_of_their_files(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    messages = camera_messages(COUNT)
    (folder / "bag_0.db3").write_bytes(sqlite_bytes(messages[:20]))
    (folder / "bag_1.db3").write_bytes(sqlite_bytes(messages[20:]))
    assert images(folder) == IMAGES
    content = "{storage_identifier: sqlite3, relative_file_paths: [bag_0.db3, bag_1.db3]}"
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {content}")
    assert images(folder) == IMAGES


def test_messages_compressed_one_by_one(tmp_path: Path) -> None:
    import zstandard

    path = tmp_path / "zstd.db3"
    path.write_bytes(sqlite_bytes([(*each[:3], zstandard.compress(each[3])) for each in camera_messages(COUNT)]))
    assert images(path) == IMAGES


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_torn_file_gives_what_it_still_holds(recording: Path, share: float) -> None:
    whole = recording.read_bytes()
    recording.write_bytes(whole[: int(share * len(whole))])
    found = images(recording)
    assert 0.5 * share * COUNT < len(found) < COUNT
    assert set(found) <= set(IMAGES)
    (note,) = Bag.open(recording).losses
    assert str(recording) in note
    assert "torn or damaged" in note


def test_a_hole_in_the_middle_is_stepped_over(recording: Path) -> None:
    damaged = bytearray(recording.read_bytes())
    middle = len(damaged) // 2 // 4096 * 4096
    damaged[middle : middle + 3 * 4096] = bytes(3 * 4096)
    recording.write_bytes(damaged)
    found = images(recording)
    assert IMAGES[0] in found
    assert IMAGES[-1] in found
    assert len(found) < COUNT


def test_a_journal_that_a_crash_left_is_told(recording: Path) -> None:
    recording.with_name("walk_0.db3-wal").write_bytes(b"x")
    (note,) = Bag.open(recording).losses
    assert "walk_0.db3-wal holds messages that are not read" in note


def test_nothing_is_written_beside_the_recording(recording: Path) -> None:
    before = recording.read_bytes()
    images(recording)
    assert [file.name for file in recording.parent.iterdir()] == [recording.name]
    assert recording.read_bytes() == before


ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS topic_id, i AS timestamp, 'x' AS data FROM n"
)
HOSTILE = {
    "a view without end": f"DROP TABLE messages; CREATE VIEW messages AS {ENDLESS}",
    "a computed column": "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, "
    "timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(1000000000)))",
    "no messages": "DROP TABLE messages",
    "no column of times": "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, data)",
    "no rows": "DROP TABLE messages; CREATE TABLE messages(topic_id INTEGER PRIMARY KEY, timestamp, data) "
    "WITHOUT ROWID",
    "topics without end": "DROP TABLE topics; CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, "
    "serialization_format); WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 9000) "
    "INSERT INTO topics SELECT i, 'a', 'b', 'cdr' FROM n",
    "names of a megabyte": "UPDATE topics SET name = printf('%.1000000c', '/')",
    "names that are numbers": "UPDATE topics SET name = 1",
    "data that are texts": "UPDATE messages SET data = 'x'",
    "messages of 300 MB": "UPDATE messages SET data = zeroblob(300000000) WHERE id < 3; DELETE FROM messages "
    "WHERE id >= 3",
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_database_is_refused_in_one_line(tmp_path: Path, what: str) -> None:
    path = tmp_path / "hostile.db3"
    path.write_bytes(sqlite_bytes(camera_messages(4)))
    with sqlite3.connect(path) as database:
        database.executescript(HOSTILE[what])
    database.close()
    started = time.monotonic()
    with pytest.raises(InputError) as caught:
        list(Bag.open(path))
    assert time.monotonic() - started < 5.0
    assert "hostile.db3" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rows_without_end_in_a_looped_tree_are_refused(recording: Path) -> None:
    """Every inner page of the table points at the first leaf, again and again."""
    damaged = bytearray(recording.read_bytes())
    for page in range(0, len(damaged), 4096):
        if damaged[page] == 5:  # an inner page of a table
            for child in range(page + 4096 - 8, page + 4096 - 4000, -8):
                damaged[child : child + 4] = damaged[page + 8 : page + 12]
    recording.write_bytes(damaged)
    started = time.monotonic()
    file = SqliteFile.open(recording)
    assert len(list(file.messages(set(file.channels)))) <= 2 * COUNT
    assert time.monotonic() - started < 5.0


def test_no_database_behind_the_magic(tmp_path: Path) -> None:
    path = tmp_path / "garbage.db3"
    path.write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 40)
    with pytest.raises(InputError, match=r"garbage.db3"):
        Bag.open(path)
