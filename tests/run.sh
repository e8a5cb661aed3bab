#!/bin/sh
# Runs every check of rosrescue on a bare Debian or Ubuntu: installs missing parts of ROS 1, then checks formatting,
# clippy, the documentation, the dependencies (if cargo-deny is installed) and whether the fuzz targets compile, and runs
# unit, integration and documentation tests, those without ROS first. Needs a Rust toolchain.
set -eu
cd "$(dirname "$0")/.."

if ! unshare --net true 2>/dev/null; then
    echo "tests/run.sh: tests share this computer's network, because network namespaces are not allowed here" >&2
fi
if ! command -v cargo >/dev/null; then
    PATH="$PATH:$HOME/.cargo/bin"
fi
if ! command -v cargo >/dev/null; then
    echo "tests/run.sh: cargo is not installed; install a Rust toolchain first: https://rustup.rs" >&2
    exit 1
fi

. tests/install_ros.sh
. tests/install_tools.sh
. tests/install_robot.sh
. tests/install_chromium.sh
. tests/install_etcd.sh
. tests/install_prometheus.sh

# Each release of Rust has lints of its own. Those of other releases are shown and do not fail the tests.
deny=
case $(rustc --version) in
"rustc 1.95."*) deny="-D warnings" ;;
*) echo "tests/run.sh: this is not Rust 1.95, so lints are only shown" >&2 ;;
esac
cargo fmt --all --check
# shellcheck disable=SC2086 # several arguments, or none
cargo clippy --locked --workspace --all-targets -- $deny
RUSTDOCFLAGS="$deny" cargo doc --locked --workspace --no-deps
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

# Under nohup, SIGHUP is ignored by every child, in the background of a script SIGINT and SIGQUIT too, and tests of an
# orderly stop would fail.
default_signals=
if env --default-signal true 2>/dev/null; then
    default_signals="env --default-signal"
fi
# Tests with real ROS mostly wait for processes, so four times as many as there are cores run at once. Of those that
# measure times (tests/timing), as many run as there are cores.
export RUST_TEST_THREADS="${RUST_TEST_THREADS:-$((4 * $(nproc)))}"
log=$(mktemp)
trap 'rm -f "$log" "$log.failed"' EXIT

# Runs test programs. If one fails, the next ones run all the same.
programs() {
    { $default_signals cargo test --locked --workspace --no-fail-fast "$@" 2>&1 || echo "$?" >"$log.failed"; } | tee -a "$log"
}

# Prints each failed test: the command that repeats it, and the beginning of its message.
failures() {
    awk '
        $1 == "Running" && $2 == "unittests" { program = $4; sub(/^.*\//, "", program); sub(/-[^-]*$/, "", program)
            gsub(/_/, "-", program); program = "-p " program " --lib" }
        $1 == "Running" && $2 ~ /^tests\// { program = $2; sub(/^tests\//, "", program)
            sub(/(\/main)?\.rs$/, "", program); program = "--test " program }
        $1 == "Doc-tests" { program = "--doc" }
        /^---- .* stdout ----$/ { print "cargo test --locked " program " " $2 " -- --exact --nocapture"; left = 8 }
        /^stack backtrace:|^note: run with|^To repeat it:/ { left = 0 }
        left > 0 && !/^----/ && NF { print "    " $0; left-- }
        /^error: could not compile|^  process did/ { print }
    ' "$log"
}

fast="codec checkpoint model tidy"
slow=
for program in tests/*/main.rs crates/*/tests/*.rs crates/*/tests/*/main.rs; do
    program=$(basename "${program%/main.rs}" .rs)
    case " $fast " in *" $program "*) ;; *) slow="$slow $program" ;; esac
done
cargo test --locked --workspace --no-run
# shellcheck disable=SC2046,SC2086 # several arguments
programs --lib --bins $(printf ' --test %s' $fast)
# shellcheck disable=SC2046,SC2086
programs $(printf ' --test %s' $slow)
programs --doc
if [ -e "$log.failed" ]; then
    echo "tests/run.sh: failed:" >&2
    failures >&2
    exit "$(cat "$log.failed")"
fi
