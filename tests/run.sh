#!/bin/sh
# Runs every check of rosrescue on a bare Debian or Ubuntu: installs missing parts of ROS 1, then checks formatting,
# clippy, the documentation, the dependencies (if cargo-deny is installed) and whether the fuzz targets compile, and runs
# unit, integration and documentation tests. Needs a Rust toolchain.
set -eu
cd "$(dirname "$0")/.."

if ! command -v cargo >/dev/null; then
    PATH="$PATH:$HOME/.cargo/bin"
fi
if ! command -v cargo >/dev/null; then
    echo "tests/run.sh: cargo is not installed; install a Rust toolchain first: https://rustup.rs" >&2
    exit 1
fi

. tests/install_ros.sh
. tests/install_robot.sh
. tests/install_chromium.sh
. tests/install_etcd.sh
. tests/install_prometheus.sh

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
    echo "tests/run.sh: cargo-deny is not installed, so dependencies are not checked (cargo install --locked cargo-deny)" >&2
fi
cargo check --locked --manifest-path fuzz/Cargo.toml --target-dir "${CARGO_TARGET_DIR:-target}"

# All test programs run, even if one fails. The failures are repeated at the end.
#
# Tests with real ROS mostly wait for processes, so twice as many as there are cores run at once. Tests that measure
# times (tests/timing) always run one at a time.
threads=${RUST_TEST_THREADS:-$((2 * $(nproc)))}
# Under nohup, SIGHUP is ignored by every child, and tests of an orderly stop would fail.
if env --default-signal=HUP true 2>/dev/null; then
    set -- env --default-signal=HUP
fi
log=$(mktemp)
trap 'rm -f "$log" "$log.failed"' EXIT
{ RUST_TEST_THREADS=$threads "$@" cargo test --locked --workspace --no-fail-fast 2>&1 || echo $? >"$log.failed"; } | tee "$log"
if [ -e "$log.failed" ]; then
    echo "tests/run.sh: cargo test failed. The beginning of the output of each failed test:" >&2
    awk '/^---- .* stdout ----$/ { left = 12 } /^stack backtrace:/ { left = 0 } left-- > 0' "$log" >&2
    exit "$(cat "$log.failed")"
fi
