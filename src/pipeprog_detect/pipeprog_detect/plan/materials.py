# SPDX-License-Identifier: Apache-2.0
"""Materials that a bill may name and the keyframes can tell."""

from __future__ import annotations

import difflib
import re

from pipeprog_camera.errors import InputError
from pipeprog_camera.outside_text import name_of, shown

MATERIALS = (
    *("steel", "galvanised", "copper", "PVC grey", "PVC orange", "black PE", "insulated"),
    *(f"painted {paint}" for paint in ("red", "yellow", "green", "blue", "white", "grey", "black")),
)
_WORDS = {
    "galvanized": "galvanised",
    "gray": "grey",
    "pe": "pe",
    "hdpe": "pe",
    "insulation": "insulated",
    "stahl": "steel",
    "verzinkt": "galvanised",
    "kupfer": "copper",
    "gedämmt": "insulated",
    "isoliert": "insulated",
    "grau": "grey",
    "schwarz": "black",
    "rot": "red",
    "gelb": "yellow",
    "grün": "green",
    "blau": "blue",
    "weiß": "white",
    "lackiert": "painted",
    "gestrichen": "painted",
    "paint": "painted",
}
_BY_WORDS = {frozenset(material.lower().split()): material for material in MATERIALS}
# A text of which this share is that of a material is a slip of the pen, such as `coper`.
_SLIP = 0.8


def read_material(where: str, value: object) -> str:
    """The material of `MATERIALS` that a bill's text means; else the text.

    Raises InputError, which begins with `where`, for a text that is nearly a material.
    """
    text = name_of(value, f"{where}: material")
    known = known_material(text)
    if known:
        return known
    near = difflib.get_close_matches(text.lower(), [material.lower() for material in MATERIALS], 1, _SLIP)
    if near:
        meant = next(material for material in MATERIALS if material.lower() == near[0])
        raise InputError(f"{where}: unknown material {shown(text)}: did you mean '{meant}'?")
    return text


def known_material(text: str) -> str:
    """The material of `MATERIALS` that a text means, whatever the order of its words; empty where it means none."""
    words = frozenset(_WORDS.get(word, word) for word in re.split(r"[\s,_-]+", text.lower()) if word)
    return _BY_WORDS.get(words, "")
