#!/bin/sh
# packaging/build-deb.sh [--debug] [--version VERSION]: makes a Debian package and prints its name.
#
# --debug takes the program that `cargo build` has made, for tests. Needs cargo-deb, which it installs into
# target/tools if it is missing there.
set -eu
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
cargo_deb=3.8.0

profile=dist
version=
fast=
while [ $# -gt 0 ]; do
    case $1 in
    --debug) profile=dev fast=--fast ;;
    --version) version=$2 && shift ;;
    *) echo "build-deb.sh: what is $1? It takes --debug and --version VERSION" >&2 && exit 2 ;;
    esac
    shift
done

deb=$target/tools/bin/cargo-deb
if ! "$deb" --version 2>/dev/null | grep -qxF "cargo-deb $cargo_deb"; then
    echo "build-deb.sh: installing cargo-deb $cargo_deb into $target/tools: some two minutes on two cores" >&2
    cargo install --quiet --locked --version "$cargo_deb" --root "$target/tools" cargo-deb
fi

if [ "$profile" = dev ]; then
    program=$target/debug/rosrescue
else
    cargo build --profile dist --locked
    program=$target/dist/rosrescue
fi

# What comes from the definition of the command line.
assets=target/package
rm -rf "$assets"
mkdir -p "$assets/completions"
"$program" man "$assets/man"
gzip -9n "$assets"/man/*.1
for shell in bash zsh fish; do
    "$program" completions "$shell" >"$assets/completions/$shell"
done
# The documents, and a book of them if there is an mdBook.
packaging/build-book.sh >/dev/null || [ $? = 3 ]
mv target/book-source "$assets/doc"
[ ! -d target/book ] || mv target/book "$assets/doc/html"
# shellcheck disable=SC2086 # no version, no words
CARGO_TARGET_DIR=$target "$deb" --quiet --locked --no-build --profile "$profile" --strip $fast \
    ${version:+--deb-version "$version"} --output "$target/deb/"
