# SPDX-License-Identifier: Apache-2.0
"""`pipeprog view`: a results folder in a window, as a picture, or its pipes as a mesh, by Open3D.

Open3D works in a child process: where graphics libraries or a display are missing it may end its process, which must
not end the command without a word.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from pipeprog_bringup.report.render import ColoredPipe, two_sides
from pipeprog_bringup.results.atomic_output import output_file
from pipeprog_bringup.results.results_reader import UNPLANNED, Results, read_results
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.errors import InputError

IMAGE_SIZE = 1600, 1000  # pixels
IMAGE_FORMATS, MESH_FORMATS = (".png", ".jpg"), (".glb", ".ply", ".obj")
FIELD_OF_VIEW = 45.0  # degrees, vertical
FEW_SECONDS = 120.0  # for a picture or a mesh: software rendering takes ten at most
_INSTALL = (
    "`pip install open3d-cpu==0.19.0` (or `make setup VIEW=1`; CPython up to 3.12 on x86-64, elsewhere open3d==0.19.0) "
    "and, on Debian or Ubuntu, `apt-get install libgl1 libegl1 libx11-6 libgomp1 libgl1-mesa-dri`"
)
# glTF has y up, `map` has z up.
_GLTF_FROM_MAP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def show(folder: Path) -> None:
    """Opens a window on a results folder and returns when it is closed; InputError where no window can be had."""
    results = read_results(folder)
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "there is no display here (DISPLAY is not set): write a picture with --image FILE.png, "
            f"or copy {folder} to a machine with one and view it there"
        )
    _in_child(_show, results, None, None)


def write_image(folder: Path, path: Path, force: bool) -> None:
    """Renders a results folder into a .png or .jpg, without a display; raises InputError where that cannot be done."""
    _write(_render, folder, path, IMAGE_FORMATS, force)


def write_mesh(folder: Path, path: Path, force: bool) -> None:
    """Writes the pipes as closed cylinders in the colours of their classes, in metres.

    A .ply or .obj keeps the frame `map`, z up; a .glb has y up, as glTF demands. Raises InputError where there are no
    pipes or the file cannot be written.
    """
    _write(_mesh, folder, path, MESH_FORMATS, force)


Task = Callable[[Results, "Path | None"], None]


def _write(task: Task, folder: Path, path: Path, formats: tuple[str, ...], force: bool) -> None:
    if path.suffix.lower() not in formats:
        raise InputError(f"{path}: '{path.suffix}' is no format to write: use one of {', '.join(formats)}")
    results = read_results(folder)
    with output_file(path, force) as temporary:
        _in_child(task, results, temporary, FEW_SECONDS)


def _in_child(task: Task, results: Results, path: Path | None, seconds: float | None) -> None:
    """Runs `task` in a process of its own; InputError with what it said where it fails, ends or takes too long."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with tempfile.NamedTemporaryFile(suffix=".log") as log:
        child = context.Process(target=_serve, args=(task, results, path, theirs, log.name), daemon=True)
        child.start()
        theirs.close()
        try:
            problem = ours.recv() if ours.poll(seconds) else f"it took more than {seconds:.0f} s"
        except EOFError:
            child.join()
            said = Path(log.name).read_text(errors="replace").strip().splitlines()
            problem = f"its process ended with code {child.exitcode}: {' / '.join(said[-3:]) or 'without a word'}"
        finally:
            child.terminate()
            child.join()
    if problem:
        raise InputError(f"Open3D cannot draw here: {problem}. It needs {_INSTALL}")


def _serve(task: Task, results: Results, path: Path | None, connection: Connection, log: str) -> None:
    """The child: answers with what is wrong, or with an empty text."""
    # What the graphics libraries print is of use only where they fail.
    descriptor = os.open(log, os.O_WRONLY)
    os.dup2(descriptor, sys.stdout.fileno())
    os.dup2(descriptor, sys.stderr.fileno())
    try:
        task(results, path)
    # Missing Python packages, libraries and displays come as one of these.
    except (ImportError, OSError, RuntimeError) as error:
        connection.send(f"{error}".strip() or type(error).__name__)
    else:
        connection.send("")


def _show(results: Results, _: Path | None) -> None:
    from pipeprog_bringup.view.scene import layers, o3d

    def label(window: object) -> None:
        for pipe, cylinder in zip(results.pipes, results.cylinders, strict=True):
            text = f"{pipe['id']} {pipe['class'] or '?'}"
            window.add_3d_label(0.5 * (cylinder.start + cylinder.end), text)  # type: ignore[attr-defined]

    eye, centre = _standpoint(results)
    o3d.visualization.draw(
        [{"name": each.name, "geometry": each.geometry, "is_visible": each.visible} for each in layers(results)],
        title=f"pipeprog: {results.folder}",
        width=IMAGE_SIZE[0],
        height=IMAGE_SIZE[1],
        eye=eye,
        lookat=centre,
        up=[0.0, 0.0, 1.0],
        field_of_view=FIELD_OF_VIEW,
        show_skybox=False,
        show_ui=True,
        point_size=2,
        on_init=label,
    )


def _render(results: Results, path: Path | None) -> None:
    # Mesa then renders in memory, whether or not there is a display.
    os.environ.pop("DISPLAY", None)
    os.environ.setdefault("EGL_PLATFORM", "surfaceless")
    from pipeprog_bringup.view.scene import layers, o3d

    rendering = o3d.visualization.rendering
    renderer = rendering.OffscreenRenderer(*IMAGE_SIZE)
    renderer.scene.set_background([1.0, 1.0, 1.0, 1.0])
    for each in (each for each in layers(results) if each.visible):
        material = rendering.MaterialRecord()
        material.shader = each.shader
        material.point_size = 2.0
        material.line_width = 1.5
        renderer.scene.add_geometry(each.name, each.geometry, material)
    eye, centre = _standpoint(results)
    renderer.setup_camera(FIELD_OF_VIEW, centre, eye, [0.0, 0.0, 1.0])
    if not o3d.io.write_image(str(path), renderer.render_to_image()):
        raise RuntimeError("the picture could not be written")


def _mesh(results: Results, path: Path | None) -> None:
    from pipeprog_bringup.view.scene import o3d, pipe_meshes

    if not results.pipes:
        raise RuntimeError("the results hold no pipe")
    whole = o3d.geometry.TriangleMesh()
    for mesh in pipe_meshes(results):
        whole += mesh
    if path is not None and path.suffix.lower() == ".glb":
        whole.rotate(_GLTF_FROM_MAP, center=np.zeros(3))
        colors = np.asarray(whole.vertex_colors) ** 2.2  # glTF wants linear light
        whole.vertex_colors = o3d.utility.Vector3dVector(colors)
    if not o3d.io.write_triangle_mesh(str(path), whole):
        raise RuntimeError("the mesh could not be written")


def _standpoint(results: Results) -> tuple[FloatArray, FloatArray]:
    """Where to look from and to, (3,) [m] each: all pipes are seen, with the fewest points before them."""
    cylinders = results.cylinders
    pipes = [ColoredPipe(cylinder, UNPLANNED, "") for cylinder in cylinders]
    ends = np.array([end for cylinder in cylinders for end in (cylinder.start, cylinder.end)])
    shown = ends if len(ends) else results.points
    if not len(shown):
        return np.array([0.0, -3.0, 1.5]), np.zeros(3)
    centre = 0.5 * (shown.min(axis=0) + shown.max(axis=0))
    reach = max(float(np.linalg.norm(shown - centre, axis=1).max()), 0.5)
    towards_eye = two_sides(results.points, pipes)[0]
    return centre + towards_eye / np.linalg.norm(towards_eye) * reach / np.tan(np.radians(0.45 * FIELD_OF_VIEW)), centre
