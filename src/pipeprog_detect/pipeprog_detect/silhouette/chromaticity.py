# SPDX-License-Identifier: Apache-2.0
"""The colour of an image without its brightness: what shading, shadows and grey texture leave as it is.

A copper pipe may be as bright as the wall behind it, and is another colour all along. Chromaticities do not change with
the amount of light (Finlayson, Drew and Lu 2004); of the two, red against blue is the one in which copper, brass, rust,
brick, timber and most paints differ from concrete, plaster and steel.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

# Grey levels that are added to the sum of the three channels: below it noise, two levels a channel, would be a colour.
DARK = 60
# Chromaticities are tabled in this many steps, four to a grey level of the result.
STEPS = 1024
# An image of which red and blue differ by no more than this [grey levels] anywhere, as rounding does, has no colour.
NO_COLOUR = 2
# The edge of a pipe in it is displaced by up to about this [px]: of a pixel that shows both, the brighter one tells the
# colour. Where the pipe is two thirds as bright as what is behind it, its share is a half only where it fills 0.6 of
# the pixel, a quarter of a blur (0.7 px) farther in.
DISPLACED = 0.2


def _levels() -> NDArray[np.uint8]:
    """sRGB levels (STEPS + 1,) of a light that grows from none to full (IEC 61966-2-1)."""
    light = np.linspace(0.0, 1.0, STEPS + 1)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * level).astype(np.uint8)


_LEVELS = _levels()


def red_against_blue(image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """The share of the grey levels by which red exceeds blue, as a grey image (H, W); None without a colour.

    It is coded as an sRGB image is, so that its decoded light is linear in the share: none at -1/2, half for grey.

    Args:
        image: (H, W, 3) in blue, green and red.
    """
    return _red_against_blue(image, _LEVELS) if _has_colour(image) else None


def _has_colour(image: NDArray[np.uint8]) -> bool:
    blue, red = image[..., 0], image[..., 2]
    return bool((np.maximum(blue, red) - np.minimum(blue, red) > NO_COLOUR).any())


@njit(cache=True, nogil=True)
def _red_against_blue(image: NDArray[np.uint8], levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """See `red_against_blue`, and for `levels` see `_levels`."""
    height, width, _ = image.shape
    result = np.empty((height, width), np.uint8)
    for r in range(height):
        for c in range(width):
            blue, green, red = float(image[r, c, 0]), float(image[r, c, 1]), float(image[r, c, 2])
            share = 0.5 + (red - blue) / (red + green + blue + DARK)
            result[r, c] = levels[int(min(max(share, 0.0), 1.0) * STEPS + 0.5)]
    return result
