# SPDX-License-Identifier: Apache-2.0
"""Which planned class a measured radius belongs to, or none; and how much of each class is installed."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.vq import kmeans2

from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.boq import BillOfQuantities
from pipeprog_detect.types import Pipe

# A pipe farther than this from every nominal radius, in standard deviations of measurement and make, is none of them.
_REJECT = 4.0
# Under this probability the class is ambiguous, and none is named.
SURE = 0.95
# Classes that the radius makes less likely than this are out of the question, whatever they look like.
_PLAUSIBLE = 0.001
# What is told of a look that was asked [probability], so that it differs from one that was not.
_LEAST = 1e-4
# A pipe that looks like one of the plausible classes' materials with less than this probability looks like none.
_LIKE_ONE = 0.2
# Steps of k-means; over radii of a site the labels settle in fewer than ten.
_KMEANS_STEPS = 100


@dataclass(frozen=True)
class ClassProgress:
    """Progress of one class: metres planned and installed, percent of the plan."""

    name: str
    outer_radius: float
    planned: float
    installed: float
    percent: float


@dataclass(frozen=True)
class Verdict:
    """Class of a pipe, or None; posterior of the most probable class, 0 where no class is near.

    Without a name and with a probability above 0 the measurement cannot tell two classes apart.
    """

    name: str | None
    probability: float


def classify(radius: float, sigma: float, boq: BillOfQuantities, concave: bool = False) -> Verdict:
    """Class of a pipe of `radius` +- `sigma` [m], whose inner surface it is where `concave`.

    Nominal radii stay fixed; the likelihood is Gaussian with the measurement's and the manufacturer's variance, the
    prior is even. A radius more than four standard deviations from every class has none, and one that two classes
    explain is not guessed.
    """
    posterior = _posterior(radius, sigma, boq, concave)
    best = int(np.argmax(posterior))
    if not posterior[best] > 0.0:
        return Verdict(None, 0.0)
    probability = float(posterior[best])
    return Verdict(boq.classes[best].name if probability >= SURE else None, probability)


def asks_look(pipe: Pipe, boq: BillOfQuantities, concave: bool = False) -> bool:
    """Whether the classes that the radius leaves differ in their materials, which all of them name."""
    plausible = _plausible(_posterior(pipe.cylinder.radius, pipe.radius_sigma, boq, concave), boq)
    return len(set(plausible)) > 1 and "" not in plausible


def classified_by_look(pipe: Pipe, boq: BillOfQuantities, look: Mapping[str, float], concave: bool = False) -> Pipe:
    """A pipe for which `asks_look`, with its class by radius and look and its material.

    The posterior of a class is that by the radius times the probability of its material by the look. A pipe that looks
    like none of the materials, or too much like two, has neither class nor material.
    """
    posterior = _posterior(pipe.cylinder.radius, pipe.radius_sigma, boq, concave)
    materials = [planned.material for planned in boq.classes]
    likely = sum(look.get(material, 0.0) for material in set(_plausible(posterior, boq)))
    joint = posterior * np.array([look.get(material, 0.0) for material in materials])
    if likely < _LIKE_ONE or not joint.sum() > 0.0:
        return replace(pipe, class_name=None, material="", material_probability=max(float(likely), _LEAST))
    joint /= joint.sum()
    shares: dict[str, float] = {}
    for material, share in zip(materials, joint.tolist(), strict=True):
        shares[material] = shares.get(material, 0.0) + share
    best, seen = int(np.argmax(joint)), max(shares, key=lambda material: shares[material])
    return replace(
        pipe,
        class_name=boq.classes[best].name if joint[best] >= SURE else None,
        class_probability=float(joint[best]),
        material=seen if shares[seen] >= SURE else "",
        material_probability=shares[seen],
    )


def _plausible(posterior: FloatArray, boq: BillOfQuantities) -> list[str]:
    """Materials of the classes that a posterior by the radius leaves."""
    return [planned.material for planned, share in zip(boq.classes, posterior, strict=True) if share > _PLAUSIBLE]


def is_planned(radius: float, sigma: float, boq: BillOfQuantities) -> bool:
    """Whether a pipe of `radius` +- `sigma` [m] may be of a planned class, be it of one or of one of several."""
    return classify(radius, sigma, boq).probability > 0.0


def by_kmeans(radii: Sequence[float], nominal: Sequence[float]) -> list[int]:
    """Number of the class of each pipe as the paper has it: k-means over radii [m] whose means start at the nominal.

    The means drift with what they gather and nothing is rejected, so a size that is not planned gets a class, too.
    The mean of a class without pipes stays where it is; scikit-learn's KMeans would move it to the pipe that
    is farthest from its own mean, and so give a class to it that none of its pipes has.
    """
    if not len(radii):
        return []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of classes without pipes: not all are built yet
        _, labels = kmeans2(
            np.asarray(radii, float), np.asarray(nominal, float), _KMEANS_STEPS, minit="matrix", missing="warn"
        )
    return [int(label) for label in labels]


def with_kmeans(pipes: Sequence[Pipe], boq: BillOfQuantities) -> list[Pipe]:
    """The pipes, each with the class that k-means over the radii of all gives it as its `class_kmeans`."""
    numbers = by_kmeans([pipe.cylinder.radius for pipe in pipes], [planned.outer_radius for planned in boq.classes])
    return [replace(pipe, class_kmeans=boq.classes[number].name) for pipe, number in zip(pipes, numbers, strict=True)]


def named_by_kmeans(pipes: Sequence[Pipe], boq: BillOfQuantities, concave: bool = False) -> list[Pipe]:
    """The pipes with their `class_kmeans` as their class, each with the posterior probability of that class."""
    number = {planned.name: k for k, planned in enumerate(boq.classes)}
    return [
        replace(
            pipe,
            class_name=pipe.class_kmeans,
            class_probability=float(
                _posterior(pipe.cylinder.radius, pipe.radius_sigma, boq, concave)[number[pipe.class_kmeans]]
            ),
        )
        for pipe in pipes
    ]


def _posterior(radius: float, sigma: float, boq: BillOfQuantities, concave: bool) -> FloatArray:
    """Posterior of each class (K,), all 0 where none is near."""
    number, nominal, tolerance = [], [], []
    for k, planned in enumerate(boq.classes):
        for size, spread in planned.bores if concave else ((planned.outer_radius, planned.tolerance),):
            number.append(k)
            nominal.append(size)
            tolerance.append(spread)
    variance = sigma**2 + np.array(tolerance) ** 2
    distance = (radius - np.array(nominal)) ** 2 / variance
    if distance.min() > _REJECT**2:
        return np.zeros(len(boq.classes))
    likely = -0.5 * distance - 0.5 * np.log(variance)
    posterior = np.bincount(number, weights=np.exp(likely - likely.max()), minlength=len(boq.classes))
    return np.asarray(posterior / posterior.sum())


def progress(pipes: Sequence[Pipe], boq: BillOfQuantities) -> list[ClassProgress]:
    """Metres installed of each planned class, in the order of the bill of quantities."""
    table = []
    for planned in boq.classes:
        installed = float(sum(pipe.cylinder.length for pipe in pipes if pipe.class_name == planned.name))
        percent = 100.0 * installed / planned.planned_length
        table.append(ClassProgress(planned.name, planned.outer_radius, planned.planned_length, installed, percent))
    return table
