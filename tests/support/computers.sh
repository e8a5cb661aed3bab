# Simulates three computers on one switch, for the instructions in docs/several-computers.md: base, arm and head, each
# with its own network, host name and /etc. Run as root in a network, a mount and a process namespace.
#
# The functions replace what a real computer has and a test does not: sudo, apt, and a systemd that runs etcd.

scratch=$ROS_HOME
declare -A process address=([base]=10.0.0.1 [arm]=10.0.0.2 [head]=10.0.0.3)
computers="base arm head"

# Waits for a command to succeed.
within() { # SECONDS COMMAND...
    local end=$((SECONDS + $1))
    shift
    until "$@" >/dev/null 2>&1; do
        if [ "$SECONDS" -ge "$end" ]; then
            echo "did not succeed in time: $*" >&2
            tail -n 20 "$scratch"/*/*.log >&2
            return 1
        fi
        sleep 0.05
    done
}

inside() { # COMPUTER COMMAND...
    local name=$1
    shift
    nsenter --target "${process[$name]}" --net --mount --uts "$@"
}

# Whether the computer's namespaces exist.
is_apart() { ! [ "/proc/$1/ns/$2" -ef "/proc/self/ns/$2" ]; }

# Starts one more computer. The cable has the computer's name.
switch_on() { # COMPUTER
    local name=$1
    unshare --net --mount --uts sleep infinity &
    process[$name]=$!
    within 120 is_apart "$!" net
    within 120 is_apart "$!" uts
    mkdir -p "$scratch/$name/etc" "$scratch/$name/lib"
    cp -a /etc/. "$scratch/$name/etc"
    inside "$name" hostname "$name"
    inside "$name" mount --bind "$scratch/$name/etc" /etc
    inside "$name" mount --bind "$scratch/$name/lib" /var/lib
    ip link add "$name" type veth peer name eth0 netns "$!"
    ip link set "$name" master switch up
    inside "$name" ip link set lo up
    inside "$name" ip addr add "${address[$name]}/24" dev eth0
    inside "$name" ip link set eth0 up
}

# Runs the script on standard input like a user on that computer.
on() { # COMPUTER
    local name=$1
    cat "$REPOSITORY/tests/support/computer.sh" - >"$scratch/$name/script"
    echo "--- on $name" >&2
    HOME=$scratch/$name inside "$name" bash -eu "$scratch/$name/script"
}

mount -t tmpfs none /run
ip link set lo up
ip link add switch type bridge
ip link set switch up
for name in $computers; do
    switch_on "$name"
done

# Whether all three etcd servers are healthy members.
all_healthy() { # SCHEME
    local folder=$scratch/base/etc/etcd
    local tls=
    [ "$1" = http ] || tls="--cacert $folder/ca.pem --cert $folder/own.pem --key $folder/own.key"
    # shellcheck disable=SC2086 # splitting is intended
    inside base env ETCDCTL_API=3 etcdctl $tls endpoint health \
        --endpoints="$1://10.0.0.1:2379,$1://10.0.0.2:2379,$1://10.0.0.3:2379"
}
