# SPDX-License-Identifier: Apache-2.0
"""Damage to bytes: what disks, networks and adversaries do to a file or a serialised message."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

# Numbers at which sizes and counts overflow, and those that a parser believes and allocates.
_EDGES = (
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    10**9,
    2**63 - 1,
    2**64 - 1,
)
_FORMATS = {1: "B", 2: "H", 4: "I", 8: "Q"}
_PIECE = 64  # bytes at most that are inserted, removed or repeated


def mutated(data: bytes, rng: random.Random) -> bytes:
    """The bytes with one to eight damages."""
    for _ in range(rng.randrange(1, 9)):
        data = rng.choice(_DAMAGES)(data, rng)
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + bytes(byte ^ 1 << rng.randrange(8) for byte in data[at : at + 1]) + data[at + 1 :]


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    """A number at an edge of its range, in place of what stands there."""
    size = rng.choice(tuple(_FORMATS))
    number = struct.pack(rng.choice("<>") + _FORMATS[size], rng.choice(_EDGES) & (1 << 8 * size) - 1)
    at = rng.randrange(len(data) + 1)
    return data[:at] + number + data[at + size :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _remove(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + data[at + rng.randrange(1, _PIECE) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + bytes(rng.randrange(256) for _ in range(rng.randrange(1, 9))) + data[at:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    """A piece of the bytes again, at another place."""
    start, at = rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)
    return data[:at] + data[start : start + rng.randrange(1, _PIECE)] * rng.choice((1, 2, 50)) + data[at:]


def _zeros(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    length = min(rng.randrange(1, _PIECE), len(data) - at)
    return data[:at] + bytes(length) + data[at + length :]


_DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _flip,
    _overwrite,
    _overwrite,
    _cut,
    _remove,
    _insert,
    _repeat,
    _zeros,
)
