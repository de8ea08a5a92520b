# SPDX-License-Identifier: Apache-2.0
"""Colours of planned classes: names that a bill may use, and those that classes get without one."""

from __future__ import annotations

import re
from collections.abc import Sequence

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import name_of, nearest, shown

Color = tuple[float, float, float]

# Names without matplotlib's values, and at once; its other names of CSS are taken, too.
NAMED_COLORS: dict[str, Color] = {
    "black": (0.0, 0.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "brown": (0.65, 0.16, 0.16),
    "cyan": (0.0, 1.0, 1.0),
    "gray": (0.5, 0.5, 0.5),
    "green": (0.0, 0.5, 0.0),
    "grey": (0.5, 0.5, 0.5),
    "lime": (0.0, 1.0, 0.0),
    "magenta": (1.0, 0.0, 1.0),
    "maroon": (0.5, 0.0, 0.0),
    "navy": (0.0, 0.0, 0.5),
    "olive": (0.5, 0.5, 0.0),
    "orange": (1.0, 0.65, 0.0),
    "pink": (1.0, 0.75, 0.8),
    "purple": (0.5, 0.0, 0.5),
    "red": (1.0, 0.0, 0.0),
    "silver": (0.75, 0.75, 0.75),
    "teal": (0.0, 0.5, 0.5),
    "white": (1.0, 1.0, 1.0),
    "yellow": (1.0, 1.0, 0.0),
}
# Colours by outer radius [m] of the paper's Figure 11, then others told apart from them.
_FIGURE_11 = {0.0086: "magenta", 0.0365: "blue", 0.0575: "cyan", 0.0841: "green", 0.1095: "red", 0.1223: "yellow"}
_OTHERS = ("orange", "purple", "lime", "brown", "teal", "pink", "navy", "olive", "maroon", "silver")


def distinct_colors(radii: Sequence[float], given: Sequence[Color | None]) -> list[Color]:
    """Colours of classes by their outer radii [m], those that are given first.

    The others are the paper's by radius, else ones that can be told apart.
    """
    colors: list[Color | None] = []
    for radius, color in zip(radii, given, strict=True):
        known = [name for nominal, name in _FIGURE_11.items() if abs(nominal - radius) < 2e-4]
        colors.append(color or (NAMED_COLORS[known[0]] if known else None))
    spare = [NAMED_COLORS[name] for name in _OTHERS if NAMED_COLORS[name] not in colors]
    missing = 0
    done = []
    for color in colors:
        if color is None:
            color = spare[missing % len(spare)]
            missing += 1
        done.append(color)
    return done


def read_color(where: str, value: object) -> Color:
    """RGB in 0..1 of a name of CSS or `#rrggbb`; raises InputError, which begins with `where`, for another value."""
    text = name_of(value, f"{where}: color").lower()
    if text in NAMED_COLORS:
        return NAMED_COLORS[text]
    if re.fullmatch(r"#[0-9a-f]{6}", text):
        return (int(text[1:3], 16) / 255, int(text[3:5], 16) / 255, int(text[5:7], 16) / 255)
    from matplotlib.colors import CSS4_COLORS, to_rgb  # a quarter of a second that only other names need

    if text in CSS4_COLORS:
        red, green, blue = to_rgb(text)
        return (red, green, blue)
    near = nearest(text, [*NAMED_COLORS, *CSS4_COLORS])
    raise InputError(f"{where}: unknown color {shown(text)}: did you mean '{near}'? #rrggbb is fine too")
