# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import tracemalloc
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard

from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.inflation import Allowance, inflate, zstd_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import FREE_CONTENT, FREE_RECORDS, MAX_INFLATION
from tests.fuzz.hostile_bags import cases, lz4_of_zeros, zstd_of_zeros

GIB = 1 << 30
COMPRESS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}
CONTENT = np.random.default_rng(0).bytes(300_000) + bytes(300_000) + np.random.default_rng(1).bytes(300_000)


@pytest.mark.parametrize("compression", COMPRESS)
def test_gives_all_or_what_lies_before_a_fault(compression: str) -> None:
    data = COMPRESS[compression](CONTENT)
    assert inflate(data, compression, len(CONTENT)) == CONTENT
    assert inflate(data, compression, 1000) == CONTENT[:1000]
    torn = inflate(data[: len(data) // 2], compression, len(CONTENT))
    assert 100_000 < len(torn) < len(CONTENT)
    assert torn == CONTENT[: len(torn)]
    assert inflate(b"noise", compression, 1000) == b""


@pytest.mark.parametrize("bomb", ["zstd", "lz4"])
def test_a_bomb_costs_what_was_declared(bomb: str) -> None:
    data = zstd_of_zeros(6 * GIB, None) if bomb == "zstd" else lz4_of_zeros(6 * GIB)
    tracemalloc.start()
    try:
        assert inflate(data, bomb, 1 << 20) == bytes(1 << 20)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_the_size_of_a_stream_is_known_where_it_declares_one() -> None:
    assert zstd_size(zstd_of_zeros(6 * GIB, 6 * GIB)) == 6 * GIB
    assert zstd_size(zstd_of_zeros(6 * GIB, None)) is None
    assert zstd_size(b"\x28\xb5\x2f\xfd") is None


def test_an_allowance_ends_at_its_edge() -> None:
    size = 1000
    allowance = Allowance(Path("bag.mcap"), size)
    allowance.take_bytes(FREE_CONTENT + MAX_INFLATION * size)
    with pytest.raises(InputError, match=r"bag\.mcap has 1000 bytes and inflates to more"):
        allowance.take_bytes(1)
    allowance.take_records(FREE_RECORDS + size // 16)
    with pytest.raises(InputError, match="claims more messages"):
        allowance.take_records(1)


def test_a_small_file_that_declares_gigabytes_is_refused_without_inflating_them(tmp_path: Path) -> None:
    path = cases()["bombs: zstd of 6 GiB that declares 6442450944"].write(tmp_path / "bag.mcap")
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="declares 6442 MB, 0 MB in the file: 269 MB at most are read"):
            Bag.open(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
