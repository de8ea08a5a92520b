# SPDX-License-Identifier: Apache-2.0
"""Sizes that can only be metres, inches or diameters where millimetres or radii belong: the user is asked."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown
from pipeprog_detect.product.standard_sizes import SIZES

# Thinner than the capillary tubes of cooled ceilings (3.4 mm across), the thinnest pipes that are laid on sites.
_THINNEST_MM = 3.0
# Of a diameter: manufacturing tolerance (EN 10220: 1 %, at least 0.5 mm) and rounding to a tenth of a millimetre.
_RELATIVE, _LEAST_MM = 0.01, 0.15
_NOMINAL = re.compile(r"\bDN ?(\d+)\b", re.IGNORECASE)
_STANDARD_MM = sorted({1e3 * size.outer_diameter for size in SIZES.values()})


@dataclass(frozen=True)
class WrittenSize:
    """The size of a class as its entry gives it: place, name, key and number."""

    where: str
    name: str
    key: str
    number: float

    @property
    def diameter_mm(self) -> float:
        """The outer diameter that the number means, taken by its key [mm]."""
        return self.number if self.key == "outer_diameter_mm" else 2.0 * self.number


_READINGS: tuple[tuple[str, Callable[[WrittenSize], float]], ...] = (
    ("metres", lambda size: 1e3 * size.diameter_mm),
    ("inches", lambda size: 25.4 * size.diameter_mm),
    ("diameters", lambda size: 0.5 * size.diameter_mm),
    ("diameters in inches", lambda size: 12.7 * size.diameter_mm),
)


def ask_about_units(sizes: Sequence[WrittenSize]) -> None:
    """Raises InputError with a question where no size is one as it is written.

    That is where a pipe is thinner than any, where no size is a standard one and all are, taken for something else, or
    where a radius is the diameter that the class's own name has.
    """
    twice = next((size for size in sizes if _is_diameter_of_its_name(size)), None)
    if twice is not None:
        raise InputError(_question(twice, "diameters", twice.number))
    thin = [size for size in sizes if size.diameter_mm < _THINNEST_MM]
    if not sizes or (not thin and any(_is_standard(size.diameter_mm) for size in sizes)):
        return
    readings = [
        (name, millimetres)
        for name, millimetres in _READINGS
        if not (name.startswith("diameters") and any(size.key == "outer_diameter_mm" for size in sizes))
    ]
    asked = thin or list(sizes)
    fitting = [reading for reading in readings if all(_is_standard(reading[1](size)) for size in asked)]
    if thin and not fitting:  # metres, if these are the metres of a pipe
        fitting = [reading for reading in readings[:1] if all(reading[1](size) >= _THINNEST_MM for size in thin)]
    if fitting:
        name, millimetres = fitting[0]
        raise InputError(_question(asked[0], name, millimetres(asked[0])))


def _question(size: WrittenSize, reading: str, diameter_mm: float) -> str:
    key = "outer_diameter_mm" if reading.startswith("diameters") else size.key
    number = diameter_mm if key == "outer_diameter_mm" else 0.5 * diameter_mm
    unless = f", or outer_diameter_mm: {size.diameter_mm:g} if it is a radius" if key != size.key else ""
    return (
        f"{size.where}: class {shown(size.name)}: {size.key} is {size.number:g}: are these {reading}? "
        f"Then write {key}: {number:g}{unless}"
    )


def _is_diameter_of_its_name(size: WrittenSize) -> bool:
    """Whether a radius, such as 114.3 of `DN100`, is the outer diameter of the nominal size in the name."""
    found = _NOMINAL.search(size.name)
    if size.key != "outer_radius_mm" or found is None:
        return False
    named = [SIZES[name] for kind in ("steel", "PVC") if (name := f"DN{found[1]} {kind}") in SIZES]
    return any(abs(size.number - 1e3 * one.outer_diameter) <= _LEAST_MM for one in named)


def _is_standard(diameter_mm: float) -> bool:
    return any(abs(diameter_mm - one) <= max(_RELATIVE * one, _LEAST_MM) for one in _STANDARD_MM)
