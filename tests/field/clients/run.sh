#!/bin/sh
# Foreign clients through the deaths of master and worker: installs them in target/field/clients, runs
# measure.py, and writes the section "Clients" of docs/compatibility.md. Needs a Debian or Ubuntu with ROS 1, root,
# node with npm, and a Rust toolchain.
#
#     tests/field/clients/run.sh [OPTIONS OF measure.py]
#
# ROSRESCUE=/path/to/rosrescue takes a binary that is there already, PYTHON2 names a Python 2, and ROSBRIDGE_GIT a
# repository of rosbridge_suite. A client that cannot be installed is left out, with the reason in the table.
set -eu
cd "$(dirname "$0")/../../.."
. tests/install_ros.sh
. tests/install_robot.sh

work=$PWD/target/field/clients
mkdir -p "$work"
skipped=$work/skipped
: >"$skipped"
clients=

# Adds CLIENTS if the commands of FUNCTION succeed.
try() { # FUNCTION CLIENTS...
    step=$1
    shift
    echo "installing: $*"
    # Not as the condition itself, in which the shell goes on after an error.
    set +e
    (set -e; "$step") >"$work/install-$step.log" 2>&1
    status=$?
    set -e
    if [ "$status" = 0 ]; then
        for one in "$@"; do clients=$clients,$one; done
    else
        reason=$(tail -n 1 "$work/install-$step.log")
        for one in "$@"; do echo "$one	$reason" >>"$skipped"; done
        echo "  left out: $reason"
    fi
}

messages() {
    apt_get install -y -qq --no-install-recommends ros-std-msgs ros-std-srvs ros-rosgraph-msgs ros-roscpp-msg
    # rosnodejs reads every package that it finds and ends at one that lacks another.
    rm -rf "$work/messages"
    mkdir "$work/messages"
    for package in std_msgs std_srvs rosgraph_msgs roscpp; do
        cp -rL "/usr/share/$package" "$work/messages"
    done
}

by_npm() {
    npm install --prefix "$work" --no-fund --no-audit rosnodejs roslib @foxglove/ros1 tslib
}

by_cargo() {
    ROS_PACKAGE_PATH=$work/messages ROSRUST_MSG_PATH=$work CMAKE_PREFIX_PATH='' \
        cargo build --locked --manifest-path tests/field/clients/rust/Cargo.toml --target-dir "$work/rust"
}

by_apt() {
    apt_get install -y -qq --no-install-recommends sbcl roslisp cl-std-msgs cl-std-srvs
    # Compiled once, and not by each node.
    sbcl --script tests/field/clients/roslisp.lisp --compile
}

# rosbridge_suite 0.11.17, its messages made by genpy; rosauth is asked for by name and not used.
bridge() {
    suite=$work/rosbridge_suite
    python=$suite/python
    if [ ! -e "$suite" ]; then
        git clone --depth 1 --branch 0.11.17 \
            "${ROSBRIDGE_GIT:-https://github.com/RobotWebTools/rosbridge_suite}" "$suite"
    fi
    /usr/bin/python3 -m venv --system-site-packages "$work/venv"
    "$work/venv/bin/pip" install -q roslibpy tornado pymongo autobahn twisted pillow setuptools
    mkdir -p "$python/rosauth/srv"
    : >"$python/rosauth/__init__.py"
    echo 'class Authentication: pass' >"$python/rosauth/srv/__init__.py"
    for package in rosapi rosbridge_library rosbridge_server; do
        cp -r "$suite/$package/src/$package" "$python/"
    done
    mkdir -p "$python/rosbridge_msgs"
    : >"$python/rosbridge_msgs/__init__.py"
    generate rosapi msg
    generate rosapi srv
    generate rosbridge_msgs msg
}

generate() { # PACKAGE msg|srv
    folder=$python/$1/$2
    mkdir -p "$folder"
    includes="-I std_msgs:/usr/share/std_msgs/msg -I $1:$suite/$1/msg"
    # shellcheck disable=SC2086 # words are what is wanted
    /usr/bin/python3 "/usr/lib/genpy/gen${2}_py.py" $includes -p "$1" -o "$folder" "$suite/$1/$2"/*."$2"
    /usr/bin/python3 "/usr/lib/genpy/gen${2}_py.py" --initpy -p "$1" -o "$folder"
}

python_2() {
    "${PYTHON2:-python2}" -c 'import xmlrpclib' || { echo "there is no Python 2"; false; }
}

messages >"$work/install-messages.log" 2>&1
try by_npm rosnodejs
try by_cargo rosrust rosrust_async roslibrust
try by_apt roslisp
try bridge roslibpy roslib
try python_2 xmlrpc2
try true xmlrpc3

if [ -z "${ROSRESCUE:-}" ]; then
    cargo build --release --locked
    ROSRESCUE=${CARGO_TARGET_DIR:-target}/release/rosrescue
fi
mkdir -p "$HOME/.ros" # roslisp needs it
tests/field/clients/measure.py --work "$work" --rosrescue "$ROSRESCUE" --clients "${clients#,}" \
    --python2 "${PYTHON2:-python2}" "$@"
case $clients in
*rosnodejs*rosrust*) PYTHONDONTWRITEBYTECODE=1 tests/field/clients/masters.py --work "$work" --rosrescue "$ROSRESCUE" ;;
esac
tests/field/clients/table.py clients "$work" docs/compatibility.md
