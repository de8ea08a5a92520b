"""Settings of the reconstruction, one dataclass per stage; SfmConfig holds them all."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class MapperConfig:
    """Features, matching and the streaming reconstruction."""

    max_features: int = field(
        default=4000,
        metadata={"description": "features extracted from one keyframe", "unit": "", "range": (200, 20000)},
    )


@dataclass(frozen=True)
class DeblurConfig:
    """Motion blur, undone for the features of keyframes."""

    exposure: float = field(
        default=0.0,
        metadata={
            "description": "exposure time of an image; 0: not known, so that no motion blur is undone",
            "unit": "s",
            "range": (0.0, 1.0),
        },
    )
    min_length: float = field(
        default=2.0,
        metadata={
            "description": "motion during the exposure from which on it is undone, as the median over the image",
            "unit": "px",
            "range": (0.5, 100.0),
        },
    )


@dataclass(frozen=True)
class BoardConfig:
    """Targets and scale."""

    eccentricity: bool = field(
        default=True,
        metadata={"description": "correct circle centres for the eccentricity of their images", "unit": ""},
    )
    min_radius: float = field(
        default=4.0,
        metadata={"description": "smallest image of a circle that is looked for", "unit": "px", "range": (3.0, 100.0)},
    )
    tolerance: float = field(
        default=0.00005,
        metadata={
            "description": "standard deviation of a circle's place on the real board against its file",
            "unit": "m",
            "range": (0.0, 0.01),
        },
    )
    upright: bool = field(
        default=True,
        metadata={"description": "the board that is seen first hangs plumb: its y axis tells what is up", "unit": ""},
    )


@dataclass(frozen=True)
class OdometryConfig:
    """Scale by what a robot knows of its motion and of its body."""

    scale_sigma: float = field(
        default=0.01,
        metadata={
            "description": "relative standard deviation of the lengths that odometry tells, as it is calibrated",
            "unit": "",
            "range": (0.0, 0.2),
        },
    )
    baseline_sigma: float = field(
        default=0.0005,
        metadata={
            "description": "standard deviation of the distance between two cameras on one body, as /tf_static tells it",
            "unit": "m",
            "range": (0.0, 0.1),
        },
    )


@dataclass(frozen=True)
class StereoConfig:
    """Depth maps."""

    max_pairs: int = field(
        default=4,
        metadata={"description": "neighbours that each keyframe is matched with", "unit": "", "range": (1, 8)},
    )
    width: int = field(
        default=1280,
        metadata={
            "description": "width at which images are matched, at most their own",
            "unit": "px",
            "range": (160, 4096),
        },
    )


@dataclass(frozen=True)
class FusionConfig:
    """The dense cloud."""

    voxel: float = field(
        default=0.004,
        metadata={"description": "edge of a voxel, at most one point each", "unit": "m", "range": (0.0005, 0.1)},
    )
    min_views: int = field(
        default=3,
        metadata={"description": "depth maps that must agree on a point", "unit": "", "range": (1, 20)},
    )
    max_neighbours: int = field(
        default=8,
        metadata={"description": "depth maps that each new one is compared with", "unit": "", "range": (1, 64)},
    )
    max_maps: int = field(
        default=400,
        metadata={"description": "latest depth maps kept in memory for comparison", "unit": "", "range": (2, 100000)},
    )


@dataclass(frozen=True)
class SfmConfig:
    """All settings of the reconstruction."""

    seed: int = field(
        default=0, metadata={"description": "seed of every random choice", "unit": "", "range": (0, 2**31 - 1)}
    )
    map_interval: int = field(
        default=5,
        metadata={"description": "keyframes between two publications of the map", "unit": "", "range": (1, 1000)},
    )
    mapper: MapperConfig = field(default_factory=MapperConfig)
    deblur: DeblurConfig = field(default_factory=DeblurConfig)
    board: BoardConfig = field(default_factory=BoardConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
