"""Depth maps of keyframes on the CPU: each keyframe is matched with a few neighbours whose poses are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_frames.camera import Camera
from pipeprog_sfm.config import StereoConfig

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]
ByteImage = NDArray[np.uint8]

BASELINE_RATIO = (0.08, 0.35)  # of the depth; below, depth is noise; above, the views differ too much to be matched
BASELINE_RATIO_BEST = 0.2
VIEW_ANGLE_MAX = np.radians(30.0)  # between optical axes: the images must overlap
FORWARD_MAX = np.radians(50.0)  # baseline out of the image plane: towards 90 the epipole enters the image
AGREEMENT = 0.01  # of the depth: two pairs that agree this well have seen the same surface


@dataclass(frozen=True)
class StereoImage:
    """An undistorted keyframe: (H, W, 3) uint8 BGR of a pinhole camera, and its pose in any unit of length."""

    stamp: int
    image: ByteImage
    camera: Camera
    camera_from_world: FloatArray


@dataclass(frozen=True)
class DepthMap:
    """Depth along the optical axis, (h, w) float32 in the unit of the poses, NaN where unknown; (h, w, 3) uint8 BGR."""

    stamp: int
    depth: FloatImage
    camera: Camera
    color: ByteImage


def choose_pairs(
    reference_stamp: int,
    poses: Mapping[int, FloatArray],
    median_depth: Mapping[int, float],
    config: StereoConfig,
) -> list[int]:
    """Neighbours of a keyframe that are worth matching with it, best first, at most `max_pairs`.

    A neighbour qualifies by its baseline (a share of the median depth), by looking the same way and by standing
    beside, not in front or behind. Among those, baselines of different direction complement each other: an edge along
    the one is no match along the other, and what one side occludes the other side sees.
    """
    reference = poses[reference_stamp]
    rotation, centre = reference[:3, :3], _centre(reference)
    candidates: list[tuple[int, float, FloatArray]] = []
    for stamp in sorted(poses):
        if stamp == reference_stamp:
            continue
        baseline = rotation @ (_centre(poses[stamp]) - centre)
        length = float(np.linalg.norm(baseline))
        ratio = length / median_depth[reference_stamp]
        if not BASELINE_RATIO[0] <= ratio <= BASELINE_RATIO[1]:
            continue
        view_angle = float(np.arccos(np.clip(poses[stamp][2, :3] @ reference[2, :3], -1.0, 1.0)))
        forward_angle = float(np.arcsin(min(1.0, abs(baseline[2]) / length)))
        if view_angle > VIEW_ANGLE_MAX or forward_angle > FORWARD_MAX:
            continue
        cost = abs(np.log(ratio / BASELINE_RATIO_BEST)) + view_angle / VIEW_ANGLE_MAX + forward_angle / FORWARD_MAX
        candidates.append((stamp, cost, baseline / length))
    chosen: list[tuple[int, FloatArray]] = []
    while candidates and len(chosen) < config.max_pairs:
        # 1 for a baseline that repeats a chosen one, 0.5 for the opposite one, 0 for one at right angles to all
        scores = [
            cost + max((max(d @ other, -0.5 * (d @ other)) for _, other in chosen), default=0.0)
            for _, cost, d in candidates
        ]
        stamp, _, direction = candidates.pop(int(np.argmin(scores)))
        chosen.append((stamp, direction))
    return [stamp for stamp, _ in chosen]


def depth_map(
    reference: StereoImage,
    neighbours: Sequence[StereoImage],
    depth_range: tuple[float, float],
    config: StereoConfig,
) -> DepthMap:
    """Depth of the reference image at working resolution from its neighbours; depth_range = (near, far) of the scene."""
    near, far = depth_range
    image, camera = _at_working_resolution(reference, config)
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    depths = []
    for neighbour in neighbours:
        other, other_camera = _at_working_resolution(neighbour, config)
        other_from_reference = neighbour.camera_from_world @ np.linalg.inv(reference.camera_from_world)
        depths.append(
            _pair_depth(
                gray, camera, cv2.cvtColor(other, cv2.COLOR_BGR2GRAY), other_camera, other_from_reference, near, far
            )
        )
    depth = _agreeing(np.stack(depths)) if depths else np.full(gray.shape, np.nan, np.float32)
    return DepthMap(reference.stamp, depth, camera, image)


def _centre(camera_from_world: FloatArray) -> FloatArray:
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def _at_working_resolution(view: StereoImage, config: StereoConfig) -> tuple[ByteImage, Camera]:
    factor = config.width / view.camera.width
    if factor >= 1.0:
        return view.image, view.camera
    camera = view.camera.scaled(factor)
    return cv2.resize(view.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), camera


def _pair_depth(
    gray: ByteImage,
    camera: Camera,
    other: ByteImage,
    other_camera: Camera,
    other_from_reference: FloatArray,
    near: float,
    far: float,
) -> FloatImage:
    """Depth in the reference view by semi-global matching along the epipolar lines, NaN where unknown.

    The pair is rectified with x along the baseline towards the neighbour, wherever that points in the image: so the
    reference is always the left image, and vertical baselines or cameras on their side are nothing special.
    """
    rotation = other_from_reference[:3, :3]
    baseline = -rotation.T @ other_from_reference[:3, 3]
    length = float(np.linalg.norm(baseline))
    x = baseline / length
    z = np.array([0.0, 0.0, 1.0]) + rotation[2]
    z -= x * (z @ x)
    z /= np.linalg.norm(z)
    rectified_from_reference = np.stack([x, np.cross(z, x), z])
    rectified_from_other = rectified_from_reference @ rotation.T
    focal = camera.fx
    corners = np.array(
        [
            [-0.5, -0.5],
            [camera.width - 0.5, -0.5],
            [camera.width - 0.5, camera.height - 0.5],
            [-0.5, camera.height - 0.5],
        ]
    )
    rays = rectified_from_reference @ np.linalg.inv(camera.matrix) @ np.c_[corners, np.ones(4)].T
    low, high = np.floor((rays[:2] / rays[2]).min(axis=1) * focal), np.ceil((rays[:2] / rays[2]).max(axis=1) * focal)
    width, height = (high - low).astype(int)
    rectified_k = np.array([[focal, 0.0, -low[0]], [0.0, focal, -low[1]], [0.0, 0.0, 1.0]])
    least = int(np.floor(focal * length / far))
    count = -(-int(np.ceil(focal * length / near) - least) // 16) * 16
    left_warp = rectified_k @ rectified_from_reference @ np.linalg.inv(camera.matrix)
    shift = np.array([[1.0, 0.0, least], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    right_warp = shift @ rectified_k @ rectified_from_other @ np.linalg.inv(other_camera.matrix)
    left = cv2.warpPerspective(gray, left_warp, (width, height))
    right = cv2.warpPerspective(other, right_warp, (width, height))
    block = 5
    matcher = cv2.StereoSGBM.create(
        0, count, block, 2 * block**2, 8 * block**2, 1, 31, 5, 50, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    pad = ((0, 0), (count, 0))  # the matcher leaves out the first `count` columns
    disparity = matcher.compute(np.pad(left, pad), np.pad(right, pad))[:, count:].astype(np.float32) / 16.0
    disparity[disparity < 0] = np.nan
    rows, columns = np.indices(gray.shape, np.float32)
    mapped = cv2.perspectiveTransform(np.stack([columns, rows], -1), left_warp)
    found = cv2.remap(disparity, mapped, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
    ray = np.stack([(mapped[..., 0] + low[0]) / focal, (mapped[..., 1] + low[1]) / focal, np.ones_like(found)], -1)
    return (focal * length / (found + least) * (ray @ rectified_from_reference[:, 2])).astype(np.float32)


def _agreeing(depths: FloatImage) -> FloatImage:
    """(pairs, h, w) -> (h, w): mean of the depths that agree with most others; of one pair alone only if there is one."""
    if len(depths) == 1:
        return depths[0]
    support = np.stack([(np.abs(depths - depth) < AGREEMENT * depth).sum(axis=0) for depth in depths])
    best = np.take_along_axis(depths, support.argmax(axis=0)[None], axis=0)
    agree = np.abs(depths - best) < AGREEMENT * best
    total = np.where(agree, depths, 0.0).sum(axis=0)
    count = agree.sum(axis=0)
    return np.where(count >= 2, total / np.maximum(count, 1), np.nan).astype(np.float32)
