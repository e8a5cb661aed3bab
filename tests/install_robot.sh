# Installs missing packages for the example robot (examples/robot) and its test. To be sourced after
# tests/install_ros.sh.

robot_missing() {
    has_node() { # PACKAGE/TYPE
        for node in /usr/lib/"$1" /opt/ros/*/lib/"$1"; do
            [ ! -x "$node" ] || return 0
        done
        return 1
    }
    # roslaunch and pluginlib find packages by this file.
    has_package() { # PACKAGE
        for package in /usr/share/"$1"/package.xml /opt/ros/*/share/"$1"/package.xml; do
            [ ! -r "$package" ] || return 0
        done
        return 1
    }
    has_library() { # NAME
        for library in /usr/lib/*/lib"$1".so /opt/ros/*/lib/lib"$1".so; do
            [ ! -r "$library" ] || return 0
        done
        return 1
    }
    need ros-robot-state-publisher has_node robot_state_publisher/robot_state_publisher
    need joint-state-publisher has_node joint_state_publisher/joint_state_publisher
    need tf2-tools has_node tf2_ros/static_transform_publisher
    need libtf2-ros-dev has_package tf2_ros
    need topic-tools has_node topic_tools/mux
    need libtopic-tools-dev has_package topic_tools
    need libnodeletlib-tools has_node nodelet/nodelet
    need libnodeletlib-dev has_library nodeletlib
    need libnodelet-topic-tools-dev has_package nodelet_topic_tools
    need libdynamic-reconfigure-config-init-mutex-dev \
        has_library dynamic_reconfigure_config_init_mutex
    need libdiagnostic-aggregator-tools has_node diagnostic_aggregator/aggregator_node
    need libdiagnostic-aggregator-dev has_package diagnostic_aggregator
    need python3-diagnostic-common-diagnostics has_node diagnostic_common_diagnostics/cpu_monitor.py
    need python3-prometheus-client /usr/bin/python3 -c 'import prometheus_client.openmetrics.parser'
    need python3-psutil /usr/bin/python3 -c 'import psutil'
    need python3-rosbag has_node rosbag/record
    need python3-dynamic-reconfigure /usr/bin/python3 -c 'import dynamic_reconfigure'
    for messages in geometry sensor nav move_base; do
        package=$(echo "$messages" | tr _ -)
        need "python3-$package-msgs" /usr/bin/python3 -c "import ${messages}_msgs.msg"
    done
    need python3-actionlib /usr/bin/python3 -c 'import actionlib'
    need python3-tf2-ros /usr/bin/python3 -c 'import tf2_ros'
    for messages in sensor nav diagnostic tf2; do
        need "lib$messages-msgs-dev" pkg-config --exists "${messages}_msgs"
    done
    need libstd-srvs-dev pkg-config --exists std_srvs
}

# shellcheck disable=SC2046 # splitting is intended
install_missing $(robot_missing)
