# SPDX-License-Identifier: Apache-2.0
"""`pipeprog simulate-patrol`: recordings surveyed one after another by the live graph, as if a robot walked them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node

from pipeprog_bringup.patrol.round import Surveyed
from pipeprog_bringup.patrol.survey_client import SurveyClient
from pipeprog_bringup.playback.node_processes import NODE_MODULES, Graph, NodeFailure
from pipeprog_bringup.playback.private_network import private_network
from pipeprog_bringup.playback.scratch import check_room, scratch_folder
from pipeprog_bringup.playback.simulated_robot import SimulatedRobot, camera_names
from pipeprog_bringup.recording.bag import Bag
from pipeprog_bringup.replay import told_by
from pipeprog_bringup.results.setting_overrides import as_parameters, effective, given_names
from pipeprog_camera.errors import InputError
from pipeprog_detect.product.boq import load_boq
from pipeprog_msgs.action import Survey
from pipeprog_node.ros_context import ros_context
from pipeprog_sfm.boards.board_file import load_board_file

MODULES = NODE_MODULES | {"survey": "pipeprog_bringup.survey.node"}
START_SECONDS = 90.0  # for a node to be there: imports of a cold disk included
CANCEL_SECONDS = 15.0  # a cancelled survey is written within 10


@dataclasses.dataclass(frozen=True)
class Request:
    """What to walk through: recordings of the same cameras, each a survey in a folder of its name in `out`."""

    bags: Sequence[Path]
    boq: Path
    out: Path
    board: Path | None = None
    rate: float = 1.0
    rig: bool = False
    overrides: Sequence[str] = ()


def simulate_patrol(request: Request, report: Callable[[str], None]) -> dict[str, Surveyed]:
    """What came of each survey, by its name; each but the first is to lie in the frame of the first.

    `report` gets a sentence at every change. Raises InputError for what the user can mend and NodeFailure when a node
    dies before the first survey; later the survey's own result tells of it.
    """
    bags = _read(request)
    with (
        scratch_folder() as scratch,
        private_network(scratch),
        Graph(_parameters(request, bags[0]), scratch, MODULES) as graph,
        ros_context(),
    ):
        node = Node("robot")
        robot, client = SimulatedRobot(node, bags[0]), SurveyClient(node)
        try:
            _activate(node, client, graph)
            return _walk(request, bags, robot, client, report)
        finally:
            client.cancel()
            client.wait(lambda: client.is_over, CANCEL_SECONDS)
            client.close()
            node.destroy_node()


def _read(request: Request) -> list[Bag]:
    """The recordings; raises InputError where something that the request names cannot be used."""
    load_boq(request.boq)
    if request.board:
        load_board_file(request.board)
    if not request.rate > 0:
        raise InputError(f"--rate {request.rate:g}: give a factor above zero, 1 for real time")
    names = [path.stem for path in request.bags]
    if len(set(names)) < len(names):
        raise InputError(f"two recordings have the same name ({', '.join(names)}), and their surveys would: rename one")
    taken = [name for name in names if (request.out / name).exists()]
    if taken:
        raise InputError(f"{request.out / taken[0]} exists: choose another --out, or remove it")
    bags = [Bag.open_rig(path) if request.rig else Bag.open(path) for path in request.bags]
    for path, bag in zip(request.bags, bags, strict=True):
        check_room(path)
        if (len(bag.rig), bag.image_type) != (len(bags[0].rig), bags[0].image_type):
            raise InputError(f"{path} has not the cameras of {request.bags[0]}: simulate their patrols one by one")
    return bags


def _parameters(request: Request, bag: Bag) -> dict[str, dict[str, Any]]:
    """The ROS parameters of each node."""
    told = told_by(bag, given_names(request.overrides))
    parameters = as_parameters(effective([*told, *request.overrides]))
    cameras = " ".join(camera_names(len(bag.rig)))
    parameters["frames"] |= {"idle": True, "cameras": cameras}
    parameters["detect"] |= {"boq": str(request.boq.resolve())}
    return parameters | {"survey": {"results": str(request.out.resolve()), "cameras": cameras}}


def _activate(node: Node, client: SurveyClient, graph: Graph) -> None:
    """Configures and activates the node `survey`, as a lifecycle manager does."""
    change = node.create_client(ChangeState, "survey/change_state")
    _wait(client, graph, change.service_is_ready)
    for step in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        answer = change.call_async(ChangeState.Request(transition=Transition(id=step)))
        _wait(client, graph, answer.done)
        if not answer.result().success:
            raise NodeFailure("the node survey was not activated")


def _wait(client: SurveyClient, graph: Graph, condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + START_SECONDS
    while not client.wait(condition, 1.0):
        graph.check()
        if time.monotonic() > deadline:
            raise NodeFailure(f"waited {START_SECONDS:.0f} s: the node survey does not answer")


def _walk(
    request: Request, bags: Sequence[Bag], robot: SimulatedRobot, client: SurveyClient, report: Callable[[str], None]
) -> dict[str, Surveyed]:
    results: dict[str, Surveyed] = {}
    board = str(request.board.resolve()) if request.board else ""
    for path, bag in zip(request.bags, bags, strict=True):
        name = path.stem
        first = next((earlier for earlier, found in results.items() if found.folder), "")
        report(f"{name}: the robot walks, {bag.image_count} images")
        client.start(name, str(request.boq.resolve()), board, reference=first)
        client.wait(lambda: client.is_over or _is_filming(client), START_SECONDS)
        robot.walk(bag, request.rate, lambda due: _pause(client, due))
        client.end()
        report(f"{name}: filmed, waiting for the pipes")
        results[name] = client.result()
        found = results[name]
        report(f"{name}: {found.folder or 'no result'}" + (f" ({found.error})" if found.error else ""))
    return results


def _is_filming(client: SurveyClient) -> bool:
    return client.feedback is not None and client.feedback.state == Survey.Feedback.FILMING


def _pause(client: SurveyClient, due: float) -> bool:
    """Waits until `due`, a time of time.monotonic; returns whether the survey goes on."""
    client.wait(lambda: client.is_over, max(due - time.monotonic(), 0.0))
    return not client.is_over
