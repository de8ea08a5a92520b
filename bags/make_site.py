# SPDX-License-Identifier: Apache-2.0
"""Make a recording of a synthetic construction site, with its ground truth, bill of quantities and board."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from sitegen.field import build_field
from sitegen.lab import build_lab
from sitegen.levels import build_levels
from sitegen.night import second_night
from sitegen.rack import build_rack
from sitegen.recording import (
    FIRST_STAMP,
    camera_info,
    truth,
    write_bag,
    write_boards,
    write_boq,
    write_truth,
)
from sitegen.render import Lens, Scene, build_scene
from sitegen.robot import MAX_RIG, MountedWalk, Robot, mounted, robot_messages
from sitegen.sensor import Sensor, compress, develop, expose
from sitegen.site import Site
from sitegen.visibility import Coverage, coverage, visible_surface
from sitegen.walk import Walk

_FOCAL_OVER_WIDTH = 0.714  # 70 degrees across, a phone's main camera
_SIZES = {"vga": (640, 480), "480p": (854, 480), "720p": (1280, 720), "1080p": (1920, 1080), "4k": (3840, 2160)}
_FISHEYE = (-0.03, 0.008, -0.003, 0.0005)  # k1 to k4, of the size that calibrations of such lenses have
_GAP = 1.0  # s; the longest that users of Spot's driver tell of
_PREVIEW_WIDTH = 320  # px; the thinnest pipe is then 2 px wide at 2 m
_LAB_SECONDS = 16.0
_MOTION_SEED = 1 << 20  # beyond the numbers of frames, which are their seeds
_NIGHT_SEED = 1 << 21  # another than those of frames and motion
_DROP_SEED = 1 << 22
_SURFACE_VIEWS = 20  # images that contribute true surface points: a million points

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


class Layout(str, Enum):
    """The sites that can be made."""

    lab = "lab"
    field = "field"
    levels = "levels"
    rack = "rack"


_BUILDERS = {
    Layout.lab: build_lab,
    Layout.field: build_field,
    Layout.levels: build_levels,
    Layout.rack: build_rack,
}


class Size(str, Enum):
    """Image sizes."""

    vga = "vga"
    p480 = "480p"
    p720 = "720p"
    p1080 = "1080p"
    p2160 = "4k"


@app.command()
def make_site(
    layout: Annotated[
        Layout, typer.Argument(help="lab: 6 pipes in a corner; field: 58; levels: in line; rack: of many materials")
    ],
    out: Annotated[Path, typer.Argument(help="NAME.mcap; NAME.truth.json, .boq.yaml and .board.yaml go beside it")],
    seed: Annotated[int, typer.Option(help="layout, textures, hand and noise")] = 1,
    size: Annotated[Size, typer.Option(help="image size")] = Size.p720,
    fps: Annotated[float, typer.Option(help="frames per second", min=0.1)] = 5.0,
    seconds: Annotated[float | None, typer.Option(help="duration; field, levels: the whole walk, else 16")] = None,
    speed: Annotated[float, typer.Option(help="walking speed, m/s", min=0.01)] = 0.75,
    distance: Annotated[float, typer.Option(help="from the wall, m", min=0.5, max=4.0)] = 2.0,
    wobble: Annotated[float, typer.Option(help="unsteadiness of the hand: 0 a rail, 1 a careful person", min=0)] = 1.0,
    richness: Annotated[float, typer.Option(help="texture: 1 rich, 0.2 freshly painted, 0 none", min=0, max=2)] = 1.0,
    second_night_later: Annotated[
        bool, typer.Option("--second-night", help="a pipe more, one less, one longer, other light, no board")
    ] = False,
    tiled: Annotated[float, typer.Option(help="metres after which the walls' texture repeats, 0 never", min=0)] = 0.0,
    exposure_ms: Annotated[float, typer.Option(help="exposure time: motion blur", min=0)] = 0.0,
    readout_ms: Annotated[float, typer.Option(help="rolling shutter, first to last row", min=0)] = 0.0,
    blur: Annotated[float, typer.Option(help="lens blur, sigma in pixels", min=0)] = 0.6,
    noise: Annotated[float, typer.Option(help="image noise, sigma in grey levels", min=0)] = 1.0,
    quality: Annotated[int, typer.Option(help="JPEG quality", min=1, max=100)] = 92,
    distortion: Annotated[str, typer.Option(help="plumb_bob k1,k2,p1,p2,k3 of the lens")] = "0,0,0,0,0",
    hide_distortion: Annotated[bool, typer.Option(help="CameraInfo says there is no distortion")] = False,
    focal_error: Annotated[float, typer.Option(help="percent by which CameraInfo's focal length is off")] = 0.0,
    robot: Annotated[bool, typer.Option(help="also a robot's /odom, /imu and /tf_static")] = False,
    odometry_error: Annotated[float, typer.Option(help="percent by which odometry's lengths are off")] = 0.0,
    rig: Annotated[int, typer.Option(help="cameras of the robot, with --robot", min=1, max=MAX_RIG)] = 1,
    turned: Annotated[bool, typer.Option("--turned", help="they lie on their sides and heads, as on Spot")] = False,
    fisheye: Annotated[bool, typer.Option("--fisheye", help="equidistant lenses, as robots have them")] = False,
    drop: Annotated[float, typer.Option(help="share of the images that get lost", min=0, max=0.9)] = 0.0,
    gaps: Annotated[int, typer.Option(help="times that no image comes for a second", min=0)] = 0,
    grey: Annotated[bool, typer.Option(help="grey images")] = False,
    surface: Annotated[bool, typer.Option(help="also NAME.surface.npz: true surface points and their pipes")] = False,
    board_error_mm: Annotated[float, typer.Option(help="standard deviation of a printed circle's place", min=0)] = 0.0,
    allow_hidden: Annotated[bool, typer.Option(help="accept a recording that does not show every pipe")] = False,
    jobs: Annotated[int, typer.Option(help="frames rendered at a time", min=1)] = os.cpu_count() or 1,
) -> None:
    """Build a site from a seed, walk a camera through it, and write what it sees and what is true."""
    console = Console(stderr=True)
    lens = fisheye_of(size) if fisheye else lens_of(size, distortion)
    rng = np.random.default_rng(seed)
    build = _BUILDERS[layout]
    try:
        site = build(rng, richness, tiled, distance, board_error_mm / 1e3)
        if second_night_later:
            rng = np.random.default_rng([seed, _NIGHT_SEED])
            second_night(site, rng)
    except RuntimeError as error:
        console.print(f"error: {error}")
        raise typer.Exit(1) from None
    scene = build_scene(site.primitives, site.lamps, site.ambient, seed, site.ambient_colour)
    walk = Walk(site.waypoints, speed, rng, site.closed_walk, wobble)
    if seconds is None:
        seconds = walk.duration if layout in (Layout.field, Layout.levels) else _LAB_SECONDS
    times = np.arange(max(math.floor(seconds * fps), 1)) / fps
    mounts = [mounted(number, turned) for number in range(rig)]
    walks = [MountedWalk(walk, mount) for mount in mounts]
    taken = _taken(times, rig, drop, gaps, np.random.default_rng([seed, _DROP_SEED]))
    poses = _poses(walks, taken)
    # As results have them: a nanosecond apart where cameras are triggered together.
    stamps = [_stamp(time) + camera for time, camera in taken]

    preview = lens.reduced(max(lens.width // _PREVIEW_WIDTH, 1))
    seen = coverage(scene, site.pipes, preview, poses)
    _refuse_hidden(console, site, seen, allow_hidden)

    out.parent.mkdir(parents=True, exist_ok=True)
    stem = out.with_suffix("")
    write_truth(Path(f"{stem}.truth.json"), truth(site, lens, fps, poses, stamps, [c.share for c in seen]))
    write_boq(Path(f"{stem}.boq.yaml"), site)
    if site.boards:
        write_boards(Path(f"{stem}.board.yaml"), len(site.boards))
    if surface:
        points, owners = visible_surface(scene, preview, poses[:: max(len(poses) // _SURFACE_VIEWS, 1)])
        np.savez_compressed(f"{stem}.surface.npz", points=points, pipe=owners)
    # The recording is written last: where it exists, all files that belong to it exist, too.
    sensor = Sensor(exposure_ms / 1e3, readout_ms / 1e3, blur, noise, quality, site.gain, site.balance)
    shots = [Shot(scene, lens, each, sensor, grey) for each in walks]
    frames = _frames(shots, taken, seed + _NIGHT_SEED * second_night_later, jobs)
    motion_rng = np.random.default_rng([seed, _MOTION_SEED])
    motion = robot_messages(walk, Robot(odometry_error / 100), float(times[-1]), FIRST_STAMP, motion_rng, mounts)
    shown = track(frames, total=len(taken), description=out.name, console=console)
    write_bag(out, camera_info(lens, focal_error / 100, hide_distortion), shown, motion if robot else ())
    console.print(f"{out}: {len(taken)} frames, {len(site.pipes)} pipes, {out.stat().st_size / 1e6:.1f} MB")


@dataclass(frozen=True)
class Shot:
    """A camera on its walk through a scene."""

    scene: Scene
    lens: Lens
    walk: MountedWalk
    sensor: Sensor
    is_grey: bool = False

    def jpeg(self, time: float, rng: np.random.Generator) -> bytes:
        """The frame at a time, s, with noise from `rng`."""
        linear = expose(self.scene, self.lens, self.walk, self.sensor, time)
        image = develop(linear, self.sensor, rng)
        return compress(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if self.is_grey else image, self.sensor)


def _taken(
    times: NDArray[np.float64], cameras: int, drop: float, gaps: int, rng: np.random.Generator
) -> list[tuple[float, int]]:
    """Time and number of the camera of each image that does not get lost; none comes in `gaps` of a second each."""
    taken = [(float(time), camera) for time in times for camera in range(cameras)]
    kept = rng.random(len(taken)) >= drop
    moments = np.repeat(times, cameras)
    for begin in rng.uniform(times[0], times[-1], gaps):
        kept &= (moments < begin) | (moments >= begin + _GAP)
    return [each for each, is_kept in zip(taken, kept, strict=True) if is_kept]


def _poses(walks: Sequence[MountedWalk], taken: Sequence[tuple[float, int]]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_camera of the images, in their order."""
    moments, cameras = (np.array(column) for column in zip(*taken, strict=True))
    poses = np.empty((len(taken), 4, 4))
    for number, walk in enumerate(walks):
        poses[cameras == number] = walk.poses(moments[cameras == number])
    return poses


def _stamp(time: float) -> int:
    """Stamp, ns, of an image at a time, s."""
    return FIRST_STAMP + round(time * 1e9)


def _frames(
    shots: Sequence[Shot], taken: Sequence[tuple[float, int]], seed: int, jobs: int
) -> Iterator[tuple[int, int, bytes]]:
    """Stamps, cameras and JPEGs in order; `jobs` frames at a time, each with noise of its own seed."""

    def make(index: int) -> tuple[int, int, bytes]:
        time, camera = taken[index]
        return _stamp(time), camera, shots[camera].jpeg(time, np.random.default_rng([seed, index]))

    with ThreadPoolExecutor(jobs) as pool:
        for first in range(0, len(taken), jobs):
            yield from pool.map(make, range(first, min(first + jobs, len(taken))))


def lens_of(size: Size, distortion: str, focal_over_width: float = _FOCAL_OVER_WIDTH) -> Lens:
    """The lens that options describe."""
    try:
        k1, k2, p1, p2, k3 = (float(value) for value in distortion.split(","))
    except ValueError:
        raise typer.BadParameter(f"'{distortion}': give five numbers, k1,k2,p1,p2,k3") from None
    width, height = _SIZES[size.value]
    focal = focal_over_width * width
    return Lens(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, (k1, k2, p1, p2, k3))


def fisheye_of(size: Size) -> Lens:
    """A wide lens: as sharp in the middle as the others, 82 degrees across in place of 70."""
    width, height = _SIZES[size.value]
    focal = _FOCAL_OVER_WIDTH * width
    return Lens(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, _FISHEYE, is_fisheye=True)


def _refuse_hidden(console: Console, site: Site, seen: Sequence[Coverage], allowed: bool) -> None:
    """Lists the pipes that a recording hardly shows, and ends unless that is allowed."""
    hidden = [
        f"pipe {k} ({site.pipes[k].radius * 1e3:g} mm): {c.frames} frames, {100 * c.share:.0f} % of its length"
        for k, c in enumerate(seen)
        if not c.enough
    ]
    if hidden:
        console.print("hardly seen:", *hidden, sep="\n  ")
        if not allowed:
            console.print("choose another seed, a longer walk or more frames, or pass --allow-hidden")
            raise typer.Exit(1)


if __name__ == "__main__":
    app()
