# SPDX-License-Identifier: Apache-2.0
"""SIFT descriptors sampled on a patch's own grid beside OpenCV's, of the same keypoints: time and matches.

    .venv/bin/python -m benchmarks.descriptors [demo] [lab:SEED[:OPTION...]] [BAG.mcap ...]

Takes the keypoints that OpenCV finds in FRAMES frames of each recording, describes them in both ways on one thread,
and matches each frame with the next: how many mutual matches there are, and how many lie within 1 px of their epipolar
line. Writes results/descriptors.json beside this file.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import made, named
from benchmarks.survey import commit
from pipeprog_bringup.recording.bag import Bag
from pipeprog_sfm.config import MapperConfig
from pipeprog_sfm.features.matching import match
from pipeprog_sfm.features.sift import keypoint_search, root_sift, working_image
from pipeprog_sfm.features.sift_descriptors import describe

RESULTS = Path(__file__).parent / "results" / "descriptors.json"
TITLE = "SIFT descriptors: ours beside OpenCV's, of the same keypoints"
FRAMES = 16  # of a recording
FEATURES = MapperConfig().max_features  # of a frame, the strongest
ROUNDS = 3  # the least of them counts: other work on the machine only adds
NEAR = 1.0  # px, from the epipolar line

Keypoints = Sequence[cv2.KeyPoint]
Described = Callable[[NDArray[np.uint8], Keypoints], NDArray[np.float32]]


def main(names: Sequence[str]) -> None:
    """Measure each recording."""
    cv2.setNumThreads(1)
    rows = [row for name in names for row in _measure(made(named(name)).bag)]
    for row in rows:
        print(*row.values(), sep="\t")
    command = " ".join(["python -m benchmarks.descriptors", *names])
    RESULTS.write_text(
        json.dumps({"title": TITLE, "command": command, "commit": commit(), "rows": rows}, indent=1) + "\n"
    )


def _measure(path: Path) -> list[dict[str, Any]]:
    messages = list(Bag.open(path))
    images = [_image(message.data) for message in messages[:: max(len(messages) // FRAMES, 1)][:FRAMES]]
    sift = keypoint_search()
    found = [sorted(sift.detect(image, None), key=lambda point: -point.response)[:FEATURES] for image in images]
    rows: list[dict[str, Any]] = []
    peer = 0.0  # ms a frame
    ways: dict[str, Described] = {"OpenCV": lambda image, points: sift.compute(image, points)[1], "ours": describe}
    for name, way in ways.items():
        way(images[0], found[0])  # compiled, loaded
        spent = 1e3 * min(_seconds(way, images, found) for _ in range(ROUNDS)) / len(images)
        peer = peer or spent
        described = [root_sift(way(image, points)) for image, points in zip(images, found, strict=True)]
        pairs = [_matches(described[n], described[n + 1], found[n], found[n + 1]) for n in range(len(images) - 1)]
        rows.append(
            {
                "recording": path.stem,
                "descriptors": name,
                "keypoints": sum(map(len, found)),
                "ms a frame": round(spent, 1),
                "time beside OpenCV": round(spent / peer, 2),
                "matches": sum(matches for matches, _ in pairs),
                "within 1 px of the epipolar line": sum(near for _, near in pairs),
            }
        )
    return rows


def _image(message: bytes) -> NDArray[np.uint8]:
    data = np.frombuffer(bytes(deserialize_message(message, CompressedImage).data), np.uint8)
    gray = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    return working_image(gray.astype(np.uint8, copy=False))[0]


def _seconds(way: Described, images: Sequence[NDArray[np.uint8]], found: Sequence[Keypoints]) -> float:
    started = time.process_time()
    for image, points in zip(images, found, strict=True):
        way(image, points)
    return time.process_time() - started


def _matches(
    first: NDArray[np.uint8], second: NDArray[np.uint8], points: Keypoints, others: Keypoints
) -> tuple[int, int]:
    """Mutual matches of two frames, and how many of them agree with one epipolar geometry."""
    pairs = match(first, second)
    if len(pairs) < 8:
        return len(pairs), 0
    places = np.array([points[index].pt for index in pairs[:, 0]], np.float32)
    there = np.array([others[index].pt for index in pairs[:, 1]], np.float32)
    cv2.setRNGSeed(0)
    _, inliers = cv2.findFundamentalMat(places, there, cv2.FM_RANSAC, NEAR, 0.999, 10_000)
    return len(pairs), int(inliers.sum())


if __name__ == "__main__":
    main(sys.argv[1:] or ["demo"])
