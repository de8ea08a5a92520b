# SPDX-License-Identifier: Apache-2.0
"""What can be told of a recording before a survey: by `pipeprog check`, and at the start of each replay.

A survey needs at least four images, some that show something, a camera that moves, and something that tells the scale.
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
from pipeprog_camera.raw_image import SAMPLES
from pipeprog_frames.corners import corners
from pipeprog_frames.incoming.decoding import reduce_image
from pipeprog_frames.tracker import MIN_CORNERS
from pipeprog_sfm.boards.board import Board
from pipeprog_sfm.boards.board_detection import detect_boards
from pipeprog_sfm.boards.board_file import BoardFile
from pipeprog_sfm.boards.ellipses import detect_ellipses
from pipeprog_sfm.config import BoardConfig

MIN_FRAMES = 4  # points and outlines count where three views agree; of three images none may be lost or stand alone
SCALE_TOPICS = {"odometry", "/tf", "/tf_static"}  # of the graph; odometry, odometry in TF, the bodies of a camera rig
_SAMPLE = 12  # frames looked at: a board that a third of the frames show is missed once in 130 recordings
_SECONDS = 3.0  # for reading at the start of a replay; what is not read by then counts for nothing
_SEARCH_SECONDS = 3.0  # for boards in all frames: some 200 of 720p. Of CPU time: the same frames on a busy machine
_BLACK = 12.0  # mean of 0..255; a lens cap gives 0 to 5, a cellar lit by one lamp 20 and more
_MANY = 1 / 3  # of the frames looked at: of three neighbours, which must agree, more than one is lost then
# Grey levels, mean difference of two thumbnails. One scene before a camera that stands: 0.5 with noise of three levels;
# frames of the recordings in which a camera walks: 11 and more.
_SAME = 1.0
_THUMBNAIL = 80, 45  # px; averages 256 pixels at 720p, and their noise with them

# Of the results, measured on four recordings of 720p in which a camera walks at 0.75 m/s, two metres from the wall.
_POINTS_A_SECOND = 70_000  # of the cloud, one a voxel of 4 mm: 50 000 to 74 000; a slower walk shows less in a second
_BYTES_A_POINT = 48 + 27 + 25  # cloud.las, cloud.ply, and compressed in out.mcap
_KEYFRAMES_A_SECOND = 3.0  # 2.4 to 3.4; out.mcap has their images as they were recorded
_BYTES_A_KEYFRAME = 450_000  # features in map.npz, features and points in colmap/


@dataclass
class Findings:
    """What was found: facts by their names, why a survey would give no result, and what may make it worse."""

    facts: dict[str, Any] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _BoardSearch:
    """Which boards frames show.

    Attributes:
        seen: in how many of the frames each board is seen.
        frames: how many were looked at.
        is_complete: whether a survey has no others than these.
    """

    seen: dict[str, int]
    frames: int
    is_complete: bool


def first_look(bag: Bag, board_file: BoardFile, config: BoardConfig, has_reference: bool) -> Findings:
    """What is told at the start of a replay, within seconds: faults, and notes where no board was seen; no facts.

    Args:
        bag: one camera, or a rig, of which one camera without a fault is enough.
        board_file: boards and scale bars.
        config: how boards are looked for.
        has_reference: whether an earlier survey may tell the scale.
    """
    cameras = bag.rig or (bag,)
    each = []
    for camera in cameras:
        samples, _, _ = _samples(camera, _SECONDS / len(cameras))
        # Of a rig that stands, several cameras may show one place.
        spoilt = _without_content(samples) or ([] if bag.rig else _still(samples))
        boards = [] if spoilt else board_file.boards
        search = _search_boards(camera, samples, boards, config, _SEARCH_SECONDS / len(cameras))
        judged = _judged(camera, board_file, spoilt, search, has_reference)
        if search.frames and not any(search.seen.values()):
            judged.notes += _poor(samples, Counter(map(fault_of, samples)))
        each.append(judged)
    return Findings(
        faults=each[0].faults if all(one.faults for one in each) else [],
        notes=each[0].notes if all(one.notes for one in each) else [],
    )


def check(bag: Bag, board_file: BoardFile, size: int) -> Findings:
    """All that can be told of a recording of `size` bytes: each frame is read, and some are looked into."""
    samples, stamps, unusable = _samples(bag, float("inf"))
    seconds = (max(stamps) - min(stamps)) * 1e-9 if stamps else 0.0
    spoilt = _without_content(samples) or _still(samples)
    search = _search_boards(bag, samples, [] if spoilt else board_file.boards, BoardConfig(), _SEARCH_SECONDS)
    poor = Counter(map(fault_of, samples))
    judged = _judged(bag, board_file, spoilt, search, has_reference=False)
    return Findings(
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
            "frames_searched": search.frames,
            "boards_seen": {board.name: search.seen.get(board.name, 0) for board in board_file.boards},
            "motion": sorted(bag.motion_topics.values()),
            "result_mb": _result_mb(size, len(stamps), seconds),
            "memory_mb": foreseen(size, None),
        },
        judged.faults,
        [*bag.notes, *bag.losses, *judged.notes, *([] if spoilt else _poor(samples, poor))],
    )


def recording_size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder."""
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]) if file.is_file())


def _judged(
    bag: Bag, board_file: BoardFile, spoilt: Sequence[str], search: _BoardSearch, has_reference: bool
) -> Findings:
    """Faults of what one camera has recorded, and a note where no board was seen and that may not matter."""
    findings = Findings()
    if bag.image_count < MIN_FRAMES:
        findings.faults.append(
            f"{bag.path} has {bag.image_count} images on {bag.image_topic}: a survey needs {MIN_FRAMES} at the very "
            "least, and about one for each 20 cm of the way"
        )
    findings.faults += spoilt
    told = has_reference or bool(board_file.scale_bars) or bool(SCALE_TOPICS & set(bag.motion_topics.values()))
    if not (told or board_file.boards):
        findings.faults.append(
            f"nothing tells the scale of {bag.path}: hang up a board and name its file with --board, or record odometry"
        )
    if not search.frames or any(search.seen.values()):
        return findings
    names = ", ".join(search.seen)
    text = f"no board ({names}) of {board_file.path} was seen in {search.frames} frames of {bag.image_count}"
    remedy = "is it the file of the board that hangs, and is the board in view, near, sharp and lit?"
    # By a focal length that is a guess, boards may be found only once the survey has refined it.
    if told or not search.is_complete or bag.focal_sigma is not None:
        findings.notes.append(f"{text}: {remedy}")
    else:
        findings.faults.append(f"{text}, and nothing else tells the scale: {remedy}")
    return findings


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


def _without_content(samples: Sequence[NDArray[np.uint8]]) -> list[str]:
    """The fault of frames of which the selector takes none: they are black, or show no corners that it can follow."""
    if not samples:
        return []
    if all(map(_is_dark, samples)):
        return [f"all {len(samples)} frames looked at are black: was the lens covered, or the light off?"]
    if any(len(corners(reduce_image(image))) >= MIN_CORNERS for image in samples):
        return []
    kind = Counter(map(fault_of, samples)).most_common(1)[0][0]
    remedy = REMEDIES.get(kind, "without texture: film surfaces that are not bare")
    return [f"no frame of {len(samples)} looked at shows {MIN_CORNERS} corners, as a keyframe must: they are {remedy}"]


def _still(samples: Sequence[NDArray[np.uint8]]) -> list[str]:
    """The fault of frames that all show one image: nothing has a depth then."""
    if len(samples) < MIN_FRAMES:
        return []
    first, *others = (cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(float) for image in samples)
    if max(np.abs(other - first).mean() for other in others) >= _SAME:
        return []
    return [
        f"all {len(samples)} frames looked at show the same image: did the camera stand, or send its last image again? "
        "walk along the pipes"
    ]


def _poor(samples: Sequence[NDArray[np.uint8]], counts: Counter[str]) -> list[str]:
    """Notes on what keeps many of the frames from being measured; `counts`: how many, by keys of REMEDIES."""
    return [
        f"{counts[kind]} of {len(samples)} frames looked at are {remedy}"
        for kind, remedy in REMEDIES.items()
        if counts[kind] > _MANY * len(samples)
    ]


def _search_boards(
    bag: Bag, samples: Sequence[NDArray[np.uint8]], boards: Sequence[Board], config: BoardConfig, limit: float
) -> _BoardSearch:
    """Boards in the samples; where these show none, in all frames, until one does or `limit` seconds are spent."""
    seen = {board.name: 0 for board in boards}

    def looked_at(image: NDArray[np.uint8] | None) -> bool:
        """Counts the boards in an image; False where it is not what the camera of the recording gives."""
        if image is None or image.shape != (bag.camera.height, bag.camera.width):
            return False
        ellipses = detect_ellipses(image, bag.camera, config)
        for name in {one.board for one in detect_boards(ellipses, boards, bag.camera)}:
            seen[name] += 1
        return True

    if not boards:
        return _BoardSearch(seen, 0, False)
    frames = sum(map(looked_at, samples))
    if any(seen.values()):
        return _BoardSearch(seen, frames, False)
    started = time.thread_time()
    frames, is_complete = 0, True
    for frame in bag:
        if any(seen.values()) or time.thread_time() > started + limit:
            return _BoardSearch(seen, frames, False)
        if not frame.fault:
            is_used = looked_at(gray_image(frame, bag.image_type))
            frames += is_used
            is_complete = is_complete and is_used
    return _BoardSearch(seen, frames, is_complete)


def _result_mb(size: int, frames: int, seconds: float) -> int:
    """The results to be expected [MB] of a recording of `size` bytes."""
    points = _POINTS_A_SECOND * seconds
    keyframes = min(_KEYFRAMES_A_SECOND * seconds, frames)
    images = size * keyframes / max(frames, 1)
    return round((_BYTES_A_POINT * points + _BYTES_A_KEYFRAME * keyframes + images) / 1e6)
