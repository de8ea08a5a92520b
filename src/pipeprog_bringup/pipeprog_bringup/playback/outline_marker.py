# SPDX-License-Identifier: Apache-2.0
"""Outlines of the pipes as one marker for a viewer's image panel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import ImageMarker

from pipeprog_bringup.results.pipe_outlines import NEAR, inside, outline, project
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_detect.types import Cylinder
from pipeprog_node import messages

_WIDTH = 2.0  # px of a line


def outline_marker(
    stamp: int,
    camera_frame: str,
    camera: Camera,
    map_from_camera: FloatArray,
    pipes: Sequence[tuple[Cylinder, ColorRGBA]],
    rolled: RolledImage | None = None,
) -> ImageMarker:
    """The pieces of all outlines that lie in the image, each line in the colour of its pipe.

    Args:
        stamp: of the keyframe [ns].
        camera_frame: its frame.
        camera: its calibration.
        map_from_camera: (4, 4).
        pipes: cylinders in `map`, and their colours.
        rolled: with a rolling shutter, where the image shows what the pose at the stamp would.
    """
    marker = ImageMarker(header=messages.header(stamp, camera_frame), type=ImageMarker.LINE_LIST, scale=_WIDTH)
    for cylinder, color in pipes:
        edge = outline(cylinder, map_from_camera[:3, 3])
        if not len(edge):
            continue
        pixels, depth = project(camera, map_from_camera, edge, rolled)
        shown = inside(camera, pixels) & (depth > NEAR)
        for number in np.flatnonzero(shown & np.roll(shown, -1)).tolist():
            for x, y in (pixels[number], pixels[(number + 1) % len(pixels)]):
                marker.points.append(Point(x=float(x), y=float(y)))
            marker.outline_colors.append(color)
    return marker
