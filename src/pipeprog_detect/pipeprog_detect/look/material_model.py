# SPDX-License-Identifier: Apache-2.0
"""Probabilities of the materials by the features of a look: an ensemble of small neural networks.

`benchmarks/train_materials.py` has trained it and written its numbers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np

from pipeprog_camera.arrays import FloatArray

FILE = "material_model.json"


@dataclass(frozen=True)
class MaterialModel:
    """The model's numbers.

    Attributes:
        materials: names, in the order of the probabilities.
        centre, spread: (F,) of the features in training; what lies further off than `furthest` spreads counts as there.
        furthest: see above.
        networks: of each its layers, weights (I, O) and offsets (O,); rectified but for the last one.
        temperature: the logarithms of the probabilities are divided by it.
    """

    materials: tuple[str, ...]
    centre: FloatArray
    spread: FloatArray
    furthest: float
    networks: tuple[tuple[tuple[FloatArray, FloatArray], ...], ...]
    temperature: float

    def probabilities(self, features: FloatArray) -> FloatArray:
        """Probabilities (N, M) of the materials for features (N, F)."""
        scaled = np.clip((features - self.centre) / self.spread, -self.furthest, self.furthest)
        each = [_softmax(_output(scaled, layers)) for layers in self.networks]
        return _softmax(np.log(np.mean(each, axis=0) + 1e-9) / self.temperature)


def material_probabilities(features: FloatArray) -> dict[str, float]:
    """Probability of each material for the features (F,) of one barrel."""
    model = _model()
    return dict(zip(model.materials, model.probabilities(features[None])[0].tolist(), strict=True))


def model_from(content: str) -> MaterialModel:
    """The model of a file's text."""
    values = json.loads(content)
    networks = tuple(
        tuple((np.array(layer["weights"]), np.array(layer["offsets"])) for layer in layers)
        for layers in values["networks"]
    )
    return MaterialModel(
        tuple(values["materials"]),
        np.array(values["centre"]),
        np.array(values["spread"]),
        float(values["furthest"]),
        networks,
        float(values["temperature"]),
    )


@cache
def _model() -> MaterialModel:
    return model_from(resources.files(__package__).joinpath(FILE).read_text(encoding="utf-8"))


def _output(values: FloatArray, layers: tuple[tuple[FloatArray, FloatArray], ...]) -> FloatArray:
    for weights, offsets in layers[:-1]:
        values = np.maximum(values @ weights + offsets, 0.0)
    weights, offsets = layers[-1]
    return np.asarray(values @ weights + offsets)


def _softmax(values: FloatArray) -> FloatArray:
    powers = np.exp(values - values.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True))
