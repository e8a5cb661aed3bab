# shellcheck shell=bash
# Functions for all examples: they provide ROS, the rosrescue to use, and a scratch folder, and clean up at the end. To
# be sourced from the root of the repository by a bash script:
#
#     . examples/common.sh
#
# Every process that an example starts has the scratch folder in its environment (ROS_HOME). That is how all of them are
# found and ended, even if their parents are gone.

set -euo pipefail
# Makes $EPOCHREALTIME contain a point in any language.
export LC_ALL=C.UTF-8
failed=0
scratch=
rosrescue_pid=
node_pids=()

bold='' red='' plain=''
if [ -t 1 ] && [ -z "${NO_COLOR:-}" ]; then
    bold=$'\e[1m' red=$'\e[31;1m' plain=$'\e[0m'
fi

# Begins a step and prints its title.
step() {
    step_number=$((${step_number:-0} + 1))
    step_began=$EPOCHREALTIME
    printf '%s%d. %s%s\n' "$bold" "$step_number" "$*" "$plain"
}

say() { printf '   %s\n' "$@"; }

# Prints a line with the time that the step took.
took() { say "$1 ($(seconds "$step_began" "$EPOCHREALTIME") s)"; }

seconds() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.1f", b - a }'; }
milliseconds() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.1f", (b - a) * 1000 }'; }

# Reports a check that failed, and goes on.
wrong() {
    failed=1
    printf '   %sWRONG: %s%s\n' "$red" "$*" "$plain"
}

# Reports an error after which the example cannot go on.
give_up() {
    failed=1
    printf '\n%s%s: %s%s\n' "$red" "${0##*/}" "$*" "$plain" >&2
    exit 1
}

# Waits until a command succeeds. Fails after SECONDS.
within() { # SECONDS COMMAND...
    local end=$((SECONDS + $1))
    shift
    until "$@"; do
        [ "$SECONDS" -lt "$end" ] || return 1
        sleep 0.1
    done
}

# Sets up ROS for this shell, and installs missing parts of it.
need_ros() {
    . tests/install_ros.sh
}

# Builds rosrescue, unless ROSRESCUE names one.
need_rosrescue() {
    if [ -n "${ROSRESCUE:-}" ]; then
        return
    fi
    command -v cargo >/dev/null || PATH="$PATH:$HOME/.cargo/bin"
    command -v cargo >/dev/null ||
        give_up "cargo is not installed; install a Rust toolchain first: https://rustup.rs"
    cargo build --release --locked ||
        give_up "cargo could not build rosrescue. It needs Rust $(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml) or later: https://rustup.rs"
    ROSRESCUE=$(cargo metadata --format-version 1 --no-deps --offline |
        /usr/bin/python3 -c 'import json, sys; print(json.load(sys.stdin)["target_directory"])')/release/rosrescue
}

# Makes a folder for all files, which is removed at the end, and an environment without any other ROS on this computer.
need_scratch() {
    trap clean_up EXIT
    trap 'exit 129' HUP
    trap 'exit 130' INT
    trap 'exit 143' TERM
    scratch=$(mktemp -d "${TMPDIR:-/tmp}/rosrescue.XXXXXX")
    local name
    for name in ${!ROSRESCUE_@}; do
        unset "$name"
    done
    unset ROS_HOSTNAME ROS_IPV6 ROS_NAMESPACE ROS_MASTER_URI ROS_PYTHON_LOG_CONFIG_FILE
    export ROS_IP=127.0.0.1 ROS_HOME=$scratch/ros ROS_LOG_DIR=$scratch/ros/log
    export ROS_PACKAGE_PATH=$PWD/examples/nodes${ROS_PACKAGE_PATH:+:$ROS_PACKAGE_PATH}
    mkdir -p "$ROS_LOG_DIR"
}

free_port() {
    /usr/bin/python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

# Starts a program in a new session, so that Ctrl-C reaches only this script. Its output goes to NAME.log in the scratch
# folder. Its process id is then in $!.
start() { # NAME COMMAND...
    local name=$1
    shift
    : >"$scratch/$name.log"
    setsid "$@" </dev/null >"$scratch/$name.log" 2>&1 &
    # The shell must not report its end.
    disown
}

start_node() { # NAME COMMAND...
    start "$@"
    node_pids+=($!)
}

# Starts rosrescue and waits until it reports that it serves. Sets rosrescue_pid and ROS_MASTER_URI.
start_rosrescue() { # ARGUMENTS...
    start rosrescue "$ROSRESCUE" "$@"
    rosrescue_pid=$!
    within 60 rosrescue_has_decided || return 1
    kill -0 "$rosrescue_pid" 2>/dev/null || return 1
    ROS_MASTER_URI=$(sed -n 's/^ROS_MASTER_URI=//p' "$scratch/rosrescue.log")
    export ROS_MASTER_URI
}

rosrescue_has_decided() {
    grep -q 'Master is now fault tolerant' "$scratch/rosrescue.log" ||
        ! kill -0 "$rosrescue_pid" 2>/dev/null
}

# Starts `rosrescue core` on a free port. Tries again if another program takes that port in the meantime.
start_core() {
    local attempt
    for attempt in 1 2 3 4 5; do
        start_rosrescue core -p "$(free_port)" && return
        grep -q 'is in use' "$scratch/rosrescue.log" || break
        [ "$attempt" = 5 ] || say "another program has taken the port; trying another one"
    done
    give_up "rosrescue did not start: $(tail -n 3 "$scratch/rosrescue.log")"
}

# Prints fields of the status page, such as `open` or `last_recovery.phases.total_ms`, one after another.
status() { # FIELD...
    /usr/bin/python3 - "$ROS_MASTER_URI" "$@" 2>>"$scratch/status.log" <<'PY'
import http.client, json, sys, urllib.parse

connection = http.client.HTTPConnection(urllib.parse.urlsplit(sys.argv[1]).netloc, timeout=5)
connection.request("GET", "/status.json")
page = json.load(connection.getresponse())
for field in sys.argv[2:]:
    value = page
    for name in field.split("."):
        value = value[name]
    print(value, end=" ")
print()
PY
}

# Whether COUNT masters have been given the state, and calls pass.
recovered() { # COUNT
    local recoveries open
    read -r recoveries open < <(status recoveries open) || return 1
    [ "$open" = True ] && [ "$recoveries" -ge "$1" ]
}

# Prints what a user can ask about a robot: nodes, topics with their nodes, services, parameters.
robot_state() {
    rosnode list
    rostopic list -v
    rosservice list
    rosparam dump
}

# Kills the master, waits until its successor has the state, and compares.
kill_master() {
    local before after recoveries master total
    before=$(robot_state 2>&1)
    read -r recoveries master < <(status recoveries last_recovery.master_pid)
    step "kill -9 $master, the rosmaster"
    kill -KILL "$master"
    within 60 recovered $((recoveries + 1)) || give_up "the master did not come back"
    read -r master total < <(status last_recovery.{master_pid,phases.total_ms})
    took "rosmaster is now process $master; it had the whole state after ${total%.*} ms"
    after=$(robot_state 2>&1)
    if [ "$before" = "$after" ]; then
        say "nodes, topics, services and parameters are the same as before"
    else
        wrong "the state differs:"
        diff <(echo "$before") <(echo "$after") || true
    fi
}

# Prints the ids of all processes that this example has started and that still run.
ours() {
    env -u ROS_HOME grep -lsF "ROS_HOME=$scratch/" /proc/[0-9]*/environ | cut -d / -f 3
}

# Sends a signal to one of them, and waits up to five seconds for its end.
end() { # SIGNAL PID
    local tick
    for tick in {1..100}; do
        ours | grep -qx "$2" || return 0
        [ "$tick" -gt 1 ] || kill -s "$1" "$2" 2>/dev/null || return 0
        sleep 0.05
    done
    return 1
}

# Ends everything cleanly: first the nodes, which unregister from the master; then rosrescue, which ends rosmaster and
# rosout; then everything that is left.
clean_up() {
    local code=$? pid
    trap '' HUP INT TERM
    trap - EXIT
    # Processes start and end while `ours` examines all of them, so errors are normal.
    set +e +o pipefail
    [ -n "$scratch" ] || exit "$code"
    [ "$code" -lt 128 ] || printf '\ncleaning up\n'
    if [ "$failed" = 1 ]; then
        for log in "$scratch"/*.log; do
            printf '\n--- the end of %s\n' "${log##*/}"
            tail -n 15 "$log"
        done >&2
    fi
    for pid in "${node_pids[@]}" $rosrescue_pid; do
        end TERM "$pid"
    done
    # Twice, because a loop that starts masters may just have started another one.
    for _ in 1 2; do
        for pid in $(ours); do
            end KILL "$pid"
        done
    done
    rm -rf "$scratch"
    [ "$code" != 0 ] || code=$failed
    exit "$code"
}
