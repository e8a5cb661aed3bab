#!/usr/bin/env bash
# `rosrescue core` in place of roscore, and a robot that roslaunch starts. Starts both, kills the master three times, and
# cleans up.
#
# This script uses free ports and a scratch folder. On a robot you need only
#
#     rosrescue core
#     roslaunch --wait my_robot.launch
#
# ROSRESCUE=/path/to/rosrescue uses a program that is already built.

cd "$(dirname "$0")/.." || exit
. examples/common.sh
need_ros
need_rosrescue
need_scratch

step "rosrescue core, in place of roscore"
start_core
took "ROS_MASTER_URI=$ROS_MASTER_URI"

# --wait, because without a master roslaunch would start its own on rosrescue's port.
step "roslaunch --wait examples/robot.launch"
start_node robot roslaunch --wait examples/robot.launch
all_up() {
    grep -qE '^[0-9.]+ [0-9]+$' "$scratch/robot.log" && rosparam get /rosdistro >/dev/null 2>&1
}
within 60 all_up || give_up "the robot did not start"
took "nodes: $(rosnode list | paste -sd ' ')"

for _ in 1 2 3; do
    kill_master
done

step "rosservice call /talker/get_loggers"
if rosservice call /talker/get_loggers >"$scratch/rosservice.log" 2>&1; then
    took "the talker answers"
else
    wrong "it failed: $(tail -n 1 "$scratch/rosservice.log")"
fi

[ "$failed" = 0 ] || give_up "something failed, see above"
printf '\nEverything worked.\n'
