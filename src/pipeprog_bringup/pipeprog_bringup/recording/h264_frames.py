# SPDX-License-Identifier: Apache-2.0
"""Which frames of an H.264 or H.265 stream can be decoded without those before them, and where a frame is missing.

A decoder of H.264 shows what it makes of a frame whose predecessor is lost without a word; the frame numbers of the
stream tell. Byte stream format (start codes): ITU-T H.264, annex B; frame numbers and their gaps: 7.3.2.1.1, 7.3.3 and
7.4.3 there; unit types of H.265: ITU-T H.265, table 7-1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

H264, HEVC = "h264", "hevc"
_START = re.compile(b"\0\0\1")
_IDR, _SLICE, _SPS = 5, 1, 7  # unit types of H.264
_HEVC_KEYS = range(16, 22)  # unit types of H.265's random access pictures: BLA, IDR, CRA
_HEAD = 512  # bytes of a unit that its first fields lie in; the longest SPS has 300
# Profiles whose SPS tells colours and scaling matrices before the length of the frame number.
_HIGH_PROFILES = (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135)


def codec_of(name: str) -> str:
    """H264 or HEVC from the names that encoders and recordings use ("libx264", "hevc_nvenc", "h265"); "" for others."""
    name = name.lower()
    if "264" in name:
        return H264
    return HEVC if "265" in name or "hevc" in name else ""


def units(data: bytes) -> Iterator[bytes]:
    """The beginnings of the stream's units, each from its header, without emulation prevention bytes."""
    for start in _START.finditer(data):
        yield data[start.end() : start.end() + _HEAD].partition(b"\0\0\1")[0].replace(b"\0\0\3", b"\0\0")


def is_key_frame(data: bytes, codec: str) -> bool:
    """Whether the coded frame can be decoded without any before it."""
    if codec == HEVC:
        return any(unit and unit[0] >> 1 & 0x3F in _HEVC_KEYS for unit in units(data))
    return any(unit and unit[0] & 0x1F == _IDR for unit in units(data))


class FrameNumbers:
    """Follows the frame numbers of an H.264 stream, frame by frame."""

    def __init__(self) -> None:
        self._bits = 0  # of a frame number; 0: not known yet
        self._has_planes = False
        self._reference: int | None = None  # frame number of the last frame that others may refer to

    def follows(self, data: bytes) -> bool:
        """Whether no frame is missing between the last one and this; True where the stream does not tell."""
        for unit in units(data):
            kind = unit[0] & 0x1F if unit else 0
            try:
                if kind == _SPS:
                    self._read_parameters(_Bits(unit[1:]))
                elif kind in (_SLICE, _IDR) and self._bits:
                    return self._take(_Bits(unit[1:]), kind == _IDR, bool(unit[0] & 0x60))
            except IndexError:
                return True
        return True

    def _take(self, bits: _Bits, is_key: bool, is_reference: bool) -> bool:
        """Note the frame of a slice header; whether its number is the last one's or the next."""
        for _ in range(3):  # first macroblock, slice type, picture parameter set
            bits.exponential()
        if self._has_planes:
            bits.number(2)
        number, last = bits.number(self._bits), self._reference
        if is_reference:
            self._reference = number
        return is_key or last is None or (number - last) % (1 << self._bits) <= 1

    def _read_parameters(self, bits: _Bits) -> None:
        """The length of a frame number from a sequence parameter set."""
        profile = bits.number(8)
        bits.number(16)
        bits.exponential()
        has_planes = False
        if profile in _HIGH_PROFILES:
            chroma = bits.exponential()
            has_planes = chroma == 3 and bool(bits.number(1))
            bits.exponential()
            bits.exponential()
            bits.number(1)
            if bits.number(1):
                for index in range(8 if chroma != 3 else 12):
                    if bits.number(1):
                        bits.skip_scaling_list(16 if index < 6 else 64)
        length = bits.exponential() + 4
        if length <= 16:
            self._bits, self._has_planes = length, has_planes


class _Bits:
    """Reads bits from the front; IndexError at the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def number(self, count: int) -> int:
        value = 0
        for _ in range(count):
            value = value << 1 | self._data[self._at >> 3] >> (7 - (self._at & 7)) & 1
            self._at += 1
        return value

    def exponential(self) -> int:
        """An Exp-Golomb number (H.264, 9.1)."""
        zeros = 0
        while not self.number(1):
            zeros += 1
        return (1 << zeros) - 1 + self.number(zeros)

    def skip_scaling_list(self, size: int) -> None:
        scale = following = 8
        for _ in range(size):
            if following:
                code = self.exponential()
                following = (scale + (code // 2 + 1 if code & 1 else -(code // 2))) % 256
            scale = following or scale
