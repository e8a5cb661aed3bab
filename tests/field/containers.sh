#!/bin/sh
# containers.sh [OPTIONS OF containers.py]: makes the image of packaging/docker/build-image.sh and an image with Debian's
# ROS, and kills the master and rosrescue in containers 100 times (containers.py). Kept in target/field/containers.
#
# Needs root, podman with netavark and aardvark-dns, debootstrap, g++, libroscpp-dev. PACKAGE names a Debian package of
# rosrescue that is already built. PODMAN and LIMITS may name another runtime and limits of `podman run`, as sandboxes
# need them: PODMAN="podman --runtime runc" LIMITS="--ulimit nofile=1024:1024 --ulimit nproc=1000:1000".
set -eu
cd "$(dirname "$0")/../.."
. tests/install_ros.sh
. tests/install_tools.sh
work=${CARGO_TARGET_DIR:-target}/field/containers
root=$work/root
mkdir -p "$work/nodes"

if [ ! -d "$root" ]; then
    rm -rf "$root.new"
    debootstrap --variant=minbase bookworm "$root.new" "${ROSRESCUE_TEST_DEBIAN:-http://deb.debian.org/debian}" >&2
    chroot "$root.new" apt-get install -y -qq --no-install-recommends python3-rosmaster python3-rospy python3-rostopic \
        python3-rosnode python3-roslaunch rosout python3-std-msgs libroscpp4d procps >&2
    rm -rf "$root.new"/var/cache/apt/archives/*.deb
    mv "$root.new" "$root"
fi
for node in talker listener; do
    # shellcheck disable=SC2046 # words
    g++ -O1 -fno-access-control -o "$work/nodes/$node" "tests/nodes/$node.cpp" $(pkg-config --cflags --libs roscpp std_msgs)
done
cp tests/nodes/talker.py tests/nodes/listener.py tests/nodes/lines.py "$work/nodes/"
[ -n "${PACKAGE:-}" ] || PACKAGE=$(packaging/build-deb.sh)

podman=${PODMAN:-podman}
packaging/docker/build-image.sh "$PACKAGE" rosrescue-field >&2
tar -C "$root" --exclude=./proc --exclude=./dev --exclude=./tmp -c . | $podman import - rosrescue-field-ros >/dev/null 2>&1
status=0
tests/field/containers.py --image rosrescue-field --ros rosrescue-field-ros --nodes "$work/nodes" --said "$work/said" "$@" || status=$?
$podman rmi --force rosrescue-field rosrescue-field-ros >/dev/null
exit "$status"
