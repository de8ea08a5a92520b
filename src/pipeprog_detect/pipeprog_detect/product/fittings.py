# SPDX-License-Identifier: Apache-2.0
"""The catalogue of fittings: which distances between the ends of pipes an elbow, tee, reducer or coupling can span.

Reducers and tees are as ASME B16.9 has them, whose sizes those of EN 10253 follow; couplings and elbows span what is
sold for steel, copper and plastic together.
"""

from __future__ import annotations

import numpy as np

from pipeprog_detect.types import Pipe

# m; ends are measured to about 5 mm, and a seam, a socket's rim or a clamp before the fitting takes up to 15 mm more.
END = 0.02
# Axes that a fitting joins meet within a fifth of the radius, as sockets have play, and 5 mm by which their measurement
# may be off; over the gap of a coupling also 3 % of its length, as directions of short pipes are off by up to 1.7 deg.
_MISS, _LEAST_MISS = 0.2, 5e-3
MISS_SLOPE = 0.03
# A turn [rad] below 8 deg is a coupling's, not an elbow's; no fitting turns by more than 135 deg.
STRAIGHT, SHARPEST = np.radians(8.0), np.radians(135.0)
# Tees leave at 90, 60 or 45 deg; axes of short branches are off by up to 5 deg.
_BRANCHING, _BRANCHING_ERROR = np.radians((45.0, 60.0, 90.0)), np.radians(5.0)
# Outer diameters vary by 1 % and at least 0.5 mm (EN 10217, EN 1057): radii by half of it, those of two pipes by both.
_OUT_OF_ROUND, _LEAST_OUT_OF_ROUND = 0.01, 5e-4
_SIGMAS = 3.0
# Centre lines of bends turn about 0.85 diameters (elbows of short radius) to 5 (pulled bends); sockets add a diameter.
_TIGHTEST, _WIDEST, _SOCKET = 0.85, 5.0, 1.0
# A barrel's surface goes on smoothly into a bend: such an end was measured up to 2.1 radii too long in generated labs,
# which is up to where the axes meet, and a quarter of a diameter is room for the error of that. The two ends differ by
# two diameters at most: a socket of a diameter at one of them, and a diameter into the bend at the other.
_INTO_BEND, _UNEQUAL = 0.25, 2.0
# Couplings: grooved ones 45 mm at all sizes, sleeves of two sockets 0.6 diameters more.
_COUPLING, _COUPLING_SLOPE = 0.05, 0.6
# Reducers go down to 0.4 of the diameter; their cones open by 30 deg to the axis at most.
_SMALLEST_END, _STEEPEST = 0.4, np.tan(np.radians(30.0))
# ASME B16.9 [mm]: outer diameter, length of a reducer by its large end, centre to end of a tee by its run.
_SIZES, _REDUCERS, _TEES = (
    1e-3
    * np.array(
        [
            (21.3, 38, 25),
            (26.7, 38, 29),
            (33.4, 51, 38),
            (42.2, 51, 48),
            (48.3, 64, 57),
            (60.3, 76, 64),
            (73.0, 89, 76),
            (88.9, 89, 86),
            (114.3, 102, 105),
            (141.3, 127, 124),
            (168.3, 140, 143),
            (219.1, 152, 178),
            (273.0, 178, 216),
            (323.9, 203, 254),
            (355.6, 330, 279),
            (406.4, 356, 305),
            (457.0, 381, 343),
            (508.0, 508, 381),
            (610.0, 508, 432),
        ]
    ).T
)


def are_of_one_size(first: Pipe, second: Pipe) -> bool:
    """Whether the radii agree within their sigmas and what is allowed in manufacture."""
    radii = np.array([first.cylinder.radius, second.cylinder.radius])
    sigma = float(np.hypot(first.radius_sigma, second.radius_sigma))
    made = np.maximum(_OUT_OF_ROUND * radii, _LEAST_OUT_OF_ROUND).sum()
    return bool(abs(radii[0] - radii[1]) <= made + _SIGMAS * sigma)


def miss_allowed(radius: float) -> float:
    """How far two axes that a fitting joins may pass each other [m]; `radius` is that of the thinner pipe."""
    return _MISS * radius + _LEAST_MISS


def is_elbow(s: float, t: float, turn: float, radius: float) -> bool:
    """Whether an elbow turns by `turn` [rad] between ends at the distances s and t [m] from where their axes meet.

    Its legs are equal, but a barrel that is measured on into the bend ends nearer to that point.
    """
    diameter, tangent = 2.0 * radius, float(np.tan(0.5 * turn))
    shortest, longest = _TIGHTEST * diameter * tangent - END, (_WIDEST * tangent + _SOCKET) * diameter + END
    return (
        shortest <= max(s, t) <= longest and min(s, t) >= -_INTO_BEND * diameter and abs(s - t) <= _UNEQUAL * diameter
    )


def is_coupling(gap: float, radius: float) -> bool:
    """Whether a coupling joins ends of pipes of one radius with this gap along the axis [m]."""
    return -END <= gap <= _COUPLING + _COUPLING_SLOPE * 2.0 * radius + END


def is_reducer(gap: float, thick: float, thin: float) -> bool:
    """Whether a reducer joins ends of pipes of these radii with this gap along the axis [m]."""
    longest = float(np.interp(2.0 * thick, _SIZES, _REDUCERS))
    return thin >= _SMALLEST_END * thick and (thick - thin) / _STEEPEST - END <= gap <= longest + END


def is_tee(reach: float, turn: float, radius: float) -> bool:
    """Whether a tee joins a branch, whose end is `reach` [m] from the axis of a run of this radius, at this angle."""
    if not (np.abs(turn - _BRANCHING) <= _BRANCHING_ERROR).any():
        return False
    sine = float(np.sin(turn))
    return radius - END <= reach * sine and reach <= float(np.interp(2.0 * radius, _SIZES, _TEES)) / sine + END
