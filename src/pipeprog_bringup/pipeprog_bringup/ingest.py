# SPDX-License-Identifier: Apache-2.0
"""`pipeprog ingest`: what a phone has filmed becomes a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from pipeprog_bringup.footage.camera_file import read_camera_file
from pipeprog_bringup.footage.shot import Excerpt, Shot
from pipeprog_bringup.footage.video import Video
from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag import readout_key
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_camera.errors import InputError

FRAME_ID = "camera_optical_frame"
IMAGE_TOPIC, INFO_TOPIC = "/camera/image/compressed", "/camera/camera_info"


@dataclass(frozen=True)
class Request:
    """What to ingest: a video with its calibration; JPEG `quality` of pictures that are decoded."""

    source: Path
    camera: Path
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
    calibration = read_camera_file(request.camera)
    if request.out.suffix != ".mcap":
        raise InputError(f"--out {request.out}: a recording is an .mcap file")
    footage = Video(request.source, calibration.camera, request.camera)
    stamps: list[int] = []
    encoded = 0
    with output_file(request.out, request.force) as temporary, temporary.open("wb") as stream, BagWriter(stream) as bag:
        if calibration.readout is not None:
            bag.describe({readout_key(IMAGE_TOPIC): repr(calibration.readout)})
        for shot in footage.shots(request.excerpt):
            encoded += not isinstance(shot.picture, bytes)
            _write(bag, shot, request.quality)
            stamps.append(shot.stamp)
            report(len(stamps) / footage.expected if footage.expected > 0 else 0.0, f"{len(stamps)} frames")
        if not stamps:
            raise InputError(f"{request.source} has no frame between --start and --end: give times within it")
    kept = len(stamps) - encoded
    notes = [f"{kept} frames were JPEG already and are kept as they were"] if kept else []
    return Ingested(len(stamps), 1e-9 * (stamps[-1] - stamps[0]), [*footage.notes, *notes])


def _write(bag: BagWriter, shot: Shot, quality: int) -> None:
    """One picture and its calibration."""
    picture = shot.picture
    if not isinstance(picture, bytes):
        picture = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    bag.write(INFO_TOPIC, cdr.CAMERA_INFO, cdr.write_camera_info(shot.stamp, FRAME_ID, shot.camera), shot.stamp)
    image = cdr.write_compressed_image(shot.stamp, FRAME_ID, "jpeg", picture)
    bag.write(IMAGE_TOPIC, cdr.COMPRESSED_IMAGE, image, shot.stamp)
