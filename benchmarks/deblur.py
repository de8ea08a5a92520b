# SPDX-License-Identifier: Apache-2.0
"""Whether undoing motion blur helps the reconstruction: the mapper on blurred recordings, without and with it.

    .venv/bin/python -m benchmarks.deblur

The same walk along a generated lab at three exposure times, each frame a keyframe; and the longest exposure in every
third frame only, among frames of the shortest one, as a jolt leaves it. "offered": keyframes whose motion was worth
undoing; "kept": those where that has added verified matches; "all deblurred": every keyframe's features from its
deblurred image, whatever that adds. Writes results/deblur.json.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

import cv2
import numpy as np
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import made, site
from benchmarks.survey import RESULTS
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_sfm.config import DeblurConfig, SfmConfig
from pipeprog_sfm.deblur import Deblurrer
from pipeprog_sfm.features.sift import Features
from pipeprog_sfm.sparse.mapper import Mapper
from pipeprog_sfm.types import EncodedImage

EXPOSURES_MS = (8, 16, 32)
OPTIONS = ("--size=480p", "--seconds=2.6", "--allow-hidden")
SEED = 41
VARIANTS = ("as it is", "deblurred", "all deblurred")

Encoded = dict[int, bytes]


class Counted(Mapper):
    """Remembers what is offered, and counts what is kept."""

    def __init__(self, config: SfmConfig) -> None:
        super().__init__(config.mapper, config.seed)
        self.offered: dict[int, Features] = {}
        self.kept = 0

    def replace_features(self, stamp: int, features: Features) -> bool:
        """As Mapper.replace_features."""
        self.offered[stamp] = features
        kept = super().replace_features(stamp, features)
        self.kept += kept
        return kept


def main() -> None:
    """Measure, print and write the table."""
    recordings: dict[int, Encoded] = {}
    for exposure in EXPOSURES_MS:
        bag = Bag.open(made(site("lab", SEED, *OPTIONS, f"--exposure-ms={exposure}")).bag)
        recordings[exposure] = {
            frame.stamp: bytes(deserialize_message(frame.data, CompressedImage).data) for frame in bag
        }
    truth_file = site("lab", SEED, *OPTIONS, f"--exposure-ms={EXPOSURES_MS[0]}").beside("truth.json")
    poses = np.array(json.loads(truth_file.read_text())["camera_to_world"])
    truth = dict(zip(recordings[EXPOSURES_MS[0]], poses[:, :3, 3], strict=True))

    shortest, longest = EXPOSURES_MS[0], EXPOSURES_MS[-1]
    jolted = {
        stamp: (recordings[longest] if number % 3 == 1 else recordings[shortest])[stamp]
        for number, stamp in enumerate(recordings[shortest])
    }
    cases = [(f"{exposure}", exposure, recordings[exposure]) for exposure in EXPOSURES_MS]
    cases.append((f"{longest} in every third frame, else {shortest}", longest, jolted))
    rows = [
        {"exposure [ms]": name, **row}
        for name, exposure, images in cases
        for row in compare(images, bag.camera, 1e-3 * exposure, truth)
    ]
    for row in rows:
        print(row)
    title = "Motion blur undone: the mapper on blurred keyframes, lab, 480p"
    document = {"title": title, "command": "python -m benchmarks.deblur", "rows": rows}
    (RESULTS / "deblur.json").write_text(json.dumps(document, indent=1) + "\n")


def compare(
    images: Encoded, camera: Camera, exposure: float, truth: dict[int, FloatArray]
) -> Iterable[dict[str, str | int | float]]:
    """A row for each variant."""
    offered: dict[int, Features] = {}
    for variant in VARIANTS:
        told = exposure if variant == "deblurred" else 0.0
        config = SfmConfig(deblur=DeblurConfig(exposure=told))
        mapper = Counted(config)
        deblurrer = Deblurrer(config)
        for stamp, encoded in images.items():
            if variant == "all deblurred" and stamp in offered:
                mapper.add_features(stamp, offered[stamp], camera)
                continue
            gray = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
            assert gray is not None
            mapper.add(stamp, gray.astype(np.uint8, copy=False), camera)
            poses, image = mapper.map.camera_from_model(), EncodedImage(encoded, camera)
            for other, features in deblurrer.deblurred(stamp, image, poses, mapper.map.points_seen):
                mapper.replace_features(other, features)
        mapper.finish()
        offered = offered or mapper.offered
        yield {
            "variant": variant,
            "keyframes": len(images),
            "registered": len(mapper.map.published),
            "offered": len(offered) if variant != "as it is" else 0,
            "kept": len(offered) if variant == "all deblurred" else mapper.kept,
            "tie points in images": sum(report.tie_points for report in mapper.map.overlap_reports()),
            "camera path RMSE [mm]": round(1e3 * _rmse(mapper.map.camera_from_model(), truth), 2),
            "reprojection error [px]": round(mapper.map.reprojection_error(), 3),
        }


def _rmse(camera_from_model: dict[int, FloatArray], truth: dict[int, FloatArray]) -> float:
    """Of the cameras' places after the best similarity (Umeyama, PAMI 1991)."""
    found = np.array([np.linalg.inv(pose)[:3, 3] for pose in camera_from_model.values()])
    true = np.array([truth[stamp] for stamp in camera_from_model])
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(true.T @ found)
    sign = np.diag([1, 1, np.linalg.det(u @ vt)])
    scale = np.trace(np.diag(s) @ sign) / (found**2).sum()
    return float(np.sqrt(((scale * found @ (u @ sign @ vt).T - true) ** 2).sum(axis=1).mean()))


if __name__ == "__main__":
    main()
