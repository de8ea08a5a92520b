# SPDX-License-Identifier: Apache-2.0
"""Encoded images that say what they are not."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

from tests.unit.bringup.recordings import jpeg


def png(width: int, height: int, pixels: bytes = b"") -> bytes:
    """A PNG that says it has this size [px], whatever its `pixels` are."""

    def part(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(pixels)) + part(b"IEND", b"")


def resized_jpeg(width: int, height: int) -> bytes:
    """A small JPEG whose header says that it has this size [px]."""
    encoded = bytearray(jpeg(0))
    start = encoded.index(b"\xff\xc0") + 5
    encoded[start : start + 4] = struct.pack(">HH", height, width)
    return bytes(encoded)


def jpeg_of_scans(count: int) -> bytes:
    """A JPEG whose last scan is repeated."""
    image = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    scan = encoded[encoded.rindex(b"\xff\xda") : -2]
    return encoded[:-2] + scan * count + encoded[-2:]


def _other(suffix: str) -> bytes:
    return cv2.imencode(suffix, np.zeros((48, 64, 3), np.uint8))[1].tobytes()


IMAGES: dict[str, bytes] = {
    "no bytes": b"",
    "one byte": b"\xff",
    "a text": b"no picture",
    "PNG of 100000 x 100000": png(100_000, 100_000),
    "PNG of 2^31 x 2^31": png(1 << 31, 1 << 31),
    "PNG of 0 x 0": png(0, 0),
    "PNG of 1 x 1": png(1, 1, b"\0\0"),
    "PNG of 31 x 64": png(31, 64),
    "PNG with pixels of 50 MB for 64 x 48": png(64, 48, bytes(50_000_000)),
    "PNG without pixels": png(64, 48),
    "PNG cut in its header": png(64, 48)[:20],
    "PNG signature alone": png(64, 48)[:8],
    "JPEG of 30000 x 30000": resized_jpeg(30_000, 30_000),
    "JPEG of 65535 x 65535": resized_jpeg(65_535, 65_535),
    "JPEG of 0 x 0": resized_jpeg(0, 0),
    "JPEG of 64 x 49": resized_jpeg(64, 49),
    "JPEG cut in half": jpeg(0)[: len(jpeg(0)) // 2],
    "JPEG without its end": jpeg(0)[:-2],
    "JPEG signature alone": jpeg(0)[:3],
    "JPEG of 3000 scans": jpeg_of_scans(3000),
    "JPEG with a tail": jpeg(0) + bytes(100_000),
    "JPEG twice": jpeg(0) * 2,
    "BMP": _other(".bmp"),
    "WebP": _other(".webp"),
    "TIFF": _other(".tiff"),
    "GIF": b"GIF89a" + struct.pack("<HH", 64, 48) + bytes(20),
    "PNM of 10^9 x 10^9": b"P6 1000000000 1000000000 255\n",
}
