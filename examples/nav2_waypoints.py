# SPDX-License-Identifier: Apache-2.0
"""A survey while Nav2 follows waypoints: filming begins at the first of them and ends at the last.

    python examples/nav2_waypoints.py --at 1.0 2.0 90 --at 6.0 2.0 90 --survey-id level2_monday

The graph with the node survey runs, configured and activated (docs/surveys.md), and Nav2 with its waypoint follower.
"""

from __future__ import annotations

import argparse
import math
import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import FollowWaypoints
from rclpy.action import ActionClient
from rclpy.node import Node

from pipeprog_bringup.patrol.survey_client import SurveyClient
from pipeprog_camera.errors import InputError

FIRST_SECONDS = 300.0  # s to the first waypoint
WALK_SECONDS = 1800.0  # s from there to the last


def pose(x: float, y: float, degrees: float, frame: str) -> PoseStamped:
    """A waypoint: place in m and direction of view in a frame of Nav2."""
    waypoint = PoseStamped()
    waypoint.header.frame_id = frame
    waypoint.pose.position.x, waypoint.pose.position.y = x, y
    half = math.radians(degrees) / 2
    waypoint.pose.orientation.z, waypoint.pose.orientation.w = math.sin(half), math.cos(half)
    return waypoint


def follow(navigation: ActionClient, survey: SurveyClient, poses: list[PoseStamped], seconds: float) -> None:
    """Lets Nav2 follow waypoints to the last; raises InputError where it misses one."""
    result = survey.drive(navigation, FollowWaypoints.Goal(poses=poses), seconds)
    if result.error_code or result.missed_waypoints:
        missed = [waypoint.index for waypoint in result.missed_waypoints]
        raise InputError(f"Nav2 has missed waypoints {missed} (error {result.error_code}: {result.error_msg})")


def main() -> None:
    """Walks, films, and says where the results are; exits with 1 where there are none."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--at", nargs=3, type=float, action="append", required=True, metavar=("X", "Y", "DEGREES"))
    parser.add_argument("--frame", default="map", help="frame of the waypoints")
    parser.add_argument("--survey-id", default="", help="names the folder of the results")
    options = parser.parse_args()

    rclpy.init(args=[])
    node = Node("nav2_waypoints")
    survey = SurveyClient(node)
    navigation = ActionClient(node, FollowWaypoints, "follow_waypoints")
    waypoints = [pose(x, y, degrees, options.frame) for x, y, degrees in options.at]
    try:
        follow(navigation, survey, waypoints[:1], FIRST_SECONDS)
        survey.start(options.survey_id)
        try:
            follow(navigation, survey, waypoints[1:], WALK_SECONDS)
        finally:  # what was filmed until Nav2 gave up is worth its results
            survey.end()
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
