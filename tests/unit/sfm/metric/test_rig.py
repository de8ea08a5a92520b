# SPDX-License-Identifier: Apache-2.0
"""Two cameras on one body: the scale by how far apart they are mounted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from targets import CAMERA

from pipeprog_sfm.config import BoardConfig, OdometryConfig
from pipeprog_sfm.metric.metric_frame import estimate_scale
from pipeprog_sfm.metric.rig import rig_measurements
from pipeprog_sfm.metric.scale import ScaleWarning
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence
from pipeprog_sfm.metric.transform_tree import Transform, TransformTree
from pipeprog_sfm.model.bundle_adjustment import rotation_from_vector
from tests.unit.sfm.metric.test_transform_tree import SECOND, Robot, pose_of, random_pose

PERFECT = OdometryConfig(baseline_sigma=0.0)
LEFT_FROM_RIGHT = pose_of(Rotation.from_rotvec([0.02, -0.05, 0.01]), [0.20, 0.003, -0.002])
SKEW = 40_000  # ns


class Pair(Robot):
    """The robot with a second camera 20 cm to the right of the first, whose images are a little later."""

    def __init__(self, seed=0, noise=0.0, skew=SKEW):
        super().__init__(seed)
        poses = {}
        for stamp, pose in self.poses.items():
            poses[stamp] = pose
            right = pose_of(Rotation.identity(), [0, 0, 0])
            right[:3, :3] = LEFT_FROM_RIGHT[:3, :3].T @ pose[:3, :3]
            right[:3, 3] = LEFT_FROM_RIGHT[:3, :3].T @ (pose[:3, 3] - self.factor * LEFT_FROM_RIGHT[:3, 3])
            poses[stamp + skew] = right
        for pose in poses.values():
            pose[:3, 3] += self.rng.normal(0, noise * self.factor, 3)
        self.poses = poses
        self.frames = {stamp: "right" if stamp - skew in poses else "camera" for stamp in poses}

    def mounted(self, left_from_right=LEFT_FROM_RIGHT):
        tree, head = TransformTree(), random_pose(self.rng)
        tree.add(
            [Transform(0, "head", "camera", head, True), Transform(0, "head", "right", head @ left_from_right, True)]
        )
        return tree

    def measured(self, tree=None, config=PERFECT):
        found = rig_measurements(self.frames, self.mounted() if tree is None else tree, self.poses, config)
        warnings = [each.text for each in found if isinstance(each, ScaleWarning)]
        return [each for each in found if not isinstance(each, ScaleWarning)], warnings


def test_an_exact_rig_gives_the_exact_scale():
    pair = Pair(1)
    (measurement,), warnings = pair.measured()
    assert warnings == []
    assert np.exp(measurement.log_scale) * pair.factor == pytest.approx(1.0, abs=1e-9)
    assert measurement.sigma < 1e-9


def test_sigma_of_a_rig_is_honest():
    """Chi-square over seeds, with a millimetre of noise in each pose and half a one in the mounting."""
    scores, sigmas = [], []
    for seed in range(60):
        pair = Pair(seed, noise=0.001)
        mounted = LEFT_FROM_RIGHT.copy()
        mounted[:3, 3] *= 1 + np.random.default_rng([seed, 1]).normal(0, 0.0005) / np.linalg.norm(mounted[:3, 3])
        (measurement,), _ = pair.measured(pair.mounted(mounted), OdometryConfig(baseline_sigma=0.0005))
        scores.append((measurement.log_scale + np.log(pair.factor)) / measurement.sigma)
        sigmas.append(measurement.sigma)
    assert 0.6 < np.mean(np.square(scores)) < 1.5
    assert np.mean(sigmas) < 0.004


def test_single_wrong_poses_leave_the_scale():
    pair = Pair(2, noise=0.0005)
    for stamp in list(pair.poses)[4:20:6]:
        pair.poses[stamp] = pair.poses[stamp].copy()
        pair.poses[stamp][:3, 3] += pair.factor * np.array([0.05, 0.0, 0.03])
    (measurement,), _ = pair.measured()
    assert abs(measurement.log_scale + np.log(pair.factor)) < 3 * measurement.sigma < 0.02


def test_derivatives_by_the_poses():
    pair = Pair(3)
    (measurement,), _ = pair.measured()
    stamps = list(pair.poses)
    for row in (0, 1, 7):
        for coordinate in range(6):
            ends = []
            for step in (1e-6, -1e-6):
                change = np.zeros(6)
                change[coordinate] = step
                moved = pair.poses[stamps[row]].copy()
                moved[:3, :3] = rotation_from_vector(change[None, :3])[0] @ moved[:3, :3]
                moved[:3, 3] += change[3:]
                poses = {**pair.poses, stamps[row]: moved}
                # The plain mean: of pairs that agree to rounding all weigh the same but the one that was moved.
                gaps = [
                    (poses[one][:3, :3] @ -(poses[one + SKEW][:3, :3].T @ poses[one + SKEW][:3, 3]) + poses[one][:3, 3])
                    @ LEFT_FROM_RIGHT[:3, 3]
                    for one in pair.stamps
                ]
                ends.append(-np.log(np.mean(gaps)))
            assert measurement.gradient[row, coordinate] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-5)


def test_what_is_wrong_is_told():
    pair = Pair(4)
    turned = pose_of(Rotation.identity(), [0.0, 0.2, 0.0])
    assert "not mounted as /tf_static says" in pair.measured(pair.mounted(turned))[1][0]
    assert "no static transform connects" in pair.measured(TransformTree())[1][0]
    assert "are at one place by /tf_static" in pair.measured(pair.mounted(np.eye(4)), OdometryConfig())[1][0]
    assert "0 images" in Pair(4, skew=SECOND // 20).measured()[1][0]


def test_a_rig_is_weighed_against_odometry():
    pair = Pair(5)
    for stretch, disagree in ((1.0, False), (1.1, True)):
        tree = pair.tree(noise=0.002, stretch=stretch)
        tree.add([Transform(0, "camera", "right", LEFT_FROM_RIGHT, True)])
        evidence = ScaleEvidence(transforms=tree, camera_frame="camera", frames=pair.frames)
        config = replace(BoardConfig(), upright=False)
        estimate = estimate_scale(PosedEvidence(evidence, pair.poses, CAMERA, config))
        assert estimate.source == "rig+odometry"
        assert any("off that of" in warning for warning in estimate.warnings) == disagree
        if not disagree:
            assert abs(np.log(estimate.scale * pair.factor)) < 3 * estimate.sigma
