# SPDX-License-Identifier: Apache-2.0
"""CPU time of the reconstruction and the detector by stage, on the keyframes that a replay has chosen.

    .venv/bin/python -m benchmarks.stage_cost [RECORDING] [--name NAME]

The recording is replayed first, unless out/surveys has it. Both cores then run in this process, without ROS and with
one thread each, so that a stage's time is its own; depth maps are made at the end, with the final poses. Writes
results/stage_cost_NAME.json.
"""

from __future__ import annotations

import csv
import functools
import json
import os
import time
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

import cv2
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import Recording, one_recording
from benchmarks.survey import RESULTS, RUNS, attempt, commit
from pipeprog_bringup.recording.bag import Bag
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.types import Cloud
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.dense import dense_mapper, stereo
from pipeprog_sfm.dense.depth_fusion import Fusion
from pipeprog_sfm.reconstruction import MetricMap, NotMetricError, Reconstruction
from pipeprog_sfm.sparse.mapper import Mapper
from pipeprog_sfm.sparse.sparse_map import SparseMap
from pipeprog_sfm.warm_up import warm_up

# Where the calls of a stage are timed; what one of them spends within another one is subtracted.
TIMED = (
    (Reconstruction, "add", "decoding, boards"),
    (Mapper, "add", "SIFT"),
    (Mapper, "add_features", "matching, registration"),
    (SparseMap, "adjust_globally", "global adjustment"),
    (Reconstruction, "trajectory", "scale"),
    (Reconstruction, "overlap_reports", "overlaps"),
    (dense_mapper, "depth_map", "depth maps, the rest"),
    (stereo, "sweep", "depth maps, sweep"),
    (stereo, "refine", "depth maps, patches"),
    (Fusion, "add", "fusion"),
    (Fusion, "cloud", "cloud"),
)


class Stages:
    """CPU seconds by stage, each thread's own."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner: dict[int, float] = defaultdict(float)  # by depth of nesting; stages of two threads never overlap
        self._depth = 0

    def time(self, owner: Any, attribute: str, stage: str) -> None:
        """Replaces a function by itself and a clock."""
        function = getattr(owner, attribute)

        @functools.wraps(function)
        def timed(*arguments: Any, **named: Any) -> Any:
            self._depth += 1
            depth, started = self._depth, time.thread_time()
            try:
                return function(*arguments, **named)
            finally:
                spent = time.thread_time() - started
                self.seconds[stage] += spent - self._inner.pop(depth, 0.0)
                self._depth -= 1
                self._inner[depth - 1] += spent

        setattr(owner, attribute, timed)


def reconstruct(recording: Recording, stamps: set[int], stages: Stages) -> tuple[MetricMap, Keyframes]:
    """The map of the keyframes with these stamps, and the keyframes; the time of each stage goes to `stages`."""
    warm_up(SfmConfig())
    for owner, attribute, stage in TIMED:
        stages.time(owner, attribute, stage)
    reconstruction = Reconstruction(SfmConfig(), load_board_file(recording.beside("board.yaml")))
    keyframes = Keyframes()
    bag = Bag.open(recording.bag)
    for message in bag:
        if message.stamp not in stamps:
            continue
        encoded = bytes(deserialize_message(message.data, CompressedImage).data)
        keyframes.add(message.stamp, encoded, bag.camera)
        reconstruction.add(message.stamp, encoded, bag.camera, message.frame_id)
        reconstruction.overlap_reports()
        try:
            reconstruction.trajectory()
        except NotMetricError:
            continue
    return reconstruction.finish(), keyframes


def detected(recording: Recording, found: MetricMap, keyframes: Keyframes) -> dict[str, float]:
    """CPU seconds of the detector's stages; the second of two runs, since the first one loads compiled code."""
    trajectory = found.trajectory
    views = [
        keyframes.view(stamp, pose)
        for stamp, pose in zip(trajectory.stamps.tolist(), trajectory.map_from_camera, strict=True)
    ]
    cloud = Cloud(found.cloud.points.astype(float), found.cloud.normals.astype(float))
    boq = load_boq(recording.beside("boq.yaml"))
    for _ in range(2):
        told: list[tuple[float, str]] = []
        detect(cloud, boq, DetectConfig(), views, lambda _, stage: told.append((time.process_time(), stage)))  # noqa: B023 - called at once
    stages: dict[str, float] = defaultdict(float)
    for (started, stage), (ended, _) in pairwise(told):
        stages["looking for pipes in patches" if "patches" in stage else stage] += ended - started
    return stages


def rows(core: str, seconds: dict[str, float]) -> list[dict[str, Any]]:
    """A row for each stage, the longest first, and one for the whole."""
    whole = sum(seconds.values())
    order = sorted(seconds, key=lambda stage: -seconds[stage])
    table = [(stage, seconds[stage]) for stage in order] + [("whole", whole)]
    return [
        {"core": core, "stage": stage, "cpu [s]": round(spent, 2), "share [%]": round(100 * spent / whole, 1)}
        for stage, spent in table
    ]


def _chosen(frames: Path) -> set[int]:
    with frames.open() as stream:
        return {int(row["stamp"]) for row in csv.DictReader(stream) if row["chosen"] == "1"}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure one recording."""
    recording, name, command = one_recording("stage_cost", __doc__, arguments)
    attempt(recording, name=name)
    cv2.setNumThreads(1)
    stages = Stages()
    stamps = _chosen(RUNS / name / "frames.csv")
    found, keyframes = reconstruct(recording, stamps, stages)
    table = rows("sfm", stages.seconds) + rows("detect", detected(recording, found, keyframes))
    content = {
        "title": f"CPU time by stage on {name}, one thread",
        "command": command,
        "commit": commit(),
        "load": round(os.getloadavg()[0], 2),
        "keyframes": len(stamps),
        "points": len(found.cloud.points),
        "rows": table,
    }
    (RESULTS / f"stage_cost_{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    for row in table:
        print(row)


if __name__ == "__main__":
    main()
