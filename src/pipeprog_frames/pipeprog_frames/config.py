"""Settings of the frame selector."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class FramesConfig:
    """Which frames become keyframes."""

    policy: str = field(
        default="stream",
        metadata={
            "description": "stream chooses as the frames come, and corrects itself by the SfM's answers; network is "
            "Algorithm 1 of the paper to the letter, over a whole recording (replay only)",
            "unit": "",
            "choices": ("stream", "network"),
        },
    )
    overlap_min: float = field(
        default=0.85,
        metadata={
            "description": "least overlap with the last keyframe (the paper's Ov_min)",
            "unit": "",
            "range": (0.3, 0.99),
        },
    )
    overlap_band: float = field(
        default=0.025,
        metadata={
            "description": "keyframes in a row whose overlap exceeds the least one by more than this are thinned out "
            "(the paper's Ov_max - Ov_min)",
            "unit": "",
            "range": (0.001, 0.7),
        },
    )
    parallax_max: float = field(
        default=0.04,
        metadata={
            "description": "a keyframe is due when the median parallax exceeds this share of the image width",
            "unit": "",
            "range": (0.005, 0.5),
        },
    )
    window: int = field(
        default=5,
        metadata={
            "description": "the sharpest of this many frames is taken; below the frames that replay keeps in flight",
            "unit": "frames",
            "range": (1, 6),
        },
    )
    buffer_mib: int = field(
        default=192,
        metadata={
            "description": "memory for compressed frames that the feedback of the SfM may still call for; "
            "a replay keeps them all, in a temporary file",
            "unit": "MiB",
            "range": (8, 4096),
        },
    )
    lockstep: bool = field(
        default=False,
        metadata={
            "description": "wait for the SfM after each keyframe, so that a recording gives the same result every time",
            "unit": "",
        },
    )
    image_transport: str = field(
        default="any",
        metadata={
            "description": "the image topics to subscribe: image, image/compressed, or any of the two; "
            "a camera that publishes both needs a choice, or each image comes twice",
            "unit": "",
            "choices": ("any", "raw", "compressed"),
        },
    )
