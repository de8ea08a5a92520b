# SPDX-License-Identifier: Apache-2.0
"""A recording on disk: NAME.mcap with images and calibration, and NAME.truth.json, .boq.yaml, .board.yaml."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer
from numpy.typing import NDArray

from sitegen.render import Lens
from sitegen.robot import RobotMessage, camera_frame
from sitegen.site import BOARD_CENTRES, BOARD_CIRCLE_RADIUS, CLASSES, Site

FloatArray = NDArray[np.float64]

FIRST_STAMP = 1_700_000_000_000_000_000
_SECOND = 1_000_000_000

_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
_RULE = "=" * 80 + "\n"
_COMMON = f"{_RULE}MSG: std_msgs/Header\n{_HEADER}{_RULE}MSG: builtin_interfaces/Time\n{_TIME}"
_IMAGE = "std_msgs/Header header\nstring format\nuint8[] data\n" + _COMMON
_INFO = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    + _COMMON
    + f"{_RULE}MSG: sensor_msgs/RegionOfInterest\n"
    "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
)


_XYZ, _XYZW = "float64 x\nfloat64 y\nfloat64 z\n", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_TRANSFORM = (
    f"{_RULE}MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    f"{_RULE}MSG: geometry_msgs/Vector3\n{_XYZ}{_RULE}MSG: geometry_msgs/Quaternion\n{_XYZW}"
)
_MOTION = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"
    f"{_RULE}MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    f"geometry_msgs/Transform transform\n{_TRANSFORM}{_COMMON}",
    "nav_msgs/msg/Odometry": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    f"{_RULE}MSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n"
    f"{_RULE}MSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{_RULE}MSG: geometry_msgs/TwistWithCovariance\ngeometry_msgs/Twist twist\nfloat64[36] covariance\n"
    f"{_RULE}MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
    f"{_RULE}MSG: geometry_msgs/Point\n{_XYZ}{_RULE}MSG: geometry_msgs/Vector3\n{_XYZ}"
    f"{_RULE}MSG: geometry_msgs/Quaternion\n{_XYZW}{_COMMON}",
    "sensor_msgs/msg/Imu": "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
    "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
    "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
    "float64[9] linear_acceleration_covariance\n"
    f"{_RULE}MSG: geometry_msgs/Quaternion\n{_XYZW}{_RULE}MSG: geometry_msgs/Vector3\n{_XYZ}{_COMMON}",
}


def camera_info(lens: Lens, focal_error: float, leave_out_distortion: bool) -> dict[str, Any]:
    """The CameraInfo of a calibration, without header; `focal_error` is relative."""
    fx, fy = lens.fx * (1 + focal_error), lens.fy * (1 + focal_error)
    return {
        "height": lens.height,
        "width": lens.width,
        "distortion_model": "equidistant" if lens.is_fisheye else "plumb_bob",
        "d": [0.0] * len(lens.distortion) if leave_out_distortion else list(lens.distortion),
        "k": [fx, 0.0, lens.cx, 0.0, fy, lens.cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, lens.cx, 0.0, 0.0, fy, lens.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def write_bag(
    path: Path, info: dict[str, Any], frames: Iterable[tuple[int, int, bytes]], motion: Iterable[RobotMessage] = ()
) -> None:
    """Write (stamp in ns, number of the camera, JPEG bytes) with one CameraInfo each, at equal stamps.

    A file under its name is complete.

    `motion` are the messages of a robot, in order of time.
    """
    part = path.with_name(path.name + ".part")
    with part.open("wb") as stream, Writer(stream) as writer:
        image_schema = writer.register_msgdef("sensor_msgs/msg/CompressedImage", _IMAGE)
        info_schema = writer.register_msgdef("sensor_msgs/msg/CameraInfo", _INFO)
        schemas = {name: writer.register_msgdef(name, text) for name, text in _MOTION.items()}
        waiting = deque(motion)

        def write_motion(until: float) -> None:
            while waiting and waiting[0].stamp <= until:
                one = waiting.popleft()
                writer.write_message(one.topic, schemas[one.type_name], one.message, one.stamp, one.stamp)

        for sequence, (stamp, camera, data) in enumerate(frames):
            write_motion(stamp)
            header = {"stamp": {"sec": stamp // _SECOND, "nanosec": stamp % _SECOND}, "frame_id": camera_frame(camera)}
            topic = f"/camera{camera or ''}"
            times = {"log_time": stamp, "publish_time": stamp, "sequence": sequence}
            writer.write_message(f"{topic}/camera_info", info_schema, {"header": header, **info}, **times)
            image = {"header": header, "format": "jpeg", "data": data}
            writer.write_message(f"{topic}/image/compressed", image_schema, image, **times)
        write_motion(math.inf)
    part.replace(path)


def truth(
    site: Site, lens: Lens, fps: float, poses: FloatArray, stamps: Sequence[int], seen: Sequence[float]
) -> dict[str, Any]:
    """What is true of a recording, as plain values; (N, 4, 4) poses at the middle of each exposure, at `stamps` [ns].

    `seen` is the share of each pipe's length that at least three frames show.
    """
    return {
        "width": lens.width,
        "height": lens.height,
        "fps": fps,
        "fx": lens.fx,
        "fy": lens.fy,
        "cx": lens.cx + 0.5,
        "cy": lens.cy + 0.5,
        "distortion_model": "equidistant" if lens.is_fisheye else "plumb_bob",
        "distortion": list(lens.distortion),
        "planned_radii": list(site.planned_radii),
        "pipes": [
            {
                "id": index,
                "start": pipe.start.tolist(),
                "end": pipe.end.tolist(),
                "radius": pipe.radius,
                "length": pipe.length,
                "material": pipe.material,
                "ends": list(pipe.ends),
                "seen": round(share, 3),
            }
            for index, (pipe, share) in enumerate(zip(site.pipes, seen, strict=True))
        ],
        "ignore": [{"start": a.tolist(), "end": b.tolist(), "radius": r} for a, b, r in site.ignored],
        "boards": [board.tolist() for board in site.boards],
        "board_radius": BOARD_CIRCLE_RADIUS,
        "camera_to_world": poses.tolist(),
        "stamps": list(stamps),
        "note": "metres; camera_to_world: optical frame, one per image, at the middle of its exposure; "
        "cx, cy: corner convention (ROS CameraInfo is 0.5 less); board_radius: circle radius",
    }


def write_truth(path: Path, values: dict[str, Any]) -> None:
    """Write the truth as one JSON document."""
    path.write_text(json.dumps(values) + "\n", encoding="utf-8")


def write_boq(path: Path, site: Site) -> None:
    """Write the bill of quantities."""
    lines = ["classes:"]
    for (radius, material), metres in site.planned_lengths().items():
        name, colour = CLASSES[radius]
        size = f"outer_radius_mm: {radius * 1e3:g}, planned_length_m: {metres}"
        told = f"{{name: {name} {material}, {size}, material: {material}}}" if material else ""
        lines.append(f"  - {told or f'{{name: {name}, {size}, color: {colour}}}'}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_boards(path: Path, count: int) -> None:
    """Write the circle centres of `count` boards, in each board's own frame."""
    centres = ", ".join(f"[{x * 1e3:g}, {y * 1e3:g}]" for x, y in BOARD_CENTRES)
    lines = ["boards:"]
    for name in "ABCDEFGH"[:count]:
        lines += [
            f"  - name: {name}",
            f"    circle_radius_mm: {BOARD_CIRCLE_RADIUS * 1e3:g}",
            f"    centres_mm: [{centres}]",
        ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
