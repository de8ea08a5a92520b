# SPDX-License-Identifier: Apache-2.0
"""What can be told of a recording before a survey: by `pipeprog check`, and at the start of each replay.

A survey needs at least four images, some that are not black, and something that tells the scale.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.fleet.memory import foreseen
from pipeprog_bringup.frame_quality import REMEDIES, fault_of
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording.frame_check import ImageMessage
from pipeprog_camera.camera import Camera
from pipeprog_camera.raw_image import SAMPLES
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.ellipses import detect_ellipses
from pipeprog_sfm.config import BoardConfig

MIN_FRAMES = 4  # points and outlines count where three views agree; of three images none may be lost or stand alone
SCALE_TOPICS = {"odometry", "/tf", "/tf_static"}  # of the graph; odometry, odometry in TF, the bodies of a camera rig
_SAMPLE = 12  # frames looked at: a board that a third of the frames show is missed once in 130 recordings
_SECONDS = 3.0  # for reading at the start of a replay; what is not read by then counts for nothing
_BLACK = 12.0  # mean of 0..255; a lens cap gives 0 to 5, a cellar lit by one lamp 20 and more
_MANY = 1 / 3  # of the frames looked at: of three neighbours, which must agree, more than one is lost then
_RESULT_SHARE = 14  # bytes of results for each byte of a recording of JPEG images (docs/fleet.md)


@dataclass
class Findings:
    """What was found: facts by their names, why a survey would give no result, and what may make it worse."""

    facts: dict[str, Any] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def faults_of(bag: Bag, board_file: BoardFile) -> list[str]:
    """Why a survey of a recording cannot give a result, in a few seconds; empty where none is known."""
    return [*_without_images(bag, board_file), *_black(_samples(bag, _SECONDS)[0])]


def check(bag: Bag, board_file: BoardFile, size: int) -> Findings:
    """All that can be told of a recording of `size` bytes: each frame is read, and some are looked into."""
    samples, stamps, unusable = _samples(bag, float("inf"))
    seconds = (max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0
    seen = _boards_in(samples, bag.camera, board_file)
    poor = Counter(map(fault_of, samples))
    motion = sorted(bag.motion_topics.values())
    findings = Findings(
        {
            "image_topic": bag.image_topic,
            "camera_info_topic": bag.camera_info_topic,
            "width": bag.camera.width,
            "height": bag.camera.height,
            "focal_length_px": round(bag.camera.fx, 1),
            "frames": len(stamps),
            "frames_unusable": unusable,
            "seconds": round(seconds, 2),
            "frames_per_second": round((len(stamps) - 1) / seconds, 2) if seconds > 0 else None,
            "frames_sampled": len(samples),
            "black": sum(map(_is_dark, samples)),
            **{kind: poor[kind] for kind in REMEDIES},
            "boards_seen": seen,
            "motion": motion,
            "result_mb": round(_RESULT_SHARE * size / 1e6),
            "memory_mb": foreseen(size, None),
        },
        [*_without_images(bag, board_file), *_black(samples)],
        [*bag.notes, *bag.losses],
    )
    if board_file.boards and samples and not any(seen.values()):
        text = f"no board was seen in {len(samples)} frames of {len(stamps)}"
        if SCALE_TOPICS & set(motion) or len(samples) < len(stamps):
            findings.notes.append(f"{text}: is it the right file, and is the board in view, near, sharp and lit?")
        else:
            findings.faults.append(f"{text}, and nothing else tells the scale: film the board, or name its file")
    findings.notes += [
        f"{poor[kind]} of {len(samples)} frames looked at are {remedy}"
        for kind, remedy in REMEDIES.items()
        if poor[kind] > _MANY * len(samples)
    ]
    return findings


def recording_size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder."""
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]) if file.is_file())


def _without_images(bag: Bag, board_file: BoardFile) -> list[str]:
    """The faults that need no look into an image."""
    faults = []
    if bag.image_count < MIN_FRAMES:
        faults.append(
            f"{bag.path} has {bag.image_count} images on {bag.image_topic}: a survey needs {MIN_FRAMES} at the very "
            "least, and about one for each 20 cm of the way"
        )
    has_target = board_file.boards or board_file.scale_bars
    if not has_target and not SCALE_TOPICS & set(bag.motion_topics.values()):
        faults.append(
            f"nothing tells the scale of {bag.path}: hang up a board and name its file with --board, or record odometry"
        )
    return faults


def _samples(bag: Bag, limit: float) -> tuple[list[NDArray[np.uint8]], list[int], int]:
    """Some frames as gray images, the stamps of all [ns], and how many cannot be used; reads for `limit` seconds."""
    step = max(1, bag.image_count // _SAMPLE)
    images, stamps, unusable = [], [], 0
    started = time.monotonic()
    for number, frame in enumerate(bag):
        if time.monotonic() > started + limit:
            break
        unusable += bool(frame.fault)
        if frame.fault:
            continue
        stamps.append(frame.stamp)
        if number % step == 0 and (image := gray_image(frame, bag.image_type)) is not None:
            images.append(image)
    return images, stamps, unusable


def gray_image(frame: ImageMessage, type_name: str) -> NDArray[np.uint8] | None:
    """(H, W) gray image; None where it cannot be decoded or has more than 8 bits a channel."""
    fields = cdr.read_image(frame.data, type_name)
    pixels = np.frombuffer(fields.data, np.uint8)
    if type_name == cdr.COMPRESSED_IMAGE:
        image = cv2.imdecode(pixels, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        return None if image is None else np.asarray(image, np.uint8)
    width, channels = SAMPLES[fields.encoding]
    if width > 1:
        return None
    rows = pixels[: fields.height * fields.step].reshape(fields.height, fields.step)[:, : fields.width * channels]
    return rows.reshape(fields.height, fields.width, channels).mean(2).astype(np.uint8)


def _is_dark(gray: NDArray[np.uint8]) -> bool:
    return bool(gray.mean() < _BLACK)


def _black(samples: Sequence[NDArray[np.uint8]]) -> list[str]:
    if not samples or not all(map(_is_dark, samples)):
        return []
    return [f"all {len(samples)} frames looked at are black: was the lens covered, or the light off?"]


def _boards_in(samples: Sequence[NDArray[np.uint8]], camera: Camera, board_file: BoardFile) -> dict[str, int]:
    """In how many of the frames each board is seen."""
    seen = {board.name: 0 for board in board_file.boards}
    if not seen:
        return seen
    for image in samples:
        if image.shape != (camera.height, camera.width):
            continue
        ellipses = detect_ellipses(image, camera, BoardConfig())
        for name in {one.board for one in detect_boards(ellipses, board_file.boards, camera)}:
            seen[name] += 1
    return seen
