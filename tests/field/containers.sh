#!/bin/sh
# containers.sh ROOT IMAGE [KILLS]: a master, rosrescue as `proxy`, a talker and a listener, each in a container of its own,
# on a bridge network and on the host's. ROOT is an installation with rosmaster and rospy (packages.sh makes one), IMAGE
# that of packaging/docker/build-image.sh. Kills the master and rosrescue in turn with SIGKILL, KILLS times each, and
# prints a row of Markdown: messages that the listener got, messages lost, and calls that failed.
#
# Needs podman as root. PODMAN and LIMITS may name another runtime and limits, as sandboxes need them.
set -eu
root=$1 image=$2 kills=${3:-100}
nodes=$(cd "$(dirname "$0")/../nodes" && pwd)
podman=${PODMAN:-podman}
limits=${LIMITS:-}
tag=rosrescue-field-$$
$podman network create "$tag" >/dev/null
tar -C "$root" --exclude=./given --exclude=./proc --exclude=./dev --exclude=./tmp -c . | $podman import - "$tag-ros" >/dev/null 2>&1

run() { # NAME IMAGE COMMAND...
    container=$1 of=$2
    shift 2
    # shellcheck disable=SC2086 # words
    $podman run --detach --name "$tag-$container" $limits $network --tmpfs /tmp --volume "$nodes:/nodes:ro" \
        --env "$(host "$container")" --env "ROS_MASTER_URI=http://$(name rosrescue):11311" --env PYTHONUNBUFFERED=1 \
        --env PYTHONDONTWRITEBYTECODE=1 "$of" "$@" >/dev/null
}
name() { # CONTAINER
    if [ "$kind" = host ]; then echo 127.0.0.1; else echo "$tag-$1"; fi
}
host() { # CONTAINER
    if [ "$kind" = host ]; then echo ROS_IP=127.0.0.1; else echo "ROS_HOSTNAME=$(name "$1")"; fi
}
status() { # CONTAINER-TO-ASK-IN
    $podman exec "$tag-listener" /usr/bin/python3 -c "
import json, urllib.request
print(json.load(urllib.request.urlopen('http://$(name rosrescue):11311/status.json'))['open'])" 2>/dev/null || true
}
stop() {
    for container in listener talker rosrescue master; do
        $podman rm --force --time 0 "$tag-$container" >/dev/null 2>&1 || true
    done
}
trap 'stop; $podman network rm --force "$tag" >/dev/null; $podman rmi --force "$tag-ros" >/dev/null' EXIT

for kind in bridge host; do
    network="--network=$tag"
    [ "$kind" = bridge ] || network=--network=host
    run master "$tag-ros" rosmaster --core -p 11312
    run rosrescue "$image" proxy --master "http://$(name master):11312"
    run talker "$tag-ros" /usr/bin/python3 /nodes/talker.py
    run listener "$tag-ros" /usr/bin/python3 /nodes/listener.py
    until [ "$(status)" = True ]; do sleep 0.2; done
    until $podman logs "$tag-listener" 2>/dev/null | grep -q talker; do sleep 0.2; done
    count=0
    while [ "$count" -lt "$kills" ]; do
        for container in master rosrescue; do
            $podman kill --signal KILL "$tag-$container" >/dev/null
            $podman wait "$tag-$container" >/dev/null
            $podman start "$tag-$container" >/dev/null
            until [ "$(status)" = True ]; do sleep 0.2; done
        done
        count=$((count + 1))
    done
    ended=$($podman ps --all --filter "name=$tag-(talker|listener)" --filter status=exited --quiet | wc -l)
    $podman logs "$tag-listener" 2>/dev/null | awk -v kind="$kind" -v kills="$kills" -v ended="$ended" '
        $1 == "got" { if (last && $NF != last + 1) lost += $NF - last - 1; last = $NF; got++ }
        END { printf "| %s | %d of each | %d | %d | %d |\n", kind, kills, got, lost, ended }'
    stop
done
