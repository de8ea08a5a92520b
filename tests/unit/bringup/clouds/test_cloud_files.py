# SPDX-License-Identifier: Apache-2.0
"""Clouds that are damaged or declare what they do not hold: each is read, or refused in one line."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import laspy
import numpy as np
import pytest

from benchmarks.hostile_clouds import NAMED, VALID, pcd_head, pipe, ply_head
from pipeprog_bringup.clouds import columns, laz, laz_decoder
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_COORDINATE

pytestmark = pytest.mark.usefixtures("little_memory")

# What can be read in spite of its oddity, and the number of points that are used and dropped.
READABLE = {
    "normals not finite.ply": (2, 0),
    "coordinates of 1e308.ply": (1, 1),
    "coordinates at the limit.ply": (402, 0),
    "all points are one.ply": (1000, 0),
    "one point.ply": (1, 0),
    "smallest numbers.ply": (3, 0),
    "one point in text.pcd": (1, 0),
    "extended records.las": (400, 0),
    "extended records beyond the file.las": (400, 0),
    "version 9.9.las": (400, 0),
    "scale of 1e300.las": None,
    "chunks of two billion points.laz": (400, 0),
    "chunks of four billion points.laz": (400, 0),
    "numbers of 5000 digits.xyz": (1, 1),
    "1e400.xyz": (1, 1),
}


@pytest.mark.parametrize("name", VALID)
def test_a_valid_cloud_is_read(tmp_path: Path, name: str) -> None:
    VALID[name](tmp_path / name)
    np.testing.assert_allclose(read_cloud(tmp_path / name).cloud.points, pipe(), atol=1e-4)


@pytest.mark.parametrize("name", [name for name in NAMED if name not in READABLE])
def test_a_hostile_cloud_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    NAMED[name](tmp_path / name)
    started = time.process_time()
    with pytest.raises(InputError) as caught:
        read_cloud(tmp_path / name)
    text = str(caught.value)
    assert name in text
    assert "\n" not in text
    assert len(text) < 500 + len(str(tmp_path))
    assert time.process_time() - started < 5.0  # s; two at most were needed


@pytest.mark.parametrize("name", READABLE)
def test_an_odd_cloud_is_read_less_what_is_no_point(tmp_path: Path, name: str) -> None:
    NAMED[name](tmp_path / name)
    file = read_cloud(tmp_path / name)
    assert np.abs(file.cloud.points).max() <= MAX_COORDINATE
    assert file.cloud.normals is None
    if READABLE[name] is not None:
        assert (len(file.cloud.points), file.dropped) == READABLE[name]


def test_the_limit_of_points_is_the_first_that_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "MAX_CLOUD_POINTS", 400)
    for name, make in VALID.items():
        make(tmp_path / name)
        assert len(read_cloud(tmp_path / name).cloud.points) == 400
    monkeypatch.setattr(columns, "MAX_CLOUD_POINTS", 399)
    for name in VALID:
        with pytest.raises(InputError, match="399 at most are read"):
            read_cloud(tmp_path / name)


def test_the_limit_of_a_line_is_the_first_that_is_refused(tmp_path: Path) -> None:
    row = "0.5 1.5 2.5"
    for head in (ply_head(2, "ascii"), pcd_head(2, "ascii"), []):
        path = tmp_path / f"cloud{'.xyz' if not head else '.ply' if head[0] == 'ply' else '.pcd'}"
        for length, fits in ((columns.MAX_CLOUD_LINE - 1, True), (2 * columns.MAX_CLOUD_LINE, False)):
            path.write_text("\n".join([*head, f"{row:{length}}", row, ""]))
            if fits:
                assert len(read_cloud(path).cloud.points) == 2
                continue
            with pytest.raises(InputError, match="one point a line"):
                read_cloud(path)


def test_what_ends_the_decoder_of_a_laz_does_not_end_its_reader(tmp_path: Path) -> None:
    NAMED["a time without end.laz"](tmp_path / "endless.laz")
    with pytest.raises(InputError, match="SIGSEGV"):
        read_cloud(tmp_path / "endless.laz")


def test_the_limit_of_a_compressed_point_is_the_last_that_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    VALID["new.laz"](tmp_path / "points.laz")
    monkeypatch.setattr(laz, "MAX_COMPRESSED_POINT", 30)
    assert len(read_cloud(tmp_path / "points.laz").cloud.points) == 400
    monkeypatch.setattr(laz, "MAX_COMPRESSED_POINT", 29)
    with pytest.raises(InputError, match="29 at most"):
        read_cloud(tmp_path / "points.laz")


def test_limits_of_chunks_are_the_last_that_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    VALID["chunks.laz"](tmp_path / "chunks.laz")
    with laspy.open(tmp_path / "chunks.laz") as file:
        description = file.header.vlrs.get("LasZipVlr")[0].record_data
        start = file.header.offset_to_point_data
    packed = laz_decoder.Packed(str(tmp_path / "chunks.laz"), 400, 30, start, description, 9)
    limits = {"MAX_CLOUD_CHUNKS": 2, "MAX_CLOUD_RECORDS": 300 * 30}
    for name, value in limits.items():
        monkeypatch.setattr(laz_decoder, name, value)
    with (tmp_path / "chunks.laz").open("rb") as stream:
        assert [points for points, _ in laz_decoder.wanted_chunks(packed, stream)] == [100, 300]
        for name, value in limits.items():
            with monkeypatch.context() as lower:
                lower.setattr(laz_decoder, name, value - 1)
                with pytest.raises(InputError, match="damaged"):
                    laz_decoder.wanted_chunks(packed, stream)


def test_ctrl_c_ends_the_reading_of_a_long_text(tmp_path: Path) -> None:
    (tmp_path / "long.xyz").write_text("0.123456 1.234567 2.345678\n" * 2_000_000)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    started = time.process_time()
    with pytest.raises(KeyboardInterrupt):
        read_cloud(tmp_path / "long.xyz")
    assert time.process_time() - started < 1.5  # s; reading all of it takes over three
