# SPDX-License-Identifier: Apache-2.0
"""A generated wall with boxes and a board, filmed along x, and settings for its reconstruction."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.config import FusionConfig, MapperConfig, SfmConfig, StereoConfig

sys.path.insert(0, str(Path(__file__).parents[3] / "bags"))  # the generator is a command beside its package
from sitegen.render import Lens, build_scene, render
from sitegen.sensor import Sensor, develop
from sitegen.site import BOARD_CENTRES, BOARD_CIRCLE_RADIUS, CONCRETE, PLASTER, SCREED, Site

STEP = 500_000_000  # ns between two keyframes
DISTANCE = 1.7  # m to the wall
CONFIG = SfmConfig(
    mapper=MapperConfig(max_features=1000), stereo=StereoConfig(max_pairs=2), fusion=FusionConfig(voxel=0.01)
)
BOARDS = BoardFile((Board("A", BOARD_CIRCLE_RADIUS, np.c_[np.array(BOARD_CENTRES), np.zeros(len(BOARD_CENTRES))]),))


def world_from_camera(x: float) -> np.ndarray:
    """Pose (4, 4) of the camera at a place [m] along the wall."""
    pose = np.eye(4)
    turn = 0.15 * np.sin(3.0 * x)
    pose[:3, 0] = np.cos(turn), np.sin(turn), 0.0
    pose[:3, 1] = 0.0, 0.0, -1.0
    pose[:3, 2] = -np.sin(turn), np.cos(turn), 0.0
    pose[:3, 3] = x, -DISTANCE + 0.1 * np.sin(5.0 * x), 1.3 + 0.05 * np.cos(4.0 * x)
    return pose


def filmed(places: Sequence[float], lenses: Sequence[Lens]) -> list[tuple[int, bytes, Camera, str]]:
    """Stamp [ns], PNG, calibration and frame of a keyframe at each of the places [m], seen by its lens."""
    site = Site((0.05,))
    site.wall((1.5, 0.0, 1.3), (0, -1, 0), 6.0, 3.0, CONCRETE)
    site.wall((1.5, -1.0, 0.0), (0, 0, 1), 6.0, 4.0, SCREED)
    for number, x in enumerate((0.4, 1.0, 2.2, 2.7)):
        site.box((x, -0.15 - 0.05 * number, 0.4 + 0.1 * number), (x + 0.25, 0.0, 1.1), PLASTER)
    site.board((1.55, 0.0, 1.45), (0, -1, 0), np.random.default_rng(0))
    site.tube_lamp((0.5, -1.5, 2.8), (2.5, -1.5, 2.8), 4.0, 2)
    scene = build_scene(site.primitives, site.lamps, 0.4, seed=1)
    rng = np.random.default_rng(2)
    keyframes = []
    for number, (x, lens) in enumerate(zip(places, lenses, strict=True)):
        rows = np.broadcast_to(world_from_camera(x), (lens.height, 4, 4))
        image = develop(render(scene, lens, rows, edge_bits=2), Sensor(), rng)
        camera = Camera(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        keyframes.append((number * STEP, cv2.imencode(".png", image)[1].tobytes(), camera, "camera"))
    return keyframes
