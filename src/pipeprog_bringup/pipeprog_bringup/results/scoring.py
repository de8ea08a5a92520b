# SPDX-License-Identifier: Apache-2.0
"""Score a result against ground truth: found, classified, radius (Eq. 4), length (Eq. 5), scale, trajectory.

Equations of Maalek, Lichti & Maalek; Eq. 4 is taken with the square that the paper's print lacks. A pipe is found by
the one-to-one match of its axis; its radius and its class play no part in that, so detection and classification are
scored apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from pipeprog_bringup.results.scored_files import Result, Segment, Truth, read_result, read_truth
from pipeprog_bringup.results.truth_alignment import Alignment, aligned
from pipeprog_camera.arrays import FloatArray

# When a detection is a pipe of the truth: axes nearer than the larger of the radius and 20 mm, angle under 3 degrees,
# the common stretch over half of either length.
AXIS_DISTANCE_MIN = 0.02
ANGLE_MAX = np.radians(3.0)
OVERLAP_MIN = 0.5
# A cylinder to be ignored is a stub, whose direction nobody can measure as well as that of a pipe.
IGNORE_ANGLE_MAX = np.radians(15.0)
# A true radius belongs to the class within the tolerance of manufacture (1 % of the diameter, EN 10255).
CLASS_TOLERANCE = 0.01
# Of Gaussian errors 99.7 % lie within this many standard deviations.
SIGMAS = 3.0


def score_files(pipes_json: Path, truth_json: Path) -> dict[str, Any]:
    """Score `pipes_json`, aligned by the trajectory.tum and frames.csv beside it (identity where there is none).

    The folder of these files may be given in place of `pipes_json`. Frames correspond by their stamps, and by their
    number where the truth has none of these stamps: row i of frames.csv is then the truth's pose i. Raises InputError
    where a file cannot be read or the trajectory cannot be laid onto the truth.
    """
    if pipes_json.is_dir():
        pipes_json /= "pipes.json"
    result, truth = read_result(pipes_json), read_truth(truth_json)
    trajectory_file = pipes_json.parent / "trajectory.tum"
    trajectory = None
    if trajectory_file.exists() and len(truth.world_from_camera):
        trajectory = aligned(trajectory_file, truth_json)
    return score(result, truth, trajectory)


def score(result: Result, truth: Truth, trajectory: Alignment | None = None) -> dict[str, Any]:
    """All figures as plain numbers, strings and lists; None where there is nothing to take a figure of.

    `detection` counts every detection; in `planned` only those with a class count, so a cylinder that was left without
    a class is not a false one there; in `classification` a match counts only with the right class. `confusion` counts
    true classes (rows) against found ones (columns): its labels are the classes, "unplanned" for a pipe of no planned
    class, and "none" for what is not there (a missed pipe's column, a false one's row).
    """
    world_from_map = np.eye(4) if trajectory is None else trajectory.world_from_map
    found = [_moved(pipe, world_from_map) for pipe in result.pipes]
    matches = match(found, truth.pipes)
    unmatched = [i for i in range(len(found)) if i not in matches]
    ignored = {i for i in unmatched if _is_ignored(found[i], truth.ignore)}
    false = [i for i in unmatched if i not in ignored]
    true_classes = [_class_of(pipe.radius, result.class_radii) for pipe in truth.pipes]
    planned = [i for i in matches if found[i].class_name is not None]
    right = [i for i in planned if found[i].class_name in true_classes[matches[i]]]
    false_planned = sum(found[i].class_name is not None for i in false)
    of_a_class = sum(bool(names) for names in true_classes)
    errors = [_errors(found[i], truth.pipes[j]) for i, j in sorted(matches.items(), key=lambda pair: pair[1])]
    return {
        "alignment": "identity" if trajectory is None else "trajectory",
        "detection": _rates(len(matches), len(false), len(truth.pipes) - len(matches)),
        "planned": _rates(len(planned), false_planned, len(truth.pipes) - len(planned)),
        "classification": {
            **_rates(len(right), len(planned) - len(right) + false_planned, of_a_class - len(right)),
            "right_of_matched": _ratio(len(right), len(matches)),
        },
        "confusion": _confusion(found, matches, false, true_classes, result.class_radii),
        "ignored": len(ignored),
        "radius": _radius_figures(errors),
        "length": _length_figures(errors, found, ignored, truth, result.class_radii, true_classes),
        "scale": {"error_percent": None if trajectory is None else 100 * trajectory.scale_error},
        "trajectory": None if trajectory is None else _trajectory_figures(trajectory),
        "pipes": errors,
        "missed": [pipe.id for j, pipe in enumerate(truth.pipes) if j not in matches.values()],
        "false": [found[i].id for i in false],
    }


def match(found: Sequence[Segment], truth: Sequence[Segment]) -> dict[int, int]:
    """The largest one-to-one matching {detection: true pipe}; of several the one that agrees best along the axes."""
    weights = np.zeros((len(found), len(truth)))
    limits = np.maximum([pipe.radius for pipe in truth], AXIS_DISTANCE_MIN)
    lengths = np.array([pipe.length for pipe in truth])
    for i, detection in enumerate(found):
        angles, distances, overlaps = relations(detection, truth)
        longer = np.maximum(lengths, detection.length)
        fits = (angles < ANGLE_MAX) & (distances < limits) & (overlaps > OVERLAP_MIN * longer)
        # Agreement lies in (0, 2): with 4 for each match, two matches always outweigh one that agrees better.
        weights[i] = np.where(fits, 4 + overlaps / longer + 1 - distances / limits, 0.0)
    rows, columns = linear_sum_assignment(-weights)
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if weights[i, j] > 0}


def relations(detection: Segment, pipes: Sequence[Segment]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each pipe (N,): angle between the axes [rad], distance amid the common stretch [m], length of that [m]."""
    starts, ends = (np.array([getattr(pipe, end) for pipe in pipes]).reshape(-1, 3) for end in ("start", "end"))
    lengths = np.linalg.norm(ends - starts, axis=1)
    axes = (ends - starts) / lengths[:, None]
    direction = (detection.end - detection.start) / np.linalg.norm(detection.end - detection.start)
    angles = np.arctan2(np.linalg.norm(np.cross(axes, direction), axis=1), np.abs(axes @ direction))
    stretches = np.stack([((end - starts) * axes).sum(1) for end in (detection.start, detection.end)])
    low, high = np.maximum(stretches.min(0), 0.0), np.minimum(stretches.max(0), lengths)
    middles = starts + axes * (low + high)[:, None] / 2
    distances = np.linalg.norm(np.cross(middles - detection.start, direction), axis=1)
    return angles, distances, np.maximum(high - low, 0.0)


def _moved(pipe: Segment, world_from_map: FloatArray) -> Segment:
    rotation, shift = world_from_map[:3, :3], world_from_map[:3, 3]
    return replace(pipe, start=rotation @ pipe.start + shift, end=rotation @ pipe.end + shift)


def _is_ignored(detection: Segment, ignore: Sequence[Segment]) -> bool:
    angles, distances, overlaps = relations(detection, ignore)
    near = distances < np.maximum([other.radius for other in ignore], AXIS_DISTANCE_MIN)
    common = overlaps > OVERLAP_MIN * np.minimum([other.length for other in ignore], detection.length)
    return bool(((angles < IGNORE_ANGLE_MAX) & near & common).any())


def _class_of(radius: float, class_radii: dict[str, float]) -> list[str]:
    """Classes that a true radius belongs to: none, one, or those that share it."""
    if not class_radii:
        return []
    nearest = min(abs(planned - radius) for planned in class_radii.values())
    if nearest > CLASS_TOLERANCE * radius:
        return []
    return [name for name, planned in class_radii.items() if abs(planned - radius) <= nearest + 1e-9]


def _errors(detection: Segment, pipe: Segment) -> dict[str, Any]:
    (angle,), (distance,), _ = relations(detection, [pipe])
    return {
        "id": detection.id,
        "truth": pipe.id,
        "class": detection.class_name,
        "true_radius": pipe.radius,
        "true_length": pipe.length,
        "radius_error_mm": 1e3 * (detection.radius - pipe.radius),
        "radius_error_sigmas": _normalised(detection.radius - pipe.radius, detection.radius_sigma),
        "length_error_percent": 100 * (detection.length - pipe.length) / pipe.length,
        "length_error_sigmas": _normalised(detection.length - pipe.length, detection.length_sigma),
        "axis_distance_mm": 1e3 * float(distance),
        "angle_deg": float(np.degrees(angle)),
    }


def _normalised(error: float, sigma: float | None) -> float | None:
    """An error in standard deviations, None where there is none."""
    return error / sigma if sigma else None


def _within(errors: list[dict[str, Any]], key: str) -> float | None:
    """Share of the errors within `SIGMAS` standard deviations, None where no sigma is known."""
    values = [abs(e[key]) for e in errors if e[key] is not None]
    return _ratio(sum(value <= SIGMAS for value in values), len(values))


def _confusion(
    found: Sequence[Segment],
    matches: dict[int, int],
    false: Sequence[int],
    true_classes: Sequence[list[str]],
    class_names: Iterable[str],
) -> dict[str, Any]:
    """Labels, and counts of true classes (rows) against found ones (columns)."""
    from sklearn.metrics import confusion_matrix  # here, since its import takes a second

    labels = [*class_names, "unplanned", "none"]
    unplanned, none = len(labels) - 2, len(labels) - 1
    found_as = [unplanned if pipe.class_name is None else labels.index(pipe.class_name) for pipe in found]
    match_of = {j: i for i, j in matches.items()}
    pairs = [(none, found_as[i]) for i in false]
    for j, names in enumerate(true_classes):
        label = found_as[match_of[j]] if j in match_of else none
        # Where several classes share the true radius, the found one is right if it is among them.
        candidates = [labels.index(name) for name in names] or [unplanned]
        pairs.append((label if label in candidates else candidates[0], label))
    true, predicted = zip(*pairs, strict=True) if pairs else ((), ())
    matrix = confusion_matrix(true, predicted, labels=range(len(labels)))
    return {"labels": labels, "matrix": matrix.tolist()}


def _rates(true: int, false: int, missed: int) -> dict[str, Any]:
    return {
        "true_positives": true,
        "false_positives": false,
        "false_negatives": missed,
        "precision": _ratio(true, true + false),
        "recall": _ratio(true, true + missed),
        "f_measure": _ratio(2 * true, 2 * true + false + missed),
        "accuracy": _ratio(true, true + false + missed),
    }


def _ratio(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _radius_figures(errors: list[dict[str, Any]]) -> dict[str, Any]:
    by_radius = {radius: [e for e in errors if e["true_radius"] == radius] for radius in _radii(errors)}
    figures = [
        {"radius_mm": 1e3 * radius, "pipes": len(group), "rmse_mm": _rms([e["radius_error_mm"] for e in group])}
        for radius, group in by_radius.items()
    ]
    values = [e["radius_error_mm"] for e in errors]
    bias = float(np.mean(values)) if values else None
    return {
        "rmse_mm": _rms(values) if values else None,
        "bias_mm": bias,
        "within_3_sigma": _within(errors, "radius_error_sigmas"),
        "per_class": figures,
    }


def _length_figures(
    errors: list[dict[str, Any]],
    found: list[Segment],
    ignored: set[int],
    truth: Truth,
    class_radii: dict[str, float],
    true_classes: list[list[str]],
) -> dict[str, Any]:
    """Mean absolute error a pipe (Eq. 5), and for each class the metres found against the true ones."""
    per_class = []
    for name in class_radii:
        true = sum(pipe.length for pipe, names in zip(truth.pipes, true_classes, strict=True) if name in names)
        measured = sum(pipe.length for i, pipe in enumerate(found) if pipe.class_name == name and i not in ignored)
        error = 100 * (measured - true) / true if true else None
        per_class.append({"class": name, "true_m": true, "measured_m": measured, "error_percent": error})
    values = [abs(e["length_error_percent"]) for e in errors]
    return {
        "mean_error_percent": float(np.mean(values)) if values else None,
        "within_3_sigma": _within(errors, "length_error_sigmas"),
        "per_class": per_class,
    }


def _trajectory_figures(trajectory: Alignment) -> dict[str, Any]:
    return {
        "poses": trajectory.poses,
        "rms_rigid_mm": 1e3 * trajectory.rms_rigid,
        "rms_similarity_mm": 1e3 * trajectory.rms_similarity,
        "max_similarity_mm": 1e3 * trajectory.max_similarity,
    }


def _radii(errors: list[dict[str, Any]]) -> list[float]:
    return sorted({e["true_radius"] for e in errors})


def _rms(values: Sequence[float] | FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
