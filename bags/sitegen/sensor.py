# SPDX-License-Identifier: Apache-2.0
"""From the light of a site to a JPEG: exposure, shutter, lens blur, noise."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sitegen.render import NEUTRAL, Colour, FloatImage, Lens, Scene, render
from sitegen.robot import MountedWalk
from sitegen.walk import Walk

_BLUR_STEP = 0.7  # px between the sub-frames of a blurred frame: less than the lens blur, so that no copies show


@dataclass(frozen=True)
class Sensor:
    """What the camera does to an image. Seconds, pixels, grey levels of 255."""

    exposure: float = 0.0
    readout: float = 0.0
    blur: float = 0.6
    noise: float = 1.0
    quality: int = 92
    gain: float = 1.0
    balance: Colour = NEUTRAL  # factors on red, green and blue


def expose(scene: Scene, lens: Lens, walk: Walk | MountedWalk, sensor: Sensor, time: float) -> FloatImage:
    """Linear image of the frame whose middle row is at the middle of its exposure at `time`."""
    rows = ((np.arange(lens.height) + 0.5) / lens.height - 0.5) * sensor.readout
    times = [0.0]
    if sensor.exposure > 0.0:
        start, end = walk.poses([time - sensor.exposure / 2, time + sensor.exposure / 2])
        turn = np.linalg.norm(end[:3, 2] - start[:3, 2])
        shift = np.linalg.norm(end[:3, 3] - start[:3, 3])
        pixels = lens.fx * (turn + shift / 2.0)  # the walks are 2 m from what they see
        count = int(np.clip(np.ceil(pixels / _BLUR_STEP), 1, 15))
        times = list(((np.arange(count) + 0.5) / count - 0.5) * sensor.exposure)
    total = np.zeros((lens.height, lens.width, 3), np.float32)
    # Sub-frames smooth each other's edges, so that four rays a pixel are enough in place of sixteen.
    for offset in times:
        instants = time + offset + rows if sensor.readout > 0.0 else np.full(lens.height, time + offset)
        total += render(scene, lens, walk.poses(instants), edge_bits=4 if len(times) < 4 else 2)
    return total / np.float32(len(times))


def develop(linear: FloatImage, sensor: Sensor, rng: np.random.Generator) -> NDArray[np.uint8]:
    """8-bit BGR image: lens blur in linear light, sRGB curve, noise.

    The noise is the same at all grey levels: photon noise grows with the root of the light, and the curve nearly does.
    """
    image = linear * (np.float32(sensor.gain) * np.asarray(sensor.balance, np.float32))
    if sensor.blur > 0.0:
        image = cv2.GaussianBlur(image, (0, 0), sensor.blur)
    levels = grey_levels(image)[:, :, ::-1]
    if sensor.noise > 0.0:
        levels = levels + sensor.noise * rng.standard_normal(levels.shape, np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def grey_levels(light: FloatImage) -> FloatImage:
    """Grey levels, 0 to 255 and not rounded, of light of which 1 is white (sRGB)."""
    light = np.clip(light, 0.0, 1.0)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** np.float32(1 / 2.4) - 0.055)
    return np.asarray(255.0 * curve, np.float32)


def compress(image: NDArray[np.uint8], sensor: Sensor) -> bytes:
    """JPEG bytes."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, sensor.quality])
    if not done:
        raise RuntimeError("the JPEG encoder failed")
    return data.tobytes()
