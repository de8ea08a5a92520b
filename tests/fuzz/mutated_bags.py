# SPDX-License-Identifier: Apache-2.0
"""Small good recordings with damage drawn from a seed: to the file's bytes, or to messages within an intact file."""

from __future__ import annotations

import functools
import random
import struct
from collections.abc import Callable
from typing import Any

import zstandard
from mcap.writer import CompressionType

from pipeprog_bringup.recording import cdr
from tests.fuzz import mcap_records as mcap
from tests.fuzz.mutated_bytes import mutated
from tests.unit.bringup.recordings import START, STEP, camera_messages, mcap_bytes, raw_image

Messages = list[tuple[str, str, int, bytes]]
_LENGTHS = (0, 1, 100, 1 << 20, 1 << 28, 1 << 31, (1 << 32) - 1, 1 << 62, (1 << 64) - 1)


def mutated_bag(seed: int) -> bytes:
    """The bytes of one recording."""
    rng = random.Random(seed)
    return rng.choice((_damaged_file, _damaged_file, _damaged_messages, _damaged_messages, _spliced, _lengthened))(rng)


@functools.cache
def _messages() -> Messages:
    """Eight frames with odometry, IMU and TF between them."""
    transform = {"header": cdr.header(START, "map"), "child_frame_id": "base"}
    told: list[tuple[str, str, dict[str, Any]]] = [
        ("/odom", cdr.ODOMETRY, {"header": cdr.header(START, "map"), "child_frame_id": "base"}),
        ("/imu", cdr.IMU, {"header": cdr.header(START, "imu")}),
        ("/tf", cdr.TF, {"transforms": [transform] * 3}),
        ("/tf_static", cdr.TF, {"transforms": [transform]}),
    ]
    motion = [
        (topic, kind, START + n * STEP + 1, cdr.write(kind, content))
        for n in (0, 3, 5)
        for topic, kind, content in told
    ]
    return sorted(camera_messages(8) + motion, key=lambda message: message[2])


@functools.cache
def _recordings() -> tuple[bytes, ...]:
    """The same content in all the layouts that writers use."""
    raw = [message for message in _messages() if message[1] != cdr.COMPRESSED_IMAGE]
    raw += [("/camera/image", cdr.IMAGE, START + n * STEP, raw_image(n)) for n in range(8)]
    one_by_one = [(*message[:3], zstandard.compress(message[3])) for message in _messages()]
    return (
        mcap_bytes(_messages()),
        mcap_bytes(_messages(), CompressionType.LZ4),
        mcap_bytes(_messages(), CompressionType.NONE),
        mcap_bytes(_messages(), chunk_size=1 << 20),
        mcap_bytes(_messages(), use_chunking=False),
        mcap_bytes(raw),
        mcap_bytes(one_by_one, CompressionType.NONE),
        mcap.good(compression=""),
    )


def _damaged_file(rng: random.Random) -> bytes:
    return mutated(rng.choice(_recordings()), rng)


def _damaged_messages(rng: random.Random) -> bytes:
    """Each second message or so of one topic, in a file that is right."""
    topic = rng.choice(sorted({message[0] for message in _messages()}))
    damage: Callable[[bytes], bytes] = rng.choice((lambda data: mutated(data, rng), lambda data: _number(data, rng)))
    share = rng.choice((0.2, 0.5, 1.0))
    return mcap_bytes(
        [(*one[:3], damage(one[3]) if one[0] == topic and rng.random() < share else one[3]) for one in _messages()],
        rng.choice(list(CompressionType)),
    )


def _number(data: bytes, rng: random.Random) -> bytes:
    """One aligned number of a message, among its first fields, at an edge of its range."""
    at = 4 * rng.randrange(1, max(min(len(data), 120) // 4, 2))
    return data[:at] + struct.pack("<I", rng.choice(_LENGTHS) & 0xFFFFFFFF) + data[at + 4 :]


def _spliced(rng: random.Random) -> bytes:
    """The beginning of one file and the end of another."""
    one, other = rng.choice(_recordings()), rng.choice(_recordings())
    return one[: rng.randrange(len(one))] + other[rng.randrange(len(other)) :]


def _lengthened(rng: random.Random) -> bytes:
    """The length of one record inflated, or cut."""
    data = rng.choice(_recordings())
    starts, position = [], len(mcap.MAGIC)
    while position + 9 <= len(data) - len(mcap.MAGIC):
        starts.append(position)
        position += 9 + struct.unpack_from("<Q", data, position + 1)[0]
    at = rng.choice(starts) + 1
    return data[:at] + struct.pack("<Q", rng.choice(_LENGTHS)) + data[at + 8 :]
