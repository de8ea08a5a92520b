# SPDX-License-Identifier: Apache-2.0
"""`pipeprog calibrate`: a film of a board becomes the calibration of the camera that made it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.footage.camera_file import camera_file_text
from pipeprog_bringup.footage.guessed_camera import guessed_camera
from pipeprog_bringup.footage.shot import Excerpt
from pipeprog_bringup.footage.video import Video, picture_size
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.recording_check import gray_image
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.calibration.board_calibration import calibrate_film
from pipeprog_sfm.calibration.board_images import RUN
from pipeprog_sfm.calibration.calibration import Calibration

RUNS = 50  # of a film: 250 images know the focal length to 0.02 %
MAX_BYTES = 1 << 30  # of images that are held; 129 of 4K
MIN_GAP = 0.025  # s between images of a run: of a film of 240 images a second, speeds would be noise
USUAL_FOCAL = {"plumb_bob": 0.75, "equidistant": 0.45}  # of the image's longer side: phones, wide fisheye lenses
_READING = 0.1  # share of the work
_RECORDINGS = (".mcap", ".db3", ".bag")


@dataclass(frozen=True)
class Request:
    """What to calibrate with: a video or recording of the first board of a board file; the lens's distortion model."""

    source: Path
    board: Path
    out: Path
    model: str = "plumb_bob"
    force: bool = False


class Runs(Excerpt):
    """Wants `count` runs of RUN pictures, spread over a film of `seconds`; all of them where it is no longer."""

    def __init__(self, seconds: float, count: int) -> None:
        super().__init__()
        self._period = seconds / count
        self._begun, self._taken, self._last = 0.0, 0, -math.inf

    def wants(self, seconds: float) -> bool:
        """Whether the picture at this time is wanted; it then counts as taken."""
        if seconds < self._last + MIN_GAP:
            return False
        if self._taken == RUN and seconds >= self._begun + self._period:
            self._begun, self._taken = seconds, 0
        if self._taken == RUN:
            return False
        self._taken, self._last = self._taken + 1, seconds
        return True


def calibrate(request: Request, report: Callable[[float, str], None]) -> Calibration:
    """Write the calibration of the camera that filmed the board.

    Raises InputError where the film cannot be read or does not tell the camera.
    """
    boards = load_board_file(request.board).boards
    if not boards:
        raise InputError(f"{request.board} has no board: give a file with `boards`, such as boards/a4.yaml")
    with output_file(request.out, request.force) as temporary:
        is_recording = request.source.is_dir() or request.source.suffix in _RECORDINGS
        start, is_guess, film = (_recorded if is_recording else _filmed)(request)
        if not film:
            raise InputError(f"{request.source} has no image that can be read: film the board again")
        try:
            found = calibrate_film(
                film, boards[0], start, is_guess, lambda share, stage: report(_READING + (1 - _READING) * share, stage)
            )
        except InputError as error:
            raise InputError(f"{request.source}: {error}") from None
        comments = [f"calibrated by `pipeprog calibrate` in {found.views} images", *summary(found), *found.advice()]
        temporary.write_text(camera_file_text(found.camera, found.readout, comments), encoding="utf-8")
    return found


def summary(found: Calibration) -> list[str]:
    """Each number with its standard deviation, the residuals by radius, and the coverage, a line each."""
    digits = {"fx": 2, "fy": 2, "cx": 2, "cy": 2, "readout": 3}
    lines = []
    for name, value in found.values.items():
        unit = {"readout": 1e3}.get(name, 1.0)
        number = digits.get(name, 5)
        label = "read-out [ms]" if name == "readout" else f"{name} [px]" if name in digits else name
        lines.append(f"{label}: {unit * value:.{number}f}, sigma {unit * found.sigmas[name]:.{number}f}")
    rings = ", ".join("none seen" if np.isnan(each) else f"{each:.3f}" for each in found.by_radius)
    lines.append(f"residuals [px]: {found.rms:.3f} rms; in rings of equal area from the middle to the corners: {rings}")
    lines.append(f"circles seen in {found.coverage:.0%} of the image")
    return lines


_Film = tuple[Camera, bool, list[tuple[int, NDArray[np.uint8]]]]  # camera to start from, whether it is a guess, images


def _filmed(request: Request) -> _Film:
    """Of a video, as the sensor saw it: rows of a picture that was turned are no rows of the shutter."""
    width, height = picture_size(request.source)
    try:
        start, is_guess = guessed_camera(request.source), False
    except InputError:
        focal = USUAL_FOCAL[request.model] * max(width, height)
        start, is_guess = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2), True
    video = Video(request.source, start, request.source)
    runs = Runs(video.seconds, _runs(start))
    images = ((shot.stamp, _gray(shot.picture)) for shot in video.shots(runs))
    return replace(start, distortion_model=request.model), is_guess, _kept(images)


def _recorded(request: Request) -> _Film:
    """Of a recording, whose calibration is a start at best."""
    bag = Bag.open(request.source)
    told = bag.camera
    start = told if told.distortion_model == request.model else replace(told.pinhole(), distortion_model=request.model)
    stamps = [frame.stamp for frame in bag if not frame.fault]
    runs = Runs(1e-9 * (stamps[-1] - stamps[0]), _runs(start))
    images = (
        (frame.stamp, gray_image(frame, bag.image_type))
        for frame in bag
        if not frame.fault and runs.wants(1e-9 * (frame.stamp - stamps[0]))
    )
    return start, False, _kept(images)


def _runs(camera: Camera) -> int:
    """How many fit into memory, RUNS at most."""
    return max(1, min(RUNS, MAX_BYTES // (RUN * camera.width * camera.height)))


def _kept(images: Iterator[tuple[int, NDArray[np.uint8] | None]]) -> list[tuple[int, NDArray[np.uint8]]]:
    """Those that could be decoded, in the order of their stamps, RUNS runs at most."""
    kept: dict[int, NDArray[np.uint8]] = {}
    for stamp, image in images:
        if image is not None and len(kept) < RUNS * RUN:
            kept[stamp] = image
    return sorted(kept.items())


def _gray(picture: bytes | NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    if isinstance(picture, bytes):
        return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
