# SPDX-License-Identifier: Apache-2.0
"""Recordings: the images of one camera with its calibration, from an .mcap, .db3 or .bag file or a rosbag2 folder.

Video is decoded on the way: it gives raw images.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from pipeprog_bringup.recording import cdr, ros1_file, sqlite_file
from pipeprog_bringup.recording.bag_folder import parts
from pipeprog_bringup.recording.frame_check import Calibration, FrameCheck, ImageMessage
from pipeprog_bringup.recording.mcap_file import McapFile
from pipeprog_bringup.recording.message_file import MessageFile, messages_of, tagged_messages
from pipeprog_bringup.recording.ros1_file import Ros1File
from pipeprog_bringup.recording.sqlite_file import SqliteFile
from pipeprog_bringup.recording.topic_choice import (
    IMAGE_TYPES,
    TF_STATIC,
    choose_camera,
    choose_motion,
    image_frame,
    rig_topics,
)
from pipeprog_bringup.recording.video_stream import VideoStream, video_codec
from pipeprog_camera.camera import Camera
from pipeprog_camera.errors import InputError
from pipeprog_camera.limits import MAX_TRIED_IMAGES
from pipeprog_camera.outside_text import shown
from pipeprog_camera.rig import unique_stamp
from pipeprog_camera.rolling_shutter import check_readout

_USED_TYPES = {*IMAGE_TYPES, cdr.CAMERA_INFO, cdr.ODOMETRY, cdr.IMU, cdr.TF}

_FORMATS: dict[bytes, type[SqliteFile] | type[Ros1File]] = {sqlite_file.MAGIC: SqliteFile, ros1_file.MAGIC: Ros1File}


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
    image_type: str  # of the images that come out
    camera_info_topic: str
    image_count: int
    camera: Camera
    motion_topics: dict[str, str]  # of the recording -> of the graph
    notes: list[str]  # one sentence for each kind of motion that is not used, and why
    _motion_types: dict[str, str]
    _files: tuple[MessageFile, ...]
    _first_calibration: Calibration
    _left_out: Counter[str]  # messages of the last pass that are damaged, by topic
    _recorded_type: str  # of the image topic; other than image_type where it is video
    _codec: str  # of that video; empty: pictures
    frame_id: str = ""  # of the first image
    rig: tuple[Bag, ...] = ()  # all cameras, this one first; empty: one camera

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
        files = tuple(_opened(part) for part in parts(path))
        counts, types = _topics(files, path)
        image_topic, info_topic = choose_camera(path, files, counts, types, image_topic, camera_info_topic)
        infos = (message.data for message in messages_of(files, {info_topic}))
        first_calibration, camera = _first_camera(path, info_topic, infos)
        images = (message.data for message in messages_of(files, {image_topic}))
        codec = video_codec(image_topic, types[image_topic], images)
        frame_id = image_frame(files, image_topic, types[image_topic])
        motion, notes = choose_motion(path, types, odometry_topic, imu_topic)
        motion_types = {topic: types[topic] for topic in motion}
        bag = cls(
            path,
            image_topic,
            cdr.IMAGE if codec else types[image_topic],
            info_topic,
            counts[image_topic],
            camera,
            motion,
            notes,
            motion_types,
            files,
            first_calibration,
            Counter(),
            types[image_topic],
            codec,
            frame_id,
        )
        bag._check_images()
        return bag

    @classmethod
    def open_rig(cls, path: Path, odometry_topic: str | None = None, imu_topic: str | None = None) -> Bag:
        """All cameras of a recording as one rig; the first one stands for it. Raises InputError as `open`."""
        files = tuple(_opened(part) for part in parts(path))
        counts, types = _topics(files, path)
        pairs = rig_topics(path, files, counts, types)
        rig = tuple(cls.open(path, image, info, odometry_topic, imu_topic) for image, info in pairs)
        frames = [bag.frame_id for bag in rig]
        if len(rig) > 1 and (len(set(frames)) < len(rig) or any(frame.split() != [frame] for frame in frames)):
            raise InputError(
                f"{path}: the frame_id of the cameras {', '.join(bag.image_topic for bag in rig)} is "
                f"{', '.join(map(shown, frames))}: give each camera one of its own, or choose one with --image-topic"
            )
        if len({bag.image_type for bag in rig}) > 1 or any(bag._codec for bag in rig):
            raise InputError(f"{path}: a rig's cameras send all JPEG or PNG, or all raw images: choose --image-topic")
        count = sum(bag.image_count for bag in rig)
        return replace(rig[0], image_count=count, rig=rig) if len(rig) > 1 else rig[0]

    def __iter__(self) -> Iterator[ImageMessage]:
        """Stream the images; each carries the CameraInfo last recorded for its frame (the first one, before any)."""
        return (message for message in self._stream(set()) if isinstance(message, ImageMessage))

    def messages(self, topic: str) -> Iterator[bytes]:
        """The messages of another topic of the recording, in CDR."""
        return (message.data for message in messages_of(self._files, {topic}))

    def with_motion(self) -> Iterator[ImageMessage | MotionMessage]:
        """Stream the images, and the messages of odometry, TF and IMU between them; static transforms come first."""
        for topic in sorted(self.motion_topics):
            if self.motion_topics[topic] == TF_STATIC:
                for message in messages_of(self._files, {topic}):
                    yield MotionMessage(TF_STATIC, self._motion_types[topic], message.data)
        yield from self._stream({topic for topic, target in self.motion_topics.items() if target != TF_STATIC})

    def _stream(self, motion: set[str]) -> Iterator[ImageMessage | MotionMessage]:
        if self.rig:
            yield from self._stream_rig(motion)
            return
        check = self._frame_check()
        video = VideoStream(self._recorded_type, self._codec, check) if self._codec else None
        for topic, message in tagged_messages(self._files, {self.image_topic, self.camera_info_topic, *motion}):
            if topic in motion:
                yield MotionMessage(self.motion_topics[topic], self._motion_types[topic], message.data)
            elif topic == self.camera_info_topic:
                check.calibrate(message.data)
                self._left_out[topic] = check.damaged
            elif video:
                yield from video.take(message.data, message.log_time)
            else:
                yield check.image(message.data, message.log_time)
        if video:
            yield from video.finish()

    def _stream_rig(self, motion: set[str]) -> Iterator[ImageMessage | MotionMessage]:
        """As `_stream`, with the images of all cameras under stamps of their own: theirs may be equal."""
        checks = [bag._frame_check() for bag in self.rig]
        images = {bag.image_topic: number for number, bag in enumerate(self.rig)}
        infos = {bag.camera_info_topic: number for number, bag in enumerate(self.rig)}
        for topic, message in tagged_messages(self._files, {*images, *infos, *motion}):
            if topic in motion:
                yield MotionMessage(self.motion_topics[topic], self._motion_types[topic], message.data)
            elif topic in infos:
                check = checks[infos[topic]]
                check.calibrate(message.data)
                self._left_out[topic] = check.damaged
            else:
                number = images[topic]
                image = checks[number].image(message.data, message.log_time)
                frame_id = self.rig[number].frame_id
                stamp = unique_stamp(image.stamp, number)
                fault = image.fault or ("" if image.frame_id == frame_id else "calibration: its frame_id has changed")
                data = image.data if fault else cdr.with_stamp(image.data, stamp)
                yield replace(image, stamp=stamp, data=data, fault=fault)

    def _frame_check(self) -> FrameCheck:
        return FrameCheck(self.image_type, self.camera_info_topic, self._first_calibration)

    @property
    def readout(self) -> float | None:
        """The read-out of the camera [s] that `ingest` has noted; None where it is not told."""
        facts = [file.facts for file in self._files if isinstance(file, McapFile)]
        told = [fact[key] for fact in facts if (key := readout_key(self.image_topic)) in fact]
        try:
            readout = float(told[0]) if told else None
            if readout is not None:
                check_readout(readout)
        except (ValueError, InputError) as error:
            raise InputError(f"{self.path}: {error}: ingest the video again, or give --set sfm.readout=...") from None
        return readout

    @property
    def focal_sigma(self) -> float | None:
        """The relative standard deviation of a focal length that is a guess; None for a calibration."""
        facts = [file.facts for file in self._files if isinstance(file, McapFile)]
        told = [fact[key] for fact in facts if (key := focal_sigma_key(self.image_topic)) in fact]
        try:
            return float(told[0]) if told else None
        except ValueError:
            raise InputError(
                f"{self.path}: {told[0][:40]!r} is no standard deviation of a focal length: ingest the video again, or "
                "give --set sfm.calibration.focal_sigma=..."
            ) from None

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


def readout_key(image_topic: str) -> str:
    """The key of a recording's metadata record `pipeprog` that has the read-out of a camera."""
    return f"readout_{image_topic}"


def focal_sigma_key(image_topic: str) -> str:
    """The key of the same record that has the relative standard deviation of a focal length that is a guess."""
    return f"focal_sigma_{image_topic}"


def _opened(path: Path) -> MessageFile:
    """The file in the format that its first bytes say, whatever it is called."""
    with path.open("rb") as stream:
        beginning = stream.read(max(map(len, _FORMATS)))
    kinds = [kind for magic, kind in _FORMATS.items() if beginning.startswith(magic)]
    return kinds[0].open(path) if kinds else McapFile.open(path)


def _topics(files: tuple[MessageFile, ...], path: Path) -> tuple[Counter[str], dict[str, str]]:
    """Messages per topic, type per topic; raises InputError where there is nothing in the recording."""
    counts: Counter[str] = Counter()
    types: dict[str, str] = {}
    for file in files:
        for channel_id, channel in file.channels.items():
            if not file.counts[channel_id]:
                continue
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
