#!/bin/sh
# packaging/build-static.sh [TARGET]: builds a rosrescue that needs no library of the system, for computers with an
# older C library than this one's, and prints its name. TARGET is that of this computer with musl, else
# aarch64-unknown-linux-musl or armv7-unknown-linux-musleabihf.
set -eu
cd "$(dirname "$0")/.."

target=${1:-$(uname -m)-unknown-linux-musl}
case $target in
*-linux-musl*) ;;
*) echo "build-static.sh: $target is no musl target, such as $(uname -m)-unknown-linux-musl" >&2 && exit 2 ;;
esac

if ! libraries=$(rustc --print target-libdir --target "$target" 2>/dev/null); then
    echo "build-static.sh: Rust knows no target $target; \`rustc --print target-list\` has them" >&2
    exit 2
fi
if [ -z "$(ls "$libraries" 2>/dev/null)" ]; then
    echo "build-static.sh: Rust's standard library for $target is missing: rustup target add $target" >&2
    exit 1
fi

# Rust brings musl and its own linker along: no C compiler of the other computer is needed, since nothing of
# rosrescue is written in C.
if [ "${target%%-*}" != "$(uname -m)" ]; then
    variable=CARGO_TARGET_$(echo "$target" | tr 'a-z-' 'A-Z_')_LINKER
    export "$variable=rust-lld"
fi
cargo build --profile dist --locked --target "$target"
program=${CARGO_TARGET_DIR:-target}/$target/dist/rosrescue
if readelf -l "$program" 2>/dev/null | grep -q INTERP; then
    echo "build-static.sh: $program needs a dynamic linker: it is not static" >&2
    exit 1
fi
echo "$program"
