# SPDX-License-Identifier: Apache-2.0
"""A site of two pipes whose keyframes are painted here, and its results folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results import result_files
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.rolling_shutter import RowMotion
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe
from pipeprog_node import messages

CAMERA = Camera.from_calibration(
    640, 480, (500.0, 0, 320.0, 0, 500.0, 240.0, 0, 0, 1), "plumb_bob", (-0.1, 0.02, 0, 0, 0)
)
UPRIGHT = Cylinder(np.array([0.2, 2.0, -0.5]), np.array([0.2, 2.0, 0.5]), 0.05)
LEVEL = Cylinder(np.array([-0.6, 2.0, 0.8]), np.array([0.6, 2.0, 0.8]), 0.05)
PAINT = {0: (40, 200, 40), 1: (200, 40, 40)}  # BGR
START = 1_700_000_000 * 10**9
STILL = RowMotion(0.0, CAMERA.height, np.zeros(3), np.zeros(3))


def looking_along_y(x: float, roll: float = 0.0) -> FloatArray:
    """map_from_camera of a camera at (x, 0, 0) that looks along y, turned about its axis [rad]."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ Rotation.from_rotvec([0, 0, roll]).as_matrix()
    pose[:3, 3] = [x, 0.0, 0.0]
    return pose


def painted(pose: FloatArray, motion: RowMotion) -> bytes:
    """JPEG of the two pipes as this camera sees them; every pixel's ray, of its row's moment, is cut with them."""
    pixels = np.mgrid[0:480, 0:640][::-1].reshape(2, -1).T.astype(float)
    ideal = CAMERA.undistort_points(pixels)
    rays = np.c_[(ideal - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(ideal))] @ pose[:3, :3].T
    centres = pose[:3, 3] - motion.row_times(pixels[:, 1])[:, None] * motion.linear @ pose[:3, :3].T
    image = np.full((len(pixels), 3), 120, np.uint8)
    for number, pipe in enumerate((UPRIGHT, LEVEL)):
        # The point of each ray that is nearest to the axis, and its distance.
        normal = np.cross(rays, pipe.axis)
        gap = np.abs((normal * (pipe.start - centres)).sum(axis=1)) / np.linalg.norm(normal, axis=1)
        t = np.einsum("ij,ij->i", np.cross(pipe.start - centres, pipe.axis[None]), normal) / (normal**2).sum(1)
        along = pipe.along(centres + t[:, None] * rays)
        image[(gap < pipe.radius) & (along > 0) & (along < pipe.length)] = PAINT[number]
    return cv2.imencode(".jpg", image.reshape(480, 640, 3))[1].tobytes()


def run(folder: Path, poses: list[FloatArray], motion: RowMotion = STILL) -> Path:
    """Results of a replay with these keyframes; `motion`: of the site, as each sees it, with a rolling shutter."""
    pipes = [Pipe(f"p0{k}", c, 1e-4, None, 0.0, 2.5, 1e-3, 900) for k, c in enumerate((UPRIGHT, LEVEL))]
    result_files.write_pipes(folder / "pipes.json", Product(pipes, [], []), result_files.Scale("board", 0.0004))
    stamps = [START + k * 10**8 for k in range(len(poses))]
    turns = np.array([Rotation.from_matrix(pose[:3, :3]).as_quat() for pose in poses])
    result_files.write_trajectory(folder / "trajectory.tum", stamps, np.array([p[:3, 3] for p in poses]), turns)
    with (folder / "out.mcap").open("wb") as stream, BagWriter(stream) as bag:
        for stamp, pose in zip(stamps, poses, strict=True):
            bag.write("/k/camera_info", cdr.CAMERA_INFO, cdr.write_camera_info(stamp, "camera", CAMERA), stamp)
            image = cdr.write_compressed_image(stamp, "camera", "jpeg", painted(pose, motion))
            bag.write("/k/image/compressed", cdr.COMPRESSED_IMAGE, image, stamp)
        if motion.readout:
            of_each = [np.tile(each, (len(poses), 1)) for each in (motion.linear, *np.zeros((3, 3)))]
            velocities = messages.keyframe_velocities(messages.header(stamps[-1], "map"), motion.readout, *of_each)
            data = serialize_message(velocities)
            bag.write("/keyframe_velocities", "pipeprog_msgs/msg/KeyframeVelocities", data, START, latched=True)
    return folder
