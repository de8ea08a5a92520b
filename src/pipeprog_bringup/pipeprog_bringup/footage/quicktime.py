# SPDX-License-Identifier: Apache-2.0
"""What a MOV or MP4 file says of itself: when it was filmed, through which lens, and how its pictures are coded.

Boxes of ISO 14496-12 (mvhd: when; colr: colours) and 14496-15 (hvcC: bits); numbers of transfer functions: ITU-T H.273;
keys and ilst: Apple's QuickTime File Format, Metadata.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_EPOCH = 2_082_844_800  # s from 1904, where these files count from, to 1970
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"meta")
_FOCAL_LENGTH = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_TEXT = 1  # type of a value; others are numbers
_FOCAL_LENGTHS = (8.0, 500.0)  # mm of 35 mm film that a camera can have: from fisheye to tele lenses
_SAMPLE_ENTRY = 78  # bytes of a picture's sample entry before its own boxes
_TRANSFERS = {16: "PQ", 18: "HLG"}
_MAX_BOXES = 10_000  # that are looked at; a phone's file has some hundred
_MAX_BOX = 1 << 12  # bytes that are read of one box


@dataclass(frozen=True)
class Movie:
    """When it was filmed [ns since 1970, UTC], None where it does not tell; bits of a colour; PQ, HLG or empty.

    focal_length: of a lens with this field of view on 35 mm film [mm], None where it does not tell.
    """

    created: int | None = None
    bits: int = 8
    transfer: str = ""
    focal_length: float | None = None


def read_movie(path: Path) -> Movie:
    """What the file tells; nothing where it is another format or damaged."""
    created, bits, transfer = None, 8, ""
    keys: list[bytes] = []
    focal_length: float | None = None
    with path.open("rb") as stream:
        for kind, content in _boxes(stream, path.stat().st_size):
            if kind == b"mvhd" and len(content) >= 20:
                long = content[0] == 1
                seconds = int.from_bytes(content[4 : 12 if long else 8], "big") - _EPOCH
                created = seconds * 1_000_000_000 if 0 < seconds < 1 << 31 else None
            elif kind == b"hvcC" and len(content) > 17:
                bits = 8 + (content[17] & 7)
            elif kind == b"colr" and content[:4] in (b"nclx", b"nclc"):
                transfer = _TRANSFERS.get(int.from_bytes(content[6:8], "big"), "")
            elif kind == b"keys":
                keys = [name for name, _ in _entries(content[8:])]
            elif kind == b"ilst":
                focal_length = _focal_length(keys, content) or focal_length
    return Movie(created, bits, transfer, focal_length)


def _focal_length(keys: list[bytes], items: bytes) -> float | None:
    """The focal length among the items of a list whose keys are known, None without one that a lens can have."""
    for content, number in _entries(items):
        index = int.from_bytes(number, "big") - 1
        if not 0 <= index < len(keys) or keys[index] != _FOCAL_LENGTH or content[4:8] != b"data":
            continue
        kind, value = int.from_bytes(content[8:12], "big"), content[16:]
        try:
            length = float(value.decode("ascii")) if kind == _TEXT else float(int.from_bytes(value, "big"))
        except ValueError:
            continue
        if _FOCAL_LENGTHS[0] <= length <= _FOCAL_LENGTHS[1]:
            return length
    return None


def _entries(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Content and kind of what stands in a row, each after its length and four bytes of a kind."""
    position = 0
    while position + 8 <= len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        if length < 8:
            return
        yield content[position + 8 : position + length], content[position + 4 : position + 8]
        position += length


def _boxes(stream: BinaryIO, size: int) -> Iterator[tuple[bytes, bytes]]:
    """Kind and beginning of the boxes, those within the containers among them."""
    waiting = [(0, size)]
    for _ in range(_MAX_BOXES):
        if not waiting:
            return
        position, end = waiting.pop()
        stream.seek(position)
        head = stream.read(16)
        length, kind, start = int.from_bytes(head[:4], "big"), head[4:8], 8
        if length == 1:
            length, start = int.from_bytes(head[8:16], "big"), 16
        elif length == 0:  # up to the end
            length = end - position
        if len(head) < 8 or not start <= length <= end - position:
            continue
        if position + length < end:
            waiting.append((position + length, end))
        if kind in _CONTAINERS:
            waiting.append((position + start, position + length))
        elif kind == b"stsd":
            waiting.append((position + start + 8, position + length))
        elif kind in (b"hvc1", b"hev1", b"avc1"):
            waiting.append((position + start + _SAMPLE_ENTRY, position + length))
        else:
            stream.seek(position + start)
            yield kind, stream.read(min(length - start, _MAX_BOX))
