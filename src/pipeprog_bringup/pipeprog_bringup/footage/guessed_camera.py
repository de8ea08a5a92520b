# SPDX-License-Identifier: Apache-2.0
"""A camera from what a video file says of its lens: a guess, which a survey refines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeprog_bringup.footage.quicktime import read_movie
from pipeprog_bringup.footage.video import picture_size
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError

FILM_DIAGONAL = 43.27  # mm, of 35 mm film (36 x 24 mm), to which "35 mm equivalent" relates the field of view
# Relative standard deviation: the length is rounded to a millimetre of 26 (2 %), and video shows a part of the picture.
GUESS_SIGMA = 0.05


def guessed_camera(video: Path) -> Camera:
    """A camera without distortion, of the focal length that the video's metadata tell.

    Raises InputError where they do not tell it, with how to calibrate.
    """
    width, height = picture_size(video)
    length = read_movie(video).focal_length
    if length is None:
        raise InputError(
            f"{video} does not tell its focal length: a video needs the calibration of its camera: give --camera "
            "CAMERA.yaml (calibrate in the video's own mode with `pipeprog calibrate`, see docs/calibration.md)"
        )
    focal = length / FILM_DIAGONAL * float(np.hypot(width, height))
    matrix = [focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1]
    return Camera.from_calibration(width, height, matrix)
