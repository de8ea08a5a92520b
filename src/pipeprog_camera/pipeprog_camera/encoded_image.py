# SPDX-License-Identifier: Apache-2.0
"""What a JPEG or PNG says of itself in its header, before a pixel is decoded."""

from __future__ import annotations

import io
import warnings

from PIL import Image

from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_ENCODED_IMAGE, MAX_JPEG_SCANS, MAX_PIXELS, MIN_SIDE

_JPEG_SCAN = b"\xff\xda"  # start of scan; inside the entropy-coded data 0xff is always followed by 0


def encoded_size(encoded: bytes) -> tuple[int, int]:
    """(width, height) [px] of JPEG or PNG bytes; raises InputError for other bytes and sizes that are no picture's."""
    if not encoded:
        raise InputError("the image is empty (0 bytes)")
    check_bytes(len(encoded))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # MAX_PIXELS is the limit
            with Image.open(io.BytesIO(encoded), formats=("JPEG", "PNG")) as image:
                width, height = image.size
    except Image.DecompressionBombError:  # Pillow's own limit, above MAX_PIXELS
        raise InputError(f"an image is too large: {MAX_PIXELS / 1e6:.0f} megapixels at most") from None
    except Exception:  # Pillow raises exceptions of many types for damaged headers
        raise InputError(f"{len(encoded)} bytes are neither JPEG nor PNG") from None
    check_size(width, height)
    scans = encoded.count(_JPEG_SCAN) if encoded.startswith(b"\xff\xd8") else 0
    if scans > MAX_JPEG_SCANS:
        raise InputError(f"the JPEG has {scans} scans: {MAX_JPEG_SCANS} at most are decoded")
    return width, height


def check_bytes(size: int) -> None:
    """Raises InputError where an image has more bytes than any that can be used."""
    if size > MAX_ENCODED_IMAGE:
        raise InputError(f"the image has {size} bytes: {MAX_ENCODED_IMAGE} at most are taken")


def check_size(width: int, height: int) -> None:
    """Raises InputError where the size [px] is none of a picture that can be used."""
    if min(width, height) < MIN_SIDE:
        raise InputError(f"an image of {width} x {height} is too small: each side needs {MIN_SIDE} pixels")
    if width * height > MAX_PIXELS:
        raise InputError(f"an image of {width} x {height} is too large: {MAX_PIXELS / 1e6:.0f} megapixels at most")
