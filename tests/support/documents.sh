# Simulates a computer for the commands in a document. `tests/robot/documents.rs` runs it before them, as root in a
# network, a mount and a process namespace, so that port 11311 and /opt are free, and `pkill` finds no other processes.
#
# The functions do what a user does beside the commands: they give a program that keeps running its own terminal, and
# wait until it is ready.

scratch=$ROS_HOME
ip link set lo up
ip addr add 10.0.0.7/24 dev lo
export HOME=$scratch/home
unset ROS_HOME ROS_LOG_DIR # the defaults lead there
if [ ! -d /opt/ros/noetic ]; then
    mount -t tmpfs none /opt
    mkdir -p /opt/ros/noetic
    : >/opt/ros/noetic/setup.bash # Debian's ROS needs no set-up script
fi

# The repository, except that files which the commands write stay here.
mkdir -p "$HOME" "$scratch/here" "$scratch/bin" "$scratch/packages"
cd "$scratch/here"
ln -s "$REPOSITORY"/* .
ln -s "$ROSRESCUE" "$scratch/bin/rosrescue"
# Most other tests also run a `rosversion` that starts at once. They make it when they first need it.
PATH=$scratch/bin:$QUICK_ROSVERSION:$PATH
cat >my_robot.launch <<'LAUNCH'
<launch>
  <param name="robot/wheels" value="4" />
  <node pkg="rosrescue_examples" type="talker.py" name="talker"><remap from="count" to="some_topic" /></node>
  <node pkg="rosrescue_examples" type="listener.py" name="listener"><remap from="count" to="some_topic" /></node>
</launch>
LAUNCH
mkdir "$scratch/packages/my_robot"
cp my_robot.launch "$scratch/packages/my_robot"
sed s/rosrescue_examples/my_robot/ "$REPOSITORY/examples/nodes/package.xml" >"$scratch/packages/my_robot/package.xml"
export ROS_PACKAGE_PATH=$scratch/packages:$REPOSITORY/examples/nodes${ROS_PACKAGE_PATH:+:$ROS_PACKAGE_PATH}
export ROS_MASTER_URI=http://127.0.0.1:11311

# Waits for a command to succeed.
within() { # SECONDS COMMAND...
    local end=$((SECONDS + $1))
    shift
    until "$@" >/dev/null 2>&1; do
        if [ "$SECONDS" -ge "$end" ]; then
            echo "did not succeed in time: $*" >&2
            tail -n 20 "$scratch"/terminal-*.log >&2
            return 1
        fi
        sleep 0.2
    done
}

terminals=0
in_a_terminal() {
    terminals=$((terminals + 1))
    command "$@" >"$scratch/terminal-$terminals.log" 2>&1 &
}

calls_are_answered() { curl -fsS "http://127.0.0.1:${1:-11311}/ready"; }
# ROS's own tools would show it as well, but each run of one takes half a second of processor time.
robot_is_up() {
    curl -fsS http://127.0.0.1:11311/state.json |
        grep -E '"name":"/some_topic",[^}]*"publishers":\[[^]]*"/talker"[^}]*"subscribers":\[[^]]*"/listener'
}
master_answers() {
    curl -fsS -H 'Content-Type: text/xml' "http://127.0.0.1:$1/RPC2" -d "<methodCall><methodName>getPid</methodName>
        <params><param><value>/documents</value></param></params></methodCall>" | grep '<int>1</int>'
}

rosrescue() {
    case ${1:-} in
        core | proxy)
            in_a_terminal rosrescue "$@"
            within 120 calls_are_answered
            ;;
        top) command rosrescue "$@" --count 2 ;;
        # The user's answer; and one kill instead of three, without a search for topics. A pause in the messages is no
        # damage: a talker or the drill may have got no processor for a second.
        drill)
            command rosrescue "$@" --yes --times 1 --topic some_topic | awk '
                { print }
                /^(PASSED|FAILED): / { fine = 1 }
                /^  failed / && !/ came for / { fine = 0 }
                END { exit !fine }'
            ;;
        *) command rosrescue "$@" ;;
    esac
}
rosmaster() {
    in_a_terminal rosmaster "$@"
    within 120 master_answers 11312
}
roslaunch() {
    in_a_terminal roslaunch "$@"
    within 120 robot_is_up
}
# In Debian it is in a separate package, which needs catkin.
if ! command -v rosrun >/dev/null; then
    rosrun() { "/usr/lib/$1/$2" "${@:3}"; }
fi
# Commands that would run until Ctrl-C: they must print something.
rostopic() {
    case ${1:-} in
        echo | hz) timeout 120 "$(type -P rostopic)" "$@" 2>&1 | grep -m 1 . ;;
        *) command rostopic "$@" ;;
    esac
}
