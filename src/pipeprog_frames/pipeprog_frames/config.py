"""Settings of the frame selector."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class FramesConfig:
    """Which frames become keyframes."""

    overlap_min: float = field(
        default=0.85,
        metadata={
            "description": "least overlap with the last keyframe (the paper's Ov_min)",
            "unit": "",
            "range": (0.3, 0.99),
        },
    )
