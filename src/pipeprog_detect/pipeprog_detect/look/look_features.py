# SPDX-License-Identifier: Apache-2.0
"""What tells materials apart, as numbers: body colour, highlight and its colour, unevenness, change between views.

A dielectric shows its own colour beside a highlight of the lamps' colour; what a metal mirrors has the metal's
(dichromatic reflection model: Shafer, "Using color to separate reflection components", 1985).
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.look.barrel_light import BarrelLight

NAMES = (
    *("body red", "body blue", "level", "dark level", "bright level"),
    *("highlight", "sharp highlight", "highlight red", "highlight blue"),
    *("red over light", "blue over light", "contrast around", "contrast along", "fine along", "fine around"),
    *("red unevenness", "change between views", "level between views", "width", "by board"),
)
# Darkest light that is told from black: the sensor's noise, relative to white.
_BLACK = 0.004
# A keyframe needs this many places.
_LEAST = 40
# Part of the body's light that is added to the highlight's, so that a highlight that is none has the body's colour.
_FAINT = 0.05


def look_features(barrel: BarrelLight) -> FloatArray | None:
    """Features (len(NAMES),) of a barrel, medians over its keyframes; None where they show too little."""
    rows, logs = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # means of places that no keyframe shows
        for light, width in zip(barrel.light, barrel.width, strict=True):
            row = _of_view(light)
            if row is not None:
                rows.append([*row, float(np.log(width))])
                logs.append(_log_level(light))
        if not rows:
            return None
        *own, wide = np.median(rows, axis=0).tolist()
        change, between = _between(np.stack(logs))
    return np.array([*own, change, between, wide, float(barrel.by_board)])


def _log_level(light: NDArray[np.float32]) -> FloatArray:
    """Logarithm of the brightness (A, L) of light (A, L, 3), green counted twice."""
    return np.log(np.maximum(light @ np.array([0.25, 0.5, 0.25]), _BLACK))


def _of_view(light: NDArray[np.float32]) -> list[float] | None:
    level = _log_level(light)
    seen = np.isfinite(level)
    if seen.sum() < _LEAST:
        return None
    flat, bright = light[seen].astype(float), level[seen]
    low, body_low, body_high, high, top = np.quantile(bright, [0.05, 0.2, 0.6, 0.9, 0.96])
    body = np.median(flat[(bright >= body_low) & (bright <= body_high)], axis=0) + _BLACK
    shine = np.maximum(flat[bright >= top].mean(axis=0) - body, 0.0) + _FAINT * body
    middle = float(np.median(bright))
    red, blue = np.log(body[0] / body[1]), np.log(body[2] / body[1])
    tint = np.log((flat[:, (0, 2)] + _BLACK) / (flat[:, 1:2] + _BLACK))
    offset = bright - bright.mean()
    slopes = (offset @ (tint - tint.mean(axis=0))) / (offset @ offset + 0.02 * len(offset))
    around = np.nanmean(level, axis=1)
    along = level - around[:, None]
    return [
        *(float(red), float(blue), middle, float(low) - middle, float(high) - middle),
        *(float(top) - middle, float(bright.max()) - float(top)),
        float(np.log(shine[0] / shine[1])) - float(red),
        float(np.log(shine[2] / shine[1])) - float(blue),
        *(float(slope) for slope in slopes),
        float(np.nanstd(around)),
        float(np.nanstd(along)),
        float(np.nanmedian(np.abs(np.diff(level, axis=1)))),
        float(np.nanmedian(np.abs(np.diff(along, axis=0)))),
        float(tint[:, 0].std()),
    ]


def _between(levels: FloatArray) -> tuple[float, float]:
    """How much one place (logarithm of its brightness), and a whole barrel, changes from keyframe to keyframe."""
    if len(levels) < 2:
        return 0.0, 0.0
    whole = np.nanmedian(levels, axis=(1, 2))
    spread = np.nanstd(levels - whole[:, None, None], axis=0)
    often = np.isfinite(levels).sum(axis=0) >= 2
    return (float(np.median(spread[often])) if often.any() else 0.0), float(whole.std())
