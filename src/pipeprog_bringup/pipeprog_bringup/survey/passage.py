# SPDX-License-Identifier: Apache-2.0
"""One survey through the running graph: the nodes begin anew, images are filmed, each node works off what it has."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future

from pipeprog_bringup.playback.connections import missing_connections
from pipeprog_bringup.playback.frame_log import LiveFrameLog
from pipeprog_bringup.playback.listener import LastMessages, Listener
from pipeprog_bringup.playback.node_processes import NodeFailure
from pipeprog_bringup.playback.watchdog import Watchdog
from pipeprog_bringup.survey.goal import Goal
from pipeprog_bringup.survey.map_listener import MapListener
from pipeprog_detect.config import DetectConfig
from pipeprog_frames.config import FramesConfig
from pipeprog_frames.frame_decision import UNCALIBRATED
from pipeprog_msgs import srv
from pipeprog_msgs.action import Survey
from pipeprog_node.settings import build, describe
from pipeprog_sfm.config import SfmConfig

CONFIGS = {"frames": FramesConfig, "sfm": SfmConfig, "detect": DetectConfig}
ANSWER_SECONDS = 30.0  # for a node to begin anew, its imports done: it starts a process of its own, no more
DELIVERY_SECONDS = 60.0  # for what a node has published already, as in a replay

FINISH_SECONDS = 3600.0  # for all work after filming: 40 s of a field take 5 minutes on two cores


class SurveyFailure(Exception):
    """A survey that gives no pipes; `code` is one of Survey.Result."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


class Cancelled(Exception):
    """The client wants no more of a survey."""


class Passage:
    """The services and topics of the graph for one survey.

    Attributes:
        log: what became of the frames.
        listener: the last status of the SfM, and answers.
        maps: the last maps with their pipes.
        stage: one of Survey.Feedback.
    """

    def __init__(self, node: Node, tick: Callable[[], Awaitable[None]], is_cancelled: Callable[[], bool]) -> None:
        """`node` is this survey's alone; `tick` waits for a moment in which the node's callbacks run."""
        self._node, self._tick, self._is_cancelled = node, tick, is_cancelled
        self._watchdog = Watchdog()
        self.log = LiveFrameLog()
        self.listener = Listener(node, self.log, self._watchdog)
        self.maps = MapListener(node)
        self.stage = Survey.Feedback.STARTING
        self._finish = {name: node.create_client(srv.Finish, f"{name}/finish") for name in CONFIGS}
        self._renew = {name: node.create_client(srv.Renew, f"{name}/renew") for name in CONFIGS}

    async def begin(self, goal: Goal, colmap: Path) -> None:
        """Lets each node forget the survey before, the one that films last; raises SurveyFailure.

        `colmap`: folder of the sparse model.
        """
        board = str(goal.site.board_path.resolve()) if goal.site.board_path else ""
        await self._renewed("detect", boq=str(goal.site.boq_path.resolve()))
        reference = str(goal.reference.path) if goal.reference else ""
        await self._renewed("sfm", board=board, colmap=str(colmap.resolve()), reference=reference)
        await self._renewed("frames", idle=False)
        await self._until(self._is_connected, DELIVERY_SECONDS, "the nodes have not found each other")

    async def film(self, is_over: Callable[[], bool]) -> None:
        """Lets images come until `is_over`."""
        self.stage = Survey.Feedback.FILMING
        while not is_over():
            await self._wait()

    async def work_off(self) -> LastMessages:
        """Ends filming and waits for the last map and its pipes; raises SurveyFailure where there are none."""
        self.stage = Survey.Feedback.RECONSTRUCTING
        filmed = await self._finished("frames", 0)
        if not filmed.outputs:
            raise self._without_keyframes()
        mapped = await self._finished("sfm", filmed.outputs)
        if not mapped.outputs:
            status = self.listener.status
            lacks_scale = status.models == 1 and not status.metric
            code = Survey.Result.NO_SCALE if lacks_scale else Survey.Result.NO_MAP
            raise SurveyFailure(code, status.message or mapped.message or "nothing was reconstructed")
        self.stage = Survey.Feedback.MEASURING
        found = await self._finished("detect", mapped.outputs)
        if not found.success:
            raise SurveyFailure(Survey.Result.UNKNOWN, found.message)
        maps, revision = self.maps, mapped.outputs
        await self._until(lambda: maps.revision >= revision, DELIVERY_SECONDS, "the last pipes have not come")
        assert maps.newest is not None
        return maps.newest

    async def rest(self) -> None:
        """Lets the nodes forget this survey and take no images."""
        await self._renewed("frames", idle=True)
        await self._renewed("sfm")
        await self._renewed("detect")

    async def settings(self) -> dict[str, Any]:
        """The settings of each node, as config.yaml has them."""
        return {name: await self._settings_of(name, kind) for name, kind in CONFIGS.items()}

    async def _settings_of(self, name: str, kind: type) -> dict[str, Any]:
        client = AsyncParameterClient(self._node, name)
        names = [setting.name for setting in describe(kind)]
        answer = await self._answer(client.get_parameters(names), name, ANSWER_SECONDS)
        given = {key: parameter_value_to_python(value) for key, value in zip(names, answer.values, strict=True)}
        config: Any = build(kind, {key: value for key, value in given.items() if value is not None})
        return dataclasses.asdict(config)

    async def _renewed(self, name: str, **fields: Any) -> None:
        client = self._renew[name]
        await self._until(client.service_is_ready, DELIVERY_SECONDS, f"the node {name} is not there")
        answer = await self._answer(client.call_async(srv.Renew.Request(**fields)), name, ANSWER_SECONDS)
        if not answer.success:
            raise SurveyFailure(Survey.Result.BAD_INPUT, answer.message)

    async def _finished(self, name: str, expected: int) -> srv.Finish.Response:
        client: Client = self._finish[name]
        await self._until(client.service_is_ready, DELIVERY_SECONDS, f"the node {name} is not there")
        return await self._answer(client.call_async(srv.Finish.Request(expected_inputs=expected)), name, FINISH_SECONDS)

    async def _answer(self, future: Future, name: str, seconds: float) -> Any:
        await self._until(future.done, seconds, f"the node {name} has not answered")
        return future.result()

    async def _until(self, condition: Callable[[], bool], seconds: float, lack: str) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise SurveyFailure(Survey.Result.TIMEOUT, f"waited {seconds:.0f} s: {lack}")
            await self._wait()

    async def _wait(self) -> None:
        if self._is_cancelled():
            raise Cancelled
        try:
            self._watchdog.check_nodes()
        except NodeFailure as error:
            raise SurveyFailure(Survey.Result.PROCESS_DIED, str(error)) from None
        await self._tick()

    def _is_connected(self) -> bool:
        return not missing_connections(self._node, (), ())

    def _without_keyframes(self) -> SurveyFailure:
        if not self.log.considered:
            return SurveyFailure(Survey.Result.NO_IMAGES, "no image has come: is the camera's topic the right one?")
        reasons = self.log.common_reasons()
        code = Survey.Result.NO_CALIBRATION if UNCALIBRATED in reasons else Survey.Result.NO_MAP
        return SurveyFailure(code, f"no image could be used as a keyframe: {reasons}")
