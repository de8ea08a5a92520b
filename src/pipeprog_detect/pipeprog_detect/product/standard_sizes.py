# SPDX-License-Identifier: Apache-2.0
"""Outer diameters of standard pipe sizes, so that a bill of quantities may say `DN50 steel` in place of a radius.

Steel: EN 10220 series 1 by DN, with which EN 10255 agrees but for DN150 (`DN150 EN 10255 steel`), ASME B36.10 by NPS
(inches). Copper: EN 1057, named by outer diameter.
PVC: EN 1329, EN 1401 and EN ISO 1452, where DN is the outer diameter.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass

_STEEL_DN = {
    "6": 10.2, "8": 13.5, "10": 17.2, "15": 21.3, "20": 26.9, "25": 33.7, "32": 42.4, "40": 48.3, "50": 60.3,
    "65": 76.1, "80": 88.9, "100": 114.3, "125": 139.7, "150": 168.3, "200": 219.1, "250": 273.0, "300": 323.9,
    "350": 355.6, "400": 406.4, "450": 457.0, "500": 508.0, "600": 610.0, "150 EN 10255": 165.1,
}  # fmt: skip
_STEEL_NPS = {
    "1/8": 10.3, "1/4": 13.7, "3/8": 17.1, "1/2": 21.3, "3/4": 26.7, "1": 33.4, "1-1/4": 42.2, "1-1/2": 48.3,
    "2": 60.3, "2-1/2": 73.0, "3": 88.9, "3-1/2": 101.6, "4": 114.3, "5": 141.3, "6": 168.3, "8": 219.1, "10": 273.0,
    "12": 323.8, "14": 355.6, "16": 406.4, "18": 457.0, "20": 508.0, "22": 559.0, "24": 610.0,
}  # fmt: skip
# ASME B36.10 by DN, where it differs from EN 10220: a plan in DN may mean either.
_ASME_DN = {"65": 73.0, "90": 101.6, "125": 141.3, "550": 559.0}
_COPPER = (
    6, 8, 10, 12, 14, 15, 16, 18, 22, 25, 28, 35, 40, 42, 54, 64, 66.7, 70, 76.1, 80, 88.9, 108, 133, 159, 219, 267,
)  # fmt: skip
_PVC = (32, 40, 50, 63, 75, 90, 110, 125, 140, 160, 180, 200, 225, 250, 280, 315, 355, 400, 450, 500)

# Standard deviation of the outer diameter: half of what the standards allow. Steel +-1 %, at least +-0.5 mm; copper
# with its ovality +-0.11 mm up to 54 mm, 0.2 up to 108, 0.7 up to 159, 1.5 beyond; PVC 0 to +0.3 % + 0.1 mm.
_STEEL_RELATIVE, _STEEL_LEAST = 0.005, 0.25
_COPPER_TOLERANCES = ((54.0, 0.06), (108.0, 0.1), (159.0, 0.35), (267.0, 0.75))
_PVC_RELATIVE, _PVC_LEAST = 0.0015, 0.1


@dataclass(frozen=True)
class Size:
    """Outer diameter and its manufacturing tolerance (one standard deviation) [m]."""

    outer_diameter: float
    tolerance: float


def _table() -> dict[str, Size]:
    def steel(diameter: float) -> Size:
        return Size(1e-3 * diameter, 1e-3 * max(_STEEL_RELATIVE * diameter, _STEEL_LEAST))

    def copper(diameter: float) -> float:
        return next(tolerance for largest, tolerance in _COPPER_TOLERANCES if diameter <= largest)

    table = {f"DN{name} steel": steel(diameter) for name, diameter in _STEEL_DN.items()}
    table |= {f"NPS {name} steel": steel(diameter) for name, diameter in _STEEL_NPS.items()}
    table |= {f"{diameter:g} copper": Size(1e-3 * diameter, 1e-3 * copper(diameter)) for diameter in _COPPER}
    table |= {
        f"DN{diameter} PVC": Size(1e-3 * diameter, 1e-3 * max(_PVC_RELATIVE * diameter, _PVC_LEAST))
        for diameter in _PVC
    }
    return table


SIZES = _table()
_NAMED_DN = re.compile(r"\bDN ?(\d+)\b", re.IGNORECASE)
_NAMED_NPS = re.compile(r"\bNPS ?(\d+[ -]\d/\d|\d/\d|\d+)(?![\d/])", re.IGNORECASE)


def find_size(text: str) -> Size | None:
    """The size that `text` names, such as 'DN50 steel', 'NPS 2-1/2 steel', '22 copper', 'DN110 PVC'; None if none."""
    return {_plain(name): size for name, size in SIZES.items()}.get(_plain(text))


def named_dn(text: str) -> int | None:
    """The first DN that a text names, 100 of 'heating DN100'; None where it names none."""
    found = _NAMED_DN.search(text)
    return int(found[1]) if found else None


def named_diameters(text: str) -> list[float]:
    """Outer diameters [m] of the nominal sizes that a text names, of each material; empty where it names none."""
    dn = [found[1] for found in _NAMED_DN.finditer(text)]
    nps = [found[1].replace(" ", "-") for found in _NAMED_NPS.finditer(text)]
    names = [*(f"DN{one} {kind}" for one in dn for kind in ("steel", "PVC")), *(f"NPS {one} steel" for one in nps)]
    diameters = [SIZES[name].outer_diameter for name in names if name in SIZES]
    return diameters + [1e-3 * _ASME_DN[one] for one in dn if one in _ASME_DN]


def nearest_name(text: str) -> str:
    """The known size whose name is most like `text`; of one with an inch mark, among the sizes in inches."""
    if re.search(r'["″]|\binch', text):
        inches = re.sub(r'["″]|\binch(es)?\b', " ", text).replace(" ", "")
        known = [name for name in SIZES if name.startswith("NPS ")]
        return difflib.get_close_matches(f"NPS {inches} steel", known, n=1, cutoff=0.0)[0]
    by_plain = {_plain(name): name for name in SIZES}
    return by_plain[difflib.get_close_matches(_plain(text), by_plain, n=1, cutoff=0.0)[0]]


def _plain(text: str) -> str:
    """The name without case, spaces, inch marks and millimetres, the material last."""
    words = re.sub(r'["″]|\bmm\b', " ", text.lower()).split()
    materials = [word for word in words if word.isalpha() and word not in ("dn", "nps")]
    return "".join(word for word in words if word not in materials) + " " + " ".join(materials)
