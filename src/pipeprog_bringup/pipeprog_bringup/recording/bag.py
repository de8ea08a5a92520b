# SPDX-License-Identifier: Apache-2.0
"""Recordings: the images of one camera with its calibration, from an .mcap file or a rosbag2 folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from pipeprog_bringup.recording import cdr
from pipeprog_bringup.recording.bag_folder import parts
from pipeprog_bringup.recording.frame_check import Calibration, FrameCheck, ImageMessage
from pipeprog_bringup.recording.mcap_file import McapFile, Message
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_CAMERAS, MAX_TRIED_IMAGES

_IMAGE_TYPES = (cdr.COMPRESSED_IMAGE, cdr.IMAGE)
TF, TF_STATIC = "/tf", "/tf_static"
# Depth and disparity images have the same message types as pictures; no camera's picture has these encodings.
_USED_TYPES = {*_IMAGE_TYPES, cdr.CAMERA_INFO, cdr.ODOMETRY, cdr.IMU, cdr.TF}
_LISTED = 20  # topics that an error names
_DEPTH_ENCODINGS = ("16UC1", "32FC1", "32FC2")


@dataclass(frozen=True)
class MotionMessage:
    """One message of a robot's motion: the topic of pipeprog's graph that it belongs on, its type, its CDR bytes."""

    topic: str
    type_name: str
    data: bytes


@dataclass(frozen=True)
class Bag:
    """One camera of a recording; iterate it for its frames in the order in which they were recorded."""

    path: Path
    image_topic: str
    image_type: str
    camera_info_topic: str
    image_count: int
    camera: Camera
    motion_topics: dict[str, str]  # of the recording -> of the graph
    notes: list[str]  # one sentence for each kind of motion that is not used, and why
    _motion_types: dict[str, str]
    _files: tuple[McapFile, ...]
    _first_calibration: Calibration
    _left_out: Counter[str]  # messages of the last pass that are damaged, by topic

    @classmethod
    def open(
        cls,
        path: Path,
        image_topic: str | None = None,
        camera_info_topic: str | None = None,
        odometry_topic: str | None = None,
        imu_topic: str | None = None,
    ) -> Bag:
        """Find the camera of the recording `path` and check that its images and its calibration fit.

        Topics that are not given are found by their types. Raises InputError where the recording cannot be read, holds
        no calibrated camera or several, or where image and CameraInfo differ in size.
        """
        files = tuple(McapFile.open(part) for part in parts(path))
        counts, types = _topics(files, path)
        image_topic, info_topic = _choose(path, files, counts, types, image_topic, camera_info_topic)
        infos = (message.data for message in _messages(files, {info_topic}))
        first_calibration, camera = _first_camera(path, info_topic, infos)
        motion, notes = _choose_motion(path, types, odometry_topic, imu_topic)
        motion_types = {topic: types[topic] for topic in motion}
        bag = cls(
            path,
            image_topic,
            types[image_topic],
            info_topic,
            counts[image_topic],
            camera,
            motion,
            notes,
            motion_types,
            files,
            first_calibration,
            Counter(),
        )
        bag._check_images()
        return bag

    def __iter__(self) -> Iterator[ImageMessage]:
        """Stream the images; each carries the CameraInfo last recorded for its frame (the first one, before any)."""
        return (message for message in self._stream(set()) if isinstance(message, ImageMessage))

    def with_motion(self) -> Iterator[ImageMessage | MotionMessage]:
        """Stream the images, and the messages of odometry, TF and IMU between them; static transforms come first."""
        for topic in sorted(self.motion_topics):
            if self.motion_topics[topic] == TF_STATIC:
                for message in _messages(self._files, {topic}):
                    yield MotionMessage(TF_STATIC, self._motion_types[topic], message.data)
        yield from self._stream({topic for topic, target in self.motion_topics.items() if target != TF_STATIC})

    def _stream(self, motion: set[str]) -> Iterator[ImageMessage | MotionMessage]:
        check = FrameCheck(self.image_type, self.camera_info_topic, self._first_calibration)
        for topic, message in _tagged(self._files, {self.image_topic, self.camera_info_topic, *motion}):
            if topic in motion:
                yield MotionMessage(self.motion_topics[topic], self._motion_types[topic], message.data)
            elif topic == self.camera_info_topic:
                check.calibrate(message.data)
                self._left_out[topic] = check.damaged
            else:
                yield check.image(message.data, message.log_time)

    @property
    def losses(self) -> list[str]:
        """The parts of the recording that cannot be read, one sentence each; complete once it was read to its end."""
        damaged = [f"{count} messages on {topic} left out: damaged" for topic, count in self._left_out.items() if count]
        return [note for file in self._files for note in file.losses()] + damaged

    def _check_images(self) -> None:
        """Raises InputError where none of the first images can be used; its text has their most frequent fault."""
        faults: Counter[str] = Counter()
        for frame in islice(self, MAX_TRIED_IMAGES):
            if not frame.fault:
                return
            faults[frame.fault] += 1
        tried = f"first {MAX_TRIED_IMAGES}" if faults.total() == MAX_TRIED_IMAGES else str(self.image_count)
        fault = faults.most_common(1)[0][0] if faults else "their chunks are damaged"
        raise InputError(f"{self.path}: none of the {tried} images on {self.image_topic} can be used: {fault}")


def _topics(files: tuple[McapFile, ...], path: Path) -> tuple[Counter[str], dict[str, str]]:
    """Messages per topic, type per topic; raises InputError where there is nothing in the recording."""
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    for file in files:
        for channel_id, channel in file.channels.items():
            if not file.counts[channel_id]:
                continue
            if channel.encoding == "ros1":
                raise InputError(f"{file.path} is a ROS 1 recording: convert it to ROS 2 (message encoding cdr)")
            counts[channel.topic] += file.counts[channel_id]
            known = types.setdefault(channel.topic, channel.type_name)
            if known != channel.type_name and {known, channel.type_name} & _USED_TYPES:
                raise InputError(
                    f"{file.path}: {channel.topic} has messages of two types, {known} and {channel.type_name}: "
                    "record it again under two names"
                )
    if not counts:
        notes = "; ".join(note for file in files for note in file.losses())
        raise InputError(f"{path} holds no messages" + (f" ({notes})" if notes else ": record it again"))
    return counts, types


def _choose(
    path: Path,
    files: tuple[McapFile, ...],
    counts: Counter[str],
    types: dict[str, str],
    image_topic: str | None,
    info_topic: str | None,
) -> tuple[str, str]:
    """The topics of the one camera; raises InputError that lists the cameras where there are several or none."""
    infos = sorted(topic for topic, name in types.items() if name == cdr.CAMERA_INFO)
    images = sorted(topic for topic, name in types.items() if name in _IMAGE_TYPES)
    for flag, topic, known in (("--image-topic", image_topic, images), ("--camera-info-topic", info_topic, infos)):
        if topic is not None and topic not in known:
            raise InputError(f"{path}: {flag} {topic} is not among its topics: {_listed(known) or 'none of that type'}")
    if image_topic is None:
        few = len(images) <= MAX_CAMERAS  # each is looked into; of more the error names some in any case
        cameras = [topic for topic in images if not (few and _is_depth(files, topic, types[topic]))]
        # The same picture is often recorded raw and compressed; frames passes keyframes on compressed in any case.
        cameras = [
            topic for topic in cameras if types[topic] == cdr.COMPRESSED_IMAGE or f"{topic}/compressed" not in cameras
        ]
        if info_topic is not None:
            beside = [topic for topic in cameras if _sibling_info(topic) == info_topic]
            cameras = beside or cameras
    else:
        cameras = [image_topic]
    if not cameras:
        kinds = _listed([f"{topic} ({name or 'no type'})" for topic, name in sorted(types.items())])
        raise InputError(f"{path} holds no images (sensor_msgs Image or CompressedImage): its topics are {kinds}")
    if not infos:
        raise InputError(
            f"{path} holds images on {_listed(cameras)} but no sensor_msgs/CameraInfo: record that topic too"
        )
    if len(cameras) == 1:
        if info_topic is not None:
            return cameras[0], info_topic
        if len(infos) == 1:
            return cameras[0], infos[0]
        if _sibling_info(cameras[0]) in infos:
            return cameras[0], _sibling_info(cameras[0])
    choices = [
        f"  --image-topic {camera} --camera-info-topic {info}   # {counts[camera]} images"
        for camera in cameras
        for info in ([_sibling_info(camera)] if _sibling_info(camera) in infos else infos)
    ]
    more = [f"  and {len(choices) - _LISTED} more"] if len(choices) > _LISTED else []
    raise InputError(f"{path} holds several cameras: choose one with\n" + "\n".join(choices[:_LISTED] + more))


def _choose_motion(
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


def _sibling_info(image_topic: str) -> str:
    """The camera_info topic that belongs to an image topic by image_transport's convention."""
    base = image_topic.removesuffix("/compressed")
    return f"{base.rpartition('/')[0]}/camera_info"


def _is_depth(files: tuple[McapFile, ...], topic: str, type_name: str) -> bool:
    first = next(_messages(files, {topic}), None)
    try:
        encoding = cdr.read_image(first.data, type_name).encoding if first else ""
    except ValueError:
        return False
    return encoding.startswith(_DEPTH_ENCODINGS) or "compressedDepth" in encoding


def _first_camera(path: Path, topic: str, infos: Iterator[bytes]) -> tuple[Calibration, Camera]:
    """The first CameraInfo that can be read, and its camera."""
    for data in infos:
        try:
            calibration, info = Calibration.read(data), cdr.read_camera_info(data)
        except ValueError:
            continue
        try:
            return calibration, info.camera()
        except InputError as error:
            raise InputError(f"{path}: {topic}: {error}") from None
    raise InputError(f"{path}: no message on {topic} can be read: record it again")


def _messages(files: tuple[McapFile, ...], topics: set[str]) -> Iterator[Message]:
    return (message for _, message in _tagged(files, topics))


def _tagged(files: tuple[McapFile, ...], topics: set[str]) -> Iterator[tuple[str, Message]]:
    for file in files:
        names = {number: channel.topic for number, channel in file.channels.items() if channel.topic in topics}
        for message in file.messages(set(names)):
            yield names[message.channel_id], message
