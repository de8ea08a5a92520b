# SPDX-License-Identifier: Apache-2.0
"""Odometry, TF and IMU: paths, scale and vertical."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from targets import CAMERA

from pipeprog_camera.arrays import FloatArray
from pipeprog_sfm.config import OdometryConfig
from pipeprog_sfm.metric.gravity import STANDARD_GRAVITY, GravityError, gravity
from pipeprog_sfm.metric.metric_frame import estimate_scale
from pipeprog_sfm.metric.odometry import OdometryError, odometry_measurement
from pipeprog_sfm.metric.scale import NoScaleError
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence
from pipeprog_sfm.metric.transform_tree import Acceleration, CameraPath, NoPathError, Transform, TransformTree

SECOND = 1_000_000_000
PERFECT = OdometryConfig(scale_sigma=0.0)


def pose_of(rotation, place):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), place
    return pose


def random_pose(rng):
    return pose_of(Rotation.random(random_state=rng.integers(2**31)), rng.normal(0, 1, 3))


MOUNT = pose_of(Rotation.from_euler("yx", [90, -90], degrees=True), [0.3, 0.05, 0.4])  # camera on a robot's front


class Robot:
    """A camera on a robot that walks 6 m in a gentle curve, its body rocking; the world is z up and in metres."""

    def __init__(self, seed=0, seconds=12.0):
        rng = np.random.default_rng(seed)
        self.rng, self.seconds = rng, seconds
        self.phase = rng.uniform(0, 2 * np.pi, 4)
        self.factor = rng.uniform(0.2, 5.0)
        self.model_from_world = random_pose(rng)
        self.model_from_world[:3, :3] *= self.factor
        self.stamps = [round(t * SECOND) for t in np.linspace(0.0, seconds, 31)]
        self.poses = {stamp: self.camera_from_model(stamp) for stamp in self.stamps}

    def place(self, t):
        angle = 0.08 * t
        sway = 0.02 * np.sin(2 * np.pi * 0.8 * t + self.phase[0])
        return np.array([6.0 * np.sin(angle), 6.0 * (1 - np.cos(angle)) + sway, 0.5 + 0.02 * np.sin(5 * t)])

    def world_from_base(self, t):
        rock = 0.03 * np.sin(2 * np.pi * 0.5 * t + self.phase[1:4])
        return pose_of(Rotation.from_euler("zyx", [0.08 * t + rock[0], rock[1], rock[2]]), self.place(t))

    def world_from_camera(self, t):
        return self.world_from_base(t) @ MOUNT

    def camera_from_model(self, stamp):
        model_from_camera = self.model_from_world @ self.world_from_camera(stamp / SECOND)
        model_from_camera[:3, :3] /= self.factor
        return np.linalg.inv(model_from_camera)

    def tree(self, noise=0.0, stretch=1.0, rate=20):
        """Odometry in a frame of its own, and where the camera is mounted."""
        odom_from_world = pose_of(Rotation.from_rotvec([0, 0, 0.7]), [4.0, -1.0, 0.0])
        tree, last = TransformTree(), None
        drift: FloatArray = np.zeros(3)
        samples = []
        for t in np.arange(-0.1, self.seconds + 0.2, 1 / rate):
            pose = self.world_from_base(t)
            if last is not None:
                step = np.linalg.norm(pose[:3, 3] - last)
                drift = drift + self.rng.normal(0, noise * np.sqrt(step), 3)
            last = pose[:3, 3].copy()
            pose[:3, 3] = stretch * pose[:3, 3] + drift
            samples.append(Transform(round(t * SECOND), "odom", "base", odom_from_world @ pose))
        tree.add(samples)
        tree.add([Transform(0, "base", "head", pose_of(Rotation.identity(), [0.1, 0, 0]), True)])
        tree.add([Transform(0, "head", "camera", pose_of(Rotation.identity(), [-0.1, 0, 0]) @ MOUNT, True)])
        return tree

    def accelerations(self, rate=100):
        h = 1e-3
        felt = []
        for t in np.arange(0.0, self.seconds + 1e-9, 1 / rate):
            force = (self.place(t + h) - 2 * self.place(t) + self.place(t - h)) / h**2 + [0, 0, STANDARD_GRAVITY]
            turn = self.world_from_base(t)[:3, :3]
            felt.append(Acceleration(round(t * SECOND), "head", turn.T @ force + self.rng.normal(0, 0.05, 3)))
        return felt


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**16), st.floats(0.0, 1.0))
def test_a_path_composes_and_interpolates(seed, share):
    rng = np.random.default_rng(seed)
    tree, mount, sensor = TransformTree(), random_pose(rng), random_pose(rng)
    axis, speed, origin = rng.normal(0, 1, 3), rng.normal(0, 1, 3), random_pose(rng)

    def base(t):
        return pose_of(Rotation.from_rotvec(0.5 * t * axis), t * speed)

    stamps = [0, SECOND // 5, 2 * SECOND // 5]
    tree.add(Transform(stamp, "odom", "base", base(stamp / SECOND)) for stamp in reversed(stamps))
    tree.add([Transform(7, "map", "odom", origin), Transform(9, "map", "odom", np.eye(4))])  # a localisation that jumps
    tree.add([Transform(0, "base", "head", mount, True), Transform(0, "head", "camera", sensor, True)])
    at = round(share * stamps[-1])
    path = tree.path("camera", [-1, at, stamps[-1] + 1])
    assert path.fixed == "odom"
    assert path.stamps.tolist() == [at]
    assert path.fixed_from_camera[0] == pytest.approx(base(at / SECOND) @ mount @ sensor, abs=1e-6)


def test_nothing_is_interpolated_over_a_gap():
    tree = TransformTree()
    tree.add(Transform(stamp, "odom", "camera", np.eye(4)) for stamp in (0, SECOND, SECOND + SECOND // 10))
    assert tree.path("camera", [0, SECOND // 2, SECOND + 1]).stamps.tolist() == [0, SECOND + 1]


def test_a_camera_that_is_mounted_nowhere_is_told():
    tree = TransformTree()
    tree.add([Transform(0, "odom", "base", np.eye(4)), Transform(0, "head", "camera", np.eye(4), True)])
    with pytest.raises(NoPathError, match=r"moves base.*'camera' \(from which they lead to 'head'\).*/tf_static"):
        tree.path("camera", [0])
    with pytest.raises(NoPathError, match="'imu' with the camera's frame 'camera'"):
        tree.static_transform("camera", "imu")


def test_static_transform_over_a_common_body():
    rng = np.random.default_rng(0)
    tree, camera, imu = TransformTree(), random_pose(rng), random_pose(rng)
    tree.add([Transform(0, "base", "camera", camera, True), Transform(0, "base", "imu", imu, True)])
    assert tree.static_transform("camera", "imu") == pytest.approx(np.linalg.inv(camera) @ imu)
    assert tree.static_transform("camera", "camera") == pytest.approx(np.eye(4))


def path_of(robot, **arguments):
    return robot.tree(**arguments).path("camera", robot.stamps)


def test_exact_odometry_gives_the_exact_scale():
    robot = Robot(1)
    measurement = odometry_measurement(path_of(robot, rate=200), robot.poses, PERFECT)
    assert np.exp(measurement.log_scale) * robot.factor == pytest.approx(1.0, abs=1e-4)


def test_sigma_of_odometry_is_honest():
    """Chi-square over seeds at 2 % of the way per root metre, a good wheel's or leg's random walk."""
    scores = []
    for seed in range(40):
        robot = Robot(seed)
        measurement = odometry_measurement(path_of(robot, noise=0.02), robot.poses, PERFECT)
        scores.append((measurement.log_scale + np.log(robot.factor)) / measurement.sigma)
    assert 0.5 < np.mean(np.square(scores)) < 1.8
    stretched = odometry_measurement(path_of(Robot(0), stretch=1.01), Robot(0).poses, OdometryConfig(scale_sigma=0.01))
    assert stretched.log_scale + np.log(Robot(0).factor) == pytest.approx(0.01, abs=1e-3)
    assert 0.01 <= stretched.sigma < 0.011


def test_a_wheel_slip_leaves_the_scale():
    robot = Robot(2)
    path = path_of(robot, noise=0.002)
    slipped = path.fixed_from_camera.copy()
    slipped[14:, :3, 3] += [0.4, -0.3, 0.0]  # half a metre within one step
    measurement = odometry_measurement(replace(path, fixed_from_camera=slipped), robot.poses, PERFECT)
    assert abs(measurement.log_scale + np.log(robot.factor)) < min(4 * measurement.sigma, 0.005)


def test_odometry_of_another_camera_is_refused():
    robot = Robot(3)
    path = path_of(robot)
    turned = path.fixed_from_camera @ pose_of(Rotation.from_rotvec([0, 2.0, 0]), [0, 0, 0])
    with pytest.raises(OdometryError, match="did not move together"):
        odometry_measurement(replace(path, fixed_from_camera=turned), robot.poses, PERFECT)
    with pytest.raises(OdometryError, match="stood still"):
        odometry_measurement(CameraPath("odom", path.stamps, np.tile(np.eye(4), (31, 1, 1))), robot.poses, PERFECT)
    with pytest.raises(OdometryError, match="1 of 31"):
        odometry_measurement(CameraPath("odom", path.stamps[:1], path.fixed_from_camera[:1]), robot.poses, PERFECT)


@pytest.mark.parametrize("seed", range(5))
def test_gravity_is_up_though_the_robot_accelerates(seed):
    robot = Robot(seed)
    felt = robot.accelerations()
    forces = np.stack([MOUNT[:3, :3].T @ one.force for one in felt])
    vertical = gravity(np.array([one.stamp for one in felt]), forces, robot.poses, 1 / robot.factor)
    up = robot.model_from_world[:3, 2] / robot.factor
    assert np.degrees(np.arccos(vertical.up_in_model @ up)) < 0.1


def test_an_imu_that_counts_in_g_is_told():
    robot = Robot(0)
    felt = robot.accelerations()
    stamps, forces = np.array([one.stamp for one in felt]), np.stack([one.force for one in felt])
    with pytest.raises(GravityError, match=r"feels 0\.9\d m/s"):
        gravity(stamps, forces / STANDARD_GRAVITY, robot.poses, 1 / robot.factor)
    with pytest.raises(GravityError, match="do not cover"):
        gravity(stamps[:500], forces[:500], robot.poses, 1 / robot.factor)


def test_odometry_alone_makes_a_metric_map_with_z_up():
    robot = Robot(4)
    evidence = ScaleEvidence(
        transforms=robot.tree(noise=0.002), accelerations=robot.accelerations(), camera_frame="camera"
    )
    estimate = estimate_scale(PosedEvidence(evidence, robot.poses, CAMERA))
    assert estimate.source == "odometry"
    assert abs(np.log(estimate.scale * robot.factor)) < 3 * estimate.sigma
    assert estimate.warnings == ()
    map_from_world = estimate.map_from_model @ robot.model_from_world
    up = map_from_world[:3, 2] / np.linalg.norm(map_from_world[:3, 2])
    assert up == pytest.approx([0, 0, 1], abs=0.003)
    start = map_from_world @ robot.world_from_camera(0.0)
    assert start[:3, 3] == pytest.approx(np.zeros(3), abs=1e-6)
    assert start[:3, 0] @ [0, 1, 0] == pytest.approx(0.0, abs=1e-6)  # x of the map is the camera's right


def test_what_is_missing_is_told():
    robot = Robot(5)
    tree = TransformTree()
    tree.add([Transform(0, "odom", "base", np.eye(4))])
    with pytest.raises(NoScaleError, match=r"nothing tells the scale.*no transform leads.*/tf_static"):
        estimate_scale(PosedEvidence(ScaleEvidence(transforms=tree, camera_frame="camera"), robot.poses, CAMERA))
