# SPDX-License-Identifier: Apache-2.0
"""`pipeprog ingest`: what a phone has filmed becomes a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.footage.camera_file import read_camera_file
from pipeprog_bringup.footage.guessed_camera import GUESS_SIGMA, guessed_camera
from pipeprog_bringup.footage.pictures import Pictures
from pipeprog_bringup.footage.polycam import Polycam
from pipeprog_bringup.footage.record3d import Record3D
from pipeprog_bringup.footage.shot import Excerpt, Footage, Shot
from pipeprog_bringup.footage.stray_scanner import StrayScanner
from pipeprog_bringup.footage.video import Video
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import focal_sigma_key, readout_key
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.recording_check import MIN_FRAMES
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_camera.errors import InputError

FRAME_ID = "camera_optical_frame"
GUESS_NOTE = (
    f"{{}}: the focal length is what the file says, a guess to {GUESS_SIGMA:.0%}: the survey calibrates itself, for "
    "which a board must be seen from several sides; a calibration is better (docs/calibration.md)"
)
IMAGE_TOPIC, INFO_TOPIC = "/camera/image/compressed", "/camera/camera_info"


@dataclass(frozen=True)
class Request:
    """What to ingest: a video or pictures with their camera, or an app's scan; JPEG `quality` of decoded ones."""

    source: Path
    camera: Path | None
    out: Path
    excerpt: Excerpt
    quality: int = 95
    force: bool = False


@dataclass(frozen=True)
class Ingested:
    """The result of `ingest`: frames written, seconds they span, and notes for the user."""

    frames: int
    seconds: float
    notes: list[str]


def ingest(request: Request, report: Callable[[float, str], None]) -> Ingested:
    """Write the pictures as JPEG, each with its calibration, into the recording `request.out`.

    Stamps are the source's own times, so a variable frame rate is kept. Raises InputError where source and calibration
    cannot be read or do not belong together.
    """
    calibration = read_camera_file(request.camera) if request.camera else None
    if request.out.suffix != ".mcap":
        raise InputError(f"--out {request.out}: a recording is an .mcap file")
    footage = _app(request.source)
    is_guess = footage is None and calibration is None
    if footage is None:
        camera = calibration.camera if calibration else guessed_camera(request.source)
        if request.source.is_dir():
            footage = Pictures(request.source, camera)
            if footage.expected < MIN_FRAMES:
                raise InputError(
                    f"{request.source} holds JPEG pictures, but {footage.expected} only, and a survey needs "
                    f"{MIN_FRAMES} at the very least: is it the folder of the walk?"
                )
        else:
            footage = Video(request.source, camera, request.camera or request.source)
    stamps: list[int] = []
    encoded = 0
    with output_file(request.out, request.force) as temporary, temporary.open("wb") as stream, BagWriter(stream) as bag:
        if is_guess:
            bag.describe({focal_sigma_key(IMAGE_TOPIC): repr(GUESS_SIGMA)})
        if calibration and calibration.readout is not None:
            bag.describe({readout_key(IMAGE_TOPIC): repr(calibration.readout)})
        for shot in footage.shots(request.excerpt):
            encoded += not isinstance(shot.picture, bytes)
            _write(bag, shot, request.quality)
            stamps.append(shot.stamp)
            report(len(stamps) / footage.expected if footage.expected > 0 else 0.0, f"{len(stamps)} frames")
        if not stamps:
            raise InputError(f"{request.source} has no frame between --start and --end: give times within it")
    kept = len(stamps) - encoded
    notes = [GUESS_NOTE.format(request.source)] if is_guess else []
    notes += [f"{kept} frames were JPEG already and are kept as they were"] if kept else []
    return Ingested(len(stamps), 1e-9 * (stamps[-1] - stamps[0]), [*footage.notes, *notes])


def _app(source: Path) -> Footage | None:
    """What an app has recorded, by its form; None for a video or pictures, InputError for any other folder."""
    if (source / "odometry.csv").is_file():
        return StrayScanner(source)
    if (source / "keyframes").is_dir():
        return Polycam(source)
    if source.suffix == ".r3d" and source.is_file():
        return Record3D(source)
    if source.exists() and not source.is_file() and not (source.is_dir() and _has_pictures(source)):
        raise InputError(
            f"{source} is a folder, a device or a pipe, and no scan of Stray Scanner or Polycam (raw data): "
            "give such a folder, one of JPEG pictures, or a video file"
        )
    return None


def _has_pictures(folder: Path) -> bool:
    return any(file.suffix.lower() in (".jpg", ".jpeg") for file in folder.iterdir())


def _write(bag: BagWriter, shot: Shot, quality: int) -> None:
    """One picture, its calibration, and what was measured beside it."""
    picture, stamp = shot.picture, shot.stamp
    if not isinstance(picture, bytes):
        picture = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    if shot.world_from_camera is not None:
        odometry = cdr.write_odometry(stamp, "odom", FRAME_ID, shot.world_from_camera)
        bag.write("/odometry", cdr.ODOMETRY, odometry, stamp)
    bag.write(INFO_TOPIC, cdr.CAMERA_INFO, cdr.write_camera_info(stamp, FRAME_ID, shot.camera), stamp)
    image = cdr.write_compressed_image(stamp, FRAME_ID, "jpeg", picture)
    bag.write(IMAGE_TOPIC, cdr.COMPRESSED_IMAGE, image, stamp)
    if shot.depth is not None:
        _write_depth(bag, shot, shot.depth)


def _write_depth(bag: BagWriter, shot: Shot, depth: NDArray[np.uint16]) -> None:
    """Depth [mm] with the camera at its size, and confidence, of 16 bits too: readers take 8 bits for pictures."""
    camera = shot.camera.scaled(depth.shape[1] / shot.camera.width)
    if (camera.height, camera.width) != depth.shape:
        return
    info = cdr.write_camera_info(shot.stamp, FRAME_ID, camera)
    bag.write("/camera/depth/camera_info", cdr.CAMERA_INFO, info, shot.stamp)
    for topic, values in (("/camera/depth/image", depth), ("/camera/depth/confidence", shot.confidence)):
        if values is not None:
            image = cdr.write_image(shot.stamp, FRAME_ID, "16UC1", values.astype(np.uint16))
            bag.write(topic, cdr.IMAGE, image, shot.stamp)
