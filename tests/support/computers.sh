# Three computers on one switch, for what docs/several-computers.md tells people to do: base, arm and head, with a
# network, a host name and an /etc of their own each. Run as root in a network, a mount and a process namespace.
#
# The functions stand for what a computer has and a test does not: sudo, apt, and a systemd that runs etcd.

scratch=$ROS_HOME
declare -A process address=([base]=10.0.0.1 [arm]=10.0.0.2 [head]=10.0.0.3)
computers="base arm head"

# Waits for a command to succeed.
within() { # SECONDS COMMAND...
    local end=$((SECONDS + $1))
    shift
    until "$@" >/dev/null 2>&1; do
        if [ "$SECONDS" -ge "$end" ]; then
            echo "in vain: $*" >&2
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

# Its own namespaces are there.
is_apart() { ! [ "/proc/$1/ns/$2" -ef "/proc/self/ns/$2" ]; }

# One more computer; the cable is called as the computer is.
switch_on() { # COMPUTER
    local name=$1
    unshare --net --mount --uts sleep infinity &
    process[$name]=$!
    within 10 is_apart "$!" net
    within 10 is_apart "$!" uts
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

# Runs what is on the standard input, as a person there would.
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

# Whether all three etcd are members of a majority.
all_healthy() { # SCHEME
    local folder=$scratch/base/etc/etcd
    local tls=
    [ "$1" = http ] || tls="--cacert $folder/ca.pem --cert $folder/own.pem --key $folder/own.key"
    # shellcheck disable=SC2086 # words are what is wanted
    inside base env ETCDCTL_API=3 etcdctl $tls endpoint health \
        --endpoints="$1://10.0.0.1:2379,$1://10.0.0.2:2379,$1://10.0.0.3:2379"
}
