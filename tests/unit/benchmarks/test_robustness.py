# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks import robustness
from benchmarks.recordings import DEMO, Recording
from benchmarks.robustness import Shot
from pipeprog_bringup.recording.bag import Bag


@pytest.fixture
def plain(tmp_path: Path) -> Recording:
    """The demo's recording where files may be made beside it."""
    for kind in ("mcap", "truth.json", "boq.yaml", "board.yaml"):
        (tmp_path / f"demo.{kind}").symlink_to(DEMO.beside(kind))
    return Recording(tmp_path / "demo.mcap", "")


def test_a_wrong_calibration_leaves_the_frames_alone(plain: Recording) -> None:
    altered = Shot(focal_error=1.0, k1=0.05).altered(plain)
    before, after = Bag.open(plain.bag), Bag.open(altered.bag)
    assert after.camera.fx == pytest.approx(1.01 * before.camera.fx)
    assert (after.camera.cx, after.camera.cy) == (before.camera.cx, before.camera.cy)
    assert after.camera.distortion[0] == pytest.approx(0.05)
    for one, other in zip(before, after, strict=True):
        assert one.stamp == other.stamp
        assert _image(one.data) == _image(other.data)


def test_noise_is_as_strong_as_said(plain: Recording) -> None:
    altered = Shot(noise=12.0, quality=100).altered(plain)
    one, other = (next(iter(Bag.open(recording.bag))) for recording in (plain, altered))
    levels = [np.asarray(cv2.imdecode(np.frombuffer(_image(f.data), np.uint8), cv2.IMREAD_COLOR)) for f in (one, other)]
    difference = levels[1].astype(float) - levels[0]
    # Clipping at black and white, and the JPEG's colour at half the size, take some of it away.
    assert 7.0 < difference.std() < 12.5


def test_factors_that_are_not_named_keep_their_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = {"factor": "resolution", "value": "4k", "F": 1.0, "commit": "old"}
    stale = {"factor": "image noise [grey levels]", "value": "5", "F": 0.5, "commit": "old"}
    result = tmp_path / "robustness.json"
    result.write_text(json.dumps({"rows": [kept, stale]}))
    monkeypatch.setattr(robustness, "RESULTS", tmp_path)
    monkeypatch.setattr(robustness, "_draw", lambda rows: None)
    monkeypatch.setattr(robustness, "_figures", lambda shot: {"F": 1.0, "commit": "new"})
    robustness.main(["image noise [grey levels]"])
    rows = json.loads(result.read_text())["rows"]
    assert rows[-1] == kept
    assert [(row["value"], row["commit"]) for row in rows[:-1]] == [("1", "new"), ("5", "new"), ("12", "new")]


def _image(message: bytes) -> bytes:
    return bytes(deserialize_message(message, CompressedImage).data)
