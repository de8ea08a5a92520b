# SPDX-License-Identifier: Apache-2.0
"""Pipe materials as a bill names them, each drawn anew: base colour, what it mirrors, gloss, texture, dirt."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sitegen.primitives import Material

Colour = tuple[float, float, float]  # linear
_GLASSY = 0.04  # reflectance of plastics and paints, seen face on


def _range(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _grey(rng: np.random.Generator, low: float, high: float, tint: float) -> Colour:
    """A grey of an albedo in the range, even over its logarithm, its red and blue off by up to `tint`."""
    level = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    warm = _range(rng, -tint, tint)
    return (level * (1.0 + warm), level, level * (1.0 - warm))


def _worn(rng: np.random.Generator, name: str, colour: Colour, mottle: float, **more: float) -> Material:
    """A material with as much dirt as a site leaves on it."""
    dirty = float(rng.choice([0.2, 1.0])) * _range(rng, 0.5, 1.2)
    return Material(
        name,
        colour,
        mottle=mottle,
        cell=_range(rng, 0.03, 0.14),
        octaves=int(rng.integers(3, 7)),
        persistence=_range(rng, 0.5, 0.85),
        speckle=0.3 * dirty,
        speckle_cell=_range(rng, 0.012, 0.03),
        **more,
    )


def _metal(rng: np.random.Generator, name: str, colour: Colour, mottle: float, least_diffuse: float) -> Material:
    """A metal of a reflectance: a part of it is diffuse, for rust, scale and roughness, the rest mirrors and shines."""
    diffuse, shininess = _range(rng, least_diffuse, 0.9), float(np.exp(rng.uniform(np.log(8.0), np.log(90.0))))
    red, green, blue = (diffuse * part for part in colour)
    return _worn(
        rng,
        name,
        (red, green, blue),
        mottle,
        stretch=_range(rng, 1.0, 5.0),
        specular=(1.0 - diffuse) * max(colour) * _lobe(shininess) * _range(rng, 0.4, 1.0),
        shininess=shininess,
        mirror=(1.0 - diffuse) * max(colour),
        metal=1.0,
    )


def _plastic(rng: np.random.Generator, name: str, colour: Colour, mottle: float) -> Material:
    shininess = float(np.exp(rng.uniform(np.log(8.0), np.log(120.0))))
    return _worn(
        rng,
        name,
        colour,
        mottle,
        specular=_GLASSY * _lobe(shininess) * _range(rng, 0.2, 1.2),
        shininess=shininess,
        mirror=_GLASSY * _range(rng, 0.1, 1.0),
    )


def _lobe(shininess: float) -> float:
    """How much brighter a highlight is where it is sharper (Blinn and Phong's lobe, normalised)."""
    return (shininess + 8.0) / 8.0


def _steel(rng: np.random.Generator) -> Material:
    red, green, blue = _grey(rng, 0.12, 0.50, 0.03)
    rust = max(_range(rng, -0.25, 0.35), 0.0)
    colour = (red * (1.0 + rust), green, blue * (1.0 - 0.7 * rust))
    return _metal(rng, "steel", colour, _range(rng, 0.15, 0.5), 0.2)


def _galvanised(rng: np.random.Generator) -> Material:
    return _metal(rng, "galvanised", _grey(rng, 0.48, 0.78, 0.03), _range(rng, 0.05, 0.35), 0.15)


def _copper(rng: np.random.Generator) -> Material:
    level, dull = float(np.exp(rng.uniform(np.log(0.35), np.log(0.95)))), _range(rng, 0.0, 0.25)
    green, blue = _range(rng, 0.40, 0.64), _range(rng, 0.18, 0.48)
    colour = (level, level * (green + dull * (1.0 - green)), level * (blue + dull * (1.0 - blue)))
    return _metal(rng, "copper", colour, _range(rng, 0.1, 0.5), 0.1)


def _pvc_grey(rng: np.random.Generator) -> Material:
    return _plastic(rng, "PVC grey", _grey(rng, 0.07, 0.40, 0.10), _range(rng, 0.02, 0.15))


def _pvc_orange(rng: np.random.Generator) -> Material:
    level = _range(rng, 0.30, 0.65)
    colour = (level, level * _range(rng, 0.26, 0.46), level * _range(rng, 0.04, 0.16))
    return _plastic(rng, "PVC orange", colour, _range(rng, 0.02, 0.15))


def _black_pe(rng: np.random.Generator) -> Material:
    return _plastic(rng, "black PE", _grey(rng, 0.010, 0.035, 0.05), _range(rng, 0.05, 0.3))


def _insulated(rng: np.random.Generator) -> Material:
    if rng.random() < 0.6:  # a jacket of aluminium
        return _metal(rng, "insulated", _grey(rng, 0.70, 0.92, 0.02), _range(rng, 0.05, 0.35), 0.05)
    return _plastic(rng, "insulated", _grey(rng, 0.45, 0.80, 0.05), _range(rng, 0.05, 0.2))


# Albedo of the strongest of red, green and blue, and each of the three relative to it.
_PAINTS: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "red": ((0.25, 0.65), (1.0, 1.0), (0.02, 0.28), (0.02, 0.24)),
    "yellow": ((0.50, 0.90), (1.0, 1.0), (0.45, 0.85), (0.005, 0.25)),
    "green": ((0.10, 0.45), (0.02, 0.60), (1.0, 1.0), (0.10, 0.70)),
    "blue": ((0.15, 0.60), (0.01, 0.50), (0.20, 0.75), (1.0, 1.0)),
}


def _painted(rng: np.random.Generator, paint: str) -> Material:
    name = f"painted {paint}"
    if paint == "white":
        return _plastic(rng, name, _grey(rng, 0.60, 0.90, 0.05), _range(rng, 0.02, 0.2))
    if paint == "grey":
        return _plastic(rng, name, _grey(rng, 0.10, 0.50, 0.06), _range(rng, 0.02, 0.2))
    if paint == "black":
        return _plastic(rng, name, _grey(rng, 0.012, 0.045, 0.05), _range(rng, 0.05, 0.3))
    level, *shares = (_range(rng, low, high) for low, high in _PAINTS[paint])
    red, green, blue = (level * share for share in shares)
    return _plastic(rng, name, (red, green, blue), _range(rng, 0.02, 0.25))


_MAKERS: dict[str, Callable[[np.random.Generator], Material]] = {
    "steel": _steel,
    "galvanised": _galvanised,
    "copper": _copper,
    "PVC grey": _pvc_grey,
    "PVC orange": _pvc_orange,
    "black PE": _black_pe,
    "insulated": _insulated,
}
KINDS = (*_MAKERS, *(f"painted {paint}" for paint in (*_PAINTS, "white", "grey", "black")))


def pipe_material(kind: str, rng: np.random.Generator) -> Material:
    """One that a bill calls by a name of `KINDS`."""
    return _MAKERS[kind](rng) if kind in _MAKERS else _painted(rng, kind.removeprefix("painted "))
