# SPDX-License-Identifier: Apache-2.0
"""A cutting plane drawn as a line on a keyframe: the plane through the camera's centre and both rays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_camera.errors import InputError

_DRAWN = re.compile(r"\s*(\d+)\s*:(.*)")
_SHORTEST = 10.0  # px: at this length, one end drawn half a pixel off turns the plane by 3 degrees


def as_points(planes: str, run: Path) -> str:
    """The setting `detect.plane` for planes parted by semicolons, of which some may be lines `KEYFRAME:u1,v1,u2,v2`.

    KEYFRAME counts the lines of `trajectory.tum` in the folder `run` of a finished survey from 1, pixels are those of
    its image. Three points of each drawn plane replace the line: the camera's centre and a metre along each ray.
    Raises InputError where a line cannot be read or lies outside the image, or where the folder holds no survey.
    """
    parts = ((plane, _DRAWN.fullmatch(plane)) for plane in planes.split(";"))
    return ";".join(_points(plane.strip(), int(drawn[1]), drawn[2], run) if drawn else plane for plane, drawn in parts)


def _points(drawn: str, number: int, line: str, run: Path) -> str:
    try:
        pixels = np.array([float(word) for word in line.split(",")]).reshape(2, 2)
    except ValueError:
        raise InputError(f"plane '{drawn}': a line on a keyframe is KEYFRAME:u1,v1,u2,v2") from None
    for name in ("trajectory.tum", "out.mcap"):
        if not (run / name).is_file():
            raise InputError(
                f"plane '{drawn}': a line needs the folder of a finished survey, and {run} has no {name}: "
                "give the cloud in such a folder, or the plane by three points"
            )
    _, poses = read_trajectory(run / "trajectory.tum")
    if not 1 <= number <= len(poses):
        raise InputError(f"plane '{drawn}': there are keyframes 1 to {len(poses)} in {run / 'trajectory.tum'}")
    camera = Bag.open(run / "out.mcap").camera
    inside = (pixels >= -0.5) & (pixels <= np.array([camera.width, camera.height]) - 0.5)
    if not inside.all():
        raise InputError(f"plane '{drawn}': the line leaves the image of {camera.width} x {camera.height} px")
    if np.linalg.norm(pixels[1] - pixels[0]) < _SHORTEST:
        raise InputError(f"plane '{drawn}': the line is shorter than {_SHORTEST:g} px: draw it longer")
    ideal = camera.undistort_points(pixels)
    rays = np.c_[(ideal - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(2)]
    pose = poses[number - 1]
    points = pose[:3, 3] + np.concatenate([np.zeros((1, 3)), rays]) @ pose[:3, :3].T
    return " ".join(",".join(f"{value:.9g}" for value in point) for point in points)
