# SPDX-License-Identifier: Apache-2.0
"""Loads (the first time: compiles) what Numba compiles, before the first keyframe has to wait for it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from pipeprog_camera.camera import Camera
from pipeprog_camera.rolled_image import RolledImage
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.camera_in_use import FIRST_CHECK
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.dense.depth_fusion import Fusion
from pipeprog_sfm.dense.stereo import Picture, StereoImage, depth_map
from pipeprog_sfm.reconstruction import Reconstruction

SIZE = (320, 240)
DEPTHS = (0.7, 1.5)
STEP = 24  # px between two views of a wall at 1 m
FEATURES = 600  # of a view: thrice the tie points that self-calibration asks for
REACH = 2  # views on either side that a depth map is made with
READOUT = 1e-3  # s, of a rolling shutter that moves nothing by a pixel


def warm_up(config: SfmConfig) -> None:
    """Runs each stage on a few views of a plane; takes about a second once everything is compiled."""
    config = replace(config, readout=READOUT, mapper=replace(config.mapper, max_features=FEATURES))
    width, height = SIZE
    camera = Camera(width, height, 300.0, 300.0, (width - 1) / 2, (height - 1) / 2)
    wall = np.random.default_rng(0).integers(0, 256, (height // 4, width), np.uint8)
    wall = cv2.resize(wall, (4 * width, height), interpolation=cv2.INTER_CUBIC)
    reconstruction = Reconstruction(config, BoardFile())
    views = []
    for number in range(FIRST_CHECK):  # with the last one, the calibration is looked at
        gray = np.ascontiguousarray(wall[:, number * STEP :][:, :width])
        image = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
        pose = np.eye(4)
        pose[0, 3] = -number * STEP / camera.fx
        views.append(StereoImage(number, Picture(image, camera), pose))
        reconstruction.add(number, cv2.imencode(".png", image)[1].tobytes(), camera)
        reconstruction.overlap_reports()
    motion = RowMotion(READOUT, height, np.zeros(3), np.zeros(3))
    rolling = [replace(view, rolled=RolledImage(motion, camera)) for view in views[: REACH + 1]]
    depth_map(rolling[0], rolling[1:], DEPTHS)
    fusion = Fusion(config.fusion)
    for view in views:
        others = [other for other in views if 0 < abs(other.stamp - view.stamp) <= REACH]
        fusion.add(depth_map(view, others, DEPTHS), view.camera_from_world, 1.0)
    fusion.cloud()


if __name__ == "__main__":
    warm_up(SfmConfig())
