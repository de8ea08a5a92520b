# SPDX-License-Identifier: Apache-2.0
"""Pipes in a NumPy cloud, here a simulated scan of two pipes before a wall: how well do they come back?

python examples/detect_on_a_cloud.py
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import pipeprog

NOISE = 0.001  # m, one standard deviation of a point, as of a good laser scanner
TRUE_RADII = {"DN65": 0.0365, "DN100": 0.0575}  # m


def scan(rng: np.random.Generator) -> NDArray[np.float64]:
    """(N, 3) points [m]: two upright pipes 1.5 m long, of which a scanner sees a half, and the wall behind them."""
    parts = [rng.uniform([-1.0, 0.0, 0.0], [1.0, 0.0, 1.5], (60_000, 3))]
    for x, radius in zip((-0.4, 0.4), TRUE_RADII.values(), strict=True):
        turn, height = rng.uniform(-1.4, 1.4, 20_000), rng.uniform(0.0, 1.5, 20_000)
        parts.append(np.stack([x + radius * np.sin(turn), -0.2 - radius * np.cos(turn), height], axis=1))
    points = np.concatenate(parts)
    return points + rng.normal(0.0, NOISE, points.shape)


def main() -> list[pipeprog.Pipe]:
    """Detects the pipes of the scan and prints them beside the truth."""
    pipes = pipeprog.detect(scan(np.random.default_rng(0)), TRUE_RADII)
    for pipe in pipes:
        error = 1e3 * (pipe.cylinder.radius - TRUE_RADII[pipe.class_name or ""])
        print(
            f"{pipe.class_name}: radius {1e3 * pipe.cylinder.radius:.2f} mm ({error:+.2f} mm, "
            f"sigma {1e3 * pipe.radius_sigma:.2f} mm), length {pipe.cylinder.length:.3f} m"
        )
    return pipes


if __name__ == "__main__":
    main()
