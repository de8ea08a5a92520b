# SPDX-License-Identifier: Apache-2.0
"""Motions that a selector must survive: a fast turn, a long stop, a covered lens, a walk there and back.

    .venv/bin/python -m benchmarks.motions [MOTION ...]

Renders a lab (480p), feeds selector, ring and mapper as the nodes do in a replay, and writes results/motions.json.
"""

from __future__ import annotations

import json
import sys
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS
from pipeprog_camera.camera import Camera
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import Decision
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_frames.incoming.frame_buffer import EncodedFrame, FrameFile
from pipeprog_frames.overlap_feedback import OverlapReport
from pipeprog_frames.policy.keyframe_budget import KeyframeBudget
from pipeprog_frames.policy.stream import KeyframeStream
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.sparse.mapper import Mapper

sys.path.insert(0, str(ROOT / "bags"))
from pipeprog_camera.arrays import FloatArray
from sitegen.lab import build_lab
from sitegen.render import Lens, Scene, build_scene
from sitegen.sensor import Sensor, compress, develop, expose
from sitegen.walk import Walk, look

Recorded = list[tuple[int, bytes]]

SEED = 41
KEPT = ROOT / "out" / "motions"
WIDTH, HEIGHT, FOCAL = 854, 480, 610.0
LENS = Lens(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
ARM = 0.35  # m from a person's or a robot's axis to the camera
SWAY = 0.005  # m and rad, of a steady hand
SPEED, FPS = 0.75, 5.0
TURN_FPS = 15.0
NOISE = 1.0  # grey level
SECOND = 1_000_000_000


class Path(Walk):
    """Straight ways between (t, x, y, yaw) of the carrier's axis: s, m, rad; yaw turns left from +y."""

    def __init__(self, *corners: tuple[float, float, float, float]) -> None:
        self._corners = np.array(corners)

    def poses(self, seconds: ArrayLike) -> FloatArray:
        """(N, 4, 4) world_from_camera at (N,) times."""
        t = np.atleast_1d(np.asarray(seconds, float))
        keys = self._corners
        x, y, yaw = (np.interp(t, keys[:, 0], keys[:, column]) for column in (1, 2, 3))
        sway = SWAY * np.sin(2 * np.pi * np.outer(t, [0.83, 1.1, 1.73]))
        yaw = yaw + sway[:, 2]
        place = np.stack([x - ARM * np.sin(yaw), y + ARM * np.cos(yaw) + sway[:, 0], 1.5 + sway[:, 1]], axis=1)
        return look(place, yaw, sway[:, 0], sway[:, 1])


ALONG = Path((0.0, 0.5, -2.3, 0.0), (6.0, 0.5 + 6 * SPEED, -2.3, 0.0))
BACK = Path((0.0, 0.5 + 3 * SPEED, -2.35, 0.0), (3.0, 0.5, -2.4, 0.0))
TURN = Path((0, 0.5, -2.3, 0), (1.5, 1.6, -2.3, 0), (2.5, 1.6, -2.3, np.pi / 2), (4.0, 1.6, -3.4, np.pi / 2))


def turn() -> Recorded:
    """Along one wall, 90 degrees in a second, along the other."""
    times = np.concatenate([np.arange(0, 1.5, 1 / FPS), np.arange(1.5, 2.5, 1 / TURN_FPS), np.arange(2.5, 4, 1 / FPS)])
    return _rendered("turn", TURN, times)


def stop() -> Recorded:
    """A walk of 2 s, a stop of 20 s at 10 frames a second with a hand's tremor, and on."""
    frames = _rendered("along", ALONG, np.arange(0, 6, 1 / FPS))
    before, after = frames[: int(2 * FPS)], frames[int(2 * FPS) :]
    still = decoded(before[-1][1], cv2.IMREAD_COLOR)
    rng = np.random.default_rng(SEED)
    held = []
    for n in range(200):
        shift = 1.5 * np.sin(0.1 * n * np.array([5.2, 6.9]))
        moved = cv2.warpAffine(
            still, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE
        )
        held.append((before[-1][0] + (n + 1) * SECOND // 10, _encoded(moved, rng)))
    return before + held + [(stamp + 20 * SECOND, encoded) for stamp, encoded in after]


def covered() -> Recorded:
    """A walk of 6 s during which a hand covers the lens for 2 s."""
    rng = np.random.default_rng(SEED)
    hand = np.full((HEIGHT, WIDTH, 3), 12, np.uint8)
    frames = _rendered("along", ALONG, np.arange(0, 6, 1 / FPS))
    return [
        (stamp, _encoded(hand, rng) if 2 * SECOND <= stamp - frames[0][0] < 4 * SECOND else encoded)
        for stamp, encoded in frames
    ]


def there_and_back() -> Recorded:
    """3 s along the wall, and the same way back a little farther from it."""
    there = _rendered("along", ALONG, np.arange(0, 6, 1 / FPS))[: int(3 * FPS)]
    back = _rendered("back", BACK, np.arange(0, 3, 1 / FPS))
    return there + [(stamp + 3 * SECOND, encoded) for stamp, encoded in back]


MOTIONS: dict[str, Callable[[], Recorded]] = {
    "90 degrees in 1 s": turn,
    "stop of 20 s": stop,
    "lens covered for 2 s": covered,
    "there and back": there_and_back,
}


def main(names: list[str]) -> None:
    """Measure and write the table."""
    rows = [{"motion": name, **survive(MOTIONS[name]())} for name in names or MOTIONS]
    for row in rows:
        print(row)
    title = "Motions that a selector must survive, 480p: frames and what the mapper makes of the keyframes"
    command = " ".join(["python -m benchmarks.motions", *names])
    (RESULTS / "motions.json").write_text(
        json.dumps({"title": title, "command": command, "rows": rows}, indent=1) + "\n"
    )


def survive(frames: Recorded) -> dict[str, Any]:
    """What selector and mapper make of a recording."""
    stamps, mapper = mapped(frames, CAMERA)
    return {
        "frames": len(frames),
        "keyframes": len(stamps),
        "registered": len(mapper.map.published),
        "models": len(mapper.map.models),
        "longest time without [s]": round(float(np.diff(stamps).max()) / SECOND, 2),
    }


def mapped(frames: Recorded, camera: Camera) -> tuple[list[int], Mapper]:
    """Stamps of the keyframes of a recording and the mapper that has worked them off, in lockstep with the selector."""
    ring, mapper, images = FrameFile(), Mapper(SfmConfig().mapper), dict(frames)
    stream = KeyframeStream(FramesConfig(), camera, ring.sharpest_between, KeyframeBudget(0))
    changes: deque[Decision] = deque()
    keyframes: set[int] = set()

    def work_off() -> None:
        while changes:
            decision = changes.popleft()
            if decision.chosen:
                keyframes.add(decision.stamp)
                mapper.add(decision.stamp, decoded(images[decision.stamp], cv2.IMREAD_GRAYSCALE), camera)
            else:
                keyframes.discard(decision.stamp)
                mapper.retire([decision.stamp])
            changes.extend(stream.answer(_overlaps(mapper)))

    for stamp, encoded in frames:
        ring.add(EncodedFrame(stamp, "camera", encoded, camera))
        decisions = stream.consider(stamp, partial(decode_reduced, encoded, camera.width))
        changes.extend(decision for decision in decisions if decision.chosen)
        work_off()
    changes.extend(decision for decision in stream.flush() if decision.chosen)
    work_off()
    while changes := deque(stream.finish_round()):
        work_off()
    mapper.finish()
    return sorted(keyframes), mapper


def _overlaps(mapper: Mapper) -> list[OverlapReport]:
    return [
        OverlapReport(
            report.stamp,
            report.registered,
            report.overlap,
            report.cell_overlap,
            report.matches_previous,
            report.matches_next,
        )
        for report in mapper.map.overlap_reports()
    ]


def _rendered(name: str, path: Path, times: NDArray[Any]) -> Recorded:
    """Frames of the lab along a path, from out/motions where they are known."""
    kept = KEPT / f"{name}.npz"
    if not kept.exists():
        KEPT.mkdir(parents=True, exist_ok=True)
        site = build_lab(np.random.default_rng(SEED), 1.0, 0.0, 2.0)
        scene = build_scene(site.primitives, site.lamps, site.ambient, SEED)
        sensor = Sensor(gain=site.gain, noise=NOISE)
        with ThreadPoolExecutor(2) as pool:
            encoded = list(pool.map(partial(_frame, scene, path, sensor), times))
        np.savez(kept, *[np.frombuffer(image, np.uint8) for image in encoded])
    with np.load(kept) as images:
        return [(SECOND + round(t * SECOND), images[f"arr_{n}"].tobytes()) for n, t in enumerate(times)]


def _frame(scene: Scene, path: Path, sensor: Sensor, time: float) -> bytes:
    rng = np.random.default_rng([SEED, round(1000 * time)])
    return compress(develop(expose(scene, LENS, path, sensor, time), sensor, rng), sensor)


def decoded(encoded: bytes, flags: int) -> NDArray[np.uint8]:
    """Image of an encoded frame, by OpenCV's flags."""
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags)
    assert image is not None
    return image.astype(np.uint8, copy=False)


def _encoded(image: NDArray[np.uint8], rng: np.random.Generator) -> bytes:
    noisy = np.clip(image + rng.normal(0, NOISE, image.shape), 0, 255).astype(np.uint8)
    return compress(noisy, Sensor())


if __name__ == "__main__":
    main(sys.argv[1:])
