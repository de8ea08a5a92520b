# SPDX-License-Identifier: Apache-2.0
"""A site one night later: a pipe added, one removed, one lengthened, other light and clutter, and no board.

What stays keeps its place among the primitives, by which its texture is seeded; what goes is buried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sitegen.primitives import Kind, unit
from sitegen.site import BLACK, CARDBOARD, PIPE_MATERIALS, WHITE, Pipe, Site, segment_gap

FloatArray = NDArray[np.float64]

LONGER = 0.30  # m by which a pipe has grown
_BURIED = np.array([0.0, 0.0, -100.0])  # m; no ray comes there
_GAP = 0.04  # m of air that a new barrel keeps from everything else
_MOUNTED = 0.03  # m from a barrel's surface to the axis of what is mounted on it: clamps, their rods, flanges
_TRIES = 2000  # places drawn for a new pipe
_THIN = 0.02  # m; thinner pipes are neither removed nor added: whether one is gone is not seen in depths


def second_night(site: Site, rng: np.random.Generator) -> None:
    """Changes a site as a day of work does; raises RuntimeError where nothing more fits in."""
    _remove_boards(site)
    free = [n for n, pipe in enumerate(site.pipes) if pipe.radius > _THIN and "elbow" not in pipe.ends]
    _remove_pipe(site, int(rng.choice(free)))
    _lengthen(site, rng)
    _add_pipe(site, rng)
    _clutter(site, rng)
    for number, lamp in enumerate(site.lamps):
        x, y, z = lamp.position
        moved = (x + float(rng.uniform(-0.5, 0.5)), y + float(rng.uniform(-0.3, 0.3)), z)
        site.lamps[number] = replace(lamp, position=moved, power=lamp.power * float(rng.uniform(0.6, 1.4)))
    site.ambient *= float(rng.uniform(0.7, 1.2))


def _bury(site: Site, number: int) -> None:
    primitive = site.primitives[number]
    site.primitives[number] = replace(primitive, origin=primitive.origin + _BURIED, pipe=-1)


def _remove_boards(site: Site) -> None:
    for number, primitive in enumerate(site.primitives):
        if primitive.material.name in (BLACK.name, WHITE.name):
            _bury(site, number)
    site.boards.clear()


def _remove_pipe(site: Site, index: int) -> None:
    """Buries a pipe with what is mounted on it; it stays planned."""
    gone = site.pipes.pop(index)
    site.removed.append(gone)
    for number, primitive in enumerate(site.primitives):
        if primitive.pipe == index:
            _bury(site, number)
        elif primitive.pipe > index:
            site.primitives[number] = replace(primitive, pipe=primitive.pipe - 1)
        elif primitive.pipe < 0 and primitive.kind == Kind.CYLINDER:
            start = primitive.origin
            end = start + primitive.size[1] * primitive.rotation[2]
            if segment_gap(gone.start, gone.end, start, end) < gone.radius + _MOUNTED:
                _bury(site, number)


def _lengthen(site: Site, rng: np.random.Generator) -> None:
    """Lets one pipe grow at its free end."""
    for index in rng.permutation(len(site.pipes)).tolist():
        pipe = site.pipes[index]
        axis = unit(pipe.end - pipe.start)
        end = pipe.end + LONGER * axis
        others = [other for other in site.pipes if other is not pipe]
        can_grow = pipe.radius > _THIN and pipe.ends[1] == "free"
        if can_grow and _is_free(site, others, pipe.end + _GAP * axis, end, pipe.radius):
            site.pipes[index] = replace(pipe, end=end)
            number = next(n for n, primitive in enumerate(site.primitives) if primitive.pipe == index)
            barrel = site.primitives[number]
            site.primitives[number] = replace(barrel, size=(barrel.size[0], barrel.size[1] + LONGER))
            return
    raise RuntimeError("no pipe has room to grow: choose another seed")


def _add_pipe(site: Site, rng: np.random.Generator) -> None:
    """Puts a pipe of a planned class along the wall y = 0."""
    low, high = min(pipe.start[0] for pipe in site.pipes), max(pipe.end[0] for pipe in site.pipes)
    for _ in range(_TRIES):
        radius = float(rng.choice([radius for radius in site.planned_radii if radius > _THIN]))
        start = np.array([rng.uniform(low, high), -radius - rng.uniform(0.03, 0.08), rng.uniform(0.25, 2.2)])
        end = start + np.array([rng.uniform(0.7, 1.2), 0.0, 0.0])
        if end[0] < high + LONGER and _is_free(site, site.pipes, start, end, radius):
            site.pipe(start, end, radius, PIPE_MATERIALS[int(rng.integers(len(PIPE_MATERIALS)))], ("free", "free"))
            return
    raise RuntimeError(f"no room for another pipe in {_TRIES} places: choose another seed")


def _clutter(site: Site, rng: np.random.Generator) -> None:
    """Three boxes on the floor, away from the path."""
    right = max(pipe.end[0] for pipe in site.pipes)
    for x in rng.uniform(0.5, right, 3).tolist():
        low = np.array([x, -rng.uniform(0.6, 1.0), 0.0])
        size = np.array([rng.uniform(0.2, 0.4), 0.25, rng.uniform(0.12, 0.3)])
        site.box(low, low + size, CARDBOARD, rng.uniform(0.0, np.pi))


def _is_free(site: Site, pipes: Sequence[Pipe], start: FloatArray, end: FloatArray, radius: float) -> bool:
    """Whether a barrel keeps clear of pipes, by their axes, and of all else that is built, by the boxes around it."""
    if any(segment_gap(start, end, pipe.start, pipe.end) < radius + pipe.radius + _GAP for pipe in pipes):
        return False
    low, high = np.minimum(start, end) - radius, np.maximum(start, end) + radius
    for primitive in site.primitives:
        below, above = primitive.bounds
        if primitive.pipe < 0 and primitive.kind != Kind.RECTANGLE and (low < above).all() and (high > below).all():
            return False
    return True
