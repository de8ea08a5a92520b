# SPDX-License-Identifier: Apache-2.0
"""Sizes and lengths that can only be in another unit, or diameters where radii belong: the user is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import shown
from pipeprog_detect.product.standard_sizes import SIZES, named_diameters, named_dn

# Thinner than the capillary tubes of cooled ceilings (3.4 mm across), the thinnest pipes that are laid on sites.
_THINNEST_MM = 3.0
# Of a diameter: manufacturing tolerance (EN 10220: 1 %, at least 0.5 mm) and rounding to a tenth of a millimetre.
_RELATIVE, _LEAST_MM = 0.01, 0.15
# Tubes that SIZES has no name for: refrigerant lines (ASTM B280), plastic and multilayer (EN ISO 15875, 21003).
_TUBES_MM = (6.35, 9.52, 12.7, 15.88, 19.05, 22.22, 28.58, 34.92, 41.28, 20.0, 26.0)
_STANDARD_MM = sorted({*(1e3 * size.outer_diameter for size in SIZES.values()), *_TUBES_MM})
# Without a name that tells, thicker pipes are not taken for ones in centimetres: a DN300 is 32.4 cm across, and the
# thinnest insulated pipe (12 mm of copper in 9 mm of foam), whose size is in no standard, 30 mm.
_THICKEST_IN_CM = 33.0
# Pipes of buildings are thicker than their DN; from DN150 on, a plan of sewers may give the bore, which the DN is.
_THICKEST_DN = 125
_LONGEST_LINE_M = 1000.0  # a survey films a part of a site; 1 m in millimetres is as much
_UNITS_MM = {"millimetres": 1.0, "metres": 1000.0, "centimetres": 10.0, "inches": 25.4}
_RADIUS, _DIAMETER = "outer_radius_mm", "outer_diameter_mm"


@dataclass(frozen=True)
class _Reading:
    """What the numbers of a bill may mean: a unit, and whether they are diameters for radii, or radii for diameters."""

    unit: str
    is_swapped: bool = False


# All but the one as written; the first one that fits is asked about.
_READINGS = (
    *(_Reading(unit) for unit in _UNITS_MM if unit != "millimetres"),
    *(_Reading(unit, is_swapped=True) for unit in _UNITS_MM),
)


@dataclass(frozen=True)
class WrittenSize:
    """The size of a class as its entry gives it: place, name, key and number; whether insulation is around the pipe."""

    where: str
    name: str
    key: str
    number: float
    is_insulated: bool = False

    @property
    def diameter_mm(self) -> float:
        """The outer diameter that the number means, taken by its key [mm]."""
        return self.read_as(_Reading("millimetres"))

    def key_of(self, reading: _Reading) -> str:
        """The key that belongs to the number, read so."""
        return self.key if not reading.is_swapped else _RADIUS if self.key == _DIAMETER else _DIAMETER

    def read_as(self, reading: _Reading) -> float:
        """The outer diameter that the number means, read so [mm]."""
        return self.number * _UNITS_MM[reading.unit] * (1.0 if self.key_of(reading) == _DIAMETER else 2.0)


def ask_about_units(sizes: Sequence[WrittenSize]) -> None:
    """Raises InputError with a question where a size is none as it is written.

    That is where the nominal size in a class's own name tells another unit, or a diameter for a radius; where a pipe is
    thinner than any; or where no size is a standard one and all are, taken for something else.
    """
    for size in sizes:
        _ask_by_name(size)
    thin = [size for size in sizes if size.diameter_mm < _THINNEST_MM]
    bare = [size for size in sizes if not size.is_insulated]  # insulation has no standard sizes
    if not thin and any(_is_standard(size.diameter_mm) for size in bare):
        return
    readings = [reading for reading in _READINGS if _may_be(reading, sizes)]
    for asked in filter(None, (bare, thin)):
        fitting = [reading for reading in readings if all(_is_standard(size.read_as(reading)) for size in asked)]
        if fitting:
            raise InputError(_question((thin or asked)[0], fitting[0]))
    metres = _Reading("metres")
    if thin and all(size.read_as(metres) >= _THINNEST_MM for size in thin):  # the metres of a pipe of no standard size
        raise InputError(_question(thin[0], metres))


def ask_about_length(where: str, name: str, metres: float) -> None:
    """Raises InputError with a question where the planned length of a line [m] is more likely given in millimetres."""
    if metres > _LONGEST_LINE_M and metres.is_integer():  # nobody plans fractions of a millimetre
        raise InputError(
            f"{where}: class {shown(name)}: planned_length_m is {metres:g}: are these millimetres? "
            f"Then write planned_length_m: {1e-3 * metres:g}; if they are metres, give each zone a line of its own, "
            f"of {_LONGEST_LINE_M:g} m at most"
        )


def _ask_by_name(size: WrittenSize) -> None:
    """Raises InputError where a size is not that of the nominal size in its class's name, but is, read otherwise."""
    named = [] if size.is_insulated else [1e3 * diameter for diameter in named_diameters(size.name)]
    if any(_is_near(size.diameter_mm, one) for one in named):
        return
    off = {
        reading: min(abs(size.read_as(reading) / one - 1.0) for one in named if _is_meant(size, reading, one))
        for reading in _READINGS
        if any(_is_meant(size, reading, one) for one in named)
    }
    if off:
        raise InputError(_question(size, min(off, key=lambda reading: off[reading])))
    dn = named_dn(size.name)
    if not named or dn is None or dn > _THICKEST_DN:
        return
    # Tubes of copper and plastic may be named by their outer diameter: DN15 of 15 mm.
    is_nominal = dn == size.diameter_mm and not _is_standard(size.diameter_mm)
    if is_nominal or (size.key == _RADIUS and dn == size.number):
        raise InputError(
            f"{size.where}: class {shown(size.name)}: {size.key} is {size.number:g}: is it the nominal size? "
            f"Then write {_DIAMETER}: {named[0]:g}, or the one of its material; if it is measured, take DN{dn} out of "
            "the name"
        )


def _is_meant(size: WrittenSize, reading: _Reading, diameter_mm: float) -> bool:
    """Whether a size, read so, is that of a nominal one.

    A pipe twice as thick as its nominal size may have insulation: it counts where the number is the diameter itself.
    """
    read = size.read_as(reading)
    return abs(read - diameter_mm) <= _LEAST_MM if read < size.diameter_mm else _is_near(read, diameter_mm)


def _may_be(reading: _Reading, sizes: Sequence[WrittenSize]) -> bool:
    """Whether the numbers of a bill whose names tell nothing may mean this."""
    if reading.is_swapped and any(size.key == _DIAMETER for size in sizes):
        return False
    return reading.unit != "centimetres" or all(size.diameter_mm <= _THICKEST_IN_CM for size in sizes)


def _question(size: WrittenSize, reading: _Reading) -> str:
    key, words = size.key_of(reading), reading.unit
    number = size.number * _UNITS_MM[reading.unit]
    unless = ""
    if reading.is_swapped:
        words = "radii" if key == _RADIUS else "diameters"
        words += "" if reading.unit == "millimetres" else f" in {reading.unit}"
        half_or_twice = 0.5 if key == _RADIUS else 2.0
        unless = f", or {key}: {half_or_twice * size.number:g} if it is a {size.key.split('_')[1]}"
    return (
        f"{size.where}: class {shown(size.name)}: {size.key} is {size.number:g}: are these {words}? "
        f"Then write {key}: {number:g}{unless}"
    )


def _is_standard(diameter_mm: float) -> bool:
    return any(_is_near(diameter_mm, one) for one in _STANDARD_MM)


def _is_near(diameter_mm: float, nominal_mm: float) -> bool:
    return abs(diameter_mm - nominal_mm) <= max(_RELATIVE * nominal_mm, _LEAST_MM)
