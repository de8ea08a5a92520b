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
from std_msgs.msg import Bool

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
from pipeprog_node import qos
from pipeprog_node.settings import build, describe
from pipeprog_sfm.config import SfmConfig

CONFIGS = {"frames": FramesConfig, "sfm": SfmConfig, "detect": DetectConfig}
ANSWER_SECONDS = 30.0  # for a node to begin anew, its imports done: it starts a process of its own, no more
DELIVERY_SECONDS = 60.0  # for what a node has published already, as in a replay

# s from hearing a process for the first time to calling it: before the two have found each other a call is lost.
MATCHING_SECONDS = 1.0
MAX_RESTARTS = 10  # of nodes in a survey; one that dies again and again will not end it
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

    A node that dies and is started anew takes the survey up from its journal, and is asked again what it has not
    answered.

    Attributes:
        log: what became of the frames.
        listener: the last status of the SfM, and answers.
        maps: the last maps with their pipes.
        stage: one of Survey.Feedback.
    """

    def __init__(
        self, node: Node, tick: Callable[[], Awaitable[None]], is_cancelled: Callable[[], bool], log: LiveFrameLog
    ) -> None:
        """`node` is this survey's alone; `tick` waits for a moment in which the node's callbacks run."""
        self._node, self._tick, self._is_cancelled = node, tick, is_cancelled
        self._watchdog = Watchdog()
        self.log = log
        self.listener = Listener(node, self.log, self._watchdog)
        self.maps = MapListener(node)
        self.stage = Survey.Feedback.STARTING
        self._finish = {name: node.create_client(srv.Finish, f"{name}/finish") for name in CONFIGS}
        self._renew = {name: node.create_client(srv.Renew, f"{name}/renew") for name in CONFIGS}
        self._paused = node.create_publisher(Bool, "survey/paused", qos.latched())
        self._begun: dict[str, dict[str, Any]] = {}  # how each node has begun this survey: fields of Renew
        space = node.get_namespace().strip("/")
        self._full_names = {name: f"{space}/{name}".strip("/") for name in CONFIGS}  # as diagnostics call them
        self._names = {full_name: name for name, full_name in self._full_names.items()}
        self._lives = dict.fromkeys(CONFIGS, 0)  # times that each has taken it up
        self._map_asked: int | None = None  # keyframes of the map that has been made; None: not yet

    async def begin(self, goal: Goal, colmap: Path, journal: Path) -> dict[str, dict[str, Any]]:
        """Lets each node forget the survey before, the one that films last; raises SurveyFailure.

        Args:
            goal: what is asked for.
            colmap: folder of the sparse model.
            journal: folder of what the nodes write down.

        Returns:
            How each node has begun, for `go_on`.
        """
        folder = str(journal.resolve())
        await self._renewed("frames", idle=True)  # what it keeps for nodes that come late is of the survey before
        board = str(goal.site.board_path.resolve()) if goal.site.board_path else ""
        await self._begin("detect", boq=str(goal.site.boq_path.resolve()), journal=folder)
        reference = str(goal.reference.path) if goal.reference else ""
        await self._begin("sfm", board=board, colmap=str(colmap.resolve()), reference=reference, journal=folder)
        await self._begin("frames", idle=False, journal=folder)
        await self._until(self._is_connected, DELIVERY_SECONDS, "the nodes have not found each other")
        return self._begun

    async def go_on(self, begun: dict[str, dict[str, Any]]) -> None:
        """Takes a survey up whose node `survey` was killed, while the others went on."""
        self._begun = begun
        await self._until(self._is_connected, DELIVERY_SECONDS, "the nodes have not found each other")

    def pause(self, is_paused: bool) -> None:
        """Has `frames` take no images, or take them again; one that is started anew later hears of it, too."""
        self._paused.publish(Bool(data=is_paused))

    async def film(self, is_over: Callable[[], bool]) -> None:
        """Lets images come until `is_over`."""
        self.stage = Survey.Feedback.FILMING
        while not is_over():
            await self._wait()

    async def work_off(self) -> LastMessages:
        """Ends filming and waits for the last map and its pipes; raises SurveyFailure where there are none."""
        self.stage = Survey.Feedback.RECONSTRUCTING
        self._begun["frames"]["idle"] = True  # one that dies from now on takes no more images
        filmed = await self._finished("frames", 0)
        if not filmed.outputs:
            raise self._without_keyframes()
        mapped = await self._finished("sfm", filmed.outputs)
        if not mapped.outputs:
            status = self.listener.status
            lacks_scale = status.models == 1 and not status.metric
            code = Survey.Result.NO_SCALE if lacks_scale else Survey.Result.NO_MAP
            raise SurveyFailure(code, status.message or mapped.message or "nothing was reconstructed")
        self.stage, self._map_asked = Survey.Feedback.MEASURING, filmed.outputs
        found = await self._finished("detect", mapped.outputs)
        if not found.success:
            raise SurveyFailure(Survey.Result.UNKNOWN, found.message)
        maps, revision = self.maps, mapped.outputs
        await self._until(lambda: maps.revision >= revision, DELIVERY_SECONDS, "the last pipes have not come")
        assert maps.newest is not None
        return maps.newest

    async def rest(self) -> None:
        """Lets the nodes forget this survey and take no images; one that is still starting has nothing to forget."""
        begun, self._begun = self._begun, {}
        if "frames" in begun or self._is_there("frames"):
            await self._renewed("frames", idle=True)
        self.pause(False)
        for name in ("sfm", "detect"):
            if name in begun or self._is_there(name):
                await self._renewed(name)

    async def settings(self) -> dict[str, Any]:
        """The settings of each node, as config.yaml has them."""
        return {name: await self._settings_of(name, kind) for name, kind in CONFIGS.items()}

    async def _settings_of(self, name: str, kind: type) -> dict[str, Any]:
        client = AsyncParameterClient(self._node, name)
        names = [setting.name for setting in describe(kind)]
        answer = await self._answer(lambda: client.get_parameters(names), name, ANSWER_SECONDS)
        given = {key: parameter_value_to_python(value) for key, value in zip(names, answer.values, strict=True)}
        config: Any = build(kind, {key: value for key, value in given.items() if value is not None})
        return dataclasses.asdict(config)

    async def _begin(self, name: str, **fields: Any) -> None:
        await self._renewed(name, **fields)
        self._begun[name] = fields

    async def _take_up(self, name: str) -> None:
        """Lets a node that was started anew go on where the one before it was killed."""
        self._lives[name] += 1
        if sum(self._lives.values()) > MAX_RESTARTS:
            text = f"nodes of the graph have died {MAX_RESTARTS + 1} times, the last was {name}: see its output"
            raise SurveyFailure(Survey.Result.PROCESS_DIED, text)
        life, matched = self._lives[name], time.monotonic() + MATCHING_SECONDS
        while time.monotonic() < matched:
            await self._wait()
        if name not in self._begun:
            return
        if self._lives[name] == life:  # it has not died meanwhile
            await self._renewed(name, **self._begun[name])
        if self._lives[name] == life and name == "sfm" and self._map_asked is not None:
            await self._finished("sfm", self._map_asked)  # the map may not have reached the detector

    async def _renewed(self, name: str, **fields: Any) -> None:
        client = self._renew[name]
        await self._until(lambda: self._is_there(name), DELIVERY_SECONDS, f"the node {name} is not there")
        request = srv.Renew.Request(**fields)
        answer = await self._answer(lambda: client.call_async(request), name, ANSWER_SECONDS)
        if not answer.success:
            raise SurveyFailure(Survey.Result.BAD_INPUT, answer.message)

    def _is_there(self, name: str) -> bool:
        """Whether a node can be asked to begin: its death over that must be noticed."""
        return self._renew[name].service_is_ready() and self._watchdog.knows(self._full_names[name])

    async def _finished(self, name: str, expected: int) -> srv.Finish.Response:
        client: Client = self._finish[name]
        await self._until(client.service_is_ready, DELIVERY_SECONDS, f"the node {name} is not there")
        request = srv.Finish.Request(expected_inputs=expected)
        return await self._answer(lambda: client.call_async(request), name, FINISH_SECONDS)

    async def _answer(self, ask: Callable[[], Future], name: str, seconds: float) -> Any:
        """The answer of a node, which is asked again where it has died over the question."""
        while True:
            asked, life = ask(), self._lives[name]
            await self._until(
                lambda asked=asked, life=life: asked.done() or self._lives[name] != life,  # type: ignore[misc]
                seconds,
                f"the node {name} has not answered",
            )
            if asked.done():
                return asked.result()

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
        for full_name in self._watchdog.restarted():
            if full_name in self._names:  # and no other robot's
                await self._take_up(self._names[full_name])
        await self._tick()

    def _is_connected(self) -> bool:
        return not missing_connections(self._node, (), ())

    def _without_keyframes(self) -> SurveyFailure:
        if not self.log.considered:
            return SurveyFailure(Survey.Result.NO_IMAGES, "no image has come: is the camera's topic the right one?")
        reasons = self.log.common_reasons()
        code = Survey.Result.NO_CALIBRATION if UNCALIBRATED in reasons else Survey.Result.NO_MAP
        return SurveyFailure(code, f"no image could be used as a keyframe: {reasons}")
