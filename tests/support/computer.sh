# Simulates a user's computer for `tests/support/computers.sh`.
name=$(hostname)
folder=$HOME
cd "$folder"
id etcd >/dev/null 2>&1 || echo "etcd:x:990:990::/var/lib/etcd:/usr/sbin/nologin" >>/etc/passwd # the package would create this user

export ROS_HOME=$folder ROS_LOG_DIR=$folder/log ROS_MASTER_URI=http://localhost:11311
ROS_IP=$(ip -4 -o addr show dev eth0 | sed 's|.*inet \([0-9.]*\)/.*|\1|')
export ROS_IP
# A computer that gets no processor for 2 s, the default, keeps its leadership here.
export ROSRESCUE_CLUSTER_TTL=20

# Programs that keep running get a terminal of their own.
rosrescue() {
    if [ "$1" != core ]; then
        "$ROSRESCUE" "$@"
    else
        "$ROSRESCUE" "$@" >>"$folder/rosrescue.log" 2>&1 &
        "$ROSRESCUE" wait
    fi
}
sudo() { "$@"; }
apt() { :; }

# Repeats commands that the document says to repeat, because members must know each other for 5 s.
etcdctl() {
    until command etcdctl "$@"; do
        [ "$1 $2" = "member add" ] || return 1
        sleep 0.5
    done
}

# Runs etcd as Debian's unit does.
systemctl() {
    case "$*" in
    daemon-reload) ;;
    "stop etcd")
        if [ -e "$folder/etcd.pid" ]; then
            pid=$(cat "$folder/etcd.pid")
            kill "$pid"
            # There may be no process to reap it.
            while [ -e "/proc/$pid/exe" ]; do sleep 0.05; done
            rm "$folder/etcd.pid"
        fi
        ;;
    "restart --no-block etcd")
        systemctl stop etcd
        mkdir -p /var/lib/etcd
        # shellcheck disable=SC2046 # splitting is intended
        env -i PATH="$PATH" ETCD_NAME="$name" ETCD_DATA_DIR=/var/lib/etcd/default \
            $(grep -v '^#' /etc/default/etcd) etcd >>"$folder/etcd.log" 2>&1 &
        echo $! >"$folder/etcd.pid"
        ;;
    *)
        echo "unsupported: systemctl $*" >&2
        return 1
        ;;
    esac
}
