"""The apparent contour of a circular cylinder: where its two outlines lie in a view, and how they move with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_detect.silhouette.occlusion import behind
from pipeprog_detect.types import Cylinder, View


@dataclass(frozen=True)
class Stations:
    """N points on the predicted outlines of one cylinder in several views.

    `view` index of the view, `side` 0 or 1; `pixel` (N, 2); `normal` (N, 2) unit, outwards from the pipe; `tangent` is
    the normal turned by 90 degrees. `along` position on the axis from the cylinder's middle [m]; `gain` displacement of
    the outline in pixels for one metre of the surface; `half_width` apparent radius of the pipe [px];
    `jacobian` (N, 5) outward displacement [px] for each unit of (offset at the start along both frame vectors, the same
    at the end, radius) [m].
    """

    view: IntArray
    side: IntArray
    pixel: FloatArray
    normal: FloatArray
    along: FloatArray
    gain: FloatArray
    half_width: FloatArray
    jacobian: FloatArray

    def __len__(self) -> int:
        return len(self.view)

    def select(self, keep: NDArray[np.bool_] | IntArray) -> Stations:
        """Those stations that a mask or an index array names."""
        return Stations(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def tangent_normals(point: FloatArray, axis: FloatArray, radius: float, centre: FloatArray) -> FloatArray | None:
    """Unit normals (2, 3) of the planes through `centre` that touch the cylinder; None where it lies inside.

    Both point inwards: the axis lies at distance `radius` on their positive side. The tangent-plane form of the
    outline of a straight homogeneous generalised cylinder.
    """
    offset = point - centre
    offset = offset - axis * (axis @ offset)
    distance = float(np.linalg.norm(offset))
    if distance <= radius * (1.0 + 1e-9):
        return None
    towards = offset / distance
    across = np.cross(axis, towards)
    sine = radius / distance
    cosine = np.sqrt(1.0 - sine * sine)
    return np.stack([sine * towards + cosine * across, sine * towards - cosine * across])


def frame(cylinder: Cylinder, towards: FloatArray) -> FloatArray:
    """Two unit vectors (2, 3) across the axis: sideways as seen along `towards`, and away from the viewer."""
    axis = cylinder.axis
    depth = towards - axis * (axis @ towards)
    norm = float(np.linalg.norm(depth))
    if norm < 1e-6:
        depth = np.eye(3)[np.argmin(np.abs(axis))]
        depth = depth - axis * (axis @ depth)
        norm = float(np.linalg.norm(depth))
    depth = depth / norm
    return np.stack([np.cross(axis, depth), depth])


def viewing_direction(cylinder: Cylinder, views: Sequence[View]) -> FloatArray:
    """Mean unit vector (3,) from the cameras to the cylinder's middle."""
    directions = [cylinder.middle - view.centre for view in views]
    return np.mean([direction / np.linalg.norm(direction) for direction in directions], axis=0)


def moved(cylinder: Cylinder, basis: FloatArray, step: FloatArray) -> Cylinder:
    """The cylinder after a step (5,): offsets of its start (2) and end (2) along `basis` and of its radius [m]."""
    return Cylinder(
        cylinder.start + step[0:2] @ basis, cylinder.end + step[2:4] @ basis, float(cylinder.radius + step[4])
    )


def project(view: View, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and depths (N,) [m] of points (N, 3) of the map."""
    in_camera = points @ view.camera_from_map[:3, :3].T + view.camera_from_map[:3, 3]
    depth = in_camera[:, 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    camera = view.camera
    pixel = np.stack(
        [camera.fx * in_camera[:, 0] / safe + camera.cx, camera.fy * in_camera[:, 1] / safe + camera.cy], axis=1
    )
    return pixel, depth


def inside(view: View, points: FloatArray) -> NDArray[np.bool_]:
    """Which points (N, 3) of the map lie before the camera and within the image."""
    pixel, depth = project(view, points)
    size = np.array([view.camera.width, view.camera.height])
    return np.asarray((depth > 0.05) & (pixel > 0).all(axis=1) & (pixel < size - 1).all(axis=1))


def showing(points: FloatArray, views: Sequence[View], most: int) -> list[View]:
    """Views, spread evenly and no more than `most`, of those that show some of the points (N, 3) of the map."""
    able = [view for view in views if inside(view, points).any()]
    return able[:: -(-len(able) // most)] if able else []


def stations(
    cylinder: Cylinder, views: Sequence[View], basis: FloatArray, spacing: float, margin: float = 4.0
) -> Stations:
    """Points on the outlines inside the images, about `spacing` pixels apart along the pipe in the median view.

    The positions along the axis are common to all views, so that evidence can be pooled by position.
    The Jacobian is exact: displacing the surface by d along its outward normal at the contact generator moves the
    outline by d / (depth |l|) pixels, l being the image line of the tangent plane (envelope theorem).
    """
    axis, length = cylinder.axis, cylinder.length
    gains = []
    for view in views:
        distance = float(np.linalg.norm(view.centre - cylinder.middle))
        gains.append(view.camera.fx / max(distance, 1e-3))
    step = spacing / float(np.median(gains))
    count = max(int(length / step), 4)
    fractions = (np.arange(count) + 0.5) / count
    parts: list[tuple[np.ndarray, ...]] = []
    for index, view in enumerate(views):
        centre = view.centre
        normals = tangent_normals(cylinder.start, axis, cylinder.radius, centre)
        if normals is None:
            continue
        rotation = view.camera_from_map[:3, :3]
        inverse = np.linalg.inv(view.camera.matrix)
        on_axis = cylinder.start + fractions[:, None] * (length * axis)
        for side, normal in enumerate(normals):
            line = inverse.T @ (rotation @ normal)
            slope = float(np.hypot(line[0], line[1]))
            pixel, depth = project(view, on_axis - cylinder.radius * normal)
            inside = (
                (depth > 0.05)
                & (pixel[:, 0] > margin)
                & (pixel[:, 0] < view.camera.width - 1 - margin)
                & (pixel[:, 1] > margin)
                & (pixel[:, 1] < view.camera.height - 1 - margin)
            )
            if not inside.any() or slope < 1e-12:
                continue
            gain = 1.0 / (depth[inside] * slope)
            share = fractions[inside]
            sideways = -(basis @ normal)
            jacobian = gain[:, None] * np.concatenate(
                [
                    (1.0 - share)[:, None] * sideways,
                    share[:, None] * sideways,
                    np.ones((len(share), 1)),
                ],
                axis=1,
            )
            total = int(inside.sum())
            parts.append(
                (
                    np.full(total, index),
                    np.full(total, side),
                    pixel[inside],
                    np.broadcast_to(-line[:2] / slope, (total, 2)),
                    (share - 0.5) * length,
                    gain,
                    gain * cylinder.radius,
                    jacobian,
                )
            )
    if not parts:
        empty = np.zeros(0)
        none = np.zeros(0, int)
        return Stations(none, none, np.zeros((0, 2)), np.zeros((0, 2)), empty, empty, empty, np.zeros((0, 5)))
    return Stations(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def visible(
    cylinder: Cylinder, others: Sequence[Cylinder], views: Sequence[View], at: Stations, margin: float = 3.0
) -> NDArray[np.bool_]:
    """Mask (N,): stations that neither another cylinder, grown by `margin` pixels, nor the cloud hides from a view."""
    result = np.ones(len(at), bool)
    for index, view in enumerate(views):
        chosen = np.flatnonzero(at.view == index)
        if len(chosen):
            on_axis = cylinder.middle + at.along[chosen, None] * cylinder.axis
            depth = (on_axis - view.centre) @ view.camera_from_map[2, :3]
            result[chosen] = ~hidden(view, at.pixel[chosen], depth, others, margin)
            result[chosen] &= ~behind(view, at.pixel[chosen], depth - cylinder.radius)
    return result


def hidden(
    view: View, pixel: FloatArray, depth: FloatArray, others: Sequence[Cylinder], margin: float = 3.0
) -> NDArray[np.bool_]:
    """Which points (N,), seen at pixel (N, 2) at depth (N,) [m], lie behind a cylinder grown by `margin` pixels."""
    result = np.zeros(len(depth), bool)
    camera, centre = view.camera, view.centre
    rays = np.stack(
        [(pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy, np.ones(len(depth))], axis=1
    )
    rays = rays @ view.camera_from_map[:3, :3]
    for other in others:
        result |= _hidden_by(other, centre, rays, depth, margin / camera.fx)
    return result


def _hidden_by(
    other: Cylinder, centre: FloatArray, rays: FloatArray, own_depth: FloatArray, margin: float
) -> NDArray[np.bool_]:
    """Rays (N, 3) with unit depth that pass `other`, grown by `margin` x depth, before `own_depth`."""
    axis = other.axis
    offset = other.start - centre
    offset_across = offset - axis * (axis @ offset)
    rays_along = rays @ axis
    rays_across = rays - rays_along[:, None] * axis
    square = np.maximum(np.einsum("ij,ij->i", rays_across, rays_across), 1e-12)
    depth = rays_across @ offset_across / square
    miss = offset_across - depth[:, None] * rays_across
    along = depth * rays_along - axis @ offset
    reach = other.radius + margin * np.abs(depth)
    near = np.einsum("ij,ij->i", miss, miss) < reach**2
    return near & (depth > 0) & (depth < own_depth) & (along > -reach) & (along < other.length + reach)


def outline(cylinder: Cylinder, view: View) -> FloatArray:
    """The two outlines as image segments (2, 2, 2): [side, end, (x, y)] in pixels, not clipped to the image.

    Raises ValueError where the camera stands inside the cylinder's infinite extension or a segment passes behind it.
    """
    normals = tangent_normals(cylinder.start, cylinder.axis, cylinder.radius, view.centre)
    if normals is None:
        raise ValueError("the camera lies inside the cylinder: it has no outline")
    result = np.empty((2, 2, 2))
    for side, normal in enumerate(normals):
        ends = np.stack([cylinder.start, cylinder.end]) - cylinder.radius * normal
        pixel, depth = project(view, ends)
        if (depth <= 0).any():
            raise ValueError("the cylinder passes behind the camera")
        result[side] = pixel
    return result
