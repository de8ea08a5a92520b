# SPDX-License-Identifier: Apache-2.0
"""What each stage brings: the labs measured whole, and with one stage left out at a time.

    .venv/bin/python -m benchmarks.ablations [--seeds 1 2 3] [--size 720p]

Starts from the surveys of benchmarks.experiments (ours, 85 % overlap), which are made where they are missing. Detection
without a stage works on the same map and keyframes, the scale without the correction for eccentricity on the same
poses; without feedback the map is made anew from the frames that the selector chose by itself. Stages that cannot be
switched off are replaced while the program runs. Deblurring is measured through the graph, on a recording that needs
it. What is measured is kept in out/surveys. Writes results/ablations.json.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.board_views import tracked
from benchmarks.experiments import Case
from benchmarks.recordings import Recording, named, site
from benchmarks.survey import RESULTS, RUNS, attempt, commit
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.results.cloud_io import read_cloud
from pipeprog_bringup.results.result_files import read_trajectory
from pipeprog_bringup.results.scored_files import Result, Segment, read_truth
from pipeprog_bringup.results.scoring import score
from pipeprog_bringup.results.truth_alignment import align
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.config import DetectConfig
from pipeprog_detect.detector import detect
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_detect.product.boq import load_boq
from pipeprog_detect.types import Cloud, Pipe, View
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_frames.policy.selector import FrameSelector
from pipeprog_sfm.boards.board_file import load_board_file
from pipeprog_sfm.config import SfmConfig
from pipeprog_sfm.reconstruction import Reconstruction

Figures = dict[str, Any]

BLURRED = "lab:41:size=480p:seconds=8:exposure-ms=8:allow-hidden"
EXPOSURE = 0.008  # s


@dataclass(frozen=True)
class Stage:
    """How detection goes without a stage: other settings, or functions replaced by what `patches` make of them."""

    config: DetectConfig = field(default_factory=DetectConfig)
    patches: tuple[tuple[str, Callable[..., Any]], ...] = ()


def _all_points(points: FloatArray, *_: Any) -> FloatArray:
    return points


def _no_end(*_: Any, **__: Any) -> None:
    return None


# What the normals let through: the sector of the circumference whose normals voted for the pipe.
NO_GATE = (("pipeprog_detect.cloud.candidate._facing", _all_points),)
CLOUD_ALONE = replace(DetectConfig(), contour=replace(DetectConfig().contour, enabled=False))
STAGES = {
    "all stages": Stage(),
    "without the normal gate": Stage(patches=NO_GATE),
    "without contours (cloud alone)": Stage(CLOUD_ALONE),
    "without contours and the normal gate": Stage(CLOUD_ALONE, NO_GATE),
    "without rims": Stage(patches=(("pipeprog_detect.refinement.pipe_ends.find_end", _no_end),)),
    "without the posterior (k-means)": Stage(replace(DetectConfig(), classifier="kmeans")),
}
ECCENTRICITY, FEEDBACK = "without the correction for eccentricity", "without feedback"
BLUR = {"blurred, all stages": (f"sfm.deblur.exposure={EXPOSURE}",), "blurred, without deblurring": ()}


@dataclass(frozen=True)
class Map:
    """What detection works on: cloud, and the poses map_from_camera (M, 4, 4) of the stamps (M,) [ns]."""

    cloud: Cloud
    stamps: NDArray[np.int64]
    map_from_camera: FloatArray


class Footage:
    """A recording's frames by stamp, its camera, bill of quantities and truth."""

    def __init__(self, recording: Recording) -> None:
        bag = Bag.open(recording.bag)
        self.camera: Camera = bag.camera
        self.encoded = {frame.stamp: bytes(deserialize_message(frame.data, CompressedImage).data) for frame in bag}
        self.boq = load_boq(recording.beside("boq.yaml"))
        self.board_file = load_board_file(recording.beside("board.yaml"))
        self.truth = read_truth(recording.beside("truth.json"))

    def figures(self, found: list[Pipe], taken: Map, factor: float = 1.0) -> Figures:
        """The score of pipes in a map; all lengths times `factor`."""
        number = {stamp: index for index, stamp in enumerate(sorted(self.encoded))}
        poses = taken.map_from_camera.copy()
        poses[:, :3, 3] *= factor
        rows = [number[stamp] for stamp in taken.stamps.tolist()]
        classes = {planned.name: planned.outer_radius for planned in self.boq.classes}
        pipes = tuple(_segment(pipe, factor) for pipe in found)
        result = score(Result(pipes, classes), self.truth, align(poses, self.truth.world_from_camera[rows]))
        return {
            "keyframes": len(rows),
            **{kind: result["classification"][kind] for kind in COUNTS},
            "radius_errors_mm": [pipe["radius_error_mm"] for pipe in result["pipes"]],
            "length_errors_percent": [pipe["length_error_percent"] for pipe in result["pipes"]],
            "scale_percent": result["scale"]["error_percent"],
        }

    def views(self, taken: Map) -> list[View]:
        """The keyframes of a map, with their poses there."""
        store = Keyframes()
        views = []
        for stamp, pose in zip(taken.stamps.tolist(), taken.map_from_camera, strict=True):
            store.add(stamp, self.encoded[stamp], self.camera)
            views.append(store.view(stamp, pose))
        return views

    def detect(self, taken: Map, config: DetectConfig) -> list[Pipe]:
        """The pipes of a map, with its keyframes."""
        return detect(taken.cloud, self.boq, config, self.views(taken))

    def chosen(self) -> list[int]:
        """The stamps of the frames that the selector takes when nobody answers it."""
        selector = FrameSelector(FramesConfig(), self.camera)
        decisions = []
        for stamp, data in self.encoded.items():
            decisions += selector.consider(stamp, partial(decode_reduced, data, self.camera.width))
        decisions += selector.flush()
        return sorted(decision.stamp for decision in decisions if decision.chosen)

    def map_of(self, stamps: list[int]) -> Map:
        """The map that these keyframes make."""
        reconstruction = Reconstruction(SfmConfig(), self.board_file)
        for stamp in stamps:
            reconstruction.add(stamp, self.encoded[stamp], self.camera)
        made = reconstruction.finish()
        cloud = Cloud(made.cloud.points.astype(float), made.cloud.normals.astype(float))
        return Map(cloud, made.trajectory.stamps, made.trajectory.map_from_camera)


COUNTS = ("true_positives", "false_positives", "false_negatives")


def main() -> None:
    """Measure what has not been measured, and write the table after each recording."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ablations", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--size", default="720p")
    arguments = parser.parse_args()
    known: dict[str, list[Figures]] = {}
    for seed in arguments.seeds:
        case = Case("lab", site("lab", seed, f"--size={arguments.size}"), "ours", 0.85)
        if case.known() is None:
            case.measure()
        for stage, figures in _without_each(case).items():
            known.setdefault(stage, []).append(figures)
            print(stage, _row(stage, known[stage]), flush=True)
        _write(known)
    for stage, settings in BLUR.items():
        figures = attempt(named(BLURRED), settings, f"{named(BLURRED).name}_{'deblurred' if settings else 'plain'}")
        known[stage] = [_of_survey(figures)]
    _write(known)


def _without_each(case: Case) -> dict[str, Figures]:
    """The figures of every stage's absence on one survey, each kept as it is known."""
    kept = RUNS / f"ablations_{case.name}.json"
    known: dict[str, Figures] = json.loads(kept.read_text()) if kept.exists() else {}
    footage = Footage(case.recording)
    run = RUNS / case.name
    stamps, poses = read_trajectory(run / "trajectory.tum")
    whole = Map(read_cloud(run / "cloud.ply").cloud, stamps, poses)
    for stage in (*STAGES, ECCENTRICITY, FEEDBACK):
        if stage in known:
            continue
        if stage in STAGES:
            with _patched(STAGES[stage]):
                figures = footage.figures(footage.detect(whole, STAGES[stage].config), whole)
        elif stage == ECCENTRICITY:
            found = footage.detect(whole, DetectConfig())
            figures = footage.figures(found, whole, _factor(run, case.recording))
        else:
            alone = footage.map_of(footage.chosen())
            figures = footage.figures(footage.detect(alone, DetectConfig()), alone)
        known[stage] = {"commit": commit(), **figures}
        kept.write_text(json.dumps(known, indent=1) + "\n")
    return known


@contextlib.contextmanager
def _patched(stage: Stage) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for place, substitute in stage.patches:
            stack.enter_context(patch(place, substitute))
        yield


def _factor(run: Path, recording: Recording) -> float:
    """Lengths by circle centres as imaged, over those by corrected ones."""
    scales = []
    for corrected in (False, True):
        tracker, poses = tracked(run, recording.beside("board.yaml"), corrected)
        scales.append(tracker.estimate(poses).scale)
    return float(scales[0] / scales[1])


def _segment(pipe: Pipe, factor: float) -> Segment:
    cylinder = pipe.cylinder
    start, end = factor * cylinder.start, factor * cylinder.end
    return Segment(start, end, factor * cylinder.radius, factor * cylinder.length, pipe.id, pipe.class_name)


def _of_survey(figures: Figures) -> Figures:
    """A kept survey's figures as those of this benchmark."""
    result = figures["score"]
    return {
        "commit": figures["commit"],
        "keyframes": figures["keyframes"],
        **{kind: result["classification"][kind] for kind in COUNTS},
        "radius_errors_mm": [pipe["radius_error_mm"] for pipe in result["pipes"]],
        "length_errors_percent": [pipe["length_error_percent"] for pipe in result["pipes"]],
        "scale_percent": result["scale"]["error_percent"],
    }


def _row(stage: str, all_figures: list[Figures]) -> dict[str, Any]:
    """One line of the table, over all recordings."""
    true, false, missed = (sum(figures[kind] for figures in all_figures) for kind in COUNTS)
    radius = np.concatenate([figures["radius_errors_mm"] for figures in all_figures])
    length = np.abs(np.concatenate([figures["length_errors_percent"] for figures in all_figures]))
    return {
        "stage": stage,
        "sites": len(all_figures),
        "keyframes": sum(figures["keyframes"] for figures in all_figures),
        "right class": f"{true} of {true + missed}",
        "false": false,
        "F": round(2 * true / (2 * true + false + missed), 3),
        "radius RMSE [mm]": round(float(np.sqrt(np.mean(radius**2))), 3),
        "worst radius [mm]": round(float(np.abs(radius).max()), 2),
        "length error [%]": round(float(length.mean()), 2),
        "scale RMSE [%]": round(float(np.sqrt(np.mean([f["scale_percent"] ** 2 for f in all_figures]))), 4),
    }


def _write(known: dict[str, list[Figures]]) -> None:
    content = {
        "title": "What each stage brings: labs with one stage left out",
        "command": "python -m benchmarks.ablations",
        "commits": sorted({figures["commit"] for group in known.values() for figures in group}),
        "rows": [_row(stage, group) for stage, group in known.items()],
    }
    (RESULTS / "ablations.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
