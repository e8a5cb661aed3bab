#!/bin/sh
# Compiles the robot's C++ nodes into a folder, and makes that the ROS package `robot_example_cpp`:
#
#     build.sh FOLDER
#
# It replaces catkin, which Debian lacks. A program that is newer than its source is not compiled again.
set -eu
cd "$(dirname "$0")/cpp"
folder=$1
mkdir -p "$folder/lib"

compile() { # SOURCE TARGET FLAGS...
    source=$1
    target=$folder/$2
    shift 2
    if [ ! -e "$target" ] || [ "$source" -nt "$target" ]; then
        # An unfinished file has another name.
        # shellcheck disable=SC2046 # splitting is intended
        g++ -O1 -Wall -o "$target.half" "$source" "$@" $(pkg-config --cflags --libs roscpp std_msgs)
        mv "$target.half" "$target"
    fi
}

for node in base lidar safety; do
    compile "$node.cpp" "$node"
done
compile nodelets.cpp lib/librobot_nodelets.so -shared -fPIC -lnodeletlib -lclass_loader \
    -ldynamic_reconfigure_config_init_mutex \
    -I/usr/include/pluginlib -I/usr/include/class_loader -I/usr/include/rcpputils -I/usr/include/rcutils
cp nodelets.xml package.xml "$folder/"
