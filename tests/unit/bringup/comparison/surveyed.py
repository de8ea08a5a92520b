# SPDX-License-Identifier: Apache-2.0
"""Results of surveys of one wall by nine cameras, with the pipes that are given."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.cloud_io import write_ply
from pipeprog_camera.arrays import FloatArray
from pipeprog_detect.product.classification import ClassProgress
from pipeprog_detect.product.product import Product
from pipeprog_detect.types import Cylinder, Pipe, PipeEnd
from tests.unit.detect.coverage.wall import CAMERA, poses, wall_and_curtain

DAY = 86_400 * 10**9
START = 1_700_000_000 * 10**9


def survey(
    folder: Path,
    day: int,
    pipes: Sequence[Cylinder],
    source: str = "board",
    boards: Sequence[str] = ("A",),
    cloud: FloatArray | None = None,
) -> Path:
    """The results folder of a survey on a day that has measured these pipes of one class."""
    folder.mkdir(parents=True)
    end = PipeEnd(0.002, "free")
    rows = [
        Pipe(f"p{k:02d}", c, 1e-4, "DN100", 1.0, 2.5, 1e-3, 900, "DN100", (end, end)) for k, c in enumerate(pipes, 1)
    ]
    installed = sum(cylinder.length for cylinder in pipes)
    classes = [ClassProgress("DN100", 0.05, 10.0, installed, 10 * installed)]
    scale = result_files.Scale(source, 0.0004)
    result_files.write_pipes(folder / "pipes.json", Product(rows, classes, [], 0.0004), scale)
    points = wall_and_curtain() if cloud is None else cloud
    write_ply(folder / "cloud.ply", points, np.full(points.shape, 120, np.uint8))
    result_files.write_config(folder / "config.yaml", {"boards": list(boards)})
    (folder / "run.json").write_text(json.dumps({"keyframes": 9}))
    stamps = [START + day * DAY + k * 10**8 for k in range(9)]
    turns = np.array([Rotation.from_matrix(pose[:3, :3]).as_quat() for pose in poses()])
    result_files.write_trajectory(folder / "trajectory.tum", stamps, poses()[:, :3, 3], turns)
    grey = cv2.imencode(".jpg", np.full((CAMERA.height, CAMERA.width), 120, np.uint8))[1].tobytes()
    with (folder / "out.mcap").open("wb") as stream, BagWriter(stream) as bag:
        for stamp in stamps:
            bag.write("/k/camera_info", cdr.CAMERA_INFO, cdr.write_camera_info(stamp, "camera", CAMERA), stamp)
            image = cdr.write_compressed_image(stamp, "camera", "jpeg", grey)
            bag.write("/k/image/compressed", cdr.COMPRESSED_IMAGE, image, stamp)
    return folder
