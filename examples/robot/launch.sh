#!/usr/bin/env bash
# Starts the robot at the master of ROS_MASTER_URI, until it is ended:
#
#     launch.sh FOLDER [ROSLAUNCH-ARGUMENTS...]
#
# FOLDER is for what is compiled and for the bag.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
folder=$(cd "$1" && pwd)
shift
"$here/build.sh" "$folder/robot_example_cpp"
export ROS_PACKAGE_PATH=$here:$folder${ROS_PACKAGE_PATH:+:$ROS_PACKAGE_PATH}
# Where pluginlib looks for nodelets.
export CMAKE_PREFIX_PATH=$folder/robot_example_cpp${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}
# Debian's ROS belongs to Debian's Python, whatever else is called python3 here.
export PATH=/usr/bin:$PATH
# --wait: without a master roslaunch would start one of its own, on rosrescue's port.
exec roslaunch --wait "$here/robot.launch" bag:="$folder/robot.bag" "$@"
