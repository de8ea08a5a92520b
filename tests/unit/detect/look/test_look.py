# SPDX-License-Identifier: Apache-2.0
"""What keyframes show of a barrel: white by the board, hidden places, and materials by their look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.look.barrel_light import barrel_light
from pipeprog_detect.look.colour_view import NO_CIRCLES, BoardCircles, ColourImage, colour_views
from pipeprog_detect.look.look_features import NAMES, look_features
from pipeprog_detect.look.material_model import material_probabilities
from pipeprog_detect.look.told_by_look import Seen, told_by_look
from pipeprog_detect.plan.materials import MATERIALS
from pipeprog_detect.product.boq import BillLine, BillOfQuantities, PipeClass
from pipeprog_detect.types import Cylinder, Pipe, View

CAMERA = Camera(640, 360, 460.0, 460.0, 319.5, 179.5)
PIPES = [Cylinder(np.array([x, 1.5, -0.6]), np.array([x, 1.5, 0.6]), 0.06) for x in (-0.3, 0.3)]
CIRCLES = BoardCircles(np.array([[-0.1, 1.6, 0.45], [0.1, 1.6, 0.45]]), np.array([0.04, 0.04]))
GREY, PAPER, BOARD = np.array([0.4, 0.4, 0.4]), np.array([0.75, 0.75, 0.75]), np.array([0.03, 0.03, 0.03])
CREAM_LAMP = np.array([1.3, 1.0, 0.7])
COPPER, ORANGE = np.array([0.55, 0.28, 0.17]), np.array([0.45, 0.16, 0.045])


@dataclass(frozen=True)
class Look:
    """Colour (3,), highlight (3,) of a barrel: what the eye sees of it from straight before it."""

    colour: FloatArray
    highlight: FloatArray


def view_from(x: float, stamp: int) -> View:
    """A camera at (x, 0, 0) that looks along y."""
    camera_from_map = np.array([[1.0, 0, 0, -x], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return View(stamp, np.zeros((360, 640), np.uint8), CAMERA, camera_from_map)


VIEWS = [view_from(x, stamp) for stamp, x in enumerate((-0.25, 0.0, 0.25))]


def image(view: View, looks: Sequence[Look], lamp: FloatArray, exposure: float = 1.0) -> NDArray[np.uint8]:
    """The pipes before a grey wall with a board, as a camera without white balance shows them."""
    v, u = np.mgrid[:360, :640]
    rays = np.stack([(u - 319.5) / 460.0, np.ones(u.shape), -(v - 179.5) / 460.0], axis=-1)
    light = np.broadcast_to(GREY, (360, 640, 3)).copy()
    wall = view.centre + 1.6 * rays
    light[(abs(wall[..., 0]) < 0.2) & (abs(wall[..., 2] - 0.45) < 0.1)] = BOARD
    for centre, radius in zip(CIRCLES.centres, CIRCLES.radii, strict=True):
        light[np.linalg.norm(wall - centre, axis=-1) < radius] = PAPER
    for pipe, look in zip(PIPES, looks, strict=True):
        offset = (view.centre - pipe.start)[:2]
        along = (rays[..., :2] @ offset) / (rays[..., :2] ** 2).sum(axis=-1)
        near = offset - along[..., None] * rays[..., :2]
        sine = np.linalg.norm(near, axis=-1) / pipe.radius
        on = sine < 1.0
        facing = np.sqrt(1.0 - sine[on] ** 2)
        light[on] = (0.25 + 0.75 * facing[:, None]) * look.colour + facing[:, None] ** 40 * look.highlight
    linear = np.clip(light * lamp * exposure, 0.0, 1.0)
    levels = 255.0 * np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(levels[..., ::-1]).astype(np.uint8)


def features_of(looks: Sequence[Look], lamp: FloatArray, circles: BoardCircles = CIRCLES) -> list[FloatArray]:
    images = [image(view, looks, lamp, 0.8 + 0.2 * view.stamp) for view in VIEWS]
    views = colour_views(VIEWS, lambda stamp: ColourImage(images[stamp]), PIPES, circles)
    found = []
    for number, pipe in enumerate(PIPES):
        barrel = barrel_light(pipe, views, PIPES[:number] + PIPES[number + 1 :])
        assert barrel is not None
        features = look_features(barrel)
        assert features is not None
        found.append(features)
    return found


METAL = Look(0.5 * COPPER, 1.2 * COPPER)
PLASTIC = Look(ORANGE, np.full(3, 0.12))


def test_the_board_takes_the_colour_and_the_brightness_of_the_light_away() -> None:
    by_day, by_lamp = (features_of([METAL, PLASTIC], lamp)[1] for lamp in (np.full(3, 0.9), 0.6 * CREAM_LAMP))
    for name in ("body red", "body blue", "level"):
        index = NAMES.index(name)
        assert by_lamp[index] == pytest.approx(by_day[index], abs=0.05), name


def test_without_a_board_the_room_is_grey() -> None:
    (_, features) = features_of([METAL, PLASTIC], 0.6 * CREAM_LAMP, NO_CIRCLES)
    (_, told) = features_of([METAL, PLASTIC], 0.6 * CREAM_LAMP)
    assert features[NAMES.index("by board")] == 0.0
    assert told[NAMES.index("by board")] == 1.0
    assert features[0] == pytest.approx(told[0], abs=0.05)


def test_circles_that_are_not_there_are_no_white() -> None:
    elsewhere = replace(CIRCLES, centres=CIRCLES.centres - np.array([0.0, 0.0, 0.3]))
    (_, features) = features_of([METAL, PLASTIC], 0.6 * CREAM_LAMP, elsewhere)
    assert features[NAMES.index("by board")] == 0.0


def test_a_metal_mirrors_in_its_colour() -> None:
    metal, plastic = features_of([METAL, PLASTIC], np.full(3, 0.9))
    red, blue = NAMES.index("highlight red"), NAMES.index("highlight blue")
    assert abs(metal[red]) < 0.15
    assert plastic[red] < -0.3
    assert plastic[blue] > 0.3


def test_a_hidden_pipe_shows_nothing() -> None:
    images = [image(view, [METAL, PLASTIC], np.full(3, 0.9)) for view in VIEWS]
    views = colour_views(VIEWS, lambda stamp: ColourImage(images[stamp]), PIPES, CIRCLES)
    curtain = Cylinder(np.array([0.3, 1.2, -0.9]), np.array([0.3, 1.2, 0.9]), 0.25)
    assert barrel_light(PIPES[1], views, [curtain]) is None


@pytest.mark.parametrize("lamp", [np.full(3, 0.9), 0.6 * CREAM_LAMP], ids=["daylight", "lamp"])
def test_pipes_of_one_radius_get_the_classes_that_they_look_like(lamp: FloatArray) -> None:
    blue, red = (Look(np.array(colour), np.full(3, 0.1)) for colour in ((0.03, 0.14, 0.40), (0.45, 0.05, 0.04)))
    boq = BillOfQuantities(tuple(planned(material) for material in ("painted blue", "painted red", "black PE")))
    images = [image(view, [blue, red], lamp) for view in VIEWS]
    pipes = [Pipe(f"p{n}", pipe, 1e-4, None, 1 / 3, 2.0, 1e-3, 100) for n, pipe in enumerate(PIPES)]
    seen = Seen(VIEWS, images.__getitem__, np.empty((0, 3)), CIRCLES)
    told = told_by_look(pipes, boq, seen)
    assert [pipe.class_name for pipe in told] == ["painted blue", "painted red"]
    assert [pipe.material for pipe in told] == ["painted blue", "painted red"]
    assert all(pipe.material_probability > 0.95 for pipe in told)


def test_the_model_knows_the_materials_of_a_bill_and_the_features() -> None:
    shares = material_probabilities(np.zeros(len(NAMES)))
    assert set(shares) == set(MATERIALS)
    assert sum(shares.values()) == pytest.approx(1.0)


def planned(material: str) -> PipeClass:
    return PipeClass(material, 0.06, 3.0, (1, 0, 0), 6e-4, None, (BillLine(material, 3.0, material=material),))
