# SPDX-License-Identifier: Apache-2.0
"""Has Numba compile the detector, as `make setup` does, so that the first survey does not wait for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.overlapping_views import without_overlapping
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.silhouette.chromaticity import red_against_blue
from pipeprog_detect.types import Cloud, Cylinder, View

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
PLACES = np.linspace(-0.3, 0.3, 7)  # of the camera along the wall y = 0, m
DISTANCE = 1.0  # of the camera from the wall, m


def upright(x: float, radius: float, low: float, high: float) -> Cylinder:
    """A pipe before the wall."""
    return Cylinder(np.array([x, -0.1, low]), np.array([x, -0.1, high]), radius)


# Three pipes that the cloud shows, whose direction a fourth one has that the images alone show.
THICK = upright(-0.25, 0.04, -0.3, 0.3), upright(-0.05, 0.02, -0.3, 0.2), upright(0.1, 0.02, -0.2, 0.3)
THIN = upright(0.25, 0.008, -0.25, 0.25)
STEEL, COPPER = [70, 60, 60], [40, 90, 170]
COLOURS = np.array([[150, 150, 150], STEEL, STEEL, STEEL, COPPER], float)  # BGR of wall and pipes
NOISE = 1e-3  # of the cloud's points, m
SPACING = 5e-3  # between them, m


def warm_up() -> None:
    """Seeks pipes in a small scene, with a global and a rolling shutter; takes a second once all is compiled."""
    points, normals = _cloud()
    boq = BillOfQuantities.of_radii({f"{1e3 * each.radius:g}": each.radius for each in (*THICK, THIN)})
    views = [_view(number, x) for number, x in enumerate(PLACES)]
    motion = RowMotion(1e-2, CAMERA.height, np.zeros(3), np.array([0.1, 0.0, 0.0]))
    rolling = [replace(view, rolled=RolledImage(motion, CAMERA)) for view in views]
    without_overlapping([(view.camera_from_map, CAMERA) for view in rolling], points)
    for seen in views, rolling:
        detect(Cloud(points, normals), boq, DetectConfig(), seen)


def _cloud() -> tuple[FloatArray, FloatArray]:
    """Points (N, 3) of the wall and the thick pipes, and their normals."""
    x, z = np.meshgrid(np.arange(-0.6, 0.6, SPACING), np.arange(-0.4, 0.4, SPACING))
    points: list[FloatArray] = [np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)]
    normals: list[FloatArray] = [np.tile([0.0, -1.0, 0.0], (x.size, 1))]
    for pipe in THICK:
        around, up = np.arange(-1.3, 1.3, SPACING / pipe.radius), np.arange(0.0, pipe.length, SPACING)
        angle, along = np.meshgrid(around, up)
        outward = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(angle)], axis=-1).reshape(-1, 3)
        normals.append(outward)
        points.append(pipe.start + along.reshape(-1, 1) * pipe.axis + pipe.radius * outward)
    both = np.concatenate(points), np.concatenate(normals)
    return both[0] + np.random.default_rng(0).normal(0.0, NOISE, both[0].shape), both[1]


def _view(stamp: int, x: float) -> View:
    """The image of a camera that looks along y, with z up, from (x, -DISTANCE, 0)."""
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    centre = np.array([x, -DISTANCE, 0.0])
    pose[:3, 3] = -pose[:3, :3] @ centre
    column, row = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, np.ones(row.shape)], axis=-1)
    image = _seen(centre, rays @ pose[:3, :3])
    return View(stamp, image[..., 1].copy(), CAMERA, pose, chromaticity=red_against_blue(image))


def _seen(centre: FloatArray, rays: FloatArray) -> NDArray[np.uint8]:
    """(H, W, 3) image: what rays (H, W, 3) from a place (3,) meet first, brightest where it faces them."""
    depths, shades = [-centre[1] / rays[..., 1]], [np.ones(rays.shape[:2])]
    for pipe in (*THICK, THIN):  # all upright: circles of the horizontal plane
        start, across = (centre - pipe.start)[:2], rays[..., :2]
        square, half = (across**2).sum(axis=-1), across @ start
        root = np.sqrt(np.maximum(half**2 - square * (start @ start - pipe.radius**2), 0.0))
        depth = (-half - root) / square
        height = centre[2] + depth * rays[..., 2]
        is_met = (root > 0.0) & (height > pipe.start[2]) & (height < pipe.end[2])
        depths.append(np.where(is_met, depth, np.inf))
        shades.append(0.5 + 0.5 * root / (np.sqrt(square) * pipe.radius))
    first = np.argmin(depths, axis=0)
    light = np.take_along_axis(np.array(shades), first[None], axis=0)[0]
    noise = np.random.default_rng(0).normal(0.0, 3.0, rays.shape)
    return np.clip(COLOURS[first] * light[..., None] + noise, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    warm_up()
