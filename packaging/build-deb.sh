#!/bin/sh
# packaging/build-deb.sh [--debug] [--version VERSION]: makes a Debian package and prints its name.
#
# --debug takes the program that `cargo build` has made, for tests. --target TRIPLE takes the one that build-all.sh has
# made, and --output FOLDER says where the package goes. Needs cargo-deb, which it installs into target/tools if it is
# missing there.
set -eu
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}
cargo_deb=3.8.0

profile=dist
version=
fast=
triple=
output=$target/deb/
while [ $# -gt 0 ]; do
    case $1 in
    --debug) profile=dev fast=--fast ;;
    --version) version=$2 && shift ;;
    --target) triple=$2 && shift ;;
    --output) output=$2/ && shift ;;
    *) echo "build-deb.sh: unknown argument $1; use --debug, --version, --target or --output" >&2 && exit 2 ;;
    esac
    shift
done

deb=$target/tools/bin/cargo-deb
if ! "$deb" --version 2>/dev/null | grep -qxF "cargo-deb $cargo_deb"; then
    echo "build-deb.sh: installing cargo-deb $cargo_deb into $target/tools: some two minutes on two cores" >&2
    # For tests it is built quickly. They make two packages.
    quick=
    [ "$profile" = dist ] || quick=--debug
    env -u RUSTFLAGS -u CFLAGS -u CARGO_UNSTABLE_BUILD_STD cargo install $quick --quiet --locked --version "$cargo_deb" --root "$target/tools" cargo-deb
fi

# The program that makes the assets runs here, whichever processor the package is for.
if [ -n "$triple" ]; then
    program=$target/x86_64-unknown-linux-gnu/dist/rosrescue
elif [ "$profile" = dev ]; then
    program=$target/debug/rosrescue
else
    cargo build --profile dist --locked
    program=$target/dist/rosrescue
fi

# Completions and manual pages, made from the definition of the command line.
assets=target/package
rm -rf "$assets"
mkdir -p "$assets/completions"
"$program" man --folder "$assets/man"
gzip -9n "$assets"/man/*.1
for shell in bash zsh fish; do
    "$program" completions "$shell" >"$assets/completions/$shell"
done
# What Debian asks for in place of CHANGELOG.md, which is there too.
number=${version:-$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)-1}
cat >"$assets/changelog" <<END
rosrescue ($number) unstable; urgency=medium

  * See /usr/share/doc/rosrescue/CHANGELOG.md.

 -- The maintainers of rosrescue <maintainers@rosrescue.invalid>  $(LC_ALL=C date -u -R -d "@${SOURCE_DATE_EPOCH:-0}")
END
# The documents, and a book of them if there is an mdBook.
packaging/build-book.sh >/dev/null || [ $? = 3 ]
mv target/book-source "$assets/doc"
[ ! -d target/book ] || mv target/book "$assets/doc/html"
cp -r examples/systemd examples/grafana examples/prometheus "$assets/doc/examples/"
# This computer's strip knows only its own processor. The profile has stripped the program already.
strip=--strip
[ -z "$triple" ] || strip=--no-strip
# shellcheck disable=SC2086 # no version, no words
CARGO_TARGET_DIR=$target "$deb" --quiet --locked --no-build --profile "$profile" $strip $fast \
    ${version:+--deb-version "$version"} ${triple:+--target "$triple" --variant old-glibc} --output "$output"
