# SPDX-License-Identifier: Apache-2.0
"""A survey from Python: images, their camera and a board file in; poses, a metric cloud and pipes out, without ROS.

    python examples/survey_from_python.py bags/demo.mcap bags/demo.board.yaml bags/demo.boq.yaml

It wires the parts of the three nodes in the simplest way: frames are chosen once, nothing is retired, and one map is
made at the end. `pipeprog replay` also lets the reconstruction's answers correct the choice of frames.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from mcap_ros2.reader import read_ros2_messages

import pipeprog
from pipeprog_detect.keyframe_cache import Keyframes
from pipeprog_frames.incoming.decoding import decode_reduced
from pipeprog_sfm.reconstruction import MetricMap


def recorded(bag: Path, seconds: float, half: bool) -> Iterator[tuple[int, bytes]]:
    """Stamps [ns] and JPEG or PNG bytes of a recording's first seconds; frames of a video or of files will do as well.

    `half`: in half the size, for a quick look.
    """
    first = None
    for message in read_ros2_messages(bag, topics=["/camera/image/compressed"]):
        stamp = message.log_time_ns
        first = stamp if first is None else first
        if stamp - first > seconds * 1e9:
            return
        image = bytes(message.ros_msg.data)
        yield stamp, _halved(image) if half else image


def _halved(image: bytes) -> bytes:
    pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_GRAYSCALE)
    return cv2.imencode(".png", cv2.resize(pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))[1].tobytes()


def calibration(bag: Path) -> pipeprog.Camera:
    """The camera of a recording; with a calibration of your own: Camera(width, height, fx, fy, cx, cy, ...)."""
    info = next(read_ros2_messages(bag, topics=["/camera/camera_info"])).ros_msg
    return pipeprog.Camera.from_calibration(info.width, info.height, info.k, info.distortion_model, info.d)


def keyframes(images: Iterable[tuple[int, bytes]], camera: pipeprog.Camera) -> dict[int, bytes]:
    """The images worth reconstructing, by stamp."""
    selector = pipeprog.FrameSelector(pipeprog.FramesConfig(), camera)
    encoded, decisions = {}, []
    for stamp, image in images:
        encoded[stamp] = image
        decisions += selector.consider(stamp, lambda image=image: decode_reduced(image, camera.width))  # type: ignore[misc]
    decisions += selector.flush()
    return {decision.stamp: encoded[decision.stamp] for decision in decisions if decision.chosen}


def reconstruct(chosen: dict[int, bytes], camera: pipeprog.Camera, boards: Path) -> MetricMap:
    """Poses and cloud in metres; raises NotMetricError where nothing tells the scale."""
    reconstruction = pipeprog.Reconstruction(pipeprog.SfmConfig(), pipeprog.load_board_file(boards))
    for stamp in sorted(chosen):
        reconstruction.add(stamp, chosen[stamp], camera)
    return reconstruction.finish()


def pipes_of(
    metric_map: MetricMap, chosen: dict[int, bytes], camera: pipeprog.Camera, boq: Path
) -> list[pipeprog.Pipe]:
    """Pipes found in the cloud and measured in the keyframes."""
    cache = Keyframes()
    for stamp, image in chosen.items():
        cache.add(stamp, image, camera)
    poses = zip(metric_map.trajectory.stamps.tolist(), metric_map.trajectory.map_from_camera, strict=True)
    views = [cache.view(stamp, map_from_camera) for stamp, map_from_camera in poses]
    cloud = pipeprog.Cloud(metric_map.cloud.points.astype(np.float64), metric_map.cloud.normals.astype(np.float64))
    return pipeprog.detect(cloud, pipeprog.load_boq(boq), views)


def main() -> None:
    """Surveys a recording and prints what it found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("boards", type=Path)
    parser.add_argument("boq", type=Path)
    parser.add_argument("--seconds", type=float, default=np.inf, help="take no more of the recording")
    parser.add_argument("--half", action="store_true", help="halve the images, for a quick look")
    arguments = parser.parse_args()
    camera = calibration(arguments.bag).scaled(0.5 if arguments.half else 1.0)
    chosen = keyframes(recorded(arguments.bag, arguments.seconds, arguments.half), camera)
    metric_map = reconstruct(chosen, camera, arguments.boards)
    scale = metric_map.scale
    print(f"{len(metric_map.trajectory.stamps)} of {len(chosen)} keyframes have a pose")
    print(f"scale from {scale.source}, sigma {100 * scale.sigma:.3f} %; {len(metric_map.cloud.points)} points")
    for pipe in pipes_of(metric_map, chosen, camera, arguments.boq):
        radius = f"{1e3 * pipe.cylinder.radius:.2f} +- {1e3 * pipe.radius_sigma:.2f} mm"
        print(f"{pipe.id}  {pipe.class_name or 'no planned class':16}  r {radius}  {pipe.cylinder.length:.2f} m")


if __name__ == "__main__":
    main()
