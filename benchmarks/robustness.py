# SPDX-License-Identifier: Apache-2.0
"""How the result suffers when the recording does: one factor at a time, against the same site filmed well.

    .venv/bin/python -m benchmarks.robustness [FACTOR ...]

Every row is a recording of its own through the graph: rendered anew where the factor is in the scene or the camera's
motion, made from the frames of the good recording where it is in the image or in its calibration. What was measured is
kept in out/surveys, so that an interrupted run goes on. Writes results/robustness.json, docs/images/robustness.png; the
recording guide is made of them (benchmarks.write_accuracy). Each row has its commit; factors that are not named keep
their rows.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage

from benchmarks.recordings import ROOT, Recording, made, site
from benchmarks.survey import RESULTS, attempt, score_figures
from pipeprog_bringup.recording.bag import Bag

sys.path.insert(0, str(ROOT / "bags"))
from sitegen.recording import camera_info, write_bag
from sitegen.render import Lens

Image = NDArray[np.uint8]

SEED = 21
WALK = 7.5  # m: once past all pipes and back
PICTURE = ROOT / "docs" / "images" / "robustness.png"
TITLE = "Robustness: one factor at a time, a lab filmed for 7.5 m, 480p unless said"


@dataclass(frozen=True)
class Shot:
    """A recording of the lab, and what of its frames or its calibration is changed afterwards."""

    size: str = "480p"
    speed: float = 0.75  # m/s
    fps: float = 4.0
    options: tuple[str, ...] = ()  # of bags/make_site.py
    noise: float = 0.0  # grey levels, beside the one that the frames have
    quality: int | None = None  # of the JPEGs
    focal_error: float = 0.0  # percent
    k1: float = 0.0  # that CameraInfo states; the lens has none

    def recording(self) -> Recording:
        """The mcap file, made where it is not there."""
        options = [f"--size={self.size}", f"--fps={self.fps:g}", f"--seconds={WALK / self.speed:g}"]
        speed = [f"--speed={self.speed:g}"] if self.speed != Shot.speed else []
        plain = site("lab", SEED, *options, *speed, *self.options, "--allow-hidden")
        if (self.noise, self.quality, self.focal_error, self.k1) == (0.0, None, 0.0, 0.0):
            return plain
        return self.altered(made(plain))

    def altered(self, plain: Recording) -> Recording:
        """The plain recording with these changes to its frames and its calibration, in a file beside it."""
        changes = {"noise": self.noise, "quality": self.quality, "focal-error": self.focal_error, "k1": self.k1}
        said = "_".join(f"{name}{value:g}" for name, value in changes.items() if value)
        target = plain.bag.with_name(f"{plain.name}_{said}.mcap")
        if not target.exists():
            for kind in ("truth.json", "boq.yaml", "board.yaml"):
                shutil.copy(plain.beside(kind), target.with_suffix(f".{kind}"))
            bag = Bag.open(plain.bag)
            camera = bag.camera
            lens = Lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
            info = camera_info(replace(lens, distortion=(self.k1, 0.0, 0.0, 0.0, 0.0)), self.focal_error / 100, False)
            rng = np.random.default_rng(SEED)
            write_bag(target, info, ((frame.stamp, 0, self._image(frame.data, rng)) for frame in bag))
        return Recording(target, f"{plain.made_by}, then by benchmarks.robustness: {said}")

    def _image(self, message: bytes, rng: np.random.Generator) -> bytes:
        encoded = bytes(deserialize_message(message, CompressedImage).data)
        if not self.noise and self.quality is None:
            return encoded
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        levels = image + self.noise * rng.standard_normal(image.shape)
        image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.quality or 92])[1])


def _option(text: str) -> Callable[[float], Shot]:
    return lambda value: Shot(options=(text.format(value),) if value != GOOD.get(text) else ())


# What options the good recording has without being told.
GOOD = {"--richness={:g}": 1.0, "--distance={:g}": 2.0, "--exposure-ms={:g}": 0.0, "--readout-ms={:g}": 0.0}
PHONE = ("--exposure-ms=4", "--readout-ms=15")  # without blur and skew the speed would not matter
FACTORS: dict[str, dict[str, Shot]] = {
    "JPEG quality": {"92": Shot(), "60": Shot(quality=60), "25": Shot(quality=25)},
    "image noise [grey levels]": {"1": Shot(), "5": Shot(noise=5.0), "12": Shot(noise=12.0)},
    "focal length off [%]": {"0": Shot(), "0.2": Shot(focal_error=0.2), "1": Shot(focal_error=1.0)},
    "distortion off, k1": {"0": Shot(), "0.01": Shot(k1=0.01), "0.05": Shot(k1=0.05)},
    "distance [m]": {f"{d:g}": _option("--distance={:g}")(d) for d in (1.0, 2.0, 3.0, 4.0)},
    "texture, 1 is rich": {f"{r:g}": _option("--richness={:g}")(r) for r in (1.0, 0.3, 0.05)},
    "exposure [ms]": {f"{e:g}": _option("--exposure-ms={:g}")(e) for e in (0.0, 4.0, 12.0)},
    "rolling shutter [ms]": {f"{t:g}": _option("--readout-ms={:g}")(t) for t in (0.0, 15.0, 30.0)},
    "share of the images lost": {"0": Shot(), "0.5": Shot(fps=8.0, options=("--drop=0.5",))},
    "speed [m/s], phone with 4 ms and 15 ms": {
        "0.2": Shot(speed=0.2, fps=2.0, options=PHONE),
        "0.75": Shot(options=PHONE),
        "1.5": Shot(speed=1.5, options=PHONE),
    },
    "resolution": {"480p": Shot(), "720p": Shot(size="720p"), "4k": Shot(size="4k")},
}


def main(factors: list[str]) -> None:
    """Measure, write the rows down after each, and draw."""
    target = RESULTS / "robustness.json"
    known = json.loads(target.read_text())["rows"] if target.exists() else []
    rows: dict[tuple[str, str], dict[str, Any]] = {(row["factor"], row["value"]): row for row in known}
    for factor in factors or list(FACTORS):
        for value, shot in FACTORS[factor].items():
            rows[factor, value] = {"factor": factor, "value": value, **_figures(shot)}
            ordered = [rows[key] for key in ((f, v) for f in FACTORS for v in FACTORS[f]) if key in rows]
            content = {"title": TITLE, "command": "python -m benchmarks.robustness", "rows": ordered}
            target.write_text(json.dumps(content, indent=1) + "\n")
            print(rows[factor, value], flush=True)
            _draw(ordered)


def _figures(shot: Shot) -> dict[str, Any]:
    """One row's figures; F is 0 where the replay ends without a result."""
    recording = shot.recording()
    known = attempt(recording, (), f"robustness_{recording.name}")
    if "failed" in known:
        return {"F": 0.0, "why": known["failed"], "commit": known["commit"]}
    return {**score_figures(known["score"]), "commit": known["commit"]}


def _draw(rows: list[dict[str, Any]], picture: Path = PICTURE) -> None:
    """A panel for each factor: F as bars, radius RMSE as a line."""
    shown = [factor for factor in FACTORS if any(row["factor"] == factor for row in rows)]
    figure = Figure(figsize=(12, 2.6 * -(-len(shown) // 3)), layout="constrained")
    panels = figure.subplots(-(-len(shown) // 3), 3, squeeze=False).ravel()
    for panel, factor in zip(panels, shown, strict=False):
        group = [row for row in rows if row["factor"] == factor]
        values = [row["value"] for row in group]
        panel.bar(values, [row["F"] for row in group], color="0.8")
        panel.set(title=factor, ylim=(0, 1.05), ylabel="F")
        errors = [(row["value"], row["radius RMSE [mm]"]) for row in group if row.get("radius RMSE [mm]") is not None]
        line = panel.twinx()
        line.plot([value for value, _ in errors], [error for _, error in errors], "o-", color="C3")
        line.set_ylabel("radius RMSE [mm]", color="C3")
        line.set_ylim(bottom=0)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    picture.parent.mkdir(exist_ok=True)
    figure.savefig(picture, dpi=80)


if __name__ == "__main__":
    main(sys.argv[1:])
