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
class BoardConfig:
    """Targets and scale."""

    eccentricity: bool = field(
        default=True,
        metadata={"description": "correct circle centres for the eccentricity of their images", "unit": ""},
    )


@dataclass(frozen=True)
class StereoConfig:
    """Depth maps."""

    max_pairs: int = field(
        default=2,
        metadata={"description": "neighbours that each keyframe is matched with", "unit": "", "range": (1, 8)},
    )


@dataclass(frozen=True)
class FusionConfig:
    """The dense cloud."""

    voxel: float = field(
        default=0.004,
        metadata={"description": "edge of a voxel, at most one point each", "unit": "m", "range": (0.0005, 0.1)},
    )


@dataclass(frozen=True)
class SfmConfig:
    """All settings of the reconstruction."""

    seed: int = field(default=0, metadata={"description": "seed of every random choice", "unit": "", "range": (0, 2**31 - 1)})
    mapper: MapperConfig = field(default_factory=MapperConfig)
    board: BoardConfig = field(default_factory=BoardConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
