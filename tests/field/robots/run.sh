#!/bin/sh
# Tests several robots with multimaster_fkie, each behind its own rosrescue: downloads the source of multimaster_fkie
# into target/field/robots, runs measure.py, and writes the section "Several robots" of docs/compatibility.md. Needs
# root, iproute2, and a Debian or Ubuntu with ROS 1.
#
#     tests/field/robots/run.sh [OPTIONS OF measure.py]
#
# ROSRESCUE=/path/to/rosrescue uses a program that is already built, and FKIE_GIT names a repository of multimaster_fkie.
set -eu
cd "$(dirname "$0")/../../.."
. tests/install_ros.sh

work=$PWD/target/field/robots
python=$work/python
source=$work/fkie
mkdir -p "$python"
if [ ! -e "$source" ]; then
    git clone --depth 1 --branch 1.3.2 "${FKIE_GIT:-https://github.com/fkie/multimaster_fkie}" "$source"
fi
apt_get install -y -qq --no-install-recommends ros-std-msgs python3-diagnostic-msgs >"$work/install.log" 2>&1
for package in fkie_master_discovery fkie_master_sync; do
    cp -r "$source/$package/src/$package" "$python/"
done
messages=$source/fkie_multimaster_msgs
for kind in msg srv; do
    folder=$python/fkie_multimaster_msgs/$kind
    mkdir -p "$folder"
    : >"$python/fkie_multimaster_msgs/__init__.py"
    /usr/bin/python3 "/usr/lib/genpy/gen${kind}_py.py" -p fkie_multimaster_msgs -I std_msgs:/usr/share/std_msgs/msg \
        -I "fkie_multimaster_msgs:$messages/msg" -o "$folder" "$messages/$kind"/*."$kind"
    /usr/bin/python3 "/usr/lib/genpy/gen${kind}_py.py" --initpy -p fkie_multimaster_msgs -o "$folder"
done

if [ -z "${ROSRESCUE:-}" ]; then
    cargo build --release --locked
    ROSRESCUE=${CARGO_TARGET_DIR:-target}/release/rosrescue
fi
tests/field/robots/measure.py --work "$work" --rosrescue "$ROSRESCUE" "$@"
tests/field/clients/table.py robots "$work" docs/compatibility.md
