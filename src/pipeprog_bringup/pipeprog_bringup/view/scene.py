# SPDX-License-Identifier: Apache-2.0
"""A results folder as Open3D geometries: cloud, pipes in the colours of their classes, cameras, the frame `map`.

The one module that imports Open3D. It does so when it is imported itself, which a child process does (see `display`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeprog_bringup.report.render import LIFT
from pipeprog_bringup.results.results_reader import UNPLANNED, Color, Results
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.types import Cylinder

SIDES = 64  # flat sides of a drawn cylinder: each lies 0.12 % of the radius inside it at most
MOST_POINTS = 3_000_000  # of the cloud, drawn: what software rendering turns without delay
FRUSTUM = 0.08  # m from a camera to the base of its drawn pyramid: small beside the 0.25 m between keyframes
AXES = 0.3  # m, length of the axes drawn at the origin of `map`
_CAMERA_COLOR: Color = (0.95, 0.45, 0.1)
# Corners of a camera's pyramid and its edges; the shape is that of an image of 4 : 3, not of the lens.
_CORNERS = np.array([[0, 0, 0], [-0.67, -0.5, 1], [0.67, -0.5, 1], [0.67, 0.5, 1], [-0.67, 0.5, 1]])
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]])


@dataclass(frozen=True)
class Layer:
    """A geometry, the name that the window lists it by, the shader that draws it, whether it is shown at first."""

    name: str
    geometry: Any
    shader: str
    visible: bool = True


def layers(results: Results) -> list[Layer]:
    """What there is to draw of a run; what its folder does not hold is left out."""
    drawn = [
        Layer(f"{entry['id']} {entry['class'] or 'no planned class'}", mesh, "defaultLit")
        for entry, mesh in zip(results.pipes, pipe_meshes(results), strict=True)
    ]
    if results.cloud is not None:
        on_pipes = _on_pipes(results.points, results.cylinders)
        drawn.append(Layer("cloud", _point_cloud(results, ~on_pipes), "defaultUnlit"))
        drawn.append(Layer("cloud on pipes", _point_cloud(results, on_pipes), "defaultUnlit", visible=False))
    if len(results.map_from_camera):
        drawn.append(Layer("cameras", _cameras(results.map_from_camera), "unlitLine"))
        drawn.append(Layer("map", o3d.geometry.TriangleMesh.create_coordinate_frame(AXES), "defaultUnlit"))
    return drawn


def pipe_meshes(results: Results) -> list[Any]:
    """A closed cylinder (TriangleMesh) for each pipe, in its place [m] and in the colour of its class."""
    colors = [results.colors.get(pipe["class"] or "", UNPLANNED) for pipe in results.pipes]
    return [_cylinder(cylinder, color) for cylinder, color in zip(results.cylinders, colors, strict=True)]


def _cylinder(cylinder: Cylinder, color: Color) -> Any:
    mesh = o3d.geometry.TriangleMesh.create_cylinder(cylinder.radius, cylinder.length, SIDES, 1)
    turn, _ = Rotation.align_vectors([cylinder.axis], [[0.0, 0.0, 1.0]])
    mesh.rotate(turn.as_matrix(), center=np.zeros(3))
    mesh.translate(0.5 * (cylinder.start + cylinder.end))
    mesh.paint_uniform_color(color)
    mesh.compute_vertex_normals()
    return mesh


def _on_pipes(points: FloatArray, cylinders: Sequence[Cylinder]) -> NDArray[np.bool_]:
    """Which points (N,) would hide the pipes: those on and in them."""
    hiding = np.zeros(len(points), bool)
    for cylinder in cylinders:
        relative = points - cylinder.start
        along = relative @ cylinder.axis
        off_axis = np.einsum("ij,ij->i", relative, relative) - along**2
        hiding |= (along > -LIFT) & (along < cylinder.length + LIFT) & (off_axis < (cylinder.radius + LIFT) ** 2)
    return hiding


def _point_cloud(results: Results, chosen: NDArray[np.bool_]) -> Any:
    assert results.cloud is not None
    rows = np.flatnonzero(chosen)[:: -(-len(chosen) // MOST_POINTS)]
    points, colors = results.points, results.cloud.colors
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[rows]))
    if colors is None:
        cloud.paint_uniform_color((0.6, 0.6, 0.6))
    else:
        cloud.colors = o3d.utility.Vector3dVector(colors[rows] / 255.0)
    return cloud


def _cameras(map_from_camera: FloatArray) -> Any:
    """The keyframes as pyramids that open the way they look, joined in the order of time."""
    corners = map_from_camera[:, None, :3, :3] @ (FRUSTUM * _CORNERS)[None, :, :, None]
    places = corners[..., 0] + map_from_camera[:, None, :3, 3]
    first = len(_CORNERS) * np.arange(len(places))
    edges = (first[:, None, None] + _EDGES).reshape(-1, 2)
    way = np.stack([first[:-1], first[1:]], axis=1)
    lines = o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(places.reshape(-1, 3)), o3d.utility.Vector2iVector(np.concatenate([edges, way]))
    )
    lines.paint_uniform_color(_CAMERA_COLOR)
    return lines
