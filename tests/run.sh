#!/bin/sh
# Runs every check of rosrescue on a bare Debian or Ubuntu: installs what is missing of ROS 1, then
# formatting, clippy, the documentation, the dependencies (if cargo-deny is installed), the fuzz targets
# (whether they compile), and unit, integration and documentation tests. Needs a Rust toolchain.
set -eu
cd "$(dirname "$0")/.."

if ! command -v cargo >/dev/null; then
    PATH="$PATH:$HOME/.cargo/bin"
fi
if ! command -v cargo >/dev/null; then
    echo "tests/run.sh: there is no cargo; install a Rust toolchain first: https://rustup.rs" >&2
    exit 1
fi

. tests/install_ros.sh
. tests/install_robot.sh
. tests/install_chromium.sh
. tests/install_etcd.sh

cargo fmt --all --check
cargo clippy --locked --workspace --all-targets -- -D warnings
RUSTDOCFLAGS="-D warnings" cargo doc --locked --workspace --no-deps
if command -v cargo-deny >/dev/null; then
    cargo deny --locked check licenses bans sources
    for advisories in "${CARGO_HOME:-$HOME/.cargo}"/advisory-dbs/*/crates; do
        if [ -d "$advisories" ]; then
            cargo deny --locked --offline check advisories
            break
        fi
    done
else
    echo "tests/run.sh: no cargo-deny: dependencies are not checked (cargo install --locked cargo-deny)" >&2
fi
cargo check --locked --manifest-path fuzz/Cargo.toml --target-dir "${CARGO_TARGET_DIR:-target}"

# All test programs run, even if one of them fails.
#
# Tests with real ROS wait for processes most of the time: twice as many at once as there are cores. Those
# that measure times (tests/timing) run one at a time in any case.
threads=${RUST_TEST_THREADS:-$((2 * $(nproc)))}
RUST_TEST_THREADS=$threads cargo test --locked --workspace --no-fail-fast
