# SPDX-License-Identifier: Apache-2.0
"""Pipes whose radius leaves several classes, told apart by what the keyframes show of their material."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.look.barrel_light import barrel_light
from pipeprog_detect.look.colour_view import NO_CIRCLES, BoardCircles, ColourImage, colour_views
from pipeprog_detect.look.look_features import look_features
from pipeprog_detect.look.material_model import material_probabilities
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.product.classification import asks_look, classified_by_look
from pipeprog_detect.silhouette.occlusion import with_depths
from pipeprog_detect.types import Pipe, View

# Keyframes that are decoded in colour, evenly chosen: 166 MB of 720p. A pipe needs a few of them.
_MOST_IMAGES = 60


@dataclass(frozen=True)
class Seen:
    """What a survey has seen.

    Attributes:
        views: the keyframes.
        image_of: gives the image (H, W, 3) of a stamp, undistorted, in blue, green and red.
        points: of the cloud (N, 3) [m].
        circles: of the boards.
    """

    views: Sequence[View]
    image_of: Callable[[int], NDArray[np.uint8]]
    points: FloatArray
    circles: BoardCircles = NO_CIRCLES


def told_by_look(pipes: Sequence[Pipe], boq: BillOfQuantities, seen: Seen, concave: bool = False) -> list[Pipe]:
    """The pipes, those of which the bill asks the look (`asks_look`) with class and material by it."""
    cylinders = [pipe.cylinder for pipe in pipes]
    some = seen.views[:: -(-len(seen.views) // _MOST_IMAGES) or 1]
    pictures = {view.stamp: ColourImage(seen.image_of(view.stamp)) for view in some}
    in_colour = colour_views(with_depths(some, seen.points), pictures.__getitem__, cylinders, seen.circles)

    def told(number: int, pipe: Pipe) -> Pipe:
        if not asks_look(pipe, boq, concave):
            return pipe
        barrel = barrel_light(pipe.cylinder, in_colour, cylinders[:number] + cylinders[number + 1 :])
        features = None if barrel is None else look_features(barrel)
        return pipe if features is None else classified_by_look(pipe, boq, material_probabilities(features), concave)

    return [told(number, pipe) for number, pipe in enumerate(pipes)]
