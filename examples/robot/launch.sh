#!/usr/bin/env bash
# Runs the robot with the master in ROS_MASTER_URI until it is interrupted:
#
#     launch.sh FOLDER [ROSLAUNCH-ARGUMENTS...]
#
# FOLDER is for compiled programs and the bag.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$1"
folder=$(cd "$1" && pwd)
shift
"$here/build.sh" "$folder/robot_example_cpp"
export ROS_PACKAGE_PATH=$here:$folder${ROS_PACKAGE_PATH:+:$ROS_PACKAGE_PATH}
# pluginlib looks for nodelets here.
export CMAKE_PREFIX_PATH=$folder/robot_example_cpp${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}
# Debian's ROS needs Debian's Python, even if another program is named python3 here.
export PATH=/usr/bin:$PATH
# --wait, because without a master roslaunch would start its own on rosrescue's port.
exec roslaunch --wait "$here/robot.launch" bag:="$folder/robot.bag" "$@"
