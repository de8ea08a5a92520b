# SPDX-License-Identifier: Apache-2.0
"""Structure from motion against batch COLMAP on the same keyframes: CPU time, poses, and how many are registered.

    .venv/bin/python -m benchmarks.peers_sfm [demo] [BAG.mcap ...] [--every N]

COLMAP runs as pycolmap does by default on a video: SIFT, sequential matching, `incremental_mapping`, with the
calibration held and as many features as ours; ours is the mapper of the graph, keyframe after keyframe. Features are
included on both sides, both run in this process, one after the other, and their time is that of all its threads
together. Poses are compared with the truth after the best similarity. Writes results/peers_sfm.json beside this file.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.recordings import Recording, made, named
from benchmarks.scale_sigma import decoded
from benchmarks.survey import RESULTS
from pipeprog_bringup.recording.bag import Bag
from pipeprog_camera.arrays import FloatArray
from pipeprog_camera.camera import Camera
from pipeprog_camera.similarity import similarity
from pipeprog_sfm.config import MapperConfig, SfmConfig
from pipeprog_sfm.sparse.mapper import Mapper
from pipeprog_sfm.warm_up import warm_up

Images = list[NDArray[np.uint8]]


def main() -> None:
    """Measure the recordings named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers_sfm", description=__doc__)
    parser.add_argument("recordings", nargs="*", default=["demo"])
    parser.add_argument("--every", type=int, default=2, help="of the images, which are taken for keyframes")
    arguments = parser.parse_args()
    warm_up(SfmConfig())
    rows = [row for name in arguments.recordings for row in compare(made(named(name)), arguments.every)]
    ratios = [ours["CPU s"] / theirs["CPU s"] for theirs, ours in zip(rows[::2], rows[1::2], strict=True)]
    title = f"Structure from motion against batch COLMAP: {max(ratios):.2f} times its time at most"
    names = " ".join(Path(name).name for name in arguments.recordings)
    command = f"python -m benchmarks.peers_sfm {names} --every {arguments.every}"
    result = {"title": title, "command": command, "pycolmap": pycolmap.__version__, "rows": rows}
    (RESULTS / "peers_sfm.json").write_text(json.dumps(result, indent=1) + "\n")


def compare(recording: Recording, every: int) -> list[dict[str, Any]]:
    """A row for COLMAP and one for ours."""
    bag = Bag.open(recording.bag)
    images = [decoded(frame.data) for number, frame in enumerate(bag) if number % every == 0]
    poses = np.array(json.loads(recording.beside("truth.json").read_text())["camera_to_world"])[::every]
    rows = []
    for name, reconstruct in (("batch COLMAP", colmap), ("pipeprog", ours)):
        seconds, centres = timed(reconstruct, images, bag.camera)
        found = np.stack(list(centres.values()))
        true = poses[list(centres), :3, 3]
        moved = similarity(found, true)
        error = 1e3 * np.linalg.norm(found @ moved[:3, :3].T + moved[:3, 3] - true, axis=1)
        rows.append(
            {
                "recording": recording.name,
                "": name,
                "registered": f"{len(found)} of {len(images)}",
                "CPU s": round(seconds, 1),
                "cameras: RMSE [mm]": round(float(np.sqrt((error**2).mean())), 3),
                "worst [mm]": round(float(error.max()), 2),
            }
        )
        print(rows[-1], flush=True)
    return rows


def timed(
    reconstruct: Callable[[Images, Camera], dict[int, FloatArray]], images: Images, camera: Camera
) -> tuple[float, dict[int, FloatArray]]:
    """CPU seconds of all threads, and what came of them."""
    started = time.process_time()
    centres = reconstruct(images, camera)
    return time.process_time() - started, centres


def ours(images: Images, camera: Camera) -> dict[int, FloatArray]:
    """(3,) projection centres by number of the image."""
    mapper = Mapper(MapperConfig())
    for number, image in enumerate(images):
        mapper.add(number, image, camera)
    mapper.finish()
    return {number: -pose[:3, :3].T @ pose[:3, 3] for number, pose in mapper.map.camera_from_model().items()}


def colmap(images: Images, camera: Camera) -> dict[int, FloatArray]:
    """(3,) projection centres by number of the image, of the largest model."""
    if any(camera.distortion):
        raise SystemExit("a recording without lens distortion is needed: COLMAP would have to be told of it")
    pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"  # its pixel centres are at +0.5
    reader.camera_params = f"{camera.fx},{camera.fy},{camera.cx + 0.5},{camera.cy + 0.5}"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = MapperConfig().max_features
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = pipeline.ba_refine_principal_point = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        for number, image in enumerate(images):
            cv2.imwrite(str(folder / "images" / f"{number:05d}.png"), image)
        database = folder / "database.db"
        pycolmap.extract_features(
            database,
            folder / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
        pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
        models = pycolmap.incremental_mapping(database, folder / "images", folder / "sparse", options=pipeline)
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    views = sorted((largest.image(identifier) for identifier in largest.reg_image_ids()), key=lambda view: view.name)
    return {int(view.name[:5]): view.projection_center().astype(np.float64) for view in views}


if __name__ == "__main__":
    main()
