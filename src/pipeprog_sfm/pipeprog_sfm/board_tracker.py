"""Boards over a stream of keyframes: look once at each image, estimate whenever the poses move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeprog_frames.camera import Camera
from pipeprog_sfm.board import Board, BoardObservation, identify
from pipeprog_sfm.config import BoardConfig
from pipeprog_sfm.conic import FloatArray
from pipeprog_sfm.ellipse import TargetEllipses, find_ellipses
from pipeprog_sfm.scale import ScaleEstimate, estimate_scale


class BoardTracker:
    """Keeps the ellipses and the identified boards of every keyframe; the images themselves are not kept."""

    def __init__(self, boards: Sequence[Board], camera: Camera, config: BoardConfig) -> None:
        self._boards = tuple(boards)
        self._camera = camera
        self._config = config
        self._ellipses: dict[int, TargetEllipses] = {}
        self._observations: dict[int, list[BoardObservation]] = {}

    def add(self, stamp: int, gray: NDArray[np.uint8], camera: Camera | None = None) -> list[BoardObservation]:
        """Look for boards in the keyframe of `stamp` [ns], a (H, W) uint8 image; returns those identified in it."""
        ellipses = find_ellipses(gray, camera or self._camera, self._config)
        found = identify(ellipses, self._boards, camera or self._camera)
        if len(ellipses):
            self._ellipses[stamp] = ellipses
        if found:
            self._observations[stamp] = found
        return found

    def estimate(self, poses: Mapping[int, FloatArray]) -> ScaleEstimate:
        """Scale and map frame for (4, 4) poses camera_from_model by stamp; raises ScaleUnknown with the reason."""
        return estimate_scale(self._observations, poses, self._camera, self._boards, self._config, self._ellipses)
