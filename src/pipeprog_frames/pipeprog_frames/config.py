# SPDX-License-Identifier: Apache-2.0
"""Settings of the frame selector."""

from __future__ import annotations

from dataclasses import dataclass

from pipeprog_camera.setting_field import cores_setting, setting


@dataclass(frozen=True)
class FramesConfig:
    """Which frames become keyframes."""

    policy: str = setting(
        "stream",
        "stream: frames are chosen as they arrive and the choice is corrected by the SfM's overlap reports; "
        "network: Algorithm 1 of the paper, over a whole recording (replay only)",
        choices=("stream", "network"),
    )
    overlap_min: float = setting(
        0.85, "minimum overlap with the previous keyframe (the paper's Ov_min)", "", (0.3, 0.99)
    )
    overlap_band: float = setting(
        0.025,
        "width of the overlap band (the paper's Ov_max - Ov_min); consecutive keyframes above it are thinned out",
        "",
        (0.001, 0.7),
    )
    parallax_max: float = setting(
        0.04, "maximum median parallax between keyframes, as a fraction of the image width", "", (0.005, 0.5)
    )
    window: int = setting(
        5, "number of frames of which the sharpest is chosen; fewer than replay keeps in flight (10)", "frames", (1, 6)
    )
    buffer_mib: int = setting(
        192,
        "memory for compressed frames that the overlap reports may still ask for; a replay keeps all frames, in a "
        "temporary file",
        "MiB",
        (8, 4096),
    )
    max_keyframes: int = setting(
        0,
        "keyframes that a map may hold at once, each of which takes memory; from half of them on fewer are chosen, and "
        "none once the map holds as many; 0: any number (policy stream alone)",
        "keyframes",
        (0, 1_000_000),
    )
    lockstep: bool = setting(
        False, "wait for the SfM after each keyframe: the same recording then gives the same result every time"
    )
    image_transport: str = setting(
        "any",
        "image topics to subscribe to: raw (image), compressed (image/compressed) or any (both); choose one where a "
        "camera publishes both, or each image arrives twice",
        choices=("any", "raw", "compressed"),
    )
    cores: int = cores_setting()
