# SPDX-License-Identifier: Apache-2.0
"""map.npz: what is written is read back; what else a file may hold is refused by name."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nights import reference

from pipeprog_camera.errors import InputError
from pipeprog_sfm.alignment.map_file import read_map, write_map
from pipeprog_sfm.alignment.survey_map import MappedBoard, MappedPipe

BOARD = MappedBoard("A", np.array([[0.0, 1.0, 2.0], [0.1, 1.0, 2.0], [0.0, 1.2, 2.0]]))
PIPE = MappedPipe("p03", "DN100", np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.5]]), 0.0575, 0.002)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.npz"
    write_map(path, replace(reference(), boards=(BOARD,), pipes=(PIPE,)))
    return path


def test_a_map_is_read_back_as_it_was_written(written: Path, tmp_path: Path) -> None:
    survey, found = reference(), read_map(written)
    assert (found.frame, found.aligned_by, found.scale_sigma) == (survey.frame, "", survey.scale_sigma)
    assert found.cameras == survey.cameras
    for name in ("stamps", "map_from_camera", "offsets", "descriptors", "point_of"):
        assert np.array_equal(getattr(found, name), getattr(survey, name)), name
    assert np.abs(found.pixels - survey.pixels).max() <= 1 / 32
    assert np.abs(found.points - survey.points).max() < 1e-6
    assert np.abs(found.cloud - survey.cloud).max() < 0.6e-3
    assert np.abs(found.normals - survey.normals).max() < 0.01
    assert [(b.name, b.circles.tolist()) for b in found.boards] == [(BOARD.name, BOARD.circles.tolist())]
    assert [(p.life, p.class_name, p.ends.tolist(), p.radius) for p in found.pipes] == [
        (PIPE.life, PIPE.class_name, PIPE.ends.tolist(), PIPE.radius)
    ]
    write_map(tmp_path / "again.npz", found)
    assert read_map(tmp_path / "again.npz").points.tobytes() == found.points.tobytes()
    assert written.stat().st_size < 1e5 * len(survey.stamps)


def with_array(source: Path, target: Path, name: str, change: Callable[[Any], Any] | bytes | None) -> Path:
    """A copy in which one array is another one, other bytes, or missing."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(target, "w") as copy:
        for member in archive.namelist():
            data = archive.read(member)
            if member == f"{name}.npy":
                if change is None:
                    continue
                if callable(change):
                    stream = io.BytesIO()
                    np.save(stream, change(np.load(io.BytesIO(data))), allow_pickle=True)
                    data = stream.getvalue()
                else:
                    data = change
            copy.writestr(member, data)
    return target


def filled(value: float) -> Callable[[Any], Any]:
    """An array with one value in its first place."""

    def change(array: Any) -> Any:
        array = array.copy()
        array[(0,) * array.ndim] = value
        return array

    return change


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("points", None),
        ("points", filled(np.nan)),
        ("points", filled(1e30)),
        ("points", lambda array: array.astype(object)),
        ("points", lambda array: array[:, :2]),
        ("points", lambda array: np.asfortranarray(array)),
        ("point_of", filled(10**8)),
        ("point_of", filled(-1)),
        ("features", filled(-5)),
        ("features", filled(2**31 - 1)),
        ("camera_of", filled(7)),
        ("cameras", filled(0.0)),
        ("cameras", lambda array: array * -1),
        ("poses", filled(3.0)),
        ("scale_sigma", lambda array: np.array(np.nan)),
        ("version", lambda array: np.array(99, np.int32)),
        ("frame", lambda array: np.array(["../../etc", "boards"])),
        ("boards", lambda array: np.array(["a\x1b[2J"])),
        ("pipe_names", lambda array: np.array(["p" * 300, "DN100"])),
        ("pipes", lambda array: array * np.nan),
        ("descriptors", b"\x93NUMPY\x01\x00garbage"),
        ("descriptors", b"no array at all"),
        ("normals", lambda array: array[:-1]),
    ],
)
def test_what_cannot_be_is_refused_by_name(written: Path, tmp_path: Path, name: str, change: Any) -> None:
    with pytest.raises(InputError, match=r"is no map of pipeprog|is damaged") as error:
        read_map(with_array(written, tmp_path / "map.npz", name, change))
    assert "make the survey again" in str(error.value)


def test_an_array_that_declares_more_than_it_has_takes_no_memory(written: Path, tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|u1", "fortran_order": False, "shape": (1 << 22, 128)}
    )  # 512 MB declared, none there
    spoiled = with_array(written, tmp_path / "map.npz", "descriptors", header.getvalue())
    with pytest.raises(InputError, match="ends before its last value"):
        read_map(spoiled)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"PK\x03\x04", b"hello", np.random.default_rng(0).bytes(1000)):
        (tmp_path / "map.npz").write_bytes(content)
        with pytest.raises(InputError, match="is no map of pipeprog"):
            read_map(tmp_path / "map.npz")
    with pytest.raises(InputError, match="no such file"):
        read_map(tmp_path / "absent.npz")


def test_damaged_bytes_never_end_in_anything_but_an_error(written: Path, tmp_path: Path) -> None:
    rng, data = np.random.default_rng(1), written.read_bytes()
    for _ in range(20):
        spoiled = bytearray(data)
        for place in rng.integers(0, len(data), 4):
            spoiled[place] ^= 1 << rng.integers(0, 8)
        (tmp_path / "map.npz").write_bytes(spoiled)
        try:
            read_map(tmp_path / "map.npz")
        except InputError:
            continue
