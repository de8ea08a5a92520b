# SPDX-License-Identifier: Apache-2.0
"""Pipe materials: what they mirror, and the rack that shows many of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeprog_detect.plan.materials import MATERIALS
from pipeprog_detect.product.boq import load_boq
from sitegen import primitives as shapes
from sitegen.pipe_materials import KINDS, pipe_material
from sitegen.primitives import Material
from sitegen.rack import build_rack
from sitegen.recording import write_boq
from sitegen.render import Lamp, Lens, build_scene, render
from sitegen.site import Site

LENS = Lens(64, 64, 60.0, 60.0, 31.5, 31.5)
POSE = np.array([[1.0, 0, 0, 0], [0, 0, 1, -1.0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
WHITE_LAMP = Lamp((0.0, -1.0, 0.5), 1.0)
RED = Material("red", (0.4, 0.1, 0.05), mottle=0.0, speckle=0.0, specular=1.0, shininess=30.0, mirror=0.3)


def test_a_metal_tints_what_it_mirrors_and_paint_does_not() -> None:
    painted, metal = (_brightest(replace(RED, metal=metal)) for metal in (0.0, 1.0))
    assert metal[0] / metal[1] > 3.0
    assert painted[0] / painted[1] < 1.5


def test_the_light_of_a_lamp_has_its_colour() -> None:
    matt = Material("grey", (0.5, 0.5, 0.5), mottle=0.0, speckle=0.0)
    red, green, blue = _brightest(matt, Lamp((0.0, -1.0, 0.5), 1.0, (1.4, 1.0, 0.6)))
    assert red > green > blue


def test_the_racks_bill_names_its_materials(tmp_path: Path) -> None:
    site = build_rack(np.random.default_rng(3), 1.0, 0.0, 2.0)
    write_boq(tmp_path / "boq.yaml", site)
    bill = load_boq(tmp_path / "boq.yaml")
    told = {(round(planned.outer_radius, 6), planned.material) for planned in bill.classes}
    assert told == {(pipe.radius, pipe.material) for pipe in site.pipes}
    assert len(told) == len(bill.classes) == 8


def test_every_material_of_a_bill_can_be_made() -> None:
    assert KINDS == MATERIALS
    rng = np.random.default_rng(1)
    assert all(pipe_material(kind, rng).name == kind for kind in KINDS)


def _pipe(material: Material) -> shapes.Primitive:
    return shapes.cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.3, Site((0.3,)).dressed(material), 0)


def _brightest(material: Material, lamp: Lamp = WHITE_LAMP) -> np.ndarray:
    """Linear RGB of the brightest pixel of a pipe."""
    scene = build_scene([_pipe(material)], [lamp], 0.2, 1)
    image = render(scene, LENS, np.repeat(POSE[None], 64, axis=0), edge_bits=0)
    return np.asarray(image.reshape(-1, 3)[image.sum(axis=2).argmax()])
