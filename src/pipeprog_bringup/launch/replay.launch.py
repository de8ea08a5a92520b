# SPDX-License-Identifier: Apache-2.0
"""The graph on a recording, played by `ros2 bag play` in its own time, as on the robot.

ros2 launch pipeprog_bringup replay.launch.py bag:=survey.mcap boq:=site.yaml board:=board.yaml

Frames that the machine cannot keep up with are dropped, as they would be live. The command `pipeprog replay` loses
none, goes as fast as the machine allows, and writes the results to a folder.
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

ARGUMENTS = [
    DeclareLaunchArgument("boq", description="Bill of quantities: YAML file of the planned pipe classes."),
    DeclareLaunchArgument(
        "bag", default_value="", description="Recording to play: an .mcap, .db3 or .bag file or a rosbag2 folder."
    ),
    DeclareLaunchArgument("rate", default_value="1.0", description="Speed of the player; 1.0 is the time of the site."),
    DeclareLaunchArgument(
        "play",
        default_value="true",
        choices=["true", "false"],
        description="Start the player; false: it is started by hand, with --clock.",
    ),
]


def generate_launch_description() -> LaunchDescription:
    """The graph of pipeprog.launch.py, with all of its arguments, and the player."""
    graph = os.path.join(get_package_share_directory("pipeprog_bringup"), "launch", "pipeprog.launch.py")
    return LaunchDescription(
        [
            *ARGUMENTS,
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(graph),
                launch_arguments={"boq": LaunchConfiguration("boq"), "use_sim_time": "true"}.items(),
            ),
            ExecuteProcess(
                cmd=[
                    "ros2",
                    "bag",
                    "play",
                    LaunchConfiguration("bag"),
                    "--clock",
                    "--rate",
                    LaunchConfiguration("rate"),
                ],
                condition=IfCondition(LaunchConfiguration("play")),
                name="player",
                output="screen",
            ),
        ]
    )
