# SPDX-License-Identifier: Apache-2.0
"""Sizes from the headers of encoded images."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_JPEG_SCANS

GREY: np.ndarray = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.uint8)
JPEG = cv2.imencode(".jpg", GREY)[1].tobytes()
PNG = cv2.imencode(".png", GREY)[1].tobytes()


def png_header(width: int, height: int) -> bytes:
    content = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + content
        + struct.pack(">I", zlib.crc32(content))
        + bytes(4)
        + b"IDAT"
    )


@pytest.mark.parametrize("encoded", [JPEG, PNG, JPEG[:700], PNG[:100]])
def test_the_header_tells_the_size(encoded: bytes) -> None:
    assert encoded_size(encoded) == (64, 48)


@pytest.mark.parametrize("size", [(100_000, 100_000), (1, 1), (64, 2**31 - 1), (31, 400)])
def test_a_declared_size_that_no_picture_has_is_refused_before_decoding(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=r"too (large|small)"):
        encoded_size(png_header(*size))


@pytest.mark.parametrize("encoded", [b"", b"GIF89a" + bytes(100), JPEG[:3], PNG[:12], bytes(1000)])
def test_bytes_that_are_no_picture_are_refused(encoded: bytes) -> None:
    with pytest.raises(InputError):
        encoded_size(encoded)


def test_a_jpeg_of_thousands_of_scans_is_refused() -> None:
    with pytest.raises(InputError, match="scans"):
        encoded_size(JPEG + b"\xff\xda\x00\x08" * MAX_JPEG_SCANS)
