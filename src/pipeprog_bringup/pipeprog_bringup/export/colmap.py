# SPDX-License-Identifier: Apache-2.0
"""The sparse model with its images: what COLMAP's dense stereo, Gaussian splatting and nerfstudio begin with."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2

from pipeprog_bringup.export.keyframes import keyframes
from pipeprog_bringup.export.survey import Survey
from pipeprog_camera.errors import InputError

_QUALITY = 95  # of the JPEG, as `pipeprog ingest` writes them
_MODEL = ("cameras", "images", "points3D", "frames", "rigs")


def write_colmap(survey: Survey, folder: Path) -> None:
    """Writes `sparse/0/` and `images/` into a folder, the images without lens distortion as the model's cameras are.

    Coordinates are those of the map. Raises InputError where the results have no sparse model or no keyframes.
    """
    source = survey.results.folder / "colmap"
    if not (source / "images.bin").is_file():
        raise InputError(f"{survey.results.folder} has no sparse model (colmap/): export a replay's results")
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "images").mkdir()
    for name in _MODEL:
        shutil.copyfile(source / f"{name}.bin", folder / "sparse" / "0" / f"{name}.bin")
    for keyframe in keyframes(survey.results):
        image = keyframe.camera.undistort_image(keyframe.image)
        encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        (folder / "images" / f"{keyframe.stamp}.jpg").write_bytes(encoded.tobytes())
