# SPDX-License-Identifier: Apache-2.0
"""A survey as an action of Spot's Autowalk, without ROS on the robot: a remote mission service of Boston Dynamics' SDK.

    python examples/spot_remote_mission.py --host-ip 192.168.50.5 --port 50061 192.168.80.3

It needs `pip install bosdyn-client`, whose licence is Boston Dynamics' own. The service `pipeprog` stands
in the walk twice: at the first one filming begins, at the second it ends, and the mission goes on with the results.
"""

from __future__ import annotations

import argparse
import threading
import uuid
from typing import Any

import bosdyn.client.util
import rclpy
from bosdyn.api.mission import remote_pb2, remote_service_pb2_grpc
from bosdyn.client.directory_registration import DirectoryRegistrationClient, DirectoryRegistrationKeepAlive
from bosdyn.client.server_util import GrpcServiceRunner, ResponseContext
from rclpy.node import Node

from pipeprog_bringup.patrol.survey_client import SurveyClient
from pipeprog_camera.errors import InputError

NAME, SERVICE, AUTHORITY = "pipeprog", "bosdyn.api.mission.RemoteMissionService", "remote-mission"
TICK_SECONDS = 0.2  # s in which a tick lets ROS work: it is to return quickly
START_SECONDS = 20.0  # s for a goal to be accepted: a third of the walk's default time limit for an answer


class SurveyMission(remote_service_pb2_grpc.RemoteMissionServiceServicer):
    """Answers the mission's ticks: one survey at a time, which one session begins and the next one ends."""

    def __init__(self, survey: SurveyClient) -> None:
        self._survey = survey
        self._lock = threading.Lock()  # the server has several threads, ROS is spun by one
        self._begun = ""  # session that has begun to film; empty: no survey

    def EstablishSession(self, request: Any, context: Any) -> Any:
        """A session for each action of the walk."""
        response = remote_pb2.EstablishSessionResponse()
        with ResponseContext(response, request):
            response.session_id, response.status = str(uuid.uuid4()), response.STATUS_OK
        return response

    def Tick(self, request: Any, context: Any) -> Any:
        """Begins to film, or ends it and asks for the results."""
        response = remote_pb2.TickResponse()
        with ResponseContext(response, request), self._lock:
            try:
                response.status, response.error_message = self._ticked(response, request.session_id)
            except InputError as error:
                response.status, response.error_message = response.STATUS_FAILURE, str(error)
        return response

    def _ticked(self, kind: Any, session: str) -> tuple[int, str]:
        if not self._begun:
            self._survey.start()
            self._begun = session
        if session == self._begun:
            return kind.STATUS_SUCCESS, ""
        self._survey.end()
        if not self._survey.wait(lambda: self._survey.is_over, TICK_SECONDS):
            return kind.STATUS_RUNNING, ""
        self._begun, found = "", self._survey.result()
        return (kind.STATUS_SUCCESS if found.succeeded else kind.STATUS_FAILURE), found.error

    def Stop(self, request: Any, context: Any, kind: Any = remote_pb2.StopResponse) -> Any:
        """The mission is paused: filming goes on."""
        response = kind()
        with ResponseContext(response, request):
            response.status = response.STATUS_OK
        return response

    def TeardownSession(self, request: Any, context: Any) -> Any:
        """The action is over."""
        return self.Stop(request, context, remote_pb2.TeardownSessionResponse)


def main() -> None:
    """Registers the service with the robot and serves it."""
    parser = argparse.ArgumentParser()
    bosdyn.client.util.add_base_arguments(parser)
    bosdyn.client.util.add_service_endpoint_arguments(parser)
    options = parser.parse_args()
    robot = bosdyn.client.create_standard_sdk("pipeprog").create_robot(options.hostname)
    bosdyn.client.util.authenticate(robot)
    rclpy.init(args=[])
    mission = SurveyMission(SurveyClient(Node("spot_remote_mission"), start_seconds=START_SECONDS))
    add = remote_service_pb2_grpc.add_RemoteMissionServiceServicer_to_server
    runner = GrpcServiceRunner(mission, add, options.port)
    alive = DirectoryRegistrationKeepAlive(robot.ensure_client(DirectoryRegistrationClient.default_service_name))
    alive.start(NAME, SERVICE, AUTHORITY, options.host_ip, runner.port)
    with alive:
        runner.run_until_interrupt()


if __name__ == "__main__":
    main()
