#!/usr/bin/env bash
# What a robot loses when its master is only restarted: a bare rosmaster in a loop, as with systemd's Restart=always and
# RestartSec=0.1. Starts it, kills the master, shows what is left, and cleans up.

cd "$(dirname "$0")/.." || exit
. examples/common.sh
need_ros
need_scratch

master_port=$(free_port)
export ROS_MASTER_URI=http://127.0.0.1:$master_port/
# Prints the master's answer.
ask() { # METHOD ARGUMENT...
    local method=$1 params='' argument
    shift
    for argument in /example "$@"; do
        params+="<param><value>$argument</value></param>"
    done
    curl -s --noproxy '*' -m 5 -H 'Content-Type: text/xml' "$ROS_MASTER_URI" \
        -d "<methodCall><methodName>$method</methodName><params>$params</params></methodCall>"
}
master_pid() { ask getPid | sed -n 's/.*<int>\([0-9]*\)<.*/\1/p' | tail -n 1; }
heard() { grep -cE '^[0-9.]+ [0-9]+$' "$scratch/$1.log" || true; }
has_heard() { [ "$(heard "$1")" -ge "$2" ]; }
late_is_up() { ask lookupNode /late | grep http: >/dev/null; }
count() { "$@" 2>/dev/null | grep -c . || true; }

step "Start a rosmaster that is restarted 0.1 s after its end"
start master bash -c "while :; do rosmaster --core -p $master_port; sleep 0.1; done"
within 60 master_pid >/dev/null || give_up "the rosmaster did not start"
took "ROS_MASTER_URI=$ROS_MASTER_URI"

step "Start rosout (roscpp), a rospy talker and a rospy listener; set a parameter and /run_id"
rosparam set /run_id "$(cat /proc/sys/kernel/random/uuid)"
rosparam set /robot/wheels 4
for rosout in /opt/ros/*/lib/rosout/rosout /usr/lib/rosout/rosout; do
    [ ! -x "$rosout" ] || break
done
start_node rosout "$rosout"
start_node talker examples/nodes/talker.py
start_node listener examples/nodes/listener.py
within 60 has_heard listener 100 || give_up "the listener hears nothing"
took "$(count rosnode list) nodes, $(count rostopic list) topics, $(count rosservice list) services, $(count rosparam list) parameters"

master=$(master_pid)
step "kill -9 $master: the rosmaster is dead"
killed=$EPOCHREALTIME
kill -KILL "$master"
is_back() {
    local now
    now=$(master_pid) && [ "$now" != "$master" ]
}
within 60 is_back || give_up "the rosmaster did not come back"
say "after $(seconds "$killed" "$EPOCHREALTIME") s a new rosmaster answers, process $(master_pid)"

step "See what it knows five seconds later"
sleep 5
say "$(count rosnode list) nodes, $(count rostopic list) topics, $(count rosservice list) services, $(count rosparam list) parameters"
before=$(heard listener)
within 10 has_heard listener $((before + 50)) || wrong "the connected listener receives nothing more"
say "the connected listener still receives messages: $(heard listener) so far"
rosparam get /robot/wheels >"$scratch/wheels.log" 2>&1 || true
say "rosparam get /robot/wheels: $(tail -n 1 "$scratch/wheels.log")"

step "A new listener asks the new rosmaster for the talker"
start_node late examples/nodes/listener.py __name:=late
within 60 late_is_up || give_up "the new listener did not start"
if within 5 has_heard late 1; then
    wrong "it has received something, which was not expected"
else
    say "five seconds later it has received nothing; nodes: $(rosnode list | paste -sd ' ')"
fi

step "roslaunch --wait examples/robot.launch"
start_node roslaunch roslaunch --wait examples/robot.launch
within 60 grep -q 'master has started' "$scratch/roslaunch.log" || give_up "roslaunch found no master"
if within 5 grep -q 'started with pid' "$scratch/roslaunch.log"; then
    wrong "it has started nodes, which was not expected"
else
    say "five seconds later it has started nothing, because it waits for a /run_id"
fi

[ "$failed" = 0 ] || give_up "the result is not what docs/comparison.md says"
