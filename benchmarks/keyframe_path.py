# SPDX-License-Identifier: Apache-2.0
"""What the keyframes of a 30 Hz recording cost in accuracy: the camera's path from them and from every frame.

    .venv/bin/python -m benchmarks.keyframe_path [RECORDING]

Feeds selector and mapper as the nodes do in a replay, then the mapper alone with all frames, and writes
results/keyframe_path.json. Paths are laid on the truth by a similarity.
"""

from __future__ import annotations

import json
import sys

import cv2
import numpy as np
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.motions import decoded, mapped
from benchmarks.recordings import made, named
from benchmarks.survey import RESULTS
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.scored_files import read_truth
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.sparse.mapper import Mapper

RECORDING = "lab:31:fps=30:seconds=8:allow-hidden"


def main(text: str) -> None:
    """Measure and write the table."""
    recording = made(named(text))
    bag = Bag.open(recording.bag)
    frames = [(frame.stamp, bytes(deserialize_message(frame.data, CompressedImage).data)) for frame in bag]
    truth = read_truth(recording.beside("truth.json"))
    centres = dict(zip((stamp for stamp, _ in frames), truth.world_from_camera[:, :3, 3], strict=True))

    def row(what: str, used: int, mapper: Mapper) -> dict[str, float | int | str]:
        poses = mapper.map.camera_from_model()
        own = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses.values()])
        true = np.array([centres[stamp] for stamp in poses])
        onto = similarity(own, true)
        residual = np.linalg.norm(own @ onto[:3, :3].T + onto[:3, 3] - true, axis=1)
        return {
            "images": what,
            "used": used,
            "share of the frames": round(used / len(frames), 3),
            "registered": len(mapper.map.published),
            "models": len(mapper.map.models),
            "path RMSE [mm]": round(1e3 * float(np.sqrt(np.mean(residual**2))), 4),
        }

    stamps, chosen = mapped(frames, bag.camera)
    rows = [row("keyframes", len(stamps), chosen)]
    print(rows[-1], flush=True)
    everything = Mapper(SfmConfig().mapper)
    for stamp, encoded in frames:
        everything.add(stamp, decoded(encoded, cv2.IMREAD_GRAYSCALE), bag.camera)
    everything.finish()
    rows.append(row("all frames", len(frames), everything))
    print(rows[-1])
    title = "Camera path from the keyframes of a 30 Hz recording and from all of its frames"
    command = f"python -m benchmarks.keyframe_path {text}"
    (RESULTS / "keyframe_path.json").write_text(
        json.dumps({"title": title, "command": command, "rows": rows}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else RECORDING)
