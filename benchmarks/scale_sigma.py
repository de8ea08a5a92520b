# SPDX-License-Identifier: Apache-2.0
"""The stated scale sigma against the true error: twenty sites of the generator, each with a board of its own printing.

    .venv/bin/python -m benchmarks.scale_sigma [SEEDS]

Every site is another room, another walk past the board (480p, 15 images) and another print, whose circles lie off by
the tolerance that `sfm.board.tolerance` states. The mapper and the estimate of the scale run as in the graph, without
it. The true scale is that of the similarity which lays the model's cameras onto the true ones: what the stated sigma
is about. Prints a line a site and writes results/scale_sigma.json; chi2 is the mean square of error over sigma.
"""

from __future__ import annotations

import json
import sys
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import Recording, made, site
from benchmarks.survey import RESULTS
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.metric.metric_tracker import MetricTracker
from pipeprog_sfm.metric.scale import ScaleEstimate
from pipeprog_sfm.sparse.mapper import Mapper

FIRST_SEED = 201
OPTIONS = ("--size=480p", "--seconds=5", "--fps=3", "--allow-hidden")


def main(seeds: int) -> None:
    """Measure the sites one after the other."""
    config = SfmConfig()
    printing = f"--board-error-mm={1e3 * config.board.tolerance:g}"
    rows = []
    for seed in range(FIRST_SEED, FIRST_SEED + seeds):
        recording = made(site("lab", seed, *OPTIONS, printing))
        estimate, error, images = measure(recording, config)
        rows.append(
            {
                "seed": seed,
                "registered": images,
                "images of the board": len(estimate.views),
                "error [%]": round(100 * error, 4),
                "stated sigma [%]": round(100 * estimate.sigma, 4),
                "error over sigma": round(error / estimate.sigma, 2),
            }
        )
        print(rows[-1], flush=True)
    ratios = np.array([row["error over sigma"] for row in rows])
    facts = {
        "within_3_sigma": int((np.abs(ratios) < 3).sum()),
        "of": seeds,
        "chi2": round(float((ratios**2).mean()), 2),
    }
    print(facts)
    title = f"Stated sigma of the scale: {facts['within_3_sigma']} of {seeds} within 3 sigma, chi2 {facts['chi2']}"
    command = f"python -m benchmarks.scale_sigma {seeds}"
    (RESULTS / "scale_sigma.json").write_text(
        json.dumps({"title": title, "command": command, "rows": rows, **facts}, indent=1) + "\n"
    )


def measure(recording: Recording, config: SfmConfig) -> tuple[ScaleEstimate, float, int]:
    """The estimate, its true relative error, and the number of images registered."""
    bag = Bag.open(recording.bag)
    mapper, tracker = (
        Mapper(config.mapper),
        MetricTracker(load_board_file(recording.beside("board.yaml")), config.board),
    )
    stamps = []
    for frame in bag:
        gray = decoded(frame.data)
        stamps.append(frame.stamp)
        tracker.add(frame.stamp, gray, bag.camera)
        mapper.add(frame.stamp, gray, bag.camera)
    mapper.finish()
    poses = mapper.map.camera_from_model()
    estimate = tracker.estimate(poses, partial(mapper.map.covariance, next(iter(poses))))
    camera_to_world = dict(
        zip(stamps, json.loads(recording.beside("truth.json").read_text())["camera_to_world"], strict=True)
    )
    centres = np.stack([np.linalg.inv(pose)[:3, 3] for pose in poses.values()])
    true_centres = np.array([camera_to_world[stamp] for stamp in poses])[:, :3, 3]
    true_scale = float(np.cbrt(np.linalg.det(similarity(centres, true_centres)[:3, :3])))
    return estimate, estimate.scale / true_scale - 1, len(poses)


def decoded(data: bytes) -> NDArray[np.uint8]:
    """(H, W) grey image of a serialised CompressedImage."""
    encoded = np.frombuffer(deserialize_message(data, CompressedImage).data, np.uint8)
    gray = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    return gray.astype(np.uint8, copy=False)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
