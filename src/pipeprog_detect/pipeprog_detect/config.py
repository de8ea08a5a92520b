"""Settings of the detector, one dataclass per stage; DetectConfig holds them all."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ContourConfig:
    """Refinement by the outlines in the keyframes."""

    enabled: bool = field(
        default=True,
        metadata={"description": "refine radius, axis and ends by the outlines in the keyframes", "unit": ""},
    )


@dataclass(frozen=True)
class DetectConfig:
    """All settings of the detector."""

    seed: int = field(
        default=0, metadata={"description": "seed of every random choice", "unit": "", "range": (0, 2**31 - 1)}
    )
    front_end: str = field(
        default="normals",
        metadata={
            "description": "how cylinders are found in the cloud: by its normals, or as sections of planes (the paper)",
            "unit": "",
            "choices": ("normals", "planes"),
        },
    )
    plane: str = field(
        default="",
        metadata={
            "description": "front_end=planes: three points `x,y,z x,y,z x,y,z` of the plane that cuts the pipes, "
            "several planes parted by semicolons; without, planes are placed across the pipes",
            "unit": "m",
        },
    )
    straighten: bool = field(
        default=False,
        metadata={
            "description": "front_end=planes: sections are taken along the pipe, which thin ones at a slant need",
            "unit": "",
        },
    )
    concave: bool = field(
        default=False,
        metadata={"description": "pipes are seen from inside, by a camera in a sewer, not from outside", "unit": ""},
    )
    radius_min: float = field(
        default=0.005, metadata={"description": "thinnest pipe looked for", "unit": "m", "range": (0.001, 1.0)}
    )
    length_min: float = field(
        default=0.1, metadata={"description": "shortest pipe kept", "unit": "m", "range": (0.0, 10.0)}
    )
    arc_min_deg: float = field(
        default=60.0,
        metadata={"description": "least part of the circumference seen", "unit": "deg", "range": (10.0, 360.0)},
    )
    classifier: str = field(
        default="posterior",
        metadata={
            "description": "posterior: fixed nominal radii and the measured sigma, none where none fits or two do; "
            "kmeans: as in the paper, every pipe gets a class",
            "unit": "",
            "choices": ("posterior", "kmeans"),
        },
    )
    contour: ContourConfig = field(default_factory=ContourConfig)
