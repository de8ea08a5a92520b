# SPDX-License-Identifier: Apache-2.0
"""A camera from what a video or photograph says of its lens: a guess, which a survey refines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeprog_bringup.footage.pictures import picture_files, read_exif
from pipeprog_bringup.footage.quicktime import read_movie
from pipeprog_bringup.footage.video import picture_size
from pipeprog_camera.camera import Camera
from pipeprog_camera.encoded_image import encoded_size
from pipeprog_camera.errors import InputError
from pipeprog_camera.files.text_file import read_bytes
from pipeprog_camera.limits import MAX_ENCODED_IMAGE

FILM_DIAGONAL = 43.27  # mm, of 35 mm film (36 x 24 mm), to which "35 mm equivalent" relates the field of view
# Relative standard deviation: the length is rounded to a millimetre of 26 (2 %), and video shows a part of the picture.
GUESS_SIGMA = 0.05


def guessed_camera(source: Path) -> Camera:
    """A camera without distortion, of the focal length that a video's or a first photograph's metadata tell.

    Raises InputError where they do not tell it, with how to calibrate.
    """
    if source.is_dir():
        first = read_bytes(picture_files(source)[0], MAX_ENCODED_IMAGE)
        (width, height), length = encoded_size(first), read_exif(first).focal_length
    else:
        (width, height), length = picture_size(source), read_movie(source).focal_length
    if length is None:
        kind = "pictures'" if source.is_dir() else "video's"
        raise InputError(
            f"{source} does not tell its focal length, and needs the calibration of its camera: give --camera "
            f"CAMERA.yaml (calibrate in the {kind} own mode with `pipeprog calibrate`, see docs/calibration.md)"
        )
    focal = length / FILM_DIAGONAL * float(np.hypot(width, height))
    matrix = [focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1]
    return Camera.from_calibration(width, height, matrix)
