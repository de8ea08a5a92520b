# SPDX-License-Identifier: Apache-2.0
"""What choosing a frame costs beside decoding it: one run over one recording, at its size and at 4K.

    .venv/bin/python -m benchmarks.selector_cost [demo] [lab:SEED[:OPTION...]] [BAG.mcap ...]

Prints, for each recording, the time of the selector alone per frame over that of a full-size cv2.imdecode of the same
frames, both on one thread: in a process as it starts, where each image decoded at full size gets its memory from the
system, and ("warm") in one that keeps its memory, where such decoding takes half the time. Writes
results/selector_cost.json beside this file. The 4K frames are those of the recording, enlarged, with the noise of a
sensor: truly finer ones have more bytes a frame, which is all decoding.
"""

from __future__ import annotations

import ctypes
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import made, named
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_frames.policy.selector import FrameSelector

RESULTS = Path(__file__).parent / "results" / "selector_cost.json"
ROUNDS = 3  # the least of them counts: other work on the machine only adds
ENLARGED = 40  # frames, of 1 MB each
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, MALLOC_LIMIT = -1, -3, 1 << 25  # of glibc's malloc; the largest limit

Encoded = list[tuple[int, bytes]]


def main(names: Sequence[str]) -> None:
    """Measure each recording at its size and at 4K."""
    cv2.setNumThreads(1)
    recordings = []
    for name in names:
        path = made(named(name)).bag
        bag = Bag.open(path)
        frames = [(frame.stamp, bytes(deserialize_message(frame.data, CompressedImage).data)) for frame in bag]
        recordings.append((path.stem, frames, bag.camera))
        factor = 3840 / bag.camera.width
        large = [(stamp, enlarged(encoded, factor, stamp)) for stamp, encoded in frames[:ENLARGED]]
        recordings.append((path.stem, large, bag.camera.scaled(factor)))
    rows = [_measure(*recording) for recording in recordings]
    libc = ctypes.CDLL(None)
    libc.mallopt(M_MMAP_THRESHOLD, MALLOC_LIMIT)
    libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    for row, recording in zip(rows, recordings, strict=True):
        warm = _measure(*recording)
        row.update({f"{key} warm": warm[key] for key in ("decode_ms", "selector_ms", "ratio")})
    print("recording              size   fps frames chosen     decode   selector  ratio  warm")
    for row in rows:
        print(
            f"{row['recording']:16} {row['size']:>10} {row['fps']:5.1f} {row['frames']:6d} {row['chosen']:6d} "
            f"{row['decode_ms']:6.2f} ms {row['selector_ms']:6.2f} ms {row['ratio']:6.2f} {row['ratio warm']:5.2f}"
        )
    command = " ".join(["python -m benchmarks.selector_cost", *names])
    title = "Choosing keyframes: CPU time per frame, beside full-size decoding of the same frames"
    RESULTS.write_text(json.dumps({"title": title, "command": command, "rows": rows}, indent=1) + "\n")


def _measure(name: str, frames: Encoded, camera: Camera) -> dict[str, str | float | int]:
    """One row of the table."""
    chosen = 0

    def select() -> None:
        nonlocal chosen
        selector = FrameSelector(FramesConfig(), camera)
        decisions = []
        for stamp, encoded in frames:
            decisions += selector.consider(stamp, partial(decode_reduced, encoded, camera.width))
        chosen = sum(decision.chosen for decision in decisions + selector.flush())

    def decode() -> None:
        for _, encoded in frames:
            cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)

    # In turn, so that both meet the same machine.
    times = np.array([(_seconds(decode), _seconds(select)) for _ in range(ROUNDS)]).min(axis=0) / len(frames)
    return {
        "recording": name,
        "size": f"{camera.width} x {camera.height}",
        "fps": round((len(frames) - 1) * 1e9 / (frames[-1][0] - frames[0][0]), 1),
        "frames": len(frames),
        "chosen": chosen,
        "decode_ms": round(1e3 * float(times[0]), 3),
        "selector_ms": round(1e3 * float(times[1]), 3),
        "ratio": round(float(times[1] / times[0]), 3),
    }


def _seconds(work: Callable[[], None]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


def enlarged(encoded: bytes, factor: float, seed: int) -> bytes:
    """A JPEG `factor` times as large, with noise of one grey level."""
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    large = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    noise = np.random.default_rng(seed).standard_normal(large.shape, np.float32)
    noisy = np.clip(large + noise, 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


if __name__ == "__main__":
    main(sys.argv[1:] or ["demo"])
