# SPDX-License-Identifier: Apache-2.0
"""A survey while spot_ros2 walks a Spot along waypoints of its GraphNav map.

    python examples/spot_navigate_to.py --spot spot level2_begin level2_end --home dock

It walks to the first waypoint, films on the way to the last, and walks home while the survey is worked off. The map is
uploaded, the robot localised in it and the lease taken before (services of spot_ros2). `navigate_to` accepts no cancel:
where a walk takes too long, the robot is stopped by the service `stop`.
"""

from __future__ import annotations

import argparse
import sys

import rclpy
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.node import Node
from spot_msgs.action import NavigateTo
from std_srvs.srv import Trigger

from pipeprog_bringup.patrol.survey_client import SurveyClient
from pipeprog_camera.errors import InputError

WALK_SECONDS = 600.0  # s from one waypoint to the next
STOP_SECONDS = 5.0  # s for the driver to answer


class Spot:
    """Walks; all that waits is done by the survey's client, which spins the node of both."""

    def __init__(self, node: Node, name: str, survey: SurveyClient, seconds: float) -> None:
        """`name`: the namespace of its driver; `seconds`: for each walk at most."""
        self._survey, self._seconds = survey, seconds
        self._walk = ActionClient(node, NavigateTo, f"{name}/navigate_to")
        self._stop: Client = node.create_client(Trigger, f"{name}/stop")

    def walk_to(self, waypoint: str) -> None:
        """Walks to a waypoint; raises InputError, with the robot stopped, where it does not arrive."""
        try:
            result = self._survey.drive(self._walk, NavigateTo.Goal(waypoint_id=waypoint), self._seconds)
        except InputError:
            if self._stop.service_is_ready():
                self._survey.wait(self._stop.call_async(Trigger.Request()).done, STOP_SECONDS)
            raise
        if not result.success:
            raise InputError(f"Spot has not come to {waypoint}: {result.message}")


def main() -> None:
    """Walks, films, and says where the results are; exits with 1 where there are none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("waypoints", nargs="+", help="ids or names of GraphNav waypoints")
    parser.add_argument("--spot", default="spot", help="namespace of the driver")
    parser.add_argument("--home", default="", help="waypoint to walk to at the end")
    parser.add_argument("--survey-id", default="", help="names the folder of the results")
    parser.add_argument("--walk-seconds", type=float, default=WALK_SECONDS, help="for each walk at most")
    options = parser.parse_args()

    rclpy.init(args=[])
    node = Node("spot_navigate_to")
    survey = SurveyClient(node)
    spot = Spot(node, options.spot, survey, options.walk_seconds)
    try:
        spot.walk_to(options.waypoints[0])
        survey.start(options.survey_id)
        try:
            for waypoint in options.waypoints[1:]:
                spot.walk_to(waypoint)
        finally:  # what was filmed until the robot stopped is worth its results
            survey.end()
            if options.home:
                spot.walk_to(options.home)
            found = survey.result()
            print(f"results: {found.folder or 'none'}")
        if not found.succeeded:
            raise InputError(found.error)
    except InputError as error:
        sys.exit(str(error))
    finally:
        survey.close()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
