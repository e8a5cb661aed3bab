# Installs missing parts of ROS 1 for the tests and examples, and sets up ROS for this shell:
#
#     . tests/install_ros.sh
#
# Debian and Ubuntu contain ROS 1. A ROS in /opt/ros is used unchanged.

. tests/apt_get.sh

for ros_setup in /opt/ros/*/setup.sh; do
    if [ -r "$ros_setup" ] && [ -z "${ROS_DISTRO:-}" ]; then
        set +u # the set-up script of ROS uses unset variables
        . "$ros_setup"
        set -u
    fi
done

ros_has_rosout() {
    for rosout in /usr/lib/rosout/rosout /opt/ros/*/lib/rosout/rosout; do
        [ ! -x "$rosout" ] || return 0
    done
    return 1
}

# Prints PACKAGES unless CHECK succeeds.
need() { # PACKAGES CHECK...
    packages=$1
    shift
    "$@" >/dev/null 2>&1 || echo "$packages"
}

can_import() { # MODULES
    /usr/bin/python3 -c "import $1" >/dev/null 2>&1
}

# Prints the packages whose Python modules are missing. `python3` may not be the one for which ROS was built.
python_missing() { # PACKAGE:MODULES...
    all=
    for one in "$@"; do
        all=$all,${one#*:}
    done
    # If nothing is missing, one Python finds that out. Each one imports for a tenth of a second.
    ! can_import "${all#,}" || return 0
    for one in "$@"; do
        need "${one%%:*}" can_import "${one#*:}"
    done
}

# Prints the packages of everything that does not work here.
ros_missing() {
    for tool in rosmaster roslaunch rosnode rostopic rosservice rosparam; do
        need "python3-$tool" command -v "$tool"
    done
    python_missing python3-rospy:rospy,roscpp.srv python3-std-msgs:std_msgs.msg python3-nav-msgs:nav_msgs.msg \
        python3-sensor-msgs:sensor_msgs.msg python3-std-srvs:std_srvs.srv \
        python3-diagnostic-updater:diagnostic_updater python3-yaml:yaml
    need rosout ros_has_rosout
    need g++ command -v g++
    need iproute2 command -v ip
    need curl command -v curl
    need pkg-config command -v pkg-config
    need libroscpp-dev pkg-config --exists roscpp
    need libstd-msgs-dev pkg-config --exists std_msgs
    need rosbash command -v rosrun
    need procps command -v pgrep
}

install_missing() { # PACKAGES...
    [ $# -gt 0 ] || return 0
    if ! command -v apt-get >/dev/null; then
        echo "parts of ROS 1 are missing, and there is no apt-get to install: $*" >&2
        exit 1
    fi
    echo "installing: $*"
    if ! apt_get update -qq; then
        echo "cannot update the package lists; packages to install: $*" >&2
        exit 1
    fi
    if ! apt_get install -y -qq --no-install-recommends "$@"; then
        echo "apt-get cannot install some of: $*" >&2
        echo "You need a Debian or Ubuntu that contains ROS 1, such as Debian 12, or a ROS Noetic in" >&2
        echo "/opt/ros." >&2
        exit 1
    fi
}

# shellcheck disable=SC2046 # splitting is intended
install_missing $(ros_missing)
