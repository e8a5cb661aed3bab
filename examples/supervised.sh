#!/usr/bin/env bash
# A supervised set-up: `rosrescue core` in the place of roscore, and a robot that is brought up by
# roslaunch. Shows it, kills the master three times, and cleans up.
#
# It uses free ports and a scratch folder. On a robot there is nothing of that; it is just
#
#     rosrescue core
#     roslaunch --wait my_robot.launch
#
# ROSRESCUE=/path/to/rosrescue takes a binary that is there already.

cd "$(dirname "$0")/.." || exit
. examples/common.sh
need_ros
need_rosrescue
need_scratch

step "rosrescue core, where roscore was"
start_core
took "ROS_MASTER_URI=$ROS_MASTER_URI"

# --wait: without a master roslaunch would start one of its own, on rosrescue's port.
step "roslaunch --wait examples/robot.launch"
start_node robot roslaunch --wait examples/robot.launch
all_up() {
    grep -qE '^[0-9.]+ [0-9]+$' "$scratch/robot.log" && rosparam get /rosdistro >/dev/null 2>&1
}
within 60 all_up || give_up "the robot does not come up"
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

[ "$failed" = 0 ] || give_up "not everything held"
printf '\nAll of it held.\n'
