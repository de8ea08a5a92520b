# SPDX-License-Identifier: Apache-2.0
"""A folder of photographs: in the order in which they were taken, with the focal length of their EXIF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeprog_bringup.footage.pictures import picture_files, read_exif
from pipeprog_bringup.footage.shot import Excerpt
from pipeprog_bringup.ingest import Request, ingest
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.errors import InputError
from tests.unit.bringup.footage.scans import photograph


def ingested(tmp_path: Path, excerpt: Excerpt | None = None) -> tuple[Bag, list[str]]:
    request = Request(tmp_path / "walk", None, tmp_path / "walk.mcap", excerpt or Excerpt())
    notes = ingest(request, lambda share, stage: None).notes
    return Bag.open(tmp_path / "walk.mcap"), notes


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    (tmp_path / "walk").mkdir()
    return tmp_path / "walk"


def test_pictures_come_as_they_were_taken_with_a_guess_of_their_camera(tmp_path: Path, walk: Path) -> None:
    (walk / "IMG_2.JPG").write_bytes(photograph("2026:11:02 10:00:00", "5", 26))
    (walk / "IMG_10.JPG").write_bytes(photograph("2026:11:02 10:00:00", "25", 26))
    (walk / "IMG_3.JPG").write_bytes(photograph("2026:11:02 10:00:03", "", 26, turned=6))
    (walk / "IMG_1.JPG").write_bytes(photograph("2026:11:02 10:00:04", "", 26))
    bag, notes = ingested(tmp_path)
    frames = list(bag)
    assert np.diff([frame.stamp for frame in frames]).tolist() == [250_000_000, 2_500_000_000, 1_000_000_000]
    assert bag.camera.fx == pytest.approx(26 / 43.27 * np.hypot(160, 96))
    assert bag.focal_sigma == 0.05
    assert not any(frame.fault for frame in frames)
    assert all(read_exif(frame.data[frame.data.index(b"\xff\xd8") :]).is_turned is False for frame in frames)
    assert any("a guess" in note for note in notes)


def test_pictures_without_times_come_by_the_numbers_in_their_names(tmp_path: Path, walk: Path) -> None:
    for name in ("b10.jpg", "b9.jpg", "b100.jpg", "b101.jpg"):
        (walk / name).write_bytes(photograph("", "", 26))
    assert [file.name for file in picture_files(walk)] == ["b9.jpg", "b10.jpg", "b100.jpg", "b101.jpg"]
    bag, notes = ingested(tmp_path)
    assert np.diff([frame.stamp for frame in bag]).tolist() == [1_000_000_000] * 3
    assert any("one a second" in note for note in notes)


def test_pictures_of_one_second_and_damaged_ones(tmp_path: Path, walk: Path) -> None:
    whole = photograph("2026:11:02 10:00:00", "", 26)
    for number in range(3):
        (walk / f"{number}.jpg").write_bytes(whole)
    (walk / "3.jpg").write_bytes(photograph("2026:11:02 10:00:00", "", 26, width=128))
    bag, notes = ingested(tmp_path)
    assert np.diff([frame.stamp for frame in bag]).tolist() == [100_000_000] * 2
    assert any("1 pictures left out" in note for note in notes)


def test_what_cannot_be_used_is_named(tmp_path: Path, walk: Path) -> None:
    with pytest.raises(InputError, match="walk is a folder"):
        ingested(tmp_path)
    (walk / "0.jpg").write_bytes(photograph())
    with pytest.raises(InputError, match="does not tell its focal length"):
        ingested(tmp_path)


def test_a_stray_picture_is_no_walk(tmp_path: Path, walk: Path) -> None:
    for number in range(3):
        (walk / f"{number}.jpg").write_bytes(photograph("2026:11:02 10:00:00", "", 26))
    with pytest.raises(InputError, match=r"3 only, and a survey needs 4 .* is it the folder of the walk\?"):
        ingested(tmp_path)
    assert not (tmp_path / "walk.mcap").exists()


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", photograph("yesterday", "x", 3), photograph("2026:13:41 10:00:00")])
def test_exif_that_says_nothing(data: bytes) -> None:
    exif = read_exif(data)
    assert (exif.taken, exif.focal_length) == (None, None)


def test_exif_that_is_spoilt_is_no_more_than_silent() -> None:
    data = photograph("2026:11:02 10:00:00", "5", 26)
    rng = np.random.default_rng(0)
    for _ in range(200):
        spoilt = bytearray(data[:200])
        for place in rng.integers(20, 180, 4):
            spoilt[place] = rng.integers(256)
        read_exif(bytes(spoilt) + data[200:])
