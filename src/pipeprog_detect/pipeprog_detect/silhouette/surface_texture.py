# SPDX-License-Identifier: Apache-2.0
"""Whether the texture in the place of a cylinder's face lies on that face, or on what is behind it.

What lies on a surface looks the same in all views where each pixel is projected onto that surface (plane sweep,
R. T. Collins, 1996). A hole in a cloud says nothing of that: stereo may have failed there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.silhouette.apparent_contour import ViewArrays, project
from pipeprog_detect.silhouette.occlusion import cylinder_rows
from pipeprog_detect.silhouette.scene import frame, viewing_direction
from pipeprog_detect.silhouette.surface_light import light_on
from pipeprog_detect.types import Cylinder, View

# Distance of the samples on the face [px]: what lens and pixel blur together; more where they would be more than this
# many, of which a tenth would tell. Fewer tell nothing.
SPACING, MOST_SAMPLES, LEAST_SAMPLES = 2.0, 600, 24
# Half of the arc of the face that is looked at [rad]: views from up to 30 degrees aside see it at 75 degrees at most.
HALF_ARC = np.radians(45.0)
# Views that are compared, evenly thinned, and the fewest: texture repeats by chance in two, not in three.
MOST_VIEWS, LEAST_VIEWS = 12, 3
# A view tells where it sees this share of the face and more.
SEEN = 0.7
# Places behind the face that are tried: from one and a half radii behind the axis to this far [m], evenly in inverse
# depth: two pixels apart where cameras are half a metre apart and see the cylinder at two metres.
BEHIND_RADII, FARTHEST, PLACES = 1.5, 2.0, 48
# Light (0 to 255) by which a patch varies at the least: rounding to grey levels alone makes a third of it.
LEAST_SPREAD = 1.0
# A correlation is known no better than to this: light differs from view to view.
MOST_CORRELATION = 0.98


def face_log_odds(cylinder: Cylinder, views: Sequence[View], others: Sequence[Cylinder]) -> float:
    """Logarithm of how much more probable the images are with the cylinder's face than with what would be behind it.

    For normal light the likelihood of a patch given those of the other views is (1 - r^2)^(-n / 2), with their
    correlation r and the number n of independent samples; the mean over the views counts, for their errors are not
    independent. 0 where too little is seen.

    Args:
        cylinder: a short piece: what hides a part of it in a view is one of the `others`.
        views: the keyframes.
        others: further cylinders, which may hide it.
    """
    if not views:
        return 0.0
    shown = [views[index] for index in np.flatnonzero(ViewArrays.of(views).showing(cylinder.middle[None]))]
    shown = shown[:: -(-len(shown) // MOST_VIEWS)] if shown else []
    if len(shown) < LEAST_VIEWS:
        return 0.0
    side, away = frame(cylinder, viewing_direction(cylinder, shown))
    gain = float(np.median(ViewArrays.of(shown).pixels_per_metre(cylinder.middle)))
    height, width = cylinder.length * gain, 2.0 * HALF_ARC * cylinder.radius * gain
    spacing = max(SPACING, float(np.sqrt(height * width / MOST_SAMPLES)))
    rows, columns = int(height / spacing), int(width / spacing)
    if rows * columns < LEAST_SAMPLES:
        return 0.0
    angle = np.linspace(-HALF_ARC, HALF_ARC, columns)
    line = cylinder.at((np.arange(rows) + 0.5) / rows)[:, None]
    flat = line + cylinder.radius * np.sin(angle)[None, :, None] * side
    face = flat - cylinder.radius * np.cos(angle)[None, :, None] * away
    distance = float(np.median([project(view, cylinder.middle[None])[1][0] for view in shown]))
    nearest = distance + BEHIND_RADII * cylinder.radius
    depths = 1.0 / np.linspace(1.0 / nearest, 1.0 / (nearest + FARTHEST), PLACES)
    hiding = cylinder_rows(others)
    on_face = _explained(face, shown, hiding)
    behind = max(_explained(flat + (depth - distance) * away, shown, hiding) for depth in depths)
    return on_face - behind


def _explained(surface: FloatArray, views: Sequence[View], others: FloatArray) -> float:
    """Mean log likelihood of the views' patches on a surface (A, B, 3), given those of the other views."""
    points = surface.reshape(-1, 3)
    patches, masks = [], []
    for view in views:
        patch, seen = light_on(points, view, others)
        if seen.mean() > SEEN:
            patches.append(patch)
            masks.append(seen)
    if len(patches) < LEAST_VIEWS:
        return 0.0
    together = np.all(masks, axis=0)
    if together.sum() < LEAST_SAMPLES:
        return 0.0
    light = np.stack(patches)
    light -= light[:, together].mean(axis=1)[:, None]
    light[:, ~together] = 0.0
    spread = np.sqrt((light**2).sum(axis=1) / together.sum())
    light = (light / np.maximum(spread, LEAST_SPREAD)[:, None])[spread > LEAST_SPREAD]
    if len(light) < LEAST_VIEWS:
        return 0.0
    rest = light.sum(axis=0) - light
    product = (light * rest).sum(axis=1)
    correlation = product / np.maximum(np.linalg.norm(light, axis=1) * np.linalg.norm(rest, axis=1), 1e-9)
    each = -0.5 * np.log1p(-(np.clip(correlation, 0.0, MOST_CORRELATION) ** 2))
    return _independent(light.reshape(-1, *surface.shape[:2])) * float(each.mean())


def _independent(patches: FloatArray) -> float:
    """Number of independent samples in patches (V, A, B): those of noise whose chance correlation is as large.

    The variance of the correlation of two independent patches is the mean square of their autocorrelation (Bartlett,
    1946), here by their mean power spectrum (Parseval).
    """
    power = (np.abs(np.fft.fft2(patches)) ** 2).mean(axis=0)
    return float(power.sum() ** 2 / np.maximum((power**2).sum(), 1e-9))
