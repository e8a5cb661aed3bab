#!/usr/bin/env bash
# Makes docs/page.png: the page of examples/robot after two rescues, with a dead node. Needs everything that the tests need, and pngquant.
#
#     tests/page/screenshot.sh [FILE]

cd "$(dirname "$0")/../.." || exit
. examples/common.sh
need_ros
. tests/install_robot.sh
. tests/install_chromium.sh
need_rosrescue
need_scratch
command -v pngquant >/dev/null || give_up "there is no pngquant: apt-get install pngquant"

step "rosrescue core and the robot of examples/robot"
start_core
start_node robot examples/robot/launch.sh "$scratch"
within 180 rosparam get /mission/arrived >/dev/null 2>&1 || give_up "the robot did not start"

step "kill -9 of the master, twice"
for recoveries in 2 3; do
    read -r master < <(status last_recovery.master_pid)
    kill -9 "$master"
    within 60 recovered "$recoveries" || give_up "no new master"
    within 60 status last_recovery.health_check_ms || give_up "the nodes were not asked"
done

step "kill -9 of a lidar's driver"
node_pid() { # NAME
    curl -s "${ROS_MASTER_URI%/}/state.json" | /usr/bin/python3 -c '
import json, sys
print(next(node["pid"] for node in json.load(sys.stdin)["nodes"] if node["name"] == sys.argv[1]))' "$1"
}
is_dead() { status dead_nodes | grep -q "$1"; }
kill -9 "$(node_pid /lidar/rear/driver)"
within 60 is_dead /lidar/rear/driver || give_up "nobody noticed"

file=${1:-docs/page.png}
step "$file"
/usr/bin/python3 tests/page/screenshot.py "$ROS_MASTER_URI" "$scratch/page.png" 1280 1060 ||
    give_up "no picture"
pngquant --force --output "$file" 64 "$scratch/page.png"
took "$(stat -c %s "$file") bytes"

step "${file%.png}-phone.png"
/usr/bin/python3 tests/page/screenshot.py "$ROS_MASTER_URI" "$scratch/phone.png" 390 844 dark ||
    give_up "no picture"
pngquant --force --output "${file%.png}-phone.png" 64 "$scratch/phone.png"
