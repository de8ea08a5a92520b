# SPDX-License-Identifier: Apache-2.0
"""Trains what tells the materials of pipes: on generated racks under changed light, features as the detector sees them.

    .venv/bin/python -m benchmarks.train_materials [--sites 1000] [--keep FILE.npz]

Each site is a rack of eight pipes of two radii (`bags/sitegen/rack.py`), seen in five pictures of random exposure, size
and noise, with and without its board; only the pixels that are asked for are traced. A small ensemble of neural
networks learns the materials from `pipeprog_detect.look.look_features`; the temperature that makes its probabilities
true comes from sites that it has not learned from. Writes `look/material_model.json`, 100 kB of numbers. Features are
kept in FILE.npz, to which a later call adds sites.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track
from scipy.optimize import minimize_scalar
from scipy.special import softmax
from sklearn.metrics import log_loss
from sklearn.neural_network import MLPClassifier

from pipeprog_camera.arrays import FloatArray, IntArray
from pipeprog_camera.camera import Camera
from pipeprog_detect.look.barrel_light import barrel_light
from pipeprog_detect.look.colour_view import NO_CIRCLES, BoardCircles, Picture, colour_views
from pipeprog_detect.look.look_features import NAMES, look_features
from pipeprog_detect.look.material_model import FILE, MaterialModel
from pipeprog_detect.types import Cylinder, View

sys.path.insert(0, str(Path(__file__).parents[1] / "bags"))

from sitegen.pipe_materials import KINDS
from sitegen.rack import build_rack
from sitegen.render import Lens, Scene, build_scene, light_at
from sitegen.sensor import Sensor, grey_levels
from sitegen.site import BOARD_CIRCLE_RADIUS, Site
from sitegen.walk import Walk

MODEL = Path(__file__).parents[1] / "src/pipeprog_detect/pipeprog_detect/look" / FILE
VIEWS = 5
_WIDTHS = (640, 854, 1280)  # px
# Of the networks: how many, their hidden neurons, weight penalty, most rounds; copies of the features that they learn
# from, each off by this many standard deviations, so that small differences of a renderer do not count; where clipped.
_NETWORKS, _HIDDEN, _PENALTY, _ROUNDS = 4, (40, 24), 0.03, 80
_COPIES, _JITTER, _FURTHEST = 3, 0.2, 4.0
# Sites and cameras are others than those that are generated: the temperature is raised by half, so that odds of 19 to 1
# need what were 80 to 1 on the generated racks.
_DOUBT = 1.5
_RAYS = 4  # through a pixel, as far apart as lens and pixel blur


@dataclass(frozen=True)
class TracedPicture:
    """What a camera shows at the pixels that are asked for, which alone are traced."""

    scene: Scene
    lens: Lens
    pose: FloatArray
    sensor: Sensor
    rng: np.random.Generator

    def levels(self, pixel: FloatArray) -> NDArray[np.float32]:
        """Grey levels (N, 3) RGB at pixel (N, 2)."""
        many = np.repeat(np.asarray(pixel, float), _RAYS, axis=0)
        many += self.sensor.blur * self.rng.standard_normal(many.shape)
        light = light_at(self.scene, self.lens, self.pose, many).reshape(-1, _RAYS, 3).mean(axis=1)
        levels = grey_levels((light * self.sensor.gain * self.sensor.balance).astype(np.float32))
        levels += self.sensor.noise * self.rng.standard_normal(levels.shape, np.float32)
        return np.clip(np.rint(levels), 0, 255).astype(np.float32)


def pictures_of(site: Site, rng: np.random.Generator, seed: int) -> tuple[list[View], list[TracedPicture]]:
    """Views of a site at random places of its walk, and what they show; their stamps are their numbers."""
    width = int(rng.choice(_WIDTHS))
    height, focal = round(width * 9 / 16), 0.714 * width
    lens = Lens(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    scene = build_scene(site.primitives, site.lamps, site.ambient, seed, site.ambient_colour)
    walk = Walk(site.waypoints, 0.75, rng, site.closed_walk, 1.0)
    camera = Camera(width, height, focal, focal, lens.cx, lens.cy)
    drift = rng.choice([0.0, 0.15])  # of exposure and white balance, from image to image
    noise, blur = float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.3, 0.9))
    blank = np.zeros((height, width), np.uint8)
    views, pictures = [], []
    for number, time in enumerate(np.sort(rng.uniform(0.0, walk.duration, VIEWS))):
        pose = walk.poses(time)[0]
        gain = site.gain * float(np.exp(drift * rng.standard_normal()))
        red, green, blue = (np.asarray(site.balance) * np.exp(0.2 * drift * rng.standard_normal(3))).tolist()
        sensor = Sensor(blur=blur, noise=noise, gain=gain, balance=(red, green, blue))
        pictures.append(TracedPicture(scene, lens, pose, sensor, rng))
        views.append(View(number, blank, camera, np.linalg.inv(pose)))
    return views, pictures


def looks_of_pipes(
    pipes: Sequence[Cylinder], views: Sequence[View], pictures: Sequence[Picture], circles: BoardCircles
) -> list[tuple[int, FloatArray]]:
    """Number and features of each pipe that the views show; `pictures` by the views' stamps."""
    in_colour = colour_views(views, pictures.__getitem__, pipes, circles)
    found = []
    for number, pipe in enumerate(pipes):
        barrel = barrel_light(pipe, in_colour, [*pipes[:number], *pipes[number + 1 :]])
        features = None if barrel is None else look_features(barrel)
        if features is not None:
            found.append((number, features))
    return found


def generated(seed: int) -> list[tuple[int, FloatArray]]:
    """Number of the material and features of each pipe of one site, by the board and without it."""
    rng = np.random.default_rng([seed, 7])
    site = build_rack(rng, float(rng.uniform(0.2, 1.2)), 0.0, float(rng.uniform(1.2, 2.5)))
    views, pictures = pictures_of(site, rng, seed)
    pipes = [Cylinder(pipe.start, pipe.end, pipe.radius) for pipe in site.pipes]
    centres = np.concatenate(site.boards)
    circles = BoardCircles(centres, np.full(len(centres), BOARD_CIRCLE_RADIUS))
    return [
        (KINDS.index(site.pipes[number].material), features)
        for told in (circles, NO_CIRCLES)
        for number, features in looks_of_pipes(pipes, views, pictures, told)
    ]


def learned(features: FloatArray, kinds: IntArray, sites: IntArray) -> MaterialModel:
    """The model of features (N, F) of materials (N,); every fifth site tells its temperature, the others teach it."""
    held = sites % 5 == 4
    taught, own = features[~held], kinds[~held]
    centre, spread = np.median(taught, axis=0), taught.std(axis=0) + 1e-3
    rng = np.random.default_rng(0)
    networks = []
    for seed in range(_NETWORKS):
        scaled = np.concatenate([(taught - centre) / spread] * _COPIES)
        noisy = np.clip(scaled + _JITTER * rng.standard_normal(scaled.shape), -_FURTHEST, _FURTHEST)
        network = MLPClassifier(_HIDDEN, alpha=_PENALTY, max_iter=_ROUNDS, random_state=seed, tol=1e-3)
        network.fit(noisy, np.tile(own, _COPIES))
        layers = zip(network.coefs_, network.intercepts_, strict=True)
        networks.append(tuple((np.round(weights, 4), np.round(offsets, 4)) for weights, offsets in layers))
    plain = MaterialModel(KINDS, np.round(centre, 5), np.round(spread, 5), _FURTHEST, tuple(networks), 1.0)
    logs = np.log(plain.probabilities(features[held]) + 1e-9)

    def loss(temperature: float) -> float:
        return float(log_loss(kinds[held], softmax(logs / temperature, axis=1), labels=range(len(KINDS))))

    found = float(minimize_scalar(loss, bounds=(0.5, 5.0), method="bounded").x)
    return replace(plain, temperature=round(_DOUBT * found, 3))


def written(model: MaterialModel) -> str:
    """The model as its file holds it."""
    content = {
        "materials": list(model.materials),
        "features": list(NAMES),
        "centre": model.centre.tolist(),
        "spread": model.spread.tolist(),
        "furthest": model.furthest,
        "temperature": model.temperature,
        "networks": [
            [{"weights": weights.tolist(), "offsets": offsets.tolist()} for weights, offsets in layers]
            for layers in model.networks
        ],
    }
    return json.dumps(content) + "\n"


def train(
    sites: Annotated[int, typer.Option(help="seeds 0 to this one", min=10)] = 1000,
    keep: Annotated[Path, typer.Option(help="features that are kept")] = Path("materials.npz"),
) -> None:
    """Trace sites, learn, write the model."""
    rows: dict[str, list[Any]] = {"features": [], "kinds": [], "sites": []}
    if keep.is_file():
        with np.load(keep) as kept:
            rows = {name: list(kept[name]) for name in rows}
    done = {int(site) for site in rows["sites"]}
    for seed in track([seed for seed in range(sites) if seed not in done], description="tracing sites"):
        for kind, features in generated(seed):
            for name, value in zip(rows, (features, kind, seed), strict=True):
                rows[name].append(value)
    arrays = {name: np.array(values) for name, values in rows.items()}
    np.savez_compressed(keep, features=arrays["features"], kinds=arrays["kinds"], sites=arrays["sites"])
    model = learned(arrays["features"], arrays["kinds"], arrays["sites"])
    MODEL.write_text(written(model))
    held = arrays["sites"] % 5 == 4
    best = model.probabilities(arrays["features"][held]).argmax(axis=1)
    print(f"{len(held)} looks; of {held.sum()} held out {100 * (best == arrays['kinds'][held]).mean():.1f} % right")


if __name__ == "__main__":
    typer.run(train)
