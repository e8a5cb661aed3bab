#!/usr/bin/env bash
# `rosrescue proxy` in front of a master that something else starts. Here that is a loop; on a robot it is systemd
# (examples/systemd), a container, or another computer. Starts everything, kills the master, sets a parameter while
# there is no master, and cleans up.
#
#     rosmaster --core -p 11312                          a bare rosmaster, not roscore
#     rosrescue proxy --master http://localhost:11312    serves 11311, which nodes use as usual
#     rosparam set /run_id robot-1; rosrun rosout rosout  the rest of roscore, through rosrescue
#
# ROSRESCUE=/path/to/rosrescue uses a program that is already built.

cd "$(dirname "$0")/.." || exit
. examples/common.sh
need_ros
need_rosrescue
need_scratch

# Not roscore, because its rosout would connect directly to its own master, bypassing rosrescue, and because it ends when
# its master dies.
step "Start a master in a loop: rosmaster --core, restarted a second after its end"
master_port=$(free_port)
start master bash -c "while :; do rosmaster --core -p $master_port; sleep 1; done"

step "rosrescue proxy --master http://127.0.0.1:$master_port"
start_rosrescue proxy --master "http://127.0.0.1:$master_port" --listen 127.0.0.1:0 ||
    give_up "rosrescue did not start: $(tail -n 3 "$scratch/rosrescue.log")"
took "ROS_MASTER_URI=$ROS_MASTER_URI"

# The rest of what roscore does. Without a /run_id every `roslaunch --wait` would wait forever; roslaunch sets the other
# parameters of roscore.
step "/run_id and rosout through rosrescue, and roslaunch --wait examples/robot.launch"
rosparam set /run_id "$(cat /proc/sys/kernel/random/uuid)"
for rosout in /opt/ros/*/lib/rosout/rosout /usr/lib/rosout/rosout; do
    [ ! -x "$rosout" ] || break
done
start_node rosout "$rosout"
start_node robot roslaunch --wait examples/robot.launch
all_up() {
    grep -qE '^[0-9.]+ [0-9]+$' "$scratch/robot.log" && rosnode list 2>/dev/null | grep -qx /rosout
}
within 60 all_up || give_up "the robot did not start"
took "nodes: $(rosnode list | paste -sd ' ')"

kill_master

read -r master < <(status last_recovery.master_pid)
step "kill -9 $master, and rosparam set /robot/wheels 4 while there is no master"
kill -KILL "$master"
if rosparam set /robot/wheels 4; then
    took "it succeeded: /robot/wheels is $(rosparam get /robot/wheels)"
else
    wrong "it failed"
fi

[ "$failed" = 0 ] || give_up "something failed, see above"
printf '\nEverything worked.\n'
