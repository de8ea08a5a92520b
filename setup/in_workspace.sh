#!/bin/bash
# Runs a command with ROS 2 Jazzy and the built workspace sourced. Usage: in_workspace.sh COMMAND ...
set -e
. /opt/ros/jazzy/setup.bash
. "$(dirname "$0")/../install/setup.bash"
exec "$@"
