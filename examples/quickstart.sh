#!/usr/bin/env bash
# Watch a ROS 1 robot survive the death of its master.
#
#     examples/quickstart.sh          runs the demonstration and cleans up
#     examples/quickstart.sh --keep   leaves everything running afterwards, for you to try
#
# On a Debian or Ubuntu with a Rust toolchain, it installs missing parts of ROS 1 (as root or with sudo) and builds
# rosrescue. It uses free ports and a scratch folder, and does not touch any other ROS.
# ROSRESCUE=/path/to/rosrescue uses a program that is already built.
# Exit status: 0 if everything worked, 1 if anything failed, 2 for a wrong argument.

keep=0
case "$#${1:-}" in
    0) ;;
    1--keep) keep=1 ;;
    1--help | 1-h)
        sed -n '2,/^$/s/^# \{0,1\}//p' "$0"
        exit
        ;;
    *)
        echo "usage: ${0##*/} [--keep]" >&2
        exit 2
        ;;
esac
cd "$(dirname "$0")/.." || exit
. examples/common.sh

# Prints how many messages the listener NAME has received.
heard() { grep -cE '^[0-9.]+ [0-9]+$' "$scratch/$1.log" || true; }
has_heard() { [ "$(heard "$1")" -ge "$2" ] 2>/dev/null; }

# Checks that the listener NAME has received every number from its first to its last, once and in order.
check_stream() { # NAME
    local first last count broken
    read -r first last count broken < <(awk '
        !/^[0-9.]+ [0-9]+$/ { next }
        n++ && $2 != last + 1 { broken++ }
        n == 1 { first = $2 }
        { last = $2 }
        END { print first + 0, last + 0, n + 0, broken + 0 }' "$scratch/$1.log")
    if [ "$count" -gt 0 ] && [ "$broken" = 0 ] && [ "$count" = $((last - first + 1)) ]; then
        say "$1: $first to $last, $count messages: none lost, none twice"
    else
        wrong "$1: $first to $last, $count messages, $broken gaps or repeats"
    fi
}

nodes() { rosnode list 2>&1 | sort | paste -sd ' '; }

step "Look for ROS 1, and install what is missing"
need_ros
took "$(command -v rosmaster)"

step "Build rosrescue"
need_rosrescue
took "$ROSRESCUE"
need_scratch

step "Start rosrescue core, which starts a real rosmaster"
start_core
read -r master < <(status last_recovery.master_pid)
took "ROS_MASTER_URI=$ROS_MASTER_URI, rosmaster is process $master"

step "Start a rospy talker and a rospy listener, and set a parameter"
start_node talker examples/nodes/talker.py
start_node listener examples/nodes/listener.py
rosparam set /robot/wheels 4
within 60 has_heard listener 100 || give_up "the listener receives nothing"
# rosrescue sets its own parameters after it has run `rosversion`.
within 60 rosparam get /rosdistro >/dev/null 2>&1 || give_up "rosrescue did not set /rosdistro"
before=$(nodes)
took "$(heard listener) messages so far; nodes: $before"

step "kill -9 $master: the rosmaster is dead"
killed=$EPOCHREALTIME
kill -KILL "$master"
within 60 recovered 2 || give_up "the master did not come back"
read -r shut absence total pid restored < <(status last_recovery.{detected_at,phases.absence_ms,phases.total_ms,master_pid} \
    last_recovery.restored.nodes)
read -r detected listening open during first last < <(awk -v killed="$killed" -v shut="$shut" \
    -v absence="$absence" -v total="$total" '
    /^[0-9.]+ [0-9]+$/ && $1 >= killed && $1 <= shut + total / 1000 {
        n++
        if (n == 1) first = $2
        last = $2
    }
    END {
        ms = (shut - killed) * 1000
        printf "%.1f %.1f %.1f %d %d %d\n", ms, ms + absence, ms + total, n, first, last
    }' "$scratch/listener.log")
say "after $detected ms it was noticed" \
    "after $listening ms a new rosmaster, process $pid, was listening" \
    "after $open ms it knew everything again, and calls passed: $restored nodes" \
    "meanwhile the listener heard $during messages$([ "$during" = 0 ] || echo ": $first to $last")"
[ "$pid" != "$master" ] || wrong "it is still the old rosmaster"

step "A new listener asks the new rosmaster for the talker"
start_node late examples/nodes/listener.py __name:=late
within 60 has_heard late 1 || give_up "the new listener receives nothing"
took "it hears message $(awk '{ print $2; exit }' "$scratch/late.log")"
within 60 has_heard late 100 || give_up "the new listener receives nothing more"

step "Compare"
check_stream listener
check_stream late
after=$(nodes)
if [ "$after" = "/late $before" ]; then
    say "nodes: $after"
else
    wrong "nodes: before $before, now $after"
fi
wheels=$(rosparam get /robot/wheels 2>&1)
if [ "$wheels" = 4 ]; then
    say "rosparam get /robot/wheels: $wheels"
else
    wrong "rosparam get /robot/wheels: $wheels"
fi
[ "$failed" = 0 ] || give_up "something failed, see above"

if [ "$keep" = 0 ]; then
    printf '\nEverything worked. Run it with --keep to try more.\n'
    exit
fi

# A script with which the user can clean up later.
{
    printf '#!/usr/bin/env bash\n# Ends what examples/quickstart.sh --keep left running, and removes this folder.\n'
    declare -p scratch failed node_pids rosrescue_pid
    declare -f ours end clean_up
    echo clean_up
} >"$scratch/stop"
cat >"$scratch/env" <<END
for setup in /opt/ros/*/setup.sh; do
    [ ! -r "\$setup" ] || [ -n "\${ROS_DISTRO:-}" ] || . "\$setup"
done
unset ROS_HOSTNAME
export ROS_MASTER_URI=$ROS_MASTER_URI ROS_IP=127.0.0.1
END
trap - EXIT
cat <<END

It is still running. In another terminal:

    . $scratch/env
    rosnode list
    rostopic echo /count

Kill the master as often as you like, and see what nodes notice:

    $(realpath "$ROSRESCUE") drill

Status: $ROS_MASTER_URI in a browser, or

    curl $ROS_MASTER_URI

Checkpoint: $ROS_LOG_DIR/latest-chkpt.yaml
Log:        $scratch/rosrescue.log

To end everything:

    bash $scratch/stop
END
