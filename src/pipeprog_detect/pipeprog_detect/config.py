# SPDX-License-Identifier: Apache-2.0
"""Settings of the detector, one dataclass per stage; DetectConfig holds them all."""

from __future__ import annotations

from dataclasses import dataclass, field

from pipeprog_camera.setting_field import cores_setting, setting


@dataclass(frozen=True)
class ContourConfig:
    """Refinement by the outlines in the keyframes."""

    enabled: bool = setting(True, "refine radius, axis and ends by the outlines in the keyframes")


@dataclass(frozen=True)
class DetectConfig:
    """All settings of the detector."""

    seed: int = setting(0, "seed of every random choice", "", (0, 2**31 - 1))
    front_end: str = setting(
        "normals",
        "how cylinders are found in the cloud: by its normals, or as sections of planes (the paper)",
        choices=("normals", "planes"),
    )
    plane: str = setting(
        "",
        "front_end=planes: three points `x,y,z x,y,z x,y,z` of the plane that cuts the pipes, several planes parted "
        "by semicolons; without, planes are placed across the pipes",
        "m",
    )
    straighten: bool = setting(
        False, "front_end=planes: sections are taken along the pipe, which thin ones at a slant need"
    )
    concave: bool = setting(False, "pipes are seen from inside, by a camera in a sewer, not from outside")
    radius_min: float = setting(0.005, "thinnest pipe looked for", "m", (0.001, 1.0))
    length_min: float = setting(0.1, "shortest pipe kept", "m", (0.0, 10.0))
    arc_min_deg: float = setting(60.0, "least part of the circumference seen", "deg", (10.0, 360.0))
    classifier: str = setting(
        "posterior",
        "posterior: fixed nominal radii and the measured sigma, none where none fits or two do; kmeans: as in the "
        "paper, every pipe gets a class",
        choices=("posterior", "kmeans"),
    )
    cores: int = cores_setting()
    contour: ContourConfig = field(default_factory=ContourConfig)
