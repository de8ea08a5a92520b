# SPDX-License-Identifier: Apache-2.0
"""GLB (binary glTF 2.0): each pipe as a closed cylinder in the colour of its class, with its id and what was measured.

All pipes share one cylinder of radius 1 and length 1, which each node stretches to its own size.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeprog_bringup.export.survey import Survey, SurveyPipe, along_axis
from pipeprog_bringup.results.results_reader import UNPLANNED
from pipeprog_camera.errors import InputError

_SIDES = 64  # flat sides: each lies 0.12 % of the radius inside the circle at most
_GAMMA = 2.2  # glTF wants linear light
_FLOAT, _SHORT, _VERTICES, _INDICES = 5126, 5123, 34962, 34963
# glTF has y up, the map z: a quarter turn about x (quaternion x y z w).
_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


def write_glb(survey: Survey, path: Path) -> None:
    """Writes the pipes [m]; whole hundreds of metres are taken off far coordinates, and `origin` tells them.

    Raises InputError where there is no pipe.
    """
    if not survey.pipes:
        raise InputError(f"{survey.results.folder} holds no pipe: there is nothing to write as GLB")
    vertices, normals, triangles = _cylinder()
    parts = [part.tobytes() for part in (vertices, normals, triangles)]
    offsets = np.cumsum([0, *map(len, parts)])
    names = list(dict.fromkeys(pipe.class_name for pipe in survey.pipes))
    content = {
        "asset": {"version": "2.0", "generator": "pipeprog"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {
                "name": "survey",
                "rotation": _Y_UP,
                "children": list(range(1, len(survey.pipes) + 1)),
                "extras": {"origin": [float(value) for value in survey.site.origin], "crs": survey.site.crs},
            },
            *(_node(survey, pipe, names.index(pipe.class_name)) for pipe in survey.pipes),
        ],
        "materials": [_material(survey, name) for name in names],
        "meshes": [
            {
                "name": name,
                "primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": 2, "material": number}],
            }
            for number, name in enumerate(names)
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(vertices),
                "type": "VEC3",
                "min": vertices.min(axis=0).tolist(),
                "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": len(normals), "type": "VEC3"},
            {"bufferView": 2, "componentType": _SHORT, "count": triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(offset), "byteLength": len(part), "target": target}
            for part, offset, target in zip(parts, offsets, (_VERTICES, _VERTICES, _INDICES), strict=False)
        ],
        "buffers": [{"byteLength": int(offsets[-1])}],
    }
    path.write_bytes(_container(json.dumps(content, allow_nan=False).encode(), b"".join(parts)))


def _cylinder() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint16]]:
    """Vertices and normals (V, 3) and triangles (T, 3) of a closed cylinder of radius 1 along z from 0 to 1."""
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    circle = np.c_[np.cos(angles), np.sin(angles), np.zeros(_SIDES)]
    top = circle + np.array([0.0, 0.0, 1.0])
    down, up = np.tile([0.0, 0.0, -1.0], (_SIDES, 1)), np.tile([0.0, 0.0, 1.0], (_SIDES, 1))
    vertices, normals = np.concatenate([circle, top, circle, top]), np.concatenate([circle, circle, down, up])
    here, after = np.arange(_SIDES), np.roll(np.arange(_SIDES), -1)
    fan = np.arange(1, _SIDES - 1)
    first = np.zeros_like(fan)
    triangles = np.concatenate(
        [
            np.c_[here, after, after + _SIDES],
            np.c_[here, after + _SIDES, here + _SIDES],
            np.c_[first, fan + 1, fan] + 2 * _SIDES,
            np.c_[first, fan, fan + 1] + 3 * _SIDES,
        ]
    )
    return vertices.astype(np.float32), normals.astype(np.float32), triangles.astype(np.uint16)


def _node(survey: Survey, pipe: SurveyPipe, mesh: int) -> dict[str, Any]:
    matrix = along_axis(pipe.cylinder, survey.site.origin)
    matrix[:3, :3] *= [pipe.cylinder.radius, pipe.cylinder.radius, pipe.cylinder.length]
    extras = {key: value for key, value in pipe.row.items() if key not in ("start", "end")}
    return {"name": pipe.id, "mesh": mesh, "matrix": matrix.T.ravel().tolist(), "extras": extras}


def _material(survey: Survey, class_name: str) -> dict[str, Any]:
    color = survey.results.colors.get(class_name, UNPLANNED)
    factor = [round(float(part) ** _GAMMA, 6) for part in color]
    return {
        "name": class_name or "unplanned",
        "pbrMetallicRoughness": {"baseColorFactor": [*factor, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.6},
    }


def _container(text: bytes, data: bytes) -> bytes:
    """The two chunks behind the header of a GLB; each is filled up to a multiple of four bytes."""
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = b"".join(
        struct.pack("<II", len(part), kind) + part for part, kind in ((text, 0x4E4F534A), (data, 0x004E4942))
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
