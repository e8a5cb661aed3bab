#!/bin/sh
# Runs the checks that need no ROS, in less than two minutes after the build: formatting, clippy, and the tests of the
# pure core, the codec, the checkpoint and the documents. Needs a Rust toolchain, and Python with PyYAML (Debian's
# python3-yaml), with which the codec and the checkpoint are compared. `tests/run.sh` runs everything.
set -eu
cd "$(dirname "$0")/.."

cargo fmt --all --check
cargo clippy --locked --workspace --all-targets -- -D warnings
cargo test --locked --workspace --lib --test codec --test checkpoint --test model --test tidy
