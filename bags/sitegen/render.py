# SPDX-License-Identifier: Apache-2.0
"""Images of a site: one ray through the middle of each pixel, sixteen where it meets an outline or a shadow's edge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sitegen.primitives import Material, Primitive
from sitegen.raycast import STACK, Hit, IntArray, PackedTree, Tree, blocked, build_tree, nearest
from sitegen.textures import albedo_factor, value_noise

FloatArray = NDArray[np.float64]
FloatImage = NDArray[np.float32]

Colour = tuple[float, float, float]  # linear
NEUTRAL: Colour = (1.0, 1.0, 1.0)

_EDGE_BITS = 4  # sixteen rays
_BORE = 0.9  # inner over outer radius, as the end of a pipe shows it
# What is mirrored: a room whose surfaces give back this share of its light, more above than below, and unevenly, with
# this many lighter and darker places about the horizon; this share of a lamp's light falls on it.
_ROOM, _ABOVE, _UNEVEN, _PLACES, _LIT = 0.5, 0.35, 0.7, 2.0, 0.5


@dataclass(frozen=True)
class Lamp:
    """Point light; `power` is the irradiance at 1 m, linear. Several close together make a soft shadow."""

    position: tuple[float, float, float]
    power: float
    colour: Colour = NEUTRAL


@dataclass(frozen=True)
class Lens:
    """The true camera: ROS pixel convention (integers at pixel centres).

    `distortion` is k1 k2 p1 p2 k3 of plumb_bob or, of a fisheye (equidistant), k1 k2 k3 k4.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    is_fisheye: bool = False

    def row(self) -> FloatArray:
        """fx, fy, cx, cy, five coefficients (the last one of a fisheye is 0), and whether it is a fisheye."""
        coefficients = (*self.distortion, 0.0)[:5]
        return np.array([self.fx, self.fy, self.cx, self.cy, *coefficients, float(self.is_fisheye)])

    def reduced(self, factor: int) -> Lens:
        """The same view with `factor` times fewer pixels each way."""
        return replace(
            self,
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=(self.cx + 0.5) / factor - 0.5,
            cy=(self.cy + 0.5) / factor - 0.5,
        )


@dataclass(frozen=True)
class Scene:
    """Everything the renderer needs, in flat arrays."""

    tree: Tree
    materials: FloatArray  # (P, 15), one row per primitive
    seeds: IntArray  # (P,)
    pipes: IntArray  # (P,) index of the true pipe or -1
    lamps: FloatArray  # (L, 7) position, power and colour
    ambient: FloatArray  # (3,)


def build_scene(
    primitives: Sequence[Primitive], lamps: Sequence[Lamp], ambient: float, seed: int, ambient_colour: Colour = NEUTRAL
) -> Scene:
    """Pack primitives and lamps; every primitive gets a texture seed of its own."""
    materials: list[Material] = [p.material for p in primitives]
    return Scene(
        build_tree(primitives),
        np.array([m.row() for m in materials]),
        np.array([1000 * seed + 7919 * k for k in range(len(primitives))], np.int64) % 2**31,
        np.array([p.pipe for p in primitives], np.int64),
        np.array([[*lamp.position, lamp.power, *lamp.colour] for lamp in lamps], float).reshape(-1, 7),
        ambient * np.array(ambient_colour),
    )


def _edge_pattern(bits: int) -> FloatArray:
    """(2**bits, 2) offsets in a pixel, all columns and rows distinct, so that edges are not quantised coarsely."""
    reversed_ = np.array([int(f"{i:0{bits}b}"[::-1], 2) for i in range(2**bits)])
    return np.c_[np.arange(2**bits) + 0.5, reversed_ + 0.5] / 2**bits - 0.5


@njit(nogil=True)
def _fisheye_direction(xd: float, yd: float, lens: FloatArray) -> tuple[float, float, float]:
    """As `_direction`: Kannala and Brandt, r = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) at an angle t to the axis."""
    r = math.sqrt(xd * xd + yd * yd)
    if r == 0.0:
        return 0.0, 0.0, 1.0
    t = r
    for _ in range(100):
        t2 = t * t
        told = t * (1.0 + t2 * (lens[4] + t2 * (lens[5] + t2 * (lens[6] + t2 * lens[7]))))
        slope = 1.0 + t2 * (3.0 * lens[4] + t2 * (5.0 * lens[5] + t2 * (7.0 * lens[6] + t2 * 9.0 * lens[7])))
        moved = (r - told) / slope
        t += moved
        if abs(moved) < 1e-12:
            break
    s = math.sin(t) / r
    return s * xd, s * yd, math.cos(t)


@njit(nogil=True)
def _direction(u: float, v: float, lens: FloatArray) -> tuple[float, float, float]:
    """Unit direction, in the optical frame, of the ray through a pixel (distortion inverted)."""
    xd, yd = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    if lens[9] != 0.0:
        return _fisheye_direction(xd, yd, lens)
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    x, y = xd, yd
    if k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0:
        for _ in range(100):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            nx = (xd - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / radial
            ny = (yd - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / radial
            moved = abs(nx - x) + abs(ny - y)
            x, y = nx, ny
            if moved < 1e-10:
                break
    n = 1.0 / math.sqrt(x * x + y * y + 1.0)
    return x * n, y * n, n


@njit(nogil=True)
def _directions(lens: FloatArray, offsets: FloatArray, found: FloatArray) -> None:
    for k in range(len(offsets)):
        for r in range(found.shape[1]):
            for c in range(found.shape[2]):
                x, y, z = _direction(c + offsets[k, 0], r + offsets[k, 1], lens)
                found[k, r, c, 0], found[k, r, c, 1] = x / z, y / z


def pixel_directions(lens: Lens, offsets: FloatArray) -> FloatArray:
    """(K, H, W, 2) directions (x, y at z = 1, optical frame) of rays that pass each pixel at (K, 2) offsets, px."""
    found = np.empty((len(offsets), lens.height, lens.width, 2))
    _directions(lens.row(), offsets, found)
    return found


@njit(nogil=True)
def _cast(
    tree: PackedTree, pose: FloatArray, lens: FloatArray, u: float, v: float, stack: IntArray
) -> tuple[int, Hit, float, float, float]:
    """Nearest hit along a pixel's ray: (index, hit, world direction)."""
    cx, cy, cz = _direction(u, v, lens)
    dx = pose[0, 0] * cx + pose[0, 1] * cy + pose[0, 2] * cz
    dy = pose[1, 0] * cx + pose[1, 1] * cy + pose[1, 2] * cz
    dz = pose[2, 0] * cx + pose[2, 1] * cy + pose[2, 2] * cz
    p, hit = nearest(tree, stack, (pose[0, 3], pose[1, 3], pose[2, 3], dx, dy, dz))
    return p, hit, dx, dy, dz


@njit(nogil=True)
def _shade(
    tree: PackedTree,
    materials: FloatArray,
    seeds: IntArray,
    lamps: FloatArray,
    ambient: FloatArray,
    pose: FloatArray,
    lens: FloatArray,
    u: float,
    v: float,
    stack: IntArray,
) -> tuple[float, float, float, int]:
    """Linear colour of a pixel position and a label that changes across outlines, creases and shadow edges."""
    kinds, geometry = tree[0], tree[1]
    p, hit, dx, dy, dz = _cast(tree, pose, lens, u, v, stack)
    if p < 0:
        far = 0.25 + 0.05 * dz
        return far, far, far, -1
    t, x, y, z, lx, ly, lz, part = hit
    g = geometry[p]
    material = materials[p]
    nx = g[3] * lx + g[6] * ly + g[9] * lz
    ny = g[4] * lx + g[7] * ly + g[10] * lz
    nz = g[5] * lx + g[8] * ly + g[11] * lz
    facing = -(nx * dx + ny * dy + nz * dz)
    # A pixel's side on the surface: the geometric mean of its sides across and along the slope.
    footprint = t / lens[0] / math.sqrt(max(facing, 0.1))
    factor = albedo_factor(material, x, y, z, footprint, seeds[p])
    if kinds[p] == 3 and part == 1 and x * x + y * y < (_BORE * g[12]) ** 2:
        factor *= 0.12
        part = 2
    wx, wy, wz = pose[0, 3] + t * dx, pose[1, 3] + t * dy, pose[2, 3] + t * dz
    ox, oy, oz = wx + 1e-5 * nx, wy + 1e-5 * ny, wz + 1e-5 * nz
    sky = 0.8 + 0.2 * nz
    red, green, blue = ambient[0] * sky, ambient[1] * sky, ambient[2] * sky
    shine_red, shine_green, shine_blue = 0.0, 0.0, 0.0
    room_red, room_green, room_blue = ambient[0], ambient[1], ambient[2]
    shadows = 0
    for k in range(len(lamps)):
        sx, sy, sz = lamps[k, 0] - wx, lamps[k, 1] - wy, lamps[k, 2] - wz
        d2 = sx * sx + sy * sy + sz * sz
        d = math.sqrt(d2)
        sx, sy, sz = sx / d, sy / d, sz / d
        cosine = nx * sx + ny * sy + nz * sz
        spread = _LIT * lamps[k, 3] / (1.0 + d2)
        room_red, room_green = room_red + spread * lamps[k, 4], room_green + spread * lamps[k, 5]
        room_blue = room_blue + spread * lamps[k, 6]
        if cosine <= 0.0:
            continue
        if blocked(tree, stack, (ox, oy, oz, sx, sy, sz), d):
            shadows |= 1 << k
            continue
        power = lamps[k, 3] / d2
        light = power * cosine
        red, green, blue = red + light * lamps[k, 4], green + light * lamps[k, 5], blue + light * lamps[k, 6]
        if material[10] > 0.0:
            hx, hy, hz = sx - dx, sy - dy, sz - dz
            h = math.sqrt(hx * hx + hy * hy + hz * hz)
            peak = max((nx * hx + ny * hy + nz * hz) / h, 0.0)
            gloss = power * material[10] * peak ** material[11]
            shine_red, shine_green = shine_red + gloss * lamps[k, 4], shine_green + gloss * lamps[k, 5]
            shine_blue = shine_blue + gloss * lamps[k, 6]
    if material[13] > 0.0:
        mx, my, mz = dx + 2.0 * facing * nx, dy + 2.0 * facing * ny, dz + 2.0 * facing * nz
        share = material[13] + (1.0 - material[13]) * max(1.0 - facing, 0.0) ** 5
        uneven = value_noise(_PLACES * mx, _PLACES * my, _PLACES * mz, 0, seeds[0])
        share *= _ROOM * max(1.0 + _ABOVE * mz + _UNEVEN * uneven, 0.1)
        shine_red, shine_green = shine_red + share * room_red, shine_green + share * room_green
        shine_blue = shine_blue + share * room_blue
    if material[14] > 0.0:
        brightest, metal = max(material[0], material[1], material[2]), material[14]
        shine_red *= 1.0 - metal + metal * material[0] / brightest
        shine_green *= 1.0 - metal + metal * material[1] / brightest
        shine_blue *= 1.0 - metal + metal * material[2] / brightest
    label = ((p * 8 + part) << 8) | shadows
    return (
        material[0] * (red * factor) + shine_red * factor,
        material[1] * (green * factor) + shine_green * factor,
        material[2] * (blue * factor) + shine_blue * factor,
        label,
    )


@njit(nogil=True)
def _render(
    tree: PackedTree,
    materials: FloatArray,
    seeds: IntArray,
    lamps: FloatArray,
    ambient: FloatArray,
    poses: FloatArray,
    lens: FloatArray,
    pattern: FloatArray,
    image: FloatImage,
    labels: IntArray,
) -> None:
    """Fill `image` (H, W, 3) and `labels` (H, W); `poses` (H, 3, 4) hold the pose while each row is read."""
    height, width = labels.shape
    stack = np.empty(STACK, np.int64)
    for r in range(height):
        for c in range(width):
            a, b, d, label = _shade(tree, materials, seeds, lamps, ambient, poses[r], lens, float(c), float(r), stack)
            image[r, c, 0], image[r, c, 1], image[r, c, 2] = a, b, d
            labels[r, c] = label
    count = len(pattern)
    for r in range(height):
        for c in range(width):
            edge = False
            for rr in range(max(r - 1, 0), min(r + 2, height)):
                for cc in range(max(c - 1, 0), min(c + 2, width)):
                    edge = edge or labels[rr, cc] != labels[r, c]
            if not edge:
                continue
            sa, sb, sd = 0.0, 0.0, 0.0
            for k in range(count):
                a, b, d, label = _shade(
                    tree, materials, seeds, lamps, ambient, poses[r], lens, c + pattern[k, 0], r + pattern[k, 1], stack
                )
                sa, sb, sd = sa + a, sb + b, sd + d
            image[r, c, 0], image[r, c, 1], image[r, c, 2] = sa / count, sb / count, sd / count


@njit(nogil=True)
def _trace(
    tree: PackedTree,
    pose: FloatArray,
    lens: FloatArray,
    primitives: IntArray,
    points: FloatArray,
    depths: FloatArray,
) -> None:
    height, width = primitives.shape
    stack = np.empty(STACK, np.int64)
    for r in range(height):
        for c in range(width):
            p, hit, dx, dy, dz = _cast(tree, pose, lens, float(c), float(r), stack)
            primitives[r, c] = p
            depths[r, c] = hit[0]
            if p >= 0:
                points[r, c, 0] = pose[0, 3] + hit[0] * dx
                points[r, c, 1] = pose[1, 3] + hit[0] * dy
                points[r, c, 2] = pose[2, 3] + hit[0] * dz


def render(scene: Scene, lens: Lens, row_poses: FloatArray, edge_bits: int = _EDGE_BITS) -> FloatImage:
    """Linear RGB image (H, W, 3) float32, unclipped; `row_poses` (H, 4, 4) are world_from_camera for each row.

    Pixels on an edge take 2**edge_bits rays.
    """
    image = np.empty((lens.height, lens.width, 3), np.float32)
    labels = np.empty((lens.height, lens.width), np.int64)
    _render(
        scene.tree.packed(),
        scene.materials,
        scene.seeds,
        scene.lamps,
        scene.ambient,
        np.ascontiguousarray(row_poses[:, :3]),
        lens.row(),
        _edge_pattern(edge_bits),
        image,
        labels,
    )
    return image


@njit(nogil=True)
def _shade_pixels(
    tree: PackedTree,
    materials: FloatArray,
    seeds: IntArray,
    lamps: FloatArray,
    ambient: FloatArray,
    pose: FloatArray,
    lens: FloatArray,
    pixels: FloatArray,
) -> FloatArray:
    stack = np.empty(STACK, np.int64)
    light = np.empty((len(pixels), 3))
    for k in range(len(pixels)):
        u, v = pixels[k]
        light[k, 0], light[k, 1], light[k, 2], _ = _shade(
            tree, materials, seeds, lamps, ambient, pose, lens, u, v, stack
        )
    return light


def light_at(scene: Scene, lens: Lens, pose: FloatArray, pixels: FloatArray) -> FloatArray:
    """Linear RGB (N, 3) where single rays through pixels (N, 2) of a camera at world_from_camera (4, 4) end."""
    packed, top = scene.tree.packed(), np.ascontiguousarray(pose[:3])
    lit = scene.materials, scene.seeds, scene.lamps, scene.ambient
    return _shade_pixels(packed, *lit, top, lens.row(), np.ascontiguousarray(pixels, float))


def trace(scene: Scene, lens: Lens, pose: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """What each pixel's ray hits first: primitive (H, W) or -1, world point (H, W, 3), range (H, W) in metres."""
    primitives = np.empty((lens.height, lens.width), np.int64)
    points = np.full((lens.height, lens.width, 3), np.nan)
    ranges = np.empty((lens.height, lens.width))
    _trace(scene.tree.packed(), np.ascontiguousarray(pose[:3]), lens.row(), primitives, points, ranges)
    return primitives, points, ranges
