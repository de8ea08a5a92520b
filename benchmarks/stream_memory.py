# SPDX-License-Identifier: Apache-2.0
"""Memory of the selector over ten minutes of a 4K camera at 30 Hz: tracker, selector and live ring, as fast as it goes.

    .venv/bin/python -m benchmarks.stream_memory [BAG.mcap] [--minutes 10]

A few dozen frames of a recording, enlarged to 4K with the noise of a sensor, come again and again, there and back, at
the pace at which they were recorded. Writes results/stream_memory.json.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from itertools import islice
from pathlib import Path

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import made, named
from benchmarks.selector_cost import enlarged
from pipeprog_bringup.recording.bag import Bag
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_frames.incoming.frame_buffer import EncodedFrame, FrameRing
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.stream import KeyframeStream

RESULTS = Path(__file__).parent / "results"
WIDTH = 3840
CYCLE = 32  # frames, of some 1.5 MB each
FPS = 30
REPEATED = 6  # times, each of them: the recording has 5 frames a second
SECOND = 1_000_000_000
TITLE = "Memory of the frame selector over a 4K stream at 30 Hz, ring of the default size"


def main() -> None:
    """Feed the stream and note the process' memory at the end of each minute of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", default="demo")
    parser.add_argument("--minutes", type=int, default=10)
    arguments = parser.parse_args()
    bag = Bag.open(made(named(arguments.recording)).bag)
    factor = WIDTH / bag.camera.width
    some = [bytes(deserialize_message(frame.data, CompressedImage).data) for frame in islice(bag, CYCLE)]
    images = [enlarged(image, factor, number) for number, image in enumerate(some)]
    camera = bag.camera.scaled(factor)
    there_and_back = [*range(CYCLE), *range(CYCLE - 2, 0, -1)]

    command = f"python -m benchmarks.stream_memory {arguments.recording} --minutes {arguments.minutes}"
    config = FramesConfig()
    ring = FrameRing(config.buffer_mib << 20)
    stream = KeyframeStream(config, camera, ring.sharpest_between, KeyframeBudget(0))
    before, started = _resident_mib(), time.process_time()
    rows: list[dict[str, float | int]] = []
    chosen = 0
    for number in range(arguments.minutes * 60 * FPS):
        stamp = SECOND + number * SECOND // FPS
        # As a message's bytes: a copy of their own.
        encoded = bytes(bytearray(images[there_and_back[number // REPEATED % len(there_and_back)]]))
        ring.add(EncodedFrame(stamp, "camera", encoded, camera))
        for decision in stream.consider(stamp, partial(decode_reduced, encoded, camera.width)):
            if decision.chosen:
                chosen += 1
                stream.answer([OverlapReport(decision.stamp, True, 0.9, 0.9, 500, 500)])
        if (number + 1) % (60 * FPS) == 0:
            rows.append(
                {
                    "minute": (number + 1) // (60 * FPS),
                    "frames": number + 1,
                    "keyframes": chosen,
                    "resident [MiB]": round(_resident_mib()),
                    "of that, the frames that come again [MiB]": round(sum(map(len, images)) / 2**20),
                    "before the stream [MiB]": round(before),
                    "CPU [s]": round(time.process_time() - started, 1),
                }
            )
            print(rows[-1], flush=True)
            document = {"title": TITLE, "command": command, "rows": rows}
            (RESULTS / "stream_memory.json").write_text(json.dumps(document, indent=1) + "\n")


def _resident_mib() -> float:
    fields = Path("/proc/self/status").read_text().split("VmRSS:")[1].split()
    return int(fields[0]) / 1024


if __name__ == "__main__":
    main()
