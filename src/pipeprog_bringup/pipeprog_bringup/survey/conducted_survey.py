# SPDX-License-Identifier: Apache-2.0
"""One goal of the action: it is filmed, worked off and written, and the client is told where it stands."""

from __future__ import annotations

import math
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage

from pipeprog_bringup.playback.frame_log import LiveFrameLog
from pipeprog_bringup.playback.listener import LastMessages
from pipeprog_bringup.results import result_files
from pipeprog_bringup.survey.advice import advice
from pipeprog_bringup.survey.alignment_result import note_alignment
from pipeprog_bringup.survey.goal import Goal
from pipeprog_bringup.survey.missing_input import PATIENCE
from pipeprog_bringup.survey.passage import Cancelled, Passage, SurveyFailure
from pipeprog_bringup.survey.survey_journal import SurveyJournal
from pipeprog_bringup.survey.survey_output import SurveyOutput
from pipeprog_bringup.survey.time_remaining import TimeRemaining
from pipeprog_bringup.survey.waiting_client import Client
from pipeprog_camera.errors import InputError
from pipeprog_msgs.action import Survey
from pipeprog_node import messages, qos
from pipeprog_node.keyframe_input import CALIBRATIONS, DEPTH, IMAGES

FEEDBACK_PERIOD = 0.5  # s
PAUSED = "the survey is paused and takes no images: to go on, call the service survey/pause with data: false"
ROOM_PERIOD = 1.0  # s between two looks at the disk
# Shares of the work after filming that are done when a stage begins; measured on a lab: reconstruction 60 %.
_SHARE_BEFORE = {Survey.Feedback.RECONSTRUCTING: 0.0, Survey.Feedback.MEASURING: 0.6, Survey.Feedback.WRITING: 0.9}


class ConductedSurvey:
    """Runs a goal to its result."""

    def __init__(
        self,
        node: Node,
        client: Client,
        goal: Goal,
        output: SurveyOutput,
        journal: SurveyJournal,
        tick: Callable[[], Awaitable[None]],
        is_end_asked: Callable[[], bool],
        lack: Callable[[], str],
        lack_of_odometry: Callable[[], str],
        keep: Callable[[Survey.Result], None],
    ) -> None:
        """`node` is this survey's alone; `tick` waits for a moment.

        `is_end_asked`: filming is to end; `lack` and `lack_of_odometry`: why no images and no odometry come, empty: not
        known; `keep` keeps the result for the case that this process is killed before it answers. Where `journal` tells
        of a process that was killed, the survey goes on from there.
        """
        self._client, self._goal, self._output, self._journal = client, goal, output, journal
        self._wait, self._is_end_asked, self._keep = tick, is_end_asked, keep
        self._lack, self._lack_of_odometry = lack, lack_of_odometry
        self._started = self._told = self._looked = time.monotonic()
        self._stopped = False  # a cancel is heard until it is obeyed
        self._is_full = False
        self._considered, self._decided = 0, math.inf  # images decided on, and when the last of them came
        self._missing = ""
        self._remaining = TimeRemaining()
        log = LiveFrameLog(journal.frames)
        self._passage = Passage(node, self._tick, lambda: client.is_cancel_requested and not self._stopped, log)
        depth = qos.reliable(DEPTH)
        node.create_subscription(CompressedImage, IMAGES, self._keep_image, depth, raw=True)
        node.create_subscription(CameraInfo, CALIBRATIONS, self._keep_calibration, depth)

    async def run(self) -> Survey.Result:
        """The result, with the folder written; that of a cancelled goal has what there was."""
        result = Survey.Result()
        passage, settings = self._passage, {}
        survey: LastMessages | None = None
        try:
            await self._begin()
            settings = await passage.settings()
            progress, limit = self._journal.progress, self._goal.time_limit or math.inf
            progress.filming = progress.filming or time.monotonic()
            self._journal.note()
            await passage.film(
                lambda: (
                    progress.is_filmed
                    or self._is_end_asked()
                    or self._is_full
                    or progress.filmed(time.monotonic()) > limit
                )
            )
            progress.is_filmed = True
            self._journal.note()
            survey = await passage.work_off()
        except SurveyFailure as failure:
            result.error_code, result.error_msg = failure.code, str(failure)
            if failure.code == Survey.Result.NO_IMAGES and (lack := self._lack()):
                result.error_msg = f"no image has come: {lack}"
        except Cancelled:
            result.error_msg = ""
        self._stopped = True
        result = await self._written(result, survey or passage.maps.newest, settings)
        await self._at_rest()
        return result

    def pause(self, is_paused: bool) -> str:
        """Has no images taken until it goes on, in the same map; returns why that cannot be, empty: it is done."""
        progress = self._journal.progress
        if progress.is_filmed or self._stopped:
            return "filming is over: the survey is worked off"
        (progress.pause if is_paused else progress.go_on)(time.monotonic())
        self._journal.note()
        self._tell_pause()
        return ""

    @property
    def _is_paused(self) -> bool:
        return self._journal.progress.is_paused and not self._stopped

    def _tell_pause(self) -> None:
        self._passage.pause(self._is_paused)
        self._output.is_paused = self._is_paused

    async def _begin(self) -> None:
        """Lets the nodes begin, or goes on where they have."""
        passage, progress = self._passage, self._journal.progress
        self._tell_pause()
        if progress.begun:
            await passage.go_on(progress.begun)
            return
        self._journal.forget_nodes()
        progress.begun = await passage.begin(self._goal, self._output.colmap, self._output.journal)
        self._journal.note()

    async def _written(
        self, result: Survey.Result, survey: LastMessages | None, settings: dict[str, Any]
    ) -> Survey.Result:
        """Writes what there is: the result with what was written; without a frame there is nothing."""
        passage, output = self._passage, self._output
        passage.stage = Survey.Feedback.WRITING
        result.sfm = passage.listener.status
        if self._is_full and not result.error_code:
            result.error_code = Survey.Result.NO_SPACE
            result.error_msg = f"filming ended early: {output.lack_of_room}"
        if not passage.log.considered:
            output.discard()
            return result
        try:
            about = self._about(settings)
            await self._done(partial(output.write, survey, passage.listener.status, passage.log, about))
            complete = copy(result)
            complete.folder = str(output.path.resolve())
            if survey is not None:
                complete.pipes = survey.pipes
                if self._goal.reference is not None:
                    note_alignment(complete, output.map)
            complete.total_elapsed_time = messages.duration_msg(time.monotonic() - self._started)
            self._keep(complete)
            await self._done(output.publish)
        except InputError as error:
            result.error_code, result.error_msg = Survey.Result.NO_SPACE, str(error)
            return result
        return complete

    async def _done(self, work: Callable[[], None]) -> None:
        """Waits for work that is done beside."""
        with ThreadPoolExecutor(1) as worker:
            done = worker.submit(work)
            while not done.done():
                await self._tick()
        done.result()

    async def _at_rest(self) -> None:
        """The nodes wait for the next survey; one that does not answer now is asked again when that begins."""
        try:
            await self._passage.rest()
        except SurveyFailure:
            return

    async def _tick(self) -> None:
        now = time.monotonic()
        if now - self._told >= FEEDBACK_PERIOD:
            self._told = now
            self._client.publish_feedback(self._feedback(now - self._started))
        if now - self._looked >= ROOM_PERIOD:
            self._looked = now
            self._journal.live()
            self._look_for_input(now)
            if not self._journal.progress.is_filmed and not self._stopped:  # later the folder may be gone
                self._is_full = self._is_full or not self._output.has_room
        await self._wait()

    def _look_for_input(self, now: float) -> None:
        """Says why no images come, once they have not for a while, and why nothing tells the scale."""
        passage = self._passage
        is_filming = passage.stage == Survey.Feedback.FILMING and not self._is_paused
        if not is_filming or passage.log.considered > self._considered or self._decided > now:
            self._considered, self._decided = passage.log.considered, now
            self._missing = self._missing_scale() if is_filming else ""
        elif now - self._decided > PATIENCE:
            self._missing = f"no image for {now - self._decided:.0f} s: {self._lack() or 'the camera sends none'}"

    def _full(self) -> str:
        """That the map may hold no more keyframes, and what to do; empty: it may."""
        count = self._passage.log.beyond_limit
        limit = "frames would be keyframes, but the map holds as many as max_keyframes of frames allows"
        return f"{count} {limit}: film the rest in another survey" if count else ""

    def _missing_scale(self) -> str:
        """Why a map has no metres, where odometry should tell them: without a board, and without a reference.

        A rig of cameras tells the scale with the first map, so that nothing is said there.
        """
        status, goal = self._passage.listener.status, self._goal
        if status.metric or not status.keyframes_registered or goal.site.board_path or goal.reference is not None:
            return ""
        lack = self._lack_of_odometry()
        return lack and f"nothing tells the scale: {lack}"

    def _keep_image(self, data: bytes) -> None:
        if not self._stopped:
            self._output.keep_image(deserialize_message(data, CompressedImage), data)

    def _keep_calibration(self, info: CameraInfo) -> None:
        if not self._stopped:
            self._output.keep_calibration(info)

    def _feedback(self, elapsed: float) -> Survey.Feedback:
        passage = self._passage
        log, status, maps = passage.log, passage.listener.status, passage.maps
        last_known = maps.poses.poses[-1] if maps.poses is not None and maps.poses.poses else None
        position = None if last_known is None else last_known.pose.position
        place = None if position is None else (position.x, position.y, position.z)
        is_lost = passage.stage == Survey.Feedback.FILMING and not log.is_tracking
        progress = self._progress()
        return Survey.Feedback(
            state=passage.stage,
            frames=log.considered,
            keyframes=log.chosen,
            registered=status.keyframes_registered,
            waiting=status.keyframes_waiting,
            tracking=log.is_tracking,
            last_known=last_known or PoseStamped(),
            metric=status.metric,
            advice=PAUSED if self._is_paused else advice(self._missing, is_lost, place, self._full() or status.message),
            classes=[] if maps.newest is None else maps.newest.pipes.classes,
            progress=progress,
            elapsed=messages.duration_msg(elapsed),
            estimated_time_remaining=messages.duration_msg(self._remaining.at(elapsed, progress)),
        )

    def _progress(self) -> float:
        passage = self._passage
        if passage.stage not in _SHARE_BEFORE:
            return math.nan
        share = _SHARE_BEFORE[passage.stage]
        if passage.stage == Survey.Feedback.RECONSTRUCTING and passage.log.chosen:
            share += 0.5 * _SHARE_BEFORE[Survey.Feedback.MEASURING] * passage.listener.answered / passage.log.chosen
        return min(share, 1.0)

    def _about(self, settings: dict[str, Any]) -> dict[str, dict[str, Any]]:
        """What config.yaml and run.json say of this survey, besides versions and files."""
        passage, site = self._passage, self._goal.site
        status = passage.listener.status
        config = settings | {
            "boq": result_files.boq_entries(site.boq),
            "boards": [board.name for board in site.board_file.boards],
        }
        if self._goal.reference is not None:
            config["survey"] = {"reference": str(self._goal.reference.path.parent)}
        facts = {
            "command": "survey",
            "frames_considered": passage.log.considered,
            "keyframes": passage.log.chosen,
            "registered": status.keyframes_registered,
            "cancelled": self._client.is_cancel_requested,
            "notes": [*site.boq.notes, *filter(None, (status.calibration, status.message))],
            "losses": passage.log.faults(),
            "seeds": {name: values["seed"] for name, values in settings.items() if "seed" in values},
            "timings_s": {"survey": time.monotonic() - self._started},
        }
        return {"config": config, "run": facts}
