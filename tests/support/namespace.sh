#!/bin/sh
# Holds the network namespace of one test, with a loopback device and nothing else: `unshare --net namespace.sh`. When
# standard input ends, because the test has ended or its program was killed, every process in the namespace is killed.
set -eu
trap '' HUP INT TERM

ip link set lo up
echo ready
read -r _ || true

# Repeated, because a supervisor may have started another process in the meantime.
for _ in 1 2 3 4 5 6 7 8 9 10; do
    found=
    for process in /proc/[0-9]*; do
        if [ "$process/ns/net" -ef /proc/$$/ns/net ] && [ "$process" != "/proc/$$" ]; then
            kill -KILL "${process#/proc/}" 2>/dev/null || true
            found=1
        fi
    done
    [ "$found" ] || break
    sleep 0.01
done
