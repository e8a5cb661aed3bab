#!/bin/sh
# Tests rosrescue with other systems and software, and writes the results into docs/compatibility.md:
#
#     tests/field.sh                      everything; takes some hours
#     tests/field.sh releases             every release of Debian and Ubuntu that carries ROS 1, with its own ROS
#     tests/field.sh releases debian-13   this release only; the rows of others stay
#     tests/field.sh clients              other client libraries
#     tests/field.sh robots               several robots side by side
#
# Everything is kept in target/field, some 10 GB. Needs root, Rust, debootstrap and the public archives.
set -eu
cd "$(dirname "$0")/.."

part=${1:-all}
[ $# = 0 ] || shift
status=0
for known in releases clients robots; do
    if [ "$part" != all ] && [ "$part" != "$known" ]; then
        continue
    fi
    program=tests/field/$known.sh
    [ -x "$program" ] || program=tests/field/$known/run.sh
    if [ -x "$program" ]; then
        "$program" "$@" || status=1
    elif [ "$part" = "$known" ]; then
        echo "tests/field.sh: unknown part $known" >&2
        exit 1
    fi
done
case $part in
    all | releases | clients | robots) exit "$status" ;;
esac
echo "tests/field.sh: unknown part $part: use releases, clients or robots" >&2
exit 1
