# SPDX-License-Identifier: Apache-2.0
"""A scale source of one's own: a total station has tracked the prism on the camera, and its track gives the metres.

    python examples/own_scale_source.py

A source is a function of the evidence that returns measurements and warnings. For a whole survey hand
`sources=(*SOURCES, source)` to `pipeprog.Reconstruction`; here the camera's poses are simulated, in units of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import pipeprog
from pipeprog_sfm.metric.metric_frame import estimate_scale
from pipeprog_sfm.metric.scale import Measurement, ScaleEstimate, ScaleWarning
from pipeprog_sfm.metric.scale_evidence import PosedEvidence, ScaleEvidence
from pipeprog_sfm.metric.scale_sources import SOURCES

TRUE_SCALE = 2.5  # metres per unit of the simulated model
FEW = 5  # camera positions, below which the track is taken for an accident


@dataclass(frozen=True)
class TotalStation:
    """Scale by a tracked prism: positions (3,) [m] by image stamp [ns], each with `sigma` [m] in each axis."""

    positions: Mapping[int, NDArray[np.float64]]
    sigma: float

    def __call__(self, posed: PosedEvidence, /) -> Sequence[Measurement | ScaleWarning]:
        """The ratio of the two tracks' spreads: no rotation between their frames need be known."""
        stamps = [stamp for stamp in posed.poses if stamp in self.positions]
        if len(stamps) < FEW:
            return [ScaleWarning(f"the total station saw the camera in {len(stamps)} images only: track it for longer")]
        track = np.array([self.positions[stamp] for stamp in stamps])
        model = np.array([-posed.poses[stamp][:3, :3].T @ posed.poses[stamp][:3, 3] for stamp in stamps])
        spread_m, spread = (float(np.linalg.norm(places - places.mean(axis=0))) for places in (track, model))
        # Each position enters the spread with its error along the direction from the middle.
        relative = self.sigma / spread_m
        return [Measurement.of_trajectory("total_station", "total station", spread_m / spread, relative, posed.poses)]


def simulated(rng: np.random.Generator) -> tuple[PosedEvidence, TotalStation]:
    """A camera that walks 4 m past a floor and a wall, 30 images, and what the total station saw of it."""
    steps = np.linspace(0.0, 4.0, 30)
    places = np.stack([steps, 0.3 * np.sin(steps), 0.1 * np.cos(2 * steps)], axis=1)  # m, z up
    camera_from_axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y, z of the world is up
    poses = {}
    for number, place in enumerate(places):
        pose = np.eye(4)
        pose[:3, :3] = camera_from_axes
        pose[:3, 3] = -camera_from_axes @ place / TRUE_SCALE
        poses[number] = pose
    floor = np.c_[rng.uniform([-1, 0], [5, 3], (5000, 2)), np.full(5000, -1.5)]
    wall = np.insert(rng.uniform([-1, -1.5], [5, 1.5], (5000, 2)), 1, 3.0, axis=1)
    points = np.concatenate([floor, wall]) / TRUE_SCALE
    camera = pipeprog.Camera(1280, 720, 900.0, 900.0, 639.5, 359.5)
    posed = PosedEvidence(ScaleEvidence(), poses, camera, points=lambda: points)
    tracked = {number: place + rng.normal(0.0, 0.002, 3) for number, place in enumerate(places)}
    return posed, TotalStation(tracked, 0.002)


def main() -> ScaleEstimate:
    """Estimates the scale with the source among pipeprog's own and prints it beside the truth."""
    posed, station = simulated(np.random.default_rng(0))
    estimate = estimate_scale(posed, sources=(*SOURCES, station))
    print(f"{estimate.scale:.4f} m per unit from {estimate.source}, sigma {100 * estimate.sigma:.3f} %")
    print(f"true: {TRUE_SCALE} m per unit; error {100 * (estimate.scale / TRUE_SCALE - 1):+.3f} %")
    return estimate


if __name__ == "__main__":
    main()
