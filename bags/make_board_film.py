# SPDX-License-Identifier: Apache-2.0
"""Make a hand-held film of a board for `pipeprog calibrate`, with the true camera beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from make_site import Size, lens_of
from rich.console import Console
from rich.progress import track

from sitegen.board_film import BoardFilm, HandBeforeBoard
from sitegen.recording import FIRST_STAMP, camera_info, write_bag, write_boards
from sitegen.sensor import Sensor, compress, develop

_FOCAL_ERROR = 0.05  # relative, of the calibration in the recording: as good as what a phone's metadata say
_GAIN = 1.2  # of the sensor: the circles are bright and not saturated

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def make_board_film(
    out: Annotated[Path, typer.Argument(help="NAME.mcap; NAME.truth.json and .board.yaml go beside it")],
    seed: Annotated[int, typer.Option(help="hand and noise")] = 1,
    size: Annotated[Size, typer.Option(help="image size")] = Size.p720,
    fps: Annotated[float, typer.Option(help="frames per second", min=0.1)] = 30.0,
    seconds: Annotated[float, typer.Option(help="duration", min=0.1)] = 30.0,
    exposure_ms: Annotated[float, typer.Option(help="exposure time: motion blur", min=0)] = 4.0,
    readout_ms: Annotated[float, typer.Option(help="rolling shutter, first to last row", min=0)] = 15.0,
    noise: Annotated[float, typer.Option(help="image noise, sigma in grey levels", min=0)] = 1.0,
    distortion: Annotated[str, typer.Option(help="plumb_bob k1,k2,p1,p2,k3")] = "-0.1,0.04,0.0005,-0.0004,0",
    focal: Annotated[float, typer.Option(help="focal length over the image's width", min=0.2)] = 0.714,
) -> None:
    """Film a board by hand; the calibration in the recording is a guess without distortion."""
    lens = lens_of(size, distortion, focal)
    sensor = Sensor(exposure_ms / 1e3, readout_ms / 1e3, noise=noise, gain=_GAIN)
    film = BoardFilm(lens, sensor, HandBeforeBoard(np.random.default_rng(seed)))
    times = np.arange(max(int(seconds * fps), 1)) / fps
    truth = {
        "camera": [lens.fx, lens.fy, lens.cx, lens.cy],
        "distortion": list(lens.distortion),
        "readout": sensor.readout,
        "camera_to_world": film.hand.poses(times).tolist(),
        "note": "camera: fx, fy, cx, cy as in CameraInfo, px; readout: s, first row to last",
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    stem = out.with_suffix("")
    Path(f"{stem}.truth.json").write_text(json.dumps(truth) + "\n", encoding="utf-8")
    write_boards(Path(f"{stem}.board.yaml"), 1)
    console = Console(stderr=True)
    shown = track(enumerate(times), total=len(times), description=out.name, console=console)
    frames = (
        (
            FIRST_STAMP + round(time * 1e9),
            0,
            compress(develop(film.frame(time), sensor, np.random.default_rng([seed, number])), sensor),
        )
        for number, time in shown
    )
    write_bag(out, camera_info(lens, _FOCAL_ERROR, True), frames)
    console.print(f"{out}: {len(times)} frames, {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    app()
