#!/bin/sh
# packaging/build-all.sh [--sign KEY] [arm64|armhf]...: builds the Debian packages for amd64 and these processors, or for
# all three, on an amd64 computer. They are in target/packages, with a bill of materials (CycloneDX), SHA256SUMS and, with
# a key of gpg, SHA256SUMS.asc. zig links for glibc 2.17 and compiles C for the other processors. The bytes depend on the
# commit, on the versions of Rust and dpkg and on whether there is an mdBook, and not on folders.
#
# Needs Rust with rustup, python3-venv and dpkg-dev. Installs zig, cargo-zigbuild and cargo-cyclonedx into target/tools.
# Without rustup, CARGO_UNSTABLE_BUILD_STD builds Rust's standard library from its sources (docs/packaging.md).
set -eu
cd "$(dirname "$0")/.."
checkout=$PWD
target=${CARGO_TARGET_DIR:-target}
zig=0.15.2
zigbuild=0.23.0
cyclonedx=0.5.9
# The newest C library that a program may need: Ubuntu 14.04, Debian 8 and JetPack 4 have 2.19 or later.
glibc=2.17

fail() { # MESSAGE
    echo "build-all.sh: $1" >&2
    exit 1
}

key=
if [ "${1:-}" = --sign ]; then
    key=$2
    shift 2
fi

tools=$target/tools/zig
case $tools in /*) ;; *) tools=$checkout/$tools ;; esac
if ! [ "$("$tools/bin/cargo-zigbuild" --version 2>/dev/null)" = "cargo-zigbuild $zigbuild" ]; then
    python3 -m venv "$tools"
    "$tools/bin/pip" install --quiet "ziglang==$zig" "cargo-zigbuild==$zigbuild" >&2
fi
export PATH="$tools/bin:$PATH"
bom=$target/tools/bin/cargo-cyclonedx
if ! [ "$("$bom" cyclonedx --version 2>/dev/null)" = "cargo-cyclonedx-cyclonedx $cyclonedx" ]; then
    echo "build-all.sh: installing cargo-cyclonedx $cyclonedx into $target/tools: some two minutes on two cores" >&2
    cargo install --quiet --locked --version "$cyclonedx" --root "$target/tools" cargo-cyclonedx
fi

# What the bytes may depend on: the commit and its date, and no folder of this computer.
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
ROSRESCUE_COMMIT=${ROSRESCUE_COMMIT:-$(git rev-parse --short=7 HEAD)$(git diff --quiet HEAD || echo +)}
export SOURCE_DATE_EPOCH ROSRESCUE_COMMIT
cargo_home=${CARGO_HOME:-$HOME/.cargo}
sysroot=$(rustc --print sysroot)
# The last prefix that fits counts. With rust-src, rustc names the standard library's files there.
rustc=/rustc/$(rustc -vV | sed -n 's/^commit-hash: //p')
export RUSTFLAGS="--remap-path-prefix=$checkout=/rosrescue --remap-path-prefix=$cargo_home=/cargo --remap-path-prefix=$sysroot=/rust \
--remap-path-prefix=$sysroot/lib/rustlib/src/rust=$rustc"
export CFLAGS="-ffile-prefix-map=$cargo_home=/cargo"

packages=$target/packages
rm -rf "$packages"
mkdir -p "$packages"
[ $# -gt 0 ] || set -- arm64 armhf
build_std=${CARGO_UNSTABLE_BUILD_STD:-}
unset CARGO_UNSTABLE_BUILD_STD
# amd64 first: its program makes the manual pages and completions of all packages.
for processor in amd64 "$@"; do
    case $processor in
        amd64) triple=x86_64-unknown-linux-gnu ;;
        arm64) triple=aarch64-unknown-linux-gnu ;;
        armhf) triple=armv7-unknown-linux-gnueabihf ;;
        *) fail "unknown processor $processor; there are arm64 and armhf besides amd64" ;;
    esac
    # cargo takes an empty CARGO_UNSTABLE_BUILD_STD for a wish, too.
    missing=$build_std
    if [ -n "$(ls "$sysroot/lib/rustlib/$triple/lib" 2>/dev/null)" ]; then
        missing=
    elif [ -z "$build_std" ]; then
        rustup target add "$triple" >&2 || fail "Rust's standard library for $triple is missing"
    fi
    env ${missing:+"CARGO_UNSTABLE_BUILD_STD=$missing"} cargo zigbuild --profile dist --locked --target "$triple.$glibc" >&2
    program=$target/$triple/dist/rosrescue
    needs=$(readelf --dyn-syms --wide "$program" | grep -o 'GLIBC_[0-9.]*' | sort -V | tail -n 1)
    if [ "$(printf '%s\n%s\n' "$needs" "GLIBC_$glibc" | sort -V | tail -n 1)" != "GLIBC_$glibc" ]; then
        fail "$program needs $needs, which is later than $glibc"
    fi
    packaging/build-deb.sh --target "$triple" --output "$packages"
done

# The bill of materials: what amd64 is built of, of which the others need no more. The tool writes one beside each
# manifest, with the checkout's folder in its references.
RUSTFLAGS='' CFLAGS='' "$bom" cyclonedx --quiet --format json --spec-version 1.5 --target x86_64-unknown-linux-gnu \
    --override-filename target-bom >&2
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
sed "s|$checkout|/rosrescue|g" target-bom.json >"$packages/rosrescue_$version.cdx.json"
rm target-bom.json crates/*/target-bom.json
cd "$packages"
sha256sum -- *.deb *.json >SHA256SUMS
[ -z "$key" ] || gpg --batch --yes --armor --local-user "$key" --detach-sign SHA256SUMS
