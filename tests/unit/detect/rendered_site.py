# SPDX-License-Identifier: Apache-2.0
"""Views of small generated sites, walked past: what the images of the recordings' generator show of one thing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_detect.silhouette.chromaticity import red_against_blue
from pipeprog_detect.types import View
from sitegen.primitives import Primitive, rectangle
from sitegen.render import Lamp, Lens, build_scene, render
from sitegen.sensor import Sensor, develop
from sitegen.site import CONCRETE, SCREED
from sitegen.walk import look

LENS = Lens(640, 360, 460.0, 460.0, 319.5, 179.5)
# Two lamps under the ceiling, so that nothing is dark.
LAMPS = [Lamp((-1.0, -1.6, 2.0), 1.2), Lamp((1.2, -1.4, 2.2), 1.2)]
WALL = rectangle((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), 8.0, 4.0, CONCRETE)
FLOOR = rectangle((0.0, -2.0, -0.45), (0.0, 0.0, 1.0), 8.0, 4.0, SCREED)


# Width of the walk and its distance from the wall [m].
WIDTH, DISTANCE = 1.2, 1.2


def walk_past(things: Sequence[Primitive], count: int = 10) -> list[View]:
    """Views from a walk before the wall y = 0, past the place x = 0, z = 0, 0.45 m above the floor."""
    scene = build_scene([WALL, FLOOR, *things], LAMPS, 0.4, 5)
    camera = Camera(LENS.width, LENS.height, LENS.fx, LENS.fy, LENS.cx, LENS.cy)
    views = []
    for index, x in enumerate(np.linspace(-0.5, 0.5, count) * WIDTH):
        z = 0.1 * np.sin(2.0 * index)
        pose = look([x, -DISTANCE, z], 0.3 * x / DISTANCE, z / DISTANCE, 0.0)[0]
        linear = render(scene, LENS, np.repeat(pose[None], LENS.height, 0))
        image = develop(linear, Sensor(), np.random.default_rng(index))
        grey = np.ascontiguousarray(image[:, :, 1])
        chromaticity = red_against_blue(image)
        views.append(View(index, grey, camera, np.linalg.inv(pose), chromaticity=chromaticity))
    return views
