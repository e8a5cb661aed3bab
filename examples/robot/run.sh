#!/usr/bin/env bash
# Runs a whole robot (README.md) with `rosrescue core` until Ctrl-C: run.sh [PORT]
#
# It uses a free port and a scratch folder. ROSRESCUE=/path/to/rosrescue uses a program that is already built.

cd "$(dirname "$0")/../.." || exit
. examples/common.sh
need_ros
. tests/install_robot.sh
need_rosrescue
need_scratch

step "rosrescue core"
if [ $# -gt 0 ]; then
    start_rosrescue core -p "$1" ||
        give_up "rosrescue did not start: $(tail -n 3 "$scratch/rosrescue.log")"
else
    start_core
fi
took "the page: $ROS_MASTER_URI"

# This folder is kept for the next time.
built=${CARGO_TARGET_DIR:-$PWD/target}/example-robot
step "compile the robot's C++ nodes, where that has not been done"
examples/robot/build.sh "$built/robot_example_cpp" || give_up "they cannot be compiled"
took "in $built"

step "the robot: examples/robot/launch.sh"
start_node robot examples/robot/launch.sh "$built" bag:="$scratch/robot.bag"
within 120 rosparam get /mission/arrived >/dev/null 2>&1 || give_up "the robot did not start"
took "$(rosnode list | wc -l) nodes; it has reached the first place"

step "the master is yours to kill:"
read -r master < <(status master_pid)
say "kill -9 $master" "export ROS_MASTER_URI=$ROS_MASTER_URI"
say "Ctrl-C ends everything."
while kill -0 "$rosrescue_pid" 2>/dev/null; do
    sleep 1
done
give_up "rosrescue has ended"
