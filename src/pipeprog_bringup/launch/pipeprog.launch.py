# SPDX-License-Identifier: Apache-2.0
"""The graph on a robot: frames, sfm and detect on the topics of one camera.

ros2 launch pipeprog_bringup pipeprog.launch.py boq:=site.yaml board:=board.yaml image:=/camera/image_raw \
    camera_info:=/camera/camera_info
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue

RESPAWN_DELAY = 2.0  # s; a node that cannot start, as its file is wrong, says so thirty times a minute

ARGUMENTS = [
    DeclareLaunchArgument("boq", description="Bill of quantities: YAML file of the planned pipe classes."),
    DeclareLaunchArgument(
        "board",
        default_value="",
        description="YAML file of the target boards on site, which give the scale. Without any source of scale "
        "nothing metric is published.",
    ),
    DeclareLaunchArgument(
        "image",
        default_value="image",
        description="Topic of the camera's raw images, sensor_msgs/Image.",
    ),
    DeclareLaunchArgument(
        "compressed_image",
        default_value=[LaunchConfiguration("image"), "/compressed"],
        description="Topic of the camera's JPEG or PNG images, sensor_msgs/CompressedImage.",
    ),
    DeclareLaunchArgument(
        "camera_info",
        default_value="camera_info",
        description="Topic of the camera's calibration, sensor_msgs/CameraInfo. K = 0 is refused.",
    ),
    DeclareLaunchArgument(
        "cameras",
        default_value="",
        description="Several cameras of a robot, in place of image and camera_info: what their topics begin with, "
        "between spaces, such as '/spot/camera/frontleft /spot/camera/frontright'. /tf_static says where they are.",
    ),
    DeclareLaunchArgument(
        "odometry",
        default_value="odometry",
        description="Topic of the robot's odometry, nav_msgs/Odometry: a source of scale. /tf_static says where the "
        "camera is mounted.",
    ),
    DeclareLaunchArgument(
        "imu", default_value="imu", description="Topic of the robot's IMU, sensor_msgs/Imu: it gives the vertical."
    ),
    DeclareLaunchArgument(
        "image_transport",
        default_value="compressed",
        choices=["raw", "compressed"],
        description="Which of the two image topics is subscribed.",
    ),
    DeclareLaunchArgument(
        "params_file",
        default_value=os.path.join(get_package_share_directory("pipeprog_bringup"), "config", "default.yaml"),
        description="Settings of the nodes; config/spot.yaml beside the default is for Spot-style robots.",
    ),
    DeclareLaunchArgument(
        "survey",
        default_value="false",
        choices=["true", "false"],
        description="Start the managed node survey, too: images are taken while its action runs. "
        "false: one survey, from the first image on.",
    ),
    DeclareLaunchArgument(
        "results", default_value="surveys", description="Folder in which each survey of the action gets its folder."
    ),
    DeclareLaunchArgument(
        "cores",
        default_value="0",
        description="Processor cores for frames, sfm and detect together, the first of the machine; 0: all.",
    ),
    DeclareLaunchArgument(
        "record",
        default_value="false",
        choices=["true", "false"],
        description="Keep what the robot sends during each survey of the action as recording.mcap in its folder.",
    ),
    DeclareLaunchArgument("namespace", default_value="", description="Namespace of the nodes and their topics."),
    DeclareLaunchArgument(
        "enclaves",
        default_value="/pipeprog",
        description="Folder of the nodes' enclaves in the keystore of SROS2, such as /pipeprog/frames; without "
        "ROS_SECURITY_ENABLE it has no effect.",
    ),
    DeclareLaunchArgument(
        "use_sim_time",
        default_value="false",
        choices=["true", "false"],
        description="Take the time from /clock: true for simulation and for recordings.",
    ),
    DeclareLaunchArgument(
        "log_level",
        default_value="info",
        choices=["debug", "info", "warn", "error", "fatal"],
        description="Least severity of what the nodes log.",
    ),
]


def pipeprog_node(name: str, parameters: dict, remappings: list) -> Node:
    """One node of the graph; what `parameters` says goes before the parameter file."""
    return Node(
        package=f"pipeprog_{name}",
        executable=f"{name}_node",
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params_file"),
            {"use_sim_time": truth("use_sim_time"), "cores": number("cores"), **parameters},
        ],
        remappings=remappings,
        ros_arguments=ros_arguments(name),
        output="screen",
        respawn=True,  # a node that dies is there for the next survey
        respawn_delay=RESPAWN_DELAY,
    )


def ros_arguments(name: str) -> list:
    """What the process of every node gets: its least severity of logs, and its enclave."""
    return ["--log-level", LaunchConfiguration("log_level"), "--enclave", [LaunchConfiguration("enclaves"), "/", name]]


def truth(argument: str) -> ParameterValue:
    """The argument as a parameter that is true or false."""
    return ParameterValue(LaunchConfiguration(argument), value_type=bool)


def number(argument: str) -> ParameterValue:
    """The argument as a parameter that is a whole number."""
    return ParameterValue(LaunchConfiguration(argument), value_type=int)


def survey_node(remappings: list) -> LifecycleNode:
    """The managed node of the action; it is configured and activated by a lifecycle manager, or by hand."""
    files = {name: text(name) for name in ("boq", "board", "cameras")}
    return LifecycleNode(
        package="pipeprog_bringup",
        executable="survey_node",
        name="survey",
        namespace=LaunchConfiguration("namespace"),
        condition=IfCondition(LaunchConfiguration("survey")),
        parameters=[
            LaunchConfiguration("params_file"),
            {"results": text("results"), "record": truth("record"), "use_sim_time": truth("use_sim_time"), **files},
        ],
        remappings=remappings,
        ros_arguments=ros_arguments("survey"),
        output="screen",
        respawn=True,  # it goes on with a survey, and waits for a lifecycle manager without one
        respawn_delay=RESPAWN_DELAY,
    )


def text(argument: str) -> ParameterValue:
    """The argument as a text parameter, whatever it looks like."""
    return ParameterValue(LaunchConfiguration(argument), value_type=str)


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    camera = [
        ("image", LaunchConfiguration("image")),
        ("image/compressed", LaunchConfiguration("compressed_image")),
        ("camera_info", LaunchConfiguration("camera_info")),
    ]
    motion = [("odometry", LaunchConfiguration("odometry")), ("imu", LaunchConfiguration("imu"))]
    return LaunchDescription(
        [
            *ARGUMENTS,
            pipeprog_node(
                "frames",
                {
                    "image_transport": text("image_transport"),
                    "cameras": text("cameras"),
                    "idle": truth("survey"),
                },
                camera,
            ),
            pipeprog_node("sfm", {"board": text("board")}, motion),
            pipeprog_node("detect", {"boq": text("boq")}, []),
            survey_node(camera + motion),
        ]
    )
