# SPDX-License-Identifier: Apache-2.0
"""Recordings made by hand to break a reader, each by its name, with what must become of it."""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import yaml
import zstandard
from mcap.opcode import Opcode

from pipeprog_bringup.recording import cdr
from tests.fuzz import mcap_records as mcap
from tests.fuzz.hostile_images import IMAGES, jpeg_of_scans, png
from tests.unit.bringup.recordings import CAMERA, START, STEP, image, info, jpeg

_FRAMES = 8  # of a recording without damage
_HUGE = (1 << 31, (1 << 32) - 1, 1 << 63, (1 << 64) - 1)
_MIB = 1 << 20


@dataclass(frozen=True)
class Case:
    """A hostile recording.

    Attributes:
        content: makes the bytes of the file, or the files of a folder by their names.
        refused: what the one line that refuses it matches; empty where it may be read.
        usable: frames that can be used; None where any number is right.
        quick: whether it is made and read in well under a second.
    """

    content: Callable[[], bytes | Mapping[str, bytes]]
    refused: str = ""
    usable: int | None = None
    quick: bool = True

    def write(self, path: Path) -> Path:
        """The file or folder at `path`."""
        content = self.content()
        if isinstance(content, bytes):
            path.write_bytes(content)
            return path
        path.mkdir()
        for name, part in content.items():
            (path / name).write_bytes(part)
        return path


@functools.cache
def cases() -> dict[str, Case]:
    """All of them by name."""
    files = (_bombs, _chunks, _records, _floods, _channels, _ends, _times, _folders)
    families = (*files, _pictures, _raw_images, _image_messages, _calibrations, _resolutions, _motions)
    return {f"{family.__name__[1:]}: {name}": case for family in families for name, case in family()}


def _one_chunk(records: list[bytes], *others: bytes) -> bytes:
    return mcap.file(mcap.topics(), mcap.chunk(b"".join(records)), *others)


def zstd_of_zeros(size: int, declared: int | None) -> bytes:
    """A zstd frame of blocks that repeat a zero (RFC 8878, 3.1.1), with or without a size in its header."""
    block = 1 << 17
    head = b"\x28\xb5\x2f\xfd" + (b"\0\x50" if declared is None else b"\xc0\x50" + struct.pack("<Q", declared))
    repeat = ((1 << 1) | block << 3).to_bytes(3, "little") + b"\0"
    return head + repeat * (size // block - 1) + (1 | 1 << 1 | block << 3).to_bytes(3, "little") + b"\0"


def lz4_of_zeros(size: int) -> bytes:
    """An lz4 frame of blocks of zeros."""
    block = 4 * _MIB
    compressor = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB, block_linked=False)
    head = compressor.begin()
    return head + compressor.compress(bytes(block)) * (size // block) + struct.pack("<I", 0)


def _bombs() -> Iterator[tuple[str, Case]]:
    for size in (6 << 30, 100 << 30):
        for lie in (0, 1, 1000, 100 * _MIB, 256 * _MIB, size, (1 << 64) - 1):
            stored = functools.partial(zstd_of_zeros, size, None)
            yield (
                f"zstd of {size >> 30} GiB that declares {lie}",
                _bomb(stored, "zstd", lie, quick=lie < 2000 or lie >= size),
            )
    for lie in (0, 1000, 100 * _MIB, 6 << 30):
        stored = functools.partial(lz4_of_zeros, 6 << 30)
        yield f"lz4 of 6 GiB that declares {lie}", _bomb(stored, "lz4", lie, quick=False)
    for number in (20, 200):
        yield (
            f"{number} chunks of 250 MiB each",
            Case(functools.partial(_many_bombs, number), "hundred times", quick=False),
        )
    for declared in (None, 6 << 30, 200 * _MIB):
        for number in (1, 500):
            data = functools.partial(_message_bombs, number, declared)
            yield f"{number} compressed messages of 6 GiB that declare {declared}", Case(data, quick=False)
    yield "a good recording before a bomb", Case(lambda: _beside_a_bomb(before=True), usable=_FRAMES)
    yield "a good recording behind a bomb", Case(lambda: _beside_a_bomb(before=False), usable=_FRAMES)


def _bomb(stored: Callable[[], bytes], compression: str, size: int, quick: bool) -> Case:
    return Case(
        lambda: mcap.file(mcap.topics(), mcap.chunk(b"", compression, stored=stored(), size=size)),
        "holds no messages",
        quick=quick,
    )


def _many_bombs(number: int) -> bytes:
    stored = zstd_of_zeros(250 * _MIB, None)
    return mcap.file(mcap.topics(), mcap.chunk(b"", stored=stored, size=250 * _MIB, crc=0) * number)


def _message_bombs(number: int, declared: int | None) -> bytes:
    bomb = mcap.message(mcap.IMAGE, START, zstd_of_zeros(6 << 30, declared))
    return mcap.file(mcap.topics(), mcap.chunk(mcap.message(mcap.INFO, START, info(0)) + bomb * number))


def _beside_a_bomb(before: bool) -> bytes:
    bomb = mcap.chunk(b"", stored=zstd_of_zeros(1 << 30, None), size=6 << 30)
    frames = mcap.chunk(b"".join(mcap.camera_records()))
    return mcap.file(mcap.topics(), *((frames, bomb) if before else (bomb, frames)))


def _chunks() -> Iterator[tuple[str, Case]]:
    content = b"".join(mcap.camera_records())
    right = len(content)
    for compression in ("zstd", "lz4", ""):
        for size in (0, 1, right - 1, right + 1, 1 << 28, *_HUGE):
            lying = mcap.file(mcap.topics(), mcap.chunk(content, compression, size=size))
            yield f"{compression or 'plain'} of {right} that declares {size}", Case(_constant(lying))
        for length in (0, 1, 1 << 28, *_HUGE):
            lying = mcap.file(mcap.topics(), mcap.chunk(content, compression, length=length))
            yield f"{compression or 'plain'} whose records' length is {length}", Case(_constant(lying))
        wrong = mcap.file(mcap.topics(), mcap.chunk(content, compression, crc=1))
        yield f"{compression or 'plain'} with a wrong checksum", Case(_constant(wrong), "holds no messages|can be used")
        named = mcap.file(mcap.topics(), mcap.chunk(content, "", name=compression))
        yield f"plain records called {compression or 'plain'}", Case(_constant(named))
        yield (
            f"{compression or 'plain'} empty",
            Case(_constant(mcap.good(mcap.chunk(b"", compression))), usable=_FRAMES),
        )
    for name in ("brotli", "ZSTD", "zstd\0", "\x1b[31m", "z" * 60, "z" * 70, "é"):
        alien = mcap.file(mcap.topics(), mcap.chunk(content, "", name=name))
        yield f"compression {name!r}", Case(_constant(alien), "use one of zstd, lz4, none|holds no messages")
    for start in (0, START + 7 * STEP, (1 << 64) - 1):
        yield (
            f"start {start}",
            Case(_constant(mcap.file(mcap.topics(), mcap.chunk(content, start=start))), usable=_FRAMES),
        )
    yield "a chunk within a chunk", Case(lambda: mcap.good(mcap.chunk(mcap.chunk(content))), usable=_FRAMES)
    yield "a footer within a chunk", Case(lambda: mcap.good(mcap.chunk(mcap.end())), usable=_FRAMES)
    yield "out of the order of time", Case(_constant(_halves(late_first=True)), usable=_FRAMES)
    yield "chunk cut by the end", Case(_constant(mcap.good()[:-600]))
    yield "the same chunk twice", Case(lambda: mcap.file(mcap.topics(), mcap.chunk(content) * 2), usable=2 * _FRAMES)
    yield "700 chunks of one time, 1 MB each", Case(_overlapping, "mcap sort", quick=False)


def _halves(late_first: bool) -> bytes:
    records = mcap.camera_records()
    early = mcap.chunk(b"".join(records[:8]), start=START)
    late = mcap.chunk(b"".join(records[8:]), start=START + 4 * STEP)
    return mcap.file(mcap.topics(), *((late, early) if late_first else (early, late)))


def _overlapping() -> bytes:
    noise = np.random.default_rng(0).bytes(200_000)
    chunk = mcap.chunk(mcap.message(mcap.IMAGE, START + 9 * STEP, noise * 5), start=START)
    return mcap.file(mcap.topics(), mcap.chunk(b"".join(mcap.camera_records())), chunk * 700)


def _records() -> Iterator[tuple[str, Case]]:
    for opcode in (*range(1, 16), 16, 0x80, 0xFF):
        for length in (0, 3, 1 << 31, (1 << 64) - 1, (1 << 64) - 9):
            wrong = struct.pack("<BQ", opcode, length) + bytes(length if length < 10 else 0)
            yield f"opcode {opcode} of {length} bytes first", Case(_constant(mcap.good(wrong)))
    for opcode in range(1, 16):
        noise = mcap.record(opcode, np.random.default_rng(opcode).bytes(200))
        yield f"opcode {opcode} of noise behind the frames", Case(_constant(_one_chunk(mcap.camera_records(), noise)))
    within = [*mcap.camera_records()[:8], struct.pack("<BQ", Opcode.MESSAGE, (1 << 64) - 1)]
    yield "a message of 2^64 bytes within a chunk", Case(_constant(_one_chunk(within)), usable=4)
    short = [*mcap.camera_records(), mcap.record(Opcode.MESSAGE, bytes(10))]
    yield "a message of 10 bytes within a chunk", Case(_constant(_one_chunk(short)), usable=_FRAMES)
    for entries in (0, 16, *_HUGE[:2]):
        lying = mcap.index(mcap.IMAGE, [(START, 0)], entries)
        yield f"a message index of {entries} bytes", Case(_constant(_one_chunk(mcap.camera_records(), lying)))
    alien = mcap.index(999, [(START, 1 << 63)] * 5)
    yield "a message index of an unknown channel", Case(_constant(_one_chunk(mcap.camera_records(), alien)))


def _floods() -> Iterator[tuple[str, Case]]:
    empty = struct.pack("<BQ", 0x80, 0)
    yield "two million empty records", Case(lambda: mcap.good(empty * 2_000_000), "claims more messages", quick=False)
    small = mcap.message(mcap.IMAGE, START, b"")
    yield (
        "eight million messages in a chunk",
        Case(lambda: mcap.good(mcap.chunk(small * (250 * _MIB // len(small)))), "claims more messages", quick=False),
    )
    yield "a million messages in a chunk", Case(lambda: mcap.good(mcap.chunk(small * 1_000_000)), quick=False)
    yield (
        "70000 channels",
        Case(lambda: mcap.good(mcap.chunk(b"".join(_channel(n) for n in range(10, 65_536)) * 2)), quick=False),
    )
    yield "65000 schemas", Case(lambda: mcap.good(mcap.chunk(_schemas())), quick=False)
    indexes = mcap.index(7, [(0, 0)] * 100_000)
    yield "ten million entries of an index", Case(lambda: mcap.good(indexes * 100), quick=False)
    empties = mcap.chunk(b"")
    yield "100000 empty chunks", Case(lambda: mcap.good(empties * 100_000), quick=False)
    yield "20000 cameras in one topic", Case(_many_frames, usable=_FRAMES, quick=False)


def _schemas() -> bytes:
    return b"".join(mcap.schema(number, "a/msg/B", bytes(900)) for number in range(3, 65_536))


def _many_frames() -> bytes:
    infos = (mcap.message(mcap.INFO, START + n, info(0, frame_id=f"camera{n}")) for n in range(20_000))
    return mcap.file(mcap.topics(), mcap.chunk(b"".join(infos)), mcap.chunk(b"".join(mcap.camera_records())))


def _channel(number: int) -> bytes:
    return mcap.channel(number, 1, f"/camera{number}/camera_info")


def _channels() -> Iterator[tuple[str, Case]]:
    records = b"".join(mcap.camera_records())
    again = mcap.channel(mcap.IMAGE, 1, "/other")
    yield (
        "a number given twice, the second for another topic",
        Case(_constant(mcap.file(mcap.topics(), again, mcap.chunk(records))), usable=_FRAMES),
    )
    yield "a number given twice, the first for another topic", Case(_constant(mcap.good(again)))
    second = mcap.channel(9, 1, mcap.IMAGE_TOPIC) + mcap.message(9, START, info(0))
    yield "a topic of two types", Case(_constant(mcap.good(mcap.schema(1, mcap.INFO_TYPE), second)), "two types")
    unknown = mcap.chunk(mcap.message(77, START, b"x") * 5)
    yield "messages on a channel that is nowhere", Case(_constant(mcap.good(unknown)), usable=_FRAMES)
    yield "no channels at all", Case(_constant(mcap.file(mcap.chunk(records))), "no messages")
    only = mcap.channel(mcap.INFO, 1, mcap.INFO_TOPIC) + mcap.channel(mcap.IMAGE, 2, mcap.IMAGE_TOPIC)
    yield "no schemas", Case(_constant(mcap.file(only, mcap.chunk(records))), "no images")
    zero = mcap.channel(mcap.INFO, 0, mcap.INFO_TOPIC) + mcap.channel(mcap.IMAGE, 0, mcap.IMAGE_TOPIC)
    yield "schema 0", Case(_constant(mcap.file(zero, mcap.chunk(records))), "no images")
    for encoding in ("", "json", "protobuf", "ros1", "CDR", "x" * 100_000):
        channels = mcap.topics() + mcap.channel(5, 2, "/more", encoding) + mcap.message(5, START, b"{}")
        yield f"encoding {encoding[:8]!r} beside", Case(_constant(mcap.file(channels, mcap.chunk(records))))
    names: dict[str, str | bytes] = {
        "empty": "",
        "of 257 characters": "/" + "a" * 256,
        "of 900 kB": "/" + "a" * 900_000,
        "of 2 MB": "/" + "a" * 2_000_000,
        "with a line break": "/a\nb",
        "with an escape": "/a\x1b[2J",
        "with NUL": "/a\0b",
        "with markup": "[/red]/a",
        "not in UTF-8": b"/\xff\xfe",
        "that leads outside": "/../../etc",
    }
    for what, name in names.items():
        alone = mcap.schema(2, mcap.IMAGE_TYPE) + mcap.channel(mcap.IMAGE, 2, name)
        described = mcap.schema(1, mcap.INFO_TYPE) + mcap.channel(mcap.INFO, 1, mcap.INFO_TOPIC)
        yield f"an image topic {what}", Case(_constant(mcap.file(described, alone, mcap.chunk(records))))
        typed = mcap.schema(2, name) + mcap.channel(mcap.IMAGE, 2, mcap.IMAGE_TOPIC)
        yield f"a type {what}", Case(_constant(mcap.file(described, typed, mcap.chunk(records))))
    cameras = b"".join(
        mcap.channel(number, 2, f"/camera{number}/image") + mcap.message(number, START, image(0))
        for number in range(10, 2000)
    )
    yield "2000 cameras", Case(_constant(mcap.good(mcap.schema(2, mcap.IMAGE_TYPE), cameras)), "several cameras")
    metadata = mcap.channel(9, 1, "/more", metadata=bytes(900_000))
    yield "metadata of 900 kB", Case(_constant(mcap.good(metadata)), usable=_FRAMES)


def _ends() -> Iterator[tuple[str, Case]]:
    data = b"".join(mcap.camera_records())
    body = (mcap.topics(), mcap.chunk(data))
    statistics = {
        n: mcap.record(Opcode.STATISTICS, struct.pack("<QHIIIIQQI", n, 9, n % 7, 9, 9, 9, n, 0, 0))
        for n in (0, 1 << 63)
    }
    outside = struct.pack("<QQQQ", START, START, 1 << 62, 1 << 62) + struct.pack("<I", 0) + struct.pack("<Q", 0)
    chunk_index = mcap.record(Opcode.CHUNK_INDEX, outside + mcap.text("zstd") + struct.pack("<QQ", 1 << 63, 1 << 63))
    tails = {
        "no end": b"",
        "no data end": mcap.end(data_end=False),
        "no footer": mcap.record(Opcode.DATA_END, bytes(4)) + mcap.MAGIC,
        "no magic": mcap.end()[: -len(mcap.MAGIC)],
        "wrong magic": mcap.end()[:-1] + b"x",
        "two ends": mcap.end() * 2,
        "a footer that points outside": mcap.end(footer=(1 << 63, 1 << 63, 1)),
        "statistics of nothing": mcap.end(statistics[0]),
        "statistics of 2^63 messages": mcap.end(statistics[1 << 63]),
        "a chunk index outside": mcap.end(chunk_index),
        "channels of the summary that differ": mcap.end(mcap.channel(mcap.IMAGE, 1, "/other")),
        "an attachment of 2^63 bytes": mcap.record(Opcode.ATTACHMENT, bytes(40), 1 << 63),
        "an attachment of 5 MB": mcap.record(Opcode.ATTACHMENT, bytes(5_000_000)) + mcap.end(),
        "metadata of 5 MB": mcap.record(Opcode.METADATA, bytes(5_000_000)) + mcap.end(),
        "noise": np.random.default_rng(3).bytes(5000),
        "zeros": bytes(5000),
        "the file again": mcap.good(),
    }
    for name, tail in tails.items():
        yield name, Case(_constant(mcap.file(*body, tail=tail)), usable=_FRAMES if "attach" not in name else None)
    yield "magic alone", Case(lambda: mcap.MAGIC)
    yield "magic twice", Case(lambda: mcap.MAGIC * 2)
    yield "an empty file", Case(lambda: b"", "is empty")
    for length in (1, 4, 7, 8, 9, 17, 40, 60, 100):
        yield f"cut after {length} bytes", Case(_constant(mcap.good()[:length]), "cut off|no messages|not an mcap")


def _times() -> Iterator[tuple[str, Case]]:
    stamps = {
        "repeated": [0] * 8,
        "backwards": list(range(8, 0, -1)),
        "zigzag": [0, 5, 1, 6, 2, 7, 3, 8],
        "far apart": [n * 50_000_000 for n in range(8)],
    }
    for name, numbers in stamps.items():
        times = {n: _stamped(1_700_000_000 + number, 0) for n, number in enumerate(numbers)}
        yield f"stamps {name}", Case(_constant(_one_chunk(mcap.camera_records(images=times))))
    for seconds, nanoseconds in (
        (-1, 0),
        (-(1 << 31), 0),
        ((1 << 31) - 1, 0),
        ((1 << 31) - 1, 999_999_999),
        (5, 1_000_000_000),
        (5, (1 << 32) - 1),
    ):
        bad = _stamped(seconds, nanoseconds)
        what = f"{seconds} s + {nanoseconds} ns"
        one, every = ({n: bad for n in numbers} for numbers in ((3,), range(8)))
        yield f"one stamp of {what}", Case(_constant(_one_chunk(mcap.camera_records(images=one))), usable=_FRAMES - 1)
        yield (
            f"all stamps of {what}",
            Case(_constant(_one_chunk(mcap.camera_records(images=every))), "stamp is no time"),
        )
    yield "zero stamps", Case(_constant(_one_chunk(mcap.camera_records(images={n: _stamped(0, 0) for n in range(8)}))))
    for log_time in (0, 1 << 63, (1 << 64) - 1):
        last = mcap.message(mcap.IMAGE, log_time, image(7))
        yield f"logged at {log_time}", Case(_constant(_one_chunk([*mcap.camera_records()[:-1], last])), usable=_FRAMES)
        bad = mcap.message(mcap.IMAGE, log_time, b"")
        yield (
            f"damaged and logged at {log_time}",
            Case(_constant(_one_chunk([*mcap.camera_records(), bad])), usable=_FRAMES),
        )


def _stamped(seconds: int, nanoseconds: int) -> bytes:
    return image(0)[:4] + struct.pack("<iI", seconds, nanoseconds) + image(0)[12:]


def _pictures() -> Iterator[tuple[str, Case]]:
    for name, encoded in IMAGES.items():
        message = cdr.write_compressed_image(START + 3 * STEP, "camera", "jpeg", encoded)
        yield f"one {name}", Case(_constant(_one_chunk(mcap.camera_records(images={3: message}))))
    for name in ("PNG of 100000 x 100000", "JPEG of 30000 x 30000", "JPEG of 3000 scans", "PNG of 1 x 1", "a text"):
        message = cdr.write_compressed_image(START, "camera", "jpeg", IMAGES[name])
        every = mcap.camera_records(images={n: message for n in range(8)})
        yield f"only {name}", Case(_constant(_one_chunk(every)), "none of the 8 images")


def _raw_images() -> Iterator[tuple[str, Case]]:
    right = {"height": 48, "width": 64, "step": 64, "encoding": "mono8", "data": bytes(64 * 48)}
    lies: dict[str, dict[str, Any]] = {
        f"{key} {value}": {key: value}
        for key in ("height", "width", "step")
        for value in (0, 1, 63, 65, 1 << 31, (1 << 32) - 1)
    }
    lies |= {
        f"encoding {name!r}": {"encoding": name}
        for name in ("", "yuv422", "bgr8", "mono16", "jpeg", "x" * 1000, "\x1b[1m")
    }
    lies |= {"no data": {"data": b""}, "too much data": {"data": bytes(1_000_000)}, "right": {}}
    for name, lie in lies.items():
        content = {"header": cdr.header(START, "camera"), **right, **lie}
        yield (
            name,
            Case(
                _constant(_raw(cdr.write(cdr.IMAGE, content))),
                usable=1 if name in ("right", "too much data") else None,
            ),
        )
    whole = cdr.write(cdr.IMAGE, {"header": cdr.header(START, "camera"), **right})
    for length in (0, 3, 4, 12, 20, 40, 60, len(whole) - 1):
        yield f"cut after {length} bytes", Case(_constant(_raw(whole[:length])), "none of the 1 images")


def _raw(data: bytes) -> bytes:
    described = mcap.topics() + mcap.schema(3, cdr.IMAGE) + mcap.channel(3, 3, "/camera/image")
    return mcap.file(described, mcap.chunk(mcap.message(mcap.INFO, START, info(0)) + mcap.message(3, START, data)))


def _image_messages() -> Iterator[tuple[str, Case]]:
    whole = image(3)
    yield from _damaged_messages(whole, lambda data: mcap.camera_records(images={3: data}), image_only=True)
    for frame_id in ("", "x" * 255, "x" * 257, "x" * 100_000, "a\nb", "\x1b[2J", "=cmd|a", "é"):
        named = cdr.write_compressed_image(START + 3 * STEP, frame_id, "jpeg", jpeg(3))
        yield (
            f"frame_id {frame_id[:8]!r} of {len(frame_id)}",
            Case(_constant(_one_chunk(mcap.camera_records(images={3: named})))),
        )
    big = whole + bytes(3_000_000)
    yield "a tail of 3 MB", Case(_constant(_one_chunk(mcap.camera_records(images={3: big}))), usable=_FRAMES)


def _damaged_messages(
    whole: bytes, records: Callable[[bytes], list[bytes]], image_only: bool
) -> Iterator[tuple[str, Case]]:
    """Cut at many places, lengths that lie, other encapsulations; of an image, each costs just that frame."""
    usable = _FRAMES - 1 if image_only else None
    for length in (0, 1, 3, 4, 8, 11, 12, 16, 20, 24, 30, 40, len(whole) - 100, len(whole) - 8, len(whole) - 1):
        yield f"cut after {length} bytes", Case(_constant(_one_chunk(records(whole[:length]))), usable=usable)
    for at in (12, 24, 28, 32, 36):
        for value in (0, 1, 1 << 16, 1 << 31, (1 << 32) - 1):
            lying = whole[:at] + struct.pack("<I", value) + whole[at + 4 :]
            yield f"{value} at byte {at}", Case(_constant(_one_chunk(records(lying))))
    for head in (b"\0\0", b"\0\2", b"\0\3", b"\0\7", b"\1\0", b"\xff\xff"):
        yield f"encapsulation {head.hex()}", Case(_constant(_one_chunk(records(head + whole[2:]))))


def _calibrations() -> Iterator[tuple[str, Case]]:
    whole = info(3)
    yield from _damaged_messages(whole, lambda data: mcap.camera_records(infos={3: data}), image_only=False)
    for less in (1, 4, 8, 50, 99, 100, 150):
        every = {n: info(n)[:-less] for n in range(8)}
        cut = _one_chunk(mcap.camera_records(infos=every))
        yield f"all cut {less} bytes before their end", Case(_constant(cut), "can be read")
    numbers = (0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e300)
    for number in numbers:
        k = [number, 0.0, 31.5, 0.0, number, 23.5, 0.0, 0.0, 1.0]
        yield f"all of focal length {number}", Case(_constant(_with_infos(range(8), k=k)), "camera_info")
        yield f"one of focal length {number}", Case(_constant(_with_infos([3], k=k)), usable=_FRAMES - 1)
    for size in (0, 1, 63, 1 << 31, (1 << 32) - 1):
        yield f"one of width {size}", Case(_constant(_with_infos([3], width=size)), usable=_FRAMES - 1)
        yield f"all of width {size}", Case(_constant(_with_infos(range(8), width=size)), "camera_info|none of the 8")
    for count in (3, 100, 10_000):
        yield f"{count} coefficients", Case(_constant(_with_infos([3], d=[0.1] * count)))
    yield "distortion of NaN", Case(_constant(_with_infos([3], d=[float("nan")] * 5)), usable=_FRAMES - 1)
    for model in ("wavy", "x" * 100_000, "\x1b[2J", ""):
        yield f"model {model[:8]!r}", Case(_constant(_with_infos([3], distortion_model=model)))
    yield "binning", Case(_constant(_with_infos([3], binning_x=2, binning_y=2)), usable=_FRAMES - 1)
    yield (
        "a region",
        Case(_constant(_with_infos([3], roi={"x_offset": 4, "width": 32, "height": 48})), usable=_FRAMES - 1),
    )
    yield (
        "a tail of 2 MB",
        Case(_constant(_one_chunk(mcap.camera_records(infos={3: whole + bytes(2_000_000)}))), usable=_FRAMES),
    )


def _with_infos(numbers: Any, **changes: Any) -> bytes:
    right = {"height": 48, "width": 64, "distortion_model": "plumb_bob", "k": CAMERA.matrix.ravel().tolist()}
    infos = {
        n: cdr.write(cdr.CAMERA_INFO, {"header": cdr.header(START + n * STEP, "camera"), **right, **changes})
        for n in numbers
    }
    return _one_chunk(mcap.camera_records(infos=infos))


def _resolutions() -> Iterator[tuple[str, Case]]:
    larger = replace(CAMERA, width=128, height=96)
    images = {n: image(n, encoded=jpeg(n, 128, 96)) for n in range(4, 8)}
    infos = {n: info(n, larger) for n in range(4, 8)}
    yield "changed with its CameraInfo", Case(_constant(_one_chunk(mcap.camera_records(images, infos))), usable=_FRAMES)
    yield "changed without its CameraInfo", Case(_constant(_one_chunk(mcap.camera_records(images))), usable=4)
    yield "CameraInfo changed alone", Case(_constant(_one_chunk(mcap.camera_records(infos=infos))), usable=4)
    there_and_back = {n: images.get(n, image(n)) if n % 2 else image(n) for n in range(4, 8)}
    both = {n: info(n, larger) if n % 2 else info(n) for n in range(4, 8)}
    yield (
        "changed with each frame",
        Case(_constant(_one_chunk(mcap.camera_records(there_and_back, both))), usable=_FRAMES),
    )
    bomb = {n: image(n, encoded=png(8192, 8192)) for n in (4, 5)}
    wide = {n: info(n, replace(CAMERA, width=8192, height=8192, fx=8000.0, fy=8000.0)) for n in (4, 5)}
    yield "changed to 67 megapixels", Case(_constant(_one_chunk(mcap.camera_records(bomb, wide))), usable=_FRAMES)
    scans = {3: image(3, encoded=jpeg_of_scans(90))}
    yield "a JPEG of 96 scans", Case(_constant(_one_chunk(mcap.camera_records(scans))), usable=_FRAMES)


def _motions() -> Iterator[tuple[str, Case]]:
    odometry = cdr.write(cdr.ODOMETRY, {"header": cdr.header(START, "odom"), "child_frame_id": "base"})
    imu = cdr.write(cdr.IMU, {"header": cdr.header(START, "imu")})
    transform = cdr.write(cdr.TF, {"transforms": [{"header": cdr.header(START, "a"), "child_frame_id": "b"}] * 2})
    messages = {cdr.ODOMETRY: odometry, cdr.IMU: imu, cdr.TF: transform}
    for type_name, whole in messages.items():
        kind = type_name.rpartition("/")[2]
        damages = {
            "empty": b"",
            "cut in half": whole[: len(whole) // 2],
            "cut by a byte": whole[:-1],
            "of ones": whole[:4] + b"\xff" * (len(whole) - 4),
            "of noise": whole[:4] + np.random.default_rng(1).bytes(len(whole)),
            "with a length of 2^32": whole[:12] + b"\xff\xff\xff\xff" + whole[16:],
            "big-endian by its head": b"\0\0" + whole[2:],
            "with a tail of 2 MB": whole + bytes(2_000_000),
            "whole": whole,
        }
        for what, data in damages.items():
            yield f"{kind} {what}", Case(_constant(_moving(type_name, data)), usable=_FRAMES)
    many = transform[:4] + struct.pack("<I", 50_000_000) + bytes(300_000)
    yield "TF that claims 50 million transforms", Case(_constant(_moving(cdr.TF, many)), usable=_FRAMES)
    static = mcap.schema(3, cdr.TF) + mcap.channel(3, 3, "/tf_static")
    flood = mcap.chunk(mcap.message(3, START, b"x") * 200_000)
    yield "200000 damaged static transforms", Case(_constant(mcap.good(static, flood)), usable=_FRAMES, quick=False)


def _moving(type_name: str, data: bytes) -> bytes:
    topic = "/tf" if type_name == cdr.TF else "/motion"
    described = mcap.schema(3, type_name) + mcap.channel(3, 3, topic)
    return mcap.good(described, mcap.message(3, START + STEP // 2, data))


def _folders() -> Iterator[tuple[str, Case]]:
    part = {"part.mcap": mcap.good()}
    metadata: dict[str, tuple[Any, str]] = {
        "right": (["part.mcap"], ""),
        "of the folder above": (["bag/part.mcap"], ""),
        "absolute": (["/somewhere/part.mcap"], ""),
        "that lead outside": (["../../etc/passwd"], "no file in its folder"),
        "with a NUL": (["part\0.mcap"], "control character|no file"),
        "with a line break": (["pa\nrt.mcap"], "no file in its folder"),
        "that are empty": ([""], "missing"),
        "that are a point": (["."], "missing"),
        "twice": (["part.mcap"] * 2, "twice"),
        "of 300 characters": (["p" * 300], "no file in its folder"),
        "that are numbers": ([1, 2.5, None], "no file in its folder"),
        "that are lists": ([["part.mcap"]], "no file in its folder"),
        "not there": (["gone.mcap"], "missing"),
        "not there, 9000 of them": ([f"p{n}" for n in range(9000)], "and 8995 more"),
        "20000 of them": ([f"p{n}" for n in range(20_000)], "at most are read"),
        "none": ([], "names no file"),
        "a text": ("part.mcap", "no rosbag2 metadata"),
        "a mapping": ({"a": "part.mcap"}, "no rosbag2 metadata"),
        "nothing": (None, "no rosbag2 metadata"),
    }
    for what, (names, refused) in metadata.items():
        make = functools.partial(_folder, names, part)
        yield f"names {what}", Case(make, refused, None if refused else _FRAMES, quick="0 of" not in what)
    texts = {
        "a million names": b"rosbag2_bagfile_information: {relative_file_paths: [" + b"part.mcap," * 1_000_000 + b"]}",
        "nested 100000 deep": b"rosbag2_bagfile_information: " + b"[" * 100_000,
        "aliases of aliases": b"a: &a [x,x,x,x,x,x,x,x,x,x]\n"
        + b"".join(b"%c: &%c [%s]\n" % (97 + n, 97 + n, b",".join([b"*%c" % (96 + n)] * 10)) for n in range(1, 12))
        + b"rosbag2_bagfile_information: {relative_file_paths: *l}\n",
        "a tag": b"rosbag2_bagfile_information: !!python/object/apply:os.system [true]",
        "a number of 100000 digits": b"rosbag2_bagfile_information: {relative_file_paths: [" + b"9" * 100_000 + b"]}",
        "noise": np.random.default_rng(5).bytes(2000),
        "nothing": b"",
        "a bracket": b"[",
        "a list": b"[1, 2]",
        "a text": b"hello",
        "half": b"rosbag2_bagfile_information:",
        "rocksdb": b"rosbag2_bagfile_information: {storage_identifier: rocksdb, relative_file_paths: [part.mcap]}",
        "a storage that is a list": b"rosbag2_bagfile_information: {storage_identifier: [a], relative_file_paths: [b]}",
        "compressed files": b"rosbag2_bagfile_information: {compression_mode: FILE, relative_file_paths: [part.mcap]}",
    }
    for what, content in texts.items():
        yield f"metadata of {what}", Case(_constant({**part, "metadata.yaml": content}), "metadata|bag convert")
    yield "no metadata", Case(_constant(part), "no metadata.yaml: give one of its files")
    right = yaml.safe_dump({"rosbag2_bagfile_information": {"relative_file_paths": ["a.mcap", "b.mcap"]}}).encode()
    for what, other in {"empty": b"", "a text": b"hello", "torn": mcap.good()[:-700]}.items():
        files = {"a.mcap": mcap.good(), "b.mcap": other, "metadata.yaml": right}
        yield f"second file {what}", Case(_constant(files), "" if what == "torn" else "b.mcap")
    compressed = [
        mcap.message(number, START + n * STEP, zstandard.compress(data))
        for n in range(8)
        for number, data in ((mcap.INFO, info(n)), (mcap.IMAGE, image(n)))
    ]
    compressed[5] = mcap.message(mcap.IMAGE, START + 2 * STEP, zstandard.compress(image(2))[:-9])
    yield "compressed messages, one cut", Case(_constant(_one_chunk(compressed)), usable=_FRAMES - 1)


def _folder(names: Any, parts: Mapping[str, bytes]) -> Mapping[str, bytes]:
    """The parts with a metadata.yaml of these names."""
    content = {"rosbag2_bagfile_information": {"relative_file_paths": names}}
    return {**parts, "metadata.yaml": yaml.safe_dump(content).encode()}


def _constant(content: Any) -> Callable[[], Any]:
    return lambda: content
