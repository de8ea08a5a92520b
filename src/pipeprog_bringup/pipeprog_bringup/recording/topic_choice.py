# SPDX-License-Identifier: Apache-2.0
"""Which topics of a recording are the camera, its calibration and the robot's motion."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.message_file import MessageFile, messages_of
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CAMERAS

# Of one picture in several of these, the first is read.
IMAGE_TYPES = (cdr.COMPRESSED_IMAGE, cdr.IMAGE, cdr.COMPRESSED_VIDEO, cdr.FFMPEG_PACKET)
TF, TF_STATIC = "/tf", "/tf_static"
_TRANSPORTS = ("compressed", "ffmpeg", "foxglove")  # of image_transport
_REALSENSE = "/image/data"  # what the SDK of RealSense adds to the name of a stream
_LISTED = 20  # topics that an error names
# Depth and disparity images have the same message types as pictures; no camera's picture has these encodings.
_DEPTH_ENCODINGS = ("16UC1", "32FC1", "32FC2")


def choose_camera(
    path: Path,
    files: tuple[MessageFile, ...],
    counts: Counter[str],
    types: dict[str, str],
    image_topic: str | None,
    info_topic: str | None,
) -> tuple[str, str]:
    """The topics of the one camera; raises InputError that lists the cameras where there are several or none."""
    infos = sorted(topic for topic, name in types.items() if name == cdr.CAMERA_INFO)
    images = sorted(topic for topic, name in types.items() if name in IMAGE_TYPES)
    for flag, topic, known in (("--image-topic", image_topic, images), ("--camera-info-topic", info_topic, infos)):
        if topic is not None and topic not in known:
            raise InputError(f"{path}: {flag} {topic} is not among its topics: {_listed(known) or 'none of that type'}")
    if image_topic is None:
        cameras = _cameras(files, types, images)
        if info_topic is not None:
            cameras = [topic for topic in cameras if info_topic in _own_infos(files, topic, types, infos)] or cameras
    else:
        cameras = [image_topic]
    if not cameras:
        kinds = _listed([f"{topic} ({name or 'no type'})" for topic, name in sorted(types.items())])
        raise InputError(
            f"{path} holds no images (sensor_msgs Image or CompressedImage, or video): its topics are {kinds}"
        )
    if not infos:
        raise InputError(
            f"{path} holds images on {_listed(cameras)} but no sensor_msgs/CameraInfo: record that topic too"
        )
    if len(cameras) == 1:
        if info_topic is not None:
            return cameras[0], info_topic
        own = _own_infos(files, cameras[0], types, infos)
        if len(own) == 1:
            return cameras[0], own[0]
    choices = [
        f"  --image-topic {camera} --camera-info-topic {info}   # {counts[camera]} images"
        for camera in cameras
        for info in _own_infos(files, camera, types, infos)
    ]
    more = [f"  and {len(choices) - _LISTED} more"] if len(choices) > _LISTED else []
    raise InputError(
        f"{path} holds several cameras: take all of a robot's with --rig, or choose one with\n"
        + "\n".join(choices[:_LISTED] + more)
    )


def rig_topics(
    path: Path, files: tuple[MessageFile, ...], counts: Counter[str], types: dict[str, str]
) -> list[tuple[str, str]]:
    """Image and CameraInfo topic of each camera; raises InputError where a camera has no calibration of its own."""
    infos = sorted(topic for topic, name in types.items() if name == cdr.CAMERA_INFO)
    cameras = _cameras(files, types, sorted(topic for topic, name in types.items() if name in IMAGE_TYPES))
    if not 1 < len(cameras) <= MAX_CAMERAS:
        return [choose_camera(path, files, counts, types, None, None)]
    pairs = []
    for camera in cameras:
        own = _own_infos(files, camera, types, infos)
        if len(own) != 1:
            raise InputError(f"{path}: which CameraInfo is that of {camera}? Candidates: {_listed(own) or 'none'}")
        pairs.append((camera, own[0]))
    return pairs


def _cameras(files: tuple[MessageFile, ...], types: dict[str, str], images: list[str]) -> list[str]:
    """Image topics, one of each camera: no depth, and of one picture in several encodings the best."""
    few = len(images) <= MAX_CAMERAS  # each is looked into; of more the error names some in any case
    cameras = [topic for topic in images if not (few and _is_depth(files, topic, types[topic]))]
    # The same picture is often recorded several times; frames passes keyframes on compressed in any case.
    rank = {topic: IMAGE_TYPES.index(types[topic]) for topic in cameras}
    best = {_base(topic): min(rank[same] for same in cameras if _base(same) == _base(topic)) for topic in cameras}
    return [topic for topic in cameras if rank[topic] == best[_base(topic)]]


def choose_motion(
    path: Path, types: dict[str, str], odometry_topic: str | None, imu_topic: str | None
) -> tuple[dict[str, str], list[str]]:
    """Topics of a robot's motion and where in the graph they belong; notes where none of several is used."""
    chosen = {topic: TF_STATIC if topic.endswith("static") else TF for topic, name in types.items() if name == cdr.TF}
    notes = []
    for flag, wanted, target, type_name in (
        ("--odometry-topic", odometry_topic, "odometry", cdr.ODOMETRY),
        ("--imu-topic", imu_topic, "imu", cdr.IMU),
    ):
        known = sorted(topic for topic, name in types.items() if name == type_name)
        if wanted is not None and wanted not in known:
            raise InputError(
                f"{path}: {flag} {wanted} is not among its topics: {_listed(known) or 'none of that type'}"
            )
        if wanted is not None or len(known) == 1:
            chosen[wanted or known[0]] = target
        elif known:
            notes.append(
                f"{path} holds several topics of {type_name}, and none is used: choose one with "
                + " or ".join(f"{flag} {topic}" for topic in known[:_LISTED])
            )
    return chosen, notes


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more


def _own_infos(files: tuple[MessageFile, ...], image_topic: str, types: dict[str, str], infos: list[str]) -> list[str]:
    """The camera_info topics that may belong to an image topic: one where the names or the frames tell, else all.

    image_transport has camera/camera_info beside camera/image and camera/image/compressed; Spot's driver has
    frontleft/camera_info beside frontleft/compressed, RealSense's SDK Color_0/info/camera_info for Color_0/image/data.
    """
    base = _base(image_topic)
    beside = [f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info"]
    if base.endswith(_REALSENSE):
        beside = [f"{base.removesuffix(_REALSENSE)}/info/camera_info"]
    named = [topic for topic in beside if topic in infos]
    if len(infos) == 1 or len(named) == 1:
        return named or infos
    frame = image_frame(files, image_topic, types[image_topic])
    same = [topic for topic in (named or infos) if frame and image_frame(files, topic, cdr.CAMERA_INFO) == frame]
    return same if len(same) == 1 else named[:1] or infos


def _base(image_topic: str) -> str:
    """The topic that image_transport would publish the raw images on."""
    base, _, transport = image_topic.rpartition("/")
    return base if transport in _TRANSPORTS else image_topic


def image_frame(files: tuple[MessageFile, ...], topic: str, type_name: str) -> str:
    """The frame of the topic's first message; empty where it cannot be read."""
    first = next(messages_of(files, {topic}), None)
    if first is None:
        return ""
    try:
        read = (
            cdr.read_camera_info(first.data) if type_name == cdr.CAMERA_INFO else cdr.read_image(first.data, type_name)
        )
    except ValueError:
        return ""
    return read.frame_id


def _is_depth(files: tuple[MessageFile, ...], topic: str, type_name: str) -> bool:
    if topic.endswith(_REALSENSE) and "/Depth_" in topic:  # encoded as mono16
        return True
    first = next(messages_of(files, {topic}), None)
    try:
        encoding = cdr.read_image(first.data, type_name).encoding if first else ""
    except ValueError:
        return False
    return encoding.startswith(_DEPTH_ENCODINGS) or "compressedDepth" in encoding
