# SPDX-License-Identifier: Apache-2.0
"""Surveys by the action: one after another in one graph over real DDS, to the end, cancelled, and refused."""

from __future__ import annotations

import itertools
import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from action_msgs.msg import GoalStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_srvs.srv import SetBool, Trigger

from pipeprog_bringup.access_policy import GraphNames, policy_xml
from pipeprog_bringup.recording.bag import Bag
from pipeprog_msgs.action import Survey
from pipeprog_msgs.msg import FrameDecision, SiteProgress
from pipeprog_node import messages, qos
from pipeprog_sfm.alignment.map_file import MAP_FILE, read_map
from tests.access import Access, allowed, observer, used
from tests.fuzz.absurd_goals import absurd_goal, is_named

BAGS = Path(__file__).parents[2] / "bags"
BAG, BOQ, BOARD = (BAGS / f"demo.{end}" for end in ("mcap", "boq.yaml", "board.yaml"))
BOARD_SEEN = slice(3, 19)  # frames from the first that shows the whole board
COARSE = {"stereo.width": 640, "fusion.voxel": 0.006}  # the graph is tested here, not its accuracy
TIMEOUT = 240.0  # s, for whatever takes seconds on an idle machine
ANSWER = 2.0  # s for the answer to a goal: none comes from a node that is not there
SILENT = 10.0  # s after which a result is asked for again
PERIOD = 0.1  # s between two images
MODULES = {"frames": "pipeprog_frames.node", "sfm": "pipeprog_sfm.node", "detect": "pipeprog_detect.node"} | {
    "survey": "pipeprog_bringup.survey.node"
}
ROLLING_SHUTTER_ALONE = ("/pipeprog/sfm", "/sfm", "publish", "/keyframe_velocities")
REPLAYED = {"cloud.las", "cloud.ply", "config.yaml", "frames.csv", "out.mcap", "pipes.json", "progress.csv", "run.json"}
REPLAYED |= {"map.npz", "trajectory.tum", "colmap/cameras.txt", "colmap/images.txt", "colmap/points3D.txt"}


class Mission:
    """A robot whose camera never rests, and the client of its surveys."""

    def __init__(self, namespace: str) -> None:
        self.node = Node("mission", namespace=namespace)
        self.feedback: list[Survey.Feedback] = []
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._images = self.node.create_publisher(CompressedImage, "image/compressed", qos.reliable(10))
        self._infos = self.node.create_publisher(CameraInfo, "camera_info", qos.reliable(10))
        self._frames = list(Bag.open(BAG))[BOARD_SEEN]
        self._stamps = itertools.count(1_700_000_000_000_000_000, 200_000_000)
        self._place = 0  # number of the frame that the camera shows
        self._shown = self._decided = 0  # stamps of the first image of that frame, and of the last decision
        self.filmed = 0  # images
        self.node.create_subscription(FrameDecision, "frame_decisions", self._on_decision, qos.reliable(1000))
        self.node.create_timer(PERIOD, self._film)
        self.progress: list[SiteProgress] = []
        self.node.create_subscription(SiteProgress, "progress", self.progress.append, qos.latched())
        self.state = self.node.create_client(ChangeState, "survey/change_state")
        self.end = self.node.create_client(Trigger, "survey/end")
        self.pause = self.node.create_client(SetBool, "survey/pause")
        self.client = ActionClient(self.node, Survey, "survey")  # the last one that the other nodes find

    def wait_for(self, condition: Callable[[], object], seconds: float = TIMEOUT) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "waited in vain"
            self._executor.spin_once(timeout_sec=PERIOD)

    def call(self, client: Any, request: Any) -> Any:
        self.wait_for(client.service_is_ready)
        future = client.call_async(request)
        self.wait_for(future.done)
        return future.result()

    def change(self, transition: int) -> bool:
        return bool(self.call(self.state, ChangeState.Request(transition=Transition(id=transition))).success)

    def send(self, **goal: Any) -> Any:
        """The handle of a goal; the robot stands at the beginning of its walk."""
        self.feedback.clear()
        self._place = 0
        self.wait_for(self.client.server_is_ready)
        future = self.client.send_goal_async(Survey.Goal(**goal), lambda heard: self.feedback.append(heard.feedback))
        self.wait_for(future.done)
        return future.result()

    def meet(self) -> None:
        """Waits until the node `survey` answers: what it says before both have found each other is lost."""
        self._answers(lambda handle: True)

    def send_again(self, **goal: str) -> Any:
        """The handle of a goal that was asked for before: answers get lost while a node is killed."""
        return self._answers(lambda handle: handle.accepted, **goal)

    def _answers(self, is_wanted: Callable[[Any], bool], **goal: str) -> Any:
        """The first answer to a goal that is wanted; the goal is sent until there is one."""
        self.feedback.clear()
        self.wait_for(self.client.server_is_ready)
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline:
            future = self.client.send_goal_async(
                Survey.Goal(**goal), lambda heard: self.feedback.append(heard.feedback)
            )
            waited = time.monotonic() + ANSWER
            self.wait_for(lambda future=future, waited=waited: future.done() or time.monotonic() > waited)  # type: ignore[misc]
            if future.done() and is_wanted(future.result()):
                return future.result()
        raise AssertionError("no such answer")

    def film_on(self) -> None:
        """Waits while the camera sends twenty images."""
        filmed = self.filmed
        self.wait_for(lambda: self.filmed > filmed + 20)

    def hears(self, is_wanted: Callable[[Survey.Feedback], object]) -> Survey.Feedback:
        """Waits for feedback that is wanted, of those that come from now on."""
        self.feedback.clear()
        self.wait_for(lambda: self.feedback and is_wanted(self.feedback[-1]))
        return self.feedback[-1]

    def result(self, handle: Any) -> Any:
        """The answer to a goal, asked for again and again: a node that was started anew may not have heard it."""
        deadline = time.monotonic() + TIMEOUT
        while time.monotonic() < deadline:
            future, waited = handle.get_result_async(), time.monotonic() + SILENT
            self.wait_for(lambda future=future, waited=waited: future.done() or time.monotonic() > waited)  # type: ignore[misc]
            if future.done():
                return future.result()
        raise AssertionError("no result")

    def _film(self) -> None:
        """An image of the walk, which goes on once one of its place was decided on: live images get lost."""
        stamp = next(self._stamps)
        if self._decided >= self._shown:
            self._place = min(self._place + 1, len(self._frames) - 1)
            self._shown = stamp
        frame = self._frames[self._place]
        info = deserialize_message(frame.camera_info, CameraInfo)
        image = deserialize_message(frame.data, CompressedImage)
        info.header = image.header = messages.header(stamp, frame.frame_id)
        self._infos.publish(info)
        self._images.publish(image)
        self.filmed += 1

    def _on_decision(self, message: FrameDecision) -> None:
        self._decided = max(self._decided, messages.stamp_ns(message.header.stamp))


@pytest.fixture
def mission(request: pytest.FixtureRequest) -> Iterator[Mission]:
    """In the root, or in the namespace that a test asks for."""
    rclpy.init()
    mission = Mission(getattr(request, "param", ""))
    yield mission
    mission.client.destroy()
    mission.node.destroy_node()
    rclpy.shutdown()


class Nodes:
    """A graph that runs; `folder` is that of its surveys."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._commands: dict[str, list[str]] = {}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start_all(self, parameters: dict[str, dict[str, Any]], arguments: Sequence[str] = ()) -> None:
        """The nodes with `parameters`, each in an enclave of its own, with `arguments` of ROS for all of them."""
        for name, values in parameters.items():
            file = self.folder.parent / f"{name}.yaml"
            file.write_text(yaml.safe_dump({f"/**/{name}": {"ros__parameters": values}}))
            words = ["-r", f"__node:={name}", "--params-file", str(file), "--enclave", f"/pipeprog/{name}", *arguments]
            self.start(name, [sys.executable, "-m", MODULES[name], "--ros-args", *words])

    def start(self, name: str, command: list[str]) -> None:
        self._commands[name] = command
        self._processes[name] = subprocess.Popen(command, cwd=self.folder.parent)

    def kill_and_start_again(self, name: str, how: int = signal.SIGKILL) -> None:
        """As a launch file does with what dies."""
        self._processes[name].send_signal(how)
        self._processes[name].wait()
        self.start(name, self._commands[name])

    @property
    def are_running(self) -> bool:
        """Whether all that were started run still."""
        return all(process.poll() is None for process in self._processes.values())

    def close(self) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Nodes]:
    """A graph of which no node runs yet."""
    nodes = Nodes(tmp_path / "surveys")
    yield nodes
    nodes.close()


@pytest.fixture
def nodes(robot: Nodes) -> Nodes:
    robot.start_all(
        {
            "frames": {"idle": True, "image_transport": "compressed"},
            "sfm": {"map_interval": 4, **COARSE},
            "detect": {"boq": str(BOQ)},
            "survey": {"boq": str(BOQ), "board": str(BOARD), "results": str(robot.folder)},
        }
    )
    return robot


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def sendable_goals(count: int, seed: int) -> Iterator[dict[str, Any]]:
    """Absurd goals as a message holds them: a text ends before its first zero, a duration is made of integers."""
    rng = random.Random(seed)
    while count:
        goal = absurd_goal(rng)
        texts = [value for value in goal.values() if isinstance(value, str)]
        if abs(goal["time_limit"]) < 2**31 and not any("\0" in text for text in texts):
            yield goal
            count -= 1


def unlike_the_policy(mission: Mission, names: GraphNames, unused: Access) -> tuple[set[Access], set[Access]]:
    """What the nodes use and the policy does not allow, and what it allows that they do not use.

    Discovery takes its time, of a node and then of what it uses: all that is allowed but the `unused` is waited for.
    """
    may = allowed(policy_xml(names))
    deadline = time.monotonic() + TIMEOUT
    while True:
        with observer() as node:
            mission.film_on()
            do = used(node, {enclave for enclave, *_ in may})
        if do >= may - {unused} or time.monotonic() > deadline:
            return do - may, may - do


def test_surveys_come_one_after_another(mission: Mission, nodes: Nodes) -> None:
    surveys = nodes.folder
    mission.meet()
    assert not mission.send().accepted  # not configured yet
    assert mission.change(Transition.TRANSITION_CONFIGURE)
    assert mission.change(Transition.TRANSITION_ACTIVATE)

    outside = mission.result(mission.send(survey_id="../outside"))
    assert outside.status == GoalStatus.STATUS_ABORTED
    assert outside.result.error_code == Survey.Result.BAD_INPUT
    assert "survey_id" in outside.result.error_msg
    assert names(surveys) == {".survey/active"}  # the node itself, and nothing of this goal

    handle = mission.send(survey_id="first")
    assert handle.accepted
    assert not mission.send().accepted  # one at a time
    mission.wait_for(lambda: mission.feedback and mission.feedback[-1].classes)  # the robot stands, pipes are there
    assert mission.feedback[-1].metric
    assert unlike_the_policy(mission, GraphNames(), ROLLING_SHUTTER_ALONE) == (set(), {ROLLING_SHUTTER_ALONE})
    assert mission.call(mission.end, Trigger.Request()).success
    first = mission.result(handle)
    assert (first.status, first.result.error_msg) == (GoalStatus.STATUS_SUCCEEDED, "")
    assert first.result.folder == str(surveys / "first")
    assert names(surveys / "first") >= REPLAYED
    written = json.loads((surveys / "first" / "pipes.json").read_text())
    assert [pipe["id"] for pipe in written["pipes"]] == [pipe.id for pipe in first.result.pipes.pipes] != []

    handle = mission.send(survey_id="second")
    mission.wait_for(lambda: mission.feedback and mission.feedback[-1].keyframes > 2)
    assert mission.feedback[-1].frames < first.result.sfm.keyframes_seen + 20  # counted anew
    asked = time.monotonic()
    mission.wait_for(handle.cancel_goal_async().done)
    second = mission.result(handle)
    assert time.monotonic() - asked < 10.0
    assert second.status == GoalStatus.STATUS_CANCELED
    assert names(surveys / "second") >= {"frames.csv", "out.mcap", "run.json", "config.yaml"}
    assert json.loads((surveys / "second" / "run.json").read_text())["cancelled"]

    handle = mission.send(survey_id="third", reference="first")
    mission.wait_for(lambda: mission.feedback and mission.feedback[-1].registered > 2)
    registered = mission.feedback[-1].registered
    nodes.kill_and_start_again("sfm")
    mission.wait_for(lambda: mission.feedback[-1].registered > registered)  # it has taken the survey up
    mission.wait_for(lambda: mission.feedback[-1].classes)
    assert mission.call(mission.end, Trigger.Request()).success
    third = mission.result(handle)
    assert (third.status, third.result.error_msg) == (GoalStatus.STATUS_SUCCEEDED, "")
    before, after = (read_map(surveys / name / MAP_FILE) for name in ("first", "third"))
    assert (after.frame, after.aligned_by != "") == (before.frame, True)
    assert third.result.reference_covariance.any()
    lives = {pipe["life"] for pipe in json.loads((surveys / "third" / "pipes.json").read_text())["pipes"]}
    assert lives & {pipe["id"] for pipe in written["pipes"]}
    mission.wait_for(lambda: mission.progress)
    told = mission.progress[-1]
    assert (told.earlier, told.later, told.header) == ("first", "third", third.result.pipes.header)
    assert {name for change in told.pipes for name in change.pipes} == {pipe.id for pipe in third.result.pipes.pipes}
    assert all(change.counted >= change.length_after - 1e-9 for change in told.pipes)


def test_a_survey_goes_on_where_its_own_node_was_killed(mission: Mission, nodes: Nodes) -> None:
    mission.meet()
    assert mission.change(Transition.TRANSITION_CONFIGURE)
    assert mission.change(Transition.TRANSITION_ACTIVATE)
    assert mission.send(survey_id="killed").accepted
    mission.wait_for(lambda: mission.feedback and mission.feedback[-1].registered > 2)
    assert mission.call(mission.pause, SetBool.Request(data=True)).success
    mission.film_on()
    paused = mission.hears(lambda told: "survey/pause" in told.advice)
    frames, keyframes = paused.frames, paused.keyframes
    nodes.kill_and_start_again("survey")
    handle = mission.send_again(survey_id="killed")  # nobody has configured it
    mission.film_on()
    paused = mission.hears(lambda told: "survey/pause" in told.advice)  # as before
    assert paused.frames == frames
    assert mission.call(mission.pause, SetBool.Request(data=False)).success
    told = mission.hears(lambda told: told.classes and told.frames > frames)
    assert "survey/pause" not in told.advice
    assert mission.call(mission.end, Trigger.Request()).success
    answer = mission.result(handle)
    assert (answer.status, answer.result.error_msg) == (GoalStatus.STATUS_SUCCEEDED, "")
    folder = nodes.folder / "killed"
    assert names(folder) >= REPLAYED
    assert not list(folder.glob(".pipeprog-*"))
    bag = Bag.open(folder / "out.mcap")
    assert bag.image_count == answer.result.sfm.keyframes_seen >= keyframes

    nodes.kill_and_start_again("survey")  # as if before it answered
    again = mission.result(mission.send_again(survey_id="killed"))
    assert again.status == GoalStatus.STATUS_SUCCEEDED
    assert (again.result.folder, again.result.pipes) == (answer.result.folder, answer.result.pipes)
    nodes.kill_and_start_again("survey", signal.SIGINT)
    mission.meet()
    assert not mission.send().accepted  # who stops a node does not want it to be active again


@pytest.mark.parametrize("mission", ["robot7"], indirect=True)
def test_a_policy_allows_what_the_nodes_of_a_robot_with_two_cameras_use(mission: Mission, robot: Nodes) -> None:
    names = GraphNames(
        namespace="robot7",
        cameras=("/spot/camera/left", "right"),
        odometry="/spot/odometry",
        imu="body/imu",
        image_transport="raw",
        use_sim_time=True,
        record=True,
        publish_tf=True,
    )
    cameras = " ".join(names.cameras)
    robot.start_all(
        {
            "frames": {"idle": True, "cameras": cameras, "image_transport": names.image_transport},
            "sfm": {"publish_tf": names.publish_tf},
            "detect": {"boq": str(BOQ)},
            "survey": {"boq": str(BOQ), "results": str(robot.folder), "record": names.record, "cameras": cameras},
        },
        arguments=(
            *("-r", f"__ns:=/{names.namespace}", "-p", f"use_sim_time:={names.use_sim_time}"),
            *("-r", f"odometry:={names.odometry}", "-r", f"imu:={names.imu}"),
        ),
    )
    mission.meet()
    assert mission.change(Transition.TRANSITION_CONFIGURE)
    assert mission.change(Transition.TRANSITION_ACTIVATE)
    assert mission.send(survey_id="rig").accepted
    mission.wait_for(lambda: mission.feedback and mission.feedback[-1].state == Survey.Feedback.FILMING)
    velocities = ("/pipeprog/sfm", "/robot7/sfm", "publish", "/robot7/keyframe_velocities")
    assert unlike_the_policy(mission, names, velocities) == (set(), {velocities})


def test_a_hundred_absurd_goals_are_refused_and_write_nothing(mission: Mission, robot: Nodes) -> None:
    robot.start_all({"survey": {"boq": str(BOQ), "board": str(BOARD), "results": str(robot.folder)}})
    mission.meet()
    assert mission.change(Transition.TRANSITION_CONFIGURE)
    assert mission.change(Transition.TRANSITION_ACTIVATE)
    before = names(robot.folder.parent)
    for goal in sendable_goals(100, seed=19):
        limit = messages.duration_msg(goal["time_limit"])
        answer = mission.result(mission.send(**{**goal, "time_limit": limit}))
        assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, Survey.Result.BAD_INPUT)
        assert is_named(goal, answer.result.error_msg), answer.result.error_msg
        assert answer.result.folder == ""
    assert names(robot.folder.parent) == before
    assert robot.are_running
