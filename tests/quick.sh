#!/bin/sh
# Runs the checks that need no ROS, in less than two minutes after the build: formatting, clippy, and the tests of the
# pure core, the codec, the checkpoint and the documents. Needs a Rust toolchain, and Python with PyYAML (Debian's
# python3-yaml), with which the codec and the checkpoint are compared. `tests/run.sh` runs everything.
set -eu
cd "$(dirname "$0")/.."

# As in tests/run.sh.
deny=
case $(rustc --version) in "rustc 1.95."*) deny="-D warnings" ;; esac
cargo fmt --all --check
# shellcheck disable=SC2086 # several arguments, or none
cargo clippy --locked --workspace --all-targets -- $deny
cargo test --locked --workspace --lib --test codec --test checkpoint --test model --test tidy
