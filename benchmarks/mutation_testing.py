# SPDX-License-Identifier: Apache-2.0
"""Mutation testing: each deliberate mistake below is put into the code at run time, and the tests must fail.

    .venv/bin/python -m benchmarks.mutation_testing

Writes results/mutation_testing.json: for each mutant the test that killed it. The file is a pytest plugin, too: a run
of the tests with MUTANT set works on the mutated code.
"""

from __future__ import annotations

import inspect
import json
import os
import pkgutil
import re
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from types import FunctionType

from benchmarks.recordings import ROOT
from benchmarks.survey import RESULTS

SURVIVED = "SURVIVED"


@dataclass(frozen=True)
class Mutant:
    """In the source of the function `place`, `original` (found once) becomes `mutated`; `tests` are asked first.

    Functions that numba has compiled cannot be changed this way: a mutant stands in the Python that calls them.
    """

    place: str
    original: str
    mutated: str
    tests: str


MUTANTS = {
    "frames: the last frame is dropped": Mutant(
        "pipeprog_frames.policy.selector.FrameSelector.flush",
        "return decisions + self._leave_window()",
        "return decisions",
        "frames/policy/test_selector.py",
    ),
    "frames: the first frame between two for the sharpest": Mutant(
        "pipeprog_frames.incoming.frame_buffer.FrameStore.sharpest_between",
        "max(sharp, key=lambda stamp: sharp[stamp], default=None)",
        "min(sharp, default=None)",
        "frames/incoming/test_frame_buffer.py",
    ),
    "sparse: half a pixel between COLMAP and ROS": Mutant(
        "pipeprog_sfm.sparse.colmap._pixels", " + HALF_PIXEL", "", "sfm/sparse/test_colmap.py"
    ),
    "boards: eccentricity of the circles left in": Mutant(
        "pipeprog_sfm.boards.placed_board.PosedCamera.rows",
        "if not self.eccentricity:",
        "if True:",
        "sfm/boards/test_scale_bar.py",
    ),
    "boards: chi square of one degree of freedom for three": Mutant(
        "pipeprog_sfm.boards.board_check.contradiction",
        "chdtri(3, FALSE_ALARM)",
        "chdtri(1, FALSE_ALARM)",
        "sfm/boards/test_board_check.py",
    ),
    "metric: rotation of the odometry transposed": Mutant(
        "pipeprog_sfm.metric.odometry._displacements",
        '"nji,nj->ni"',
        '"nij,nj->ni"',
        "sfm/metric/test_transform_tree.py",
    ),
    "metric: a sigma that is not squared": Mutant(
        "pipeprog_sfm.metric.scale.combine", "np.diag([one.sigma**2", "np.diag([one.sigma", "sfm/metric/test_scale.py"
    ),
    "metric: a map that is a mirror image": Mutant(
        "pipeprog_sfm.metric.map_frame.map_from_model", "np.cross(up, x)", "np.cross(x, up)", "sfm/metric/test_scale.py"
    ),
    "dense: half a pixel in the reduced images": Mutant(
        "pipeprog_camera.camera.Camera.scaled",
        "(self.cx + 0.5) * factor - 0.5",
        "self.cx * factor",
        "camera/test_camera.py",
    ),
    "dense: depths fused without the scale": Mutant(
        "pipeprog_sfm.dense.depth_fusion.Fusion.add",
        "depth_map.depth * np.float32(scale)",
        "depth_map.depth",
        "sfm/dense/test_depth_fusion.py",
    ),
    "cloud: no sector of the normals": Mutant(
        "pipeprog_detect.cloud.candidate._facing", "if sector is None:", "if True:", "detect/cloud/test_candidate.py"
    ),
    "silhouette: half a pixel in the projection": Mutant(
        "pipeprog_detect.silhouette.apparent_contour.project",
        "return pixel, depth",
        "return pixel + 0.5, depth",
        "detect/refinement/test_pipe_ends.py",
    ),
    "refinement: no end from rims": Mutant(
        "pipeprog_detect.refinement.pipe_ends.find_end",
        "    return End(*_refined(",
        "    return None and End(*_refined(",
        "detect/refinement/test_pipe_ends.py",
    ),
    "thin: the axis behind the nearest points by a diameter": Mutant(
        "pipeprog_detect.thin.depth_from_cloud.at_cloud_depth",
        "0.5 * cylinder.radius",
        "2.0 * cylinder.radius",
        "detect/thin/test_depth_from_cloud.py",
    ),
    "verification: ends of a pipe per metre in place of per length": Mutant(
        "pipeprog_detect.verification.wall_ends._goes_on",
        "rate = 1.0 / cylinder.length",
        "rate = cylinder.length",
        "detect/verification/test_wall_ends.py",
    ),
    "product: the sigma of a class not squared": Mutant(
        "pipeprog_detect.product.classification._posterior",
        "sigma**2 +",
        "sigma +",
        "detect/product/test_classification.py",
    ),
    "product: order of the k-means labels": Mutant(
        "pipeprog_detect.product.classification.by_kmeans",
        "[int(label) for label in labels]",
        "[len(nominal) - 1 - int(label) for label in labels]",
        "detect/product/test_classification.py",
    ),
    "product: radius for diameter": Mutant(
        "pipeprog_detect.product.boq._read_size",
        "return 0.5 * size.outer_diameter",
        "return size.outer_diameter",
        "detect/product/test_boq.py",
    ),
    "detector's node: no DELETEALL before the markers": Mutant(
        "pipeprog_detect.node.PipeOutput.publish",
        "[Marker(header=header, action=Marker.DELETEALL)]",
        "[]",
        "detect/test_node.py",
    ),
    "detector's node: stamp of the newest status on the pipes": Mutant(
        "pipeprog_node.received.maps.sfm_status",
        "checked_stamp(message.map_stamp)",
        "checked_stamp(message.header.stamp)",
        "detect/test_node.py",
    ),
    "node: latched topics are volatile": Mutant(
        "pipeprog_node.qos.latched", "kept(1)", "reliable(1)", "node/test_qos.py"
    ),
    "node: nanoseconds of a stamp dropped": Mutant(
        "pipeprog_node.messages.time_msg", "nanosec=stamp - sec * SECOND", "nanosec=0", "node/test_messages.py"
    ),
    "bringup: the mean of the errors for their root mean square": Mutant(
        "pipeprog_bringup.results.scoring._rms",
        "np.sqrt(np.mean(np.square(values)))",
        "np.mean(np.abs(values))",
        "bringup/results/test_scoring.py",
    ),
    "bringup: w before x in trajectory.tum": Mutant(
        "pipeprog_bringup.results.result_files.write_trajectory",
        "(*position, *quaternion)",
        "(*position, quaternion[3], *quaternion[:3])",
        "bringup/results/test_result_files.py",
    ),
    "bringup: metres in progress.csv's column of millimetres": Mutant(
        "pipeprog_bringup.results.result_files.write_progress",
        "1e3 * entry.outer_radius",
        "entry.outer_radius",
        "bringup/results/test_result_files.py",
    ),
    "bringup: a torn recording is not told": Mutant(
        "pipeprog_bringup.recording.mcap_file.McapFile.losses",
        "if self.torn_at is not None:",
        "if False:",
        "bringup/recording/test_bag.py",
    ),
}


def apply(mutant: Mutant) -> None:
    """Changes the function in place, for all who have imported it; ValueError where it is no longer what it was."""
    function = pkgutil.resolve_name(mutant.place)
    if not isinstance(function, FunctionType):
        raise ValueError(f"{mutant.place} is no function of Python")
    source = textwrap.dedent(inspect.getsource(function))
    if source.count(mutant.original) != 1:
        raise ValueError(f"{mutant.place} holds {mutant.original!r} {source.count(mutant.original)} times")
    namespace = dict(function.__globals__)
    exec("from __future__ import annotations\n" + source.replace(mutant.original, mutant.mutated), namespace)
    function.__code__ = namespace[function.__name__].__code__


def killed_by(name: str, tests: str) -> str:
    """The first test that fails on a mutant, "" if it survives `tests`, a path below tests/unit."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "benchmarks.mutation_testing", f"tests/unit/{tests}"]
    environment = {**os.environ, "MUTANT": name}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if failed is None and done.returncode != 0:
        raise RuntimeError(f"{name}: {done.stdout}{done.stderr}")
    return failed[1].rpartition("/")[2] if failed else ""


def main(names: list[str]) -> None:
    """Tries the mutants whose names begin as given, all where none is given; those alone are not written."""
    rows = []
    for name, mutant in MUTANTS.items():
        if names and not name.startswith(tuple(names)):
            continue
        killer = killed_by(name, mutant.tests) or killed_by(name, "") or SURVIVED
        rows.append({"mutant": name, "place": mutant.place, "killed by": killer})
        print(f"{name}: {killer}", flush=True)
    killed = sum(row["killed by"] != SURVIVED for row in rows)
    print(f"{killed} of {len(rows)} killed")
    if not names:
        content = {"title": "Mutation testing: deliberate mistakes, and the tests that notice them", "rows": rows}
        (RESULTS / "mutation_testing.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
elif "MUTANT" in os.environ:  # as a plugin, before any test is imported
    apply(MUTANTS[os.environ["MUTANT"]])
