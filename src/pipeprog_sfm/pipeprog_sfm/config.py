# SPDX-License-Identifier: Apache-2.0
"""Settings of the reconstruction, one dataclass per stage; SfmConfig holds them all."""

from __future__ import annotations

from dataclasses import dataclass, field

from pipeprog_camera.limits import MAX_READOUT
from pipeprog_camera.rolling_shutter import check_readout
from pipeprog_camera.setting_field import cores_setting, setting

NOT_TOLD = -1.0  # s, a read-out that is not known


@dataclass(frozen=True)
class MapperConfig:
    """Features, matching and the incremental reconstruction."""

    max_features: int = setting(4000, "maximum number of features extracted from one keyframe", "", (200, 20000))


@dataclass(frozen=True)
class DeblurConfig:
    """Motion blur, removed for the features of keyframes."""

    exposure: float = setting(
        0.0, "exposure time of an image; 0: unknown, and motion blur is not removed", "s", (0.0, 1.0)
    )
    min_length: float = setting(
        2.0, "motion blur is removed where its median length over the image exceeds this", "px", (0.5, 100.0)
    )


@dataclass(frozen=True)
class CalibrationConfig:
    """What is known of the camera's calibration, which the survey refines where its images tell better."""

    focal_sigma: float = setting(
        # Calibrations of one camera by a board differ by 0.1 to 0.3 %, mostly with focus and temperature.
        0.003,
        "relative standard deviation of the calibration's focal length; 0: the calibration is taken as it is",
        "",
        (0.0, 0.2),
    )
    distortion_sigma: float = setting(
        # Of k1, as it differs between calibrations whose images leave the corners empty.
        0.005,
        "standard deviation of the calibration's k1; twice this for k2",
        "",
        (1e-6, 1.0),
    )
    readout_sigma: float = setting(
        # Read-outs that users measured of phones of one kind differ by 30 %, mostly with the recording mode.
        0.3,
        "relative standard deviation of a read-out that is told; 0: it is taken as it is",
        "",
        (0.0, 1.0),
    )


@dataclass(frozen=True)
class BoardConfig:
    """Boards, scale bars and the scale."""

    eccentricity: bool = setting(
        True, "correct circle centres for perspective eccentricity (the centre of an ellipse is not the circle's)"
    )
    min_radius: float = setting(4.0, "minimum radius of a circle's image, semi-major axis", "px", (3.0, 100.0))
    tolerance: float = setting(
        0.00005, "standard deviation of a circle's position on the real board against its file", "m", (0.0, 0.01)
    )
    upright: bool = setting(True, "the first board seen hangs plumb: its y axis is the vertical")


@dataclass(frozen=True)
class OdometryConfig:
    """Scale from a robot's odometry and from its camera rig."""

    scale_sigma: float = setting(0.01, "relative standard deviation of odometry's lengths", "", (0.0, 0.2))
    baseline_sigma: float = setting(
        0.0005,
        "standard deviation of the distance between two cameras of a rig, as given by /tf_static",
        "m",
        (0.0, 0.1),
    )


@dataclass(frozen=True)
class StereoConfig:
    """Depth maps."""

    max_pairs: int = setting(4, "neighbouring keyframes that each keyframe is matched with", "", (1, 8))
    width: int = setting(1280, "image width used for matching; smaller images keep their own width", "px", (160, 4096))


@dataclass(frozen=True)
class FusionConfig:
    """The dense cloud."""

    voxel: float = setting(0.004, "edge length of a voxel, which holds at most one point", "m", (0.0005, 0.1))
    min_views: int = setting(3, "number of depth maps that must agree on a point", "", (1, 20))
    max_neighbours: int = setting(8, "number of depth maps that each new one is compared with", "", (1, 64))
    max_maps: int = setting(400, "number of recent depth maps kept in memory for comparison", "", (2, 100000))


@dataclass(frozen=True)
class SfmConfig:
    """All settings of the reconstruction."""

    seed: int = setting(0, "seed of every random number generator", "", (0, 2**31 - 1))
    readout: float = setting(
        NOT_TOLD,
        "rolling shutter: time from the first row of an image to the last; 0: all rows at once; -1: not told, "
        "taken from the images where they tell it",
        "s",
        (NOT_TOLD, MAX_READOUT),
    )
    map_interval: int = setting(5, "number of keyframes between two publications of the map", "", (1, 1000))
    cores: int = cores_setting()
    mapper: MapperConfig = field(default_factory=MapperConfig)
    deblur: DeblurConfig = field(default_factory=DeblurConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    board: BoardConfig = field(default_factory=BoardConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)

    def __post_init__(self) -> None:
        if self.readout != NOT_TOLD:
            check_readout(self.readout)
