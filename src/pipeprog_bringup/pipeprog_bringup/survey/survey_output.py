# SPDX-License-Identifier: Apache-2.0
"""The results folder of a survey that is filmed now: keyframes go into it as they come, the rest at the end."""

from __future__ import annotations

import contextlib
import itertools
import shutil
from pathlib import Path
from typing import Any

from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from pipeprog_bringup.playback.frame_log import FrameLog
from pipeprog_bringup.playback.listener import LastMessages
from pipeprog_bringup.playback.survey_writer import (
    record_cameras,
    record_survey,
    seen_by,
    type_name,
    write_survey,
)
from pipeprog_bringup.recording.bag_writer import BagWriter
from pipeprog_bringup.results import result_files
from pipeprog_bringup.results.atomic_output import JOURNAL, OutputFolder
from pipeprog_bringup.results.plan_file import write_plan
from pipeprog_bringup.survey.goal import Goal
from pipeprog_bringup.survey.survey_journal import SurveyJournal
from pipeprog_camera.errors import InputError
from pipeprog_frames.incoming.frame_buffer import EncodedFrame
from pipeprog_msgs import msg
from pipeprog_node import messages
from pipeprog_node.processes.journal import written
from pipeprog_sfm.alignment.map_file import MAP_FILE

MIN_FREE = 1 << 30  # bytes; 1 GiB: the results of a field of 58 pipes take 0.4 GB, cloud and keyframes included


class SurveyOutput:
    """Writes one survey; nothing of it has its name before `write`, and nothing is left where that does not come.

    Attributes:
        path: the folder.
        journal: folder for what the nodes write down for the case that they are killed; it ends with the survey.
        is_paused: whether images of the robot are left out of recording.mcap.
    """

    def __init__(self, results: Path, goal: Goal, record: bool, left: Path | None = None) -> None:
        """`left`: the hidden folder of this survey, where the process that conducted it was killed.

        Raises InputError where the folder has another survey's files, or no room.
        """
        self.path = results / goal.name
        self._goal = goal
        self._open = contextlib.ExitStack()
        self._folder = self._open.enter_context(OutputFolder(self.path, left=left))
        if not self.has_room:
            self.discard()
            raise InputError(self.lack_of_room)
        self._recording = self._bag("out.mcap")
        version = result_files.package_version("pipeprog") or "unknown"
        self._recording.describe({"site": goal.site.boq_path.stem, "survey": goal.name, "pipeprog": version})
        self._input = self._bag(self._new_name("recording", "mcap")) if record else None
        self._images: set[int] = set()  # stamps of the keyframes that are written
        self._infos: dict[int, CameraInfo] = {}  # of the keyframes, by stamp
        self.journal = self._folder.file(JOURNAL)
        self.journal.mkdir(exist_ok=True)
        self._is_taken_up = left is not None
        self.is_paused = False

    @property
    def colmap(self) -> Path:
        """Where the sparse model goes."""
        return self._folder.file("colmap")

    @property
    def map(self) -> Path:
        """Where `write` puts the map, if there is one."""
        return self._folder.file(MAP_FILE)

    def journal_of(self, goal: bytes) -> SurveyJournal:
        """What the node `survey` writes down itself; raises InputError, with nothing left."""
        try:
            return SurveyJournal(self.journal, goal)
        except InputError:
            self.discard()
            raise

    def keep_image(self, image: CompressedImage, data: bytes) -> None:
        """Writes the image of a keyframe into out.mcap; `data`: the message as it came, in CDR."""
        stamp = messages.stamp_ns(image.header.stamp)
        if stamp in self._images:
            return
        self._images.add(stamp)
        self._recording.write("/keyframes/image/compressed", type_name(CompressedImage), data, stamp)

    def keep_calibration(self, info: CameraInfo) -> None:
        """Keeps the calibration of a keyframe for the end: the survey may refine it."""
        self._infos[messages.stamp_ns(info.header.stamp)] = info

    def keep_input(self, topic: str, kind: type, data: bytes, stamp: int) -> None:
        """Writes a message of the robot into recording.mcap, if the input is recorded; `stamp` [ns]: when it came."""
        if self._input is not None and not (self.is_paused and kind in (CompressedImage, Image)):
            self._input.write(topic, type_name(kind), data, stamp)

    def write(
        self, survey: LastMessages | None, status: msg.SfmStatus, log: FrameLog, about: dict[str, dict[str, Any]]
    ) -> None:
        """Writes all that there is; without a `survey` there is no map.

        `about`: what config.yaml and run.json are to say, under `config` and `run`.
        """
        if self._is_taken_up:
            self._keep_filmed()
        if survey is not None:
            record_survey(self._recording, survey, status)
            cameras = record_cameras(self._recording, survey, self._infos)
            seen = seen_by(survey, cameras, self._goal.site.boq.pipes)
            reference = self._goal.reference.map if self._goal.reference else None
            write_survey(self._folder, survey, log, seen, with_cloud=True, reference=reference)
        else:
            result_files.write_frames(self._folder.file("frames.csv"), log.rows())
        if self._goal.site.boq.pipes:
            write_plan(self._folder.file("plan.json"), self._goal.site.boq.pipes)
        result_files.write_config(self._folder.file("config.yaml"), about["config"])
        result_files.write_run(self._folder, about["run"])

    def publish(self) -> None:
        """Gives the files their names."""
        self._open.close()

    def rescue(self) -> str:
        """Ends with the recordings alone, where a fault ends the survey: the folder, empty where nothing was filmed."""
        if not self._images:
            self.discard()
            return ""
        for name in self._folder.names():
            if not name.endswith(".mcap"):  # it may be half written
                self._folder.file(name).unlink(missing_ok=True)
        self.publish()
        return str(self.path.resolve())

    def discard(self) -> None:
        """Ends without results."""
        with contextlib.suppress(_DiscardedError), self._open:
            raise _DiscardedError

    @property
    def has_room(self) -> bool:
        """Whether the disk has room for what a survey writes at its end."""
        return shutil.disk_usage(self.path).free >= MIN_FREE

    @property
    def lack_of_room(self) -> str:
        """What is said where there is none, with the remedy."""
        return f"less than {MIN_FREE >> 30} GiB is free for {self.path}: make room, or change the parameter results"

    def _keep_filmed(self) -> None:
        """Writes the keyframes that no message has brought: the selector's journal has all that were published.

        It is read at the end, for none is to be lost between the start of this process and its first message.
        """
        for change in written(self.journal / "frames.journal"):
            if isinstance(change, EncodedFrame):
                image = messages.compressed_image(change.stamp, change.frame_id, change.encoded)
                self.keep_image(image, serialize_message(image))
                self.keep_calibration(messages.info_from_camera(change.camera, change.stamp, change.frame_id))

    def _new_name(self, stem: str, ending: str) -> str:
        """NAME.ending, or NAME_2.ending, ... after a process that was killed."""
        names = (f"{stem}{f'_{number}' if number > 1 else ''}.{ending}" for number in itertools.count(1))
        return next(name for name in names if not self._folder.file(name).exists())

    def _bag(self, name: str) -> BagWriter:
        stream = self._open.enter_context(self._folder.file(name).open("wb"))
        return self._open.enter_context(BagWriter(stream))


class _DiscardedError(Exception):
    """Ends a survey without results."""
