#!/bin/sh
# packaging/build-old-glibc.sh: builds a rosrescue for x86-64 that runs with every C library since glibc 2.18, which
# Ubuntu has had since 14.04 and Debian since 8, and prints its name. It is linked in an Ubuntu 16.04 that debootstrap
# makes in target/field, by this computer's Rust, and nothing is installed here. build-static.sh needs no C library at
# all, but Rust's standard library for musl. Needs root, debootstrap and some 5 minutes the first time.
set -eu
cd "$(dirname "$0")/.."
checkout=$PWD
root=$checkout/target/field/ubuntu-16.04/root

# What the program may need at most.
newest=GLIBC_2.18

# Fetched here: the old system has no certificates.
cargo fetch --locked >&2
tests/field/release.sh make ubuntu-16.04 "$root"
# shellcheck disable=SC2016 # in the old system
tests/field/release.sh run "$root" sh -c 'cd "$1" && cargo build --profile dist --locked --offline --target-dir target/old-glibc' \
    sh "$checkout" >&2
program=$checkout/target/old-glibc/dist/rosrescue
needs=$(objdump -T "$program" | grep -o 'GLIBC_[0-9.]*' | sort -V | tail -n 1)
if [ "$(printf '%s\n%s\n' "$needs" "$newest" | sort -V | tail -n 1)" != "$newest" ]; then
    echo "build-old-glibc.sh: $program needs $needs, which is later than $newest" >&2
    exit 1
fi
echo "$program"
