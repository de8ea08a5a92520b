# SPDX-License-Identifier: Apache-2.0
"""Motion that is valid and absurd: it gives the right scale or none, with the reason, and ends nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from targets import CAMERA

from pipeprog_camera.limits import MAX_COORDINATE, MAX_SECONDS
from pipeprog_sfm.config import OdometryConfig
from pipeprog_sfm.metric.gravity import STANDARD_GRAVITY, GravityError, gravity
from pipeprog_sfm.metric.map_frame import Vertical
from pipeprog_sfm.metric.odometry import OdometryError, odometry_measurement
from pipeprog_sfm.metric.scale import Measurement, ScaleWarning
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence
from pipeprog_sfm.metric.transform_tree import Acceleration, CameraPath, NoPathError, Transform, TransformTree
from pipeprog_sfm.metric.vertical_sources import imu

SECOND = 1_000_000_000
FIRST = 1_700_000_000 * SECOND
UNIT = 2.0  # m, of the model
RATE, SECONDS = 50, 20
KEYFRAMES = [FIRST + n * SECOND // 2 for n in range(1, 2 * SECONDS - 1)]


def base(stamp: int) -> np.ndarray:
    """The robot: 0.5 m/s along x, with turns."""
    t = 1e-9 * (stamp - FIRST)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 0.3 * np.sin(t)).as_matrix()
    pose[:3, 3] = 0.5 * t, 0.3 * np.sin(0.7 * t), 0.1 * np.sin(3 * t)
    return pose


def shifted(pose: np.ndarray, stretch: float, shift: float) -> np.ndarray:
    moved = pose.copy()
    moved[:3, 3] = stretch * pose[:3, 3] + [shift, 0.0, 0.0]
    return moved


POSES = {stamp: np.linalg.inv(shifted(base(stamp), 1 / UNIT, 0.0)) for stamp in KEYFRAMES}
STAMPS = [FIRST + n * SECOND // RATE for n in range(SECONDS * RATE)]


def tree(samples: dict[int, np.ndarray]) -> TransformTree:
    made = TransformTree()
    made.add(Transform(stamp, "odom", "base", pose) for stamp, pose in samples.items())
    made.add([Transform(0, "base", "camera", np.eye(4), True)])
    return made


def measured(samples: dict[int, np.ndarray]) -> Measurement:
    return odometry_measurement(tree(samples).path("camera", KEYFRAMES), POSES, OdometryConfig())


def right() -> dict[int, np.ndarray]:
    return {stamp: base(stamp) for stamp in STAMPS}


def error(found: Measurement) -> float:
    return abs(found.log_scale - np.log(UNIT))


@pytest.mark.parametrize("every", [2, 5, 25, 100])  # 25: exactly the keyframes' samples are the other robot's
@pytest.mark.parametrize(("stretch", "shift"), [(0.0, 0.0), (0.5, 0.0), (-1.0, 3.0), (1.0, 1e6)])
def test_two_robots_on_one_topic_are_told(every: int, stretch: float, shift: float) -> None:
    samples = right()
    for stamp in STAMPS[::every]:
        samples[stamp] = shifted(base(stamp), stretch, shift)
    with pytest.raises((NoPathError, OdometryError), match=r"one robot alone|did not move together"):
        measured(samples)


@pytest.mark.parametrize("stretch", [100.0, 1000.0, -1000.0])  # centimetres, millimetres; 500 m/s
def test_odometry_that_is_faster_than_a_robot_is_told(stretch: float) -> None:
    with pytest.raises(NoPathError, match=r"faster than 30 m/s: check that odometry is in metres"):
        measured({stamp: shifted(base(stamp), stretch, 0.0) for stamp in STAMPS})


def test_one_wrong_pose_leaves_the_scale() -> None:
    samples = right()
    samples[STAMPS[300]] = shifted(base(STAMPS[300]), 1.0, 0.99 * MAX_COORDINATE)
    assert error(measured(samples)) < 1e-3


def test_stamps_that_are_years_away_leave_the_scale() -> None:
    samples = right()
    for year in range(68):
        samples[year * 365 * 86_400 * SECOND] = shifted(np.eye(4), 1.0, float(year))
    last = (MAX_SECONDS - 1) * SECOND
    samples |= {last: np.eye(4), last + 1: np.eye(4), last + 100: np.eye(4), 0: np.eye(4), 1: np.eye(4)}
    assert error(measured(samples)) < 1e-3


def test_samples_of_one_nanosecond_are_interpolated_exactly() -> None:
    samples = right() | {0: np.eye(4)}
    samples |= {stamp + n: base(stamp + n) for stamp in KEYFRAMES for n in (-1, 1)}
    assert error(measured(samples)) < 1e-3


def test_a_robot_that_trembles_stands_still() -> None:
    rng = np.random.default_rng(0)
    for size in (1e-300, 1e-12, 1e-5):
        path = CameraPath("odom", np.array(KEYFRAMES), np.stack([np.eye(4)] * len(KEYFRAMES)))
        path.fixed_from_camera[:, :3, 3] = size * rng.normal(size=(len(KEYFRAMES), 3))
        with pytest.raises(OdometryError, match=r"stood still|did not move together"):
            odometry_measurement(path, POSES, OdometryConfig())
    proportional = np.stack([shifted(base(stamp), 1e-200, 0.0) for stamp in KEYFRAMES])
    with pytest.raises(OdometryError, match="stood still"):
        odometry_measurement(CameraPath("odom", np.array(KEYFRAMES), proportional), POSES, OdometryConfig())


@pytest.mark.parametrize("static", [False, True])
def test_cycles_of_transforms_end(static: bool) -> None:
    ring = TransformTree()
    names = [f"frame {number}" for number in range(50)]
    for child, parent in zip(names, [*names[1:], names[0]], strict=True):
        ring.add([Transform(0, parent, child, np.eye(4), static)])
    if static:
        with pytest.raises(NoPathError):
            ring.path(names[0], [0])
        assert np.allclose(ring.static_transform(names[0], names[7]), np.eye(4))
    else:
        assert len(ring.path(names[0], [0]).stamps) == 1
    with pytest.raises(NoPathError):
        ring.static_transform(names[0], "another")


def felt(frame: str) -> list[Acceleration]:
    # x of the camera is horizontal and y is down.
    return [Acceleration(stamp, frame, np.array([0.0, -STANDARD_GRAVITY, 0.0])) for stamp in STAMPS]


def test_the_imu_of_another_robot_does_not_take_the_vertical_away() -> None:
    transforms = TransformTree()
    transforms.add([Transform(0, "base", frame, np.eye(4), True) for frame in ("camera", "imu")])
    still = {stamp: np.eye(4) for stamp in KEYFRAMES}
    foreign = [Acceleration(FIRST + SECOND, "foreign", np.array([1.0, 2.0, 3.0]))]
    evidence = ScaleEvidence(transforms=transforms, accelerations=felt("imu") + foreign, camera_frame="camera")
    warning, vertical = imu(PosedEvidence(evidence, still, CAMERA), 1.0)
    assert isinstance(warning, ScaleWarning)
    assert "'foreign'" in warning.text
    assert isinstance(vertical, Vertical)
    assert vertical.up_in_model == pytest.approx([0.0, -1.0, 0.0])


def test_keyframes_years_apart_give_no_vertical_by_gravity() -> None:
    last = (MAX_SECONDS - 1) * SECOND
    stamps = np.linspace(0, last, 20).astype(np.int64)
    poses = {int(stamp): np.eye(4) for stamp in (0, last - 2, last - 1, last)}
    with pytest.raises(GravityError, match="check the camera's clock"):
        gravity(stamps, np.tile([0.0, -STANDARD_GRAVITY, 0.0], (20, 1)), poses, 1.0)
