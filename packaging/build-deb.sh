#!/bin/sh
# packaging/build-deb.sh [--debug] [--version VERSION]: makes a Debian package and prints its name.
#
# --debug takes the program that `cargo build` has made, for tests. --target TRIPLE takes the one that build-all.sh has
# made, and --output FOLDER says where the package goes. Needs dpkg-dev.
set -eu
cd "$(dirname "$0")/.."
target=${CARGO_TARGET_DIR:-target}

profile=dist
version=
triple=
output=$target/deb
while [ $# -gt 0 ]; do
    case $1 in
    --debug) profile=dev ;;
    --version) version=$2 && shift ;;
    --target) triple=$2 && shift ;;
    --output) output=$2 && shift ;;
    *) echo "build-deb.sh: unknown argument $1; use --debug, --version, --target or --output" >&2 && exit 2 ;;
    esac
    shift
done

# The program that makes manual pages and completions runs here, whichever processor the package is for.
if [ -n "$triple" ]; then
    program=$target/x86_64-unknown-linux-gnu/dist/rosrescue
elif [ "$profile" = dev ]; then
    program=$target/debug/rosrescue
else
    cargo build --profile dist --locked
    program=$target/dist/rosrescue
fi
packaged=$program
[ -z "$triple" ] || packaged=$target/$triple/dist/rosrescue

stage=$target/package
root=$stage/debian/rosrescue
share=$root/usr/share
doc=$share/doc/rosrescue
control=$root/DEBIAN
rm -rf "$stage"
install -D -m 755 "$packaged" "$root/usr/bin/rosrescue"
install -D -m 755 -t "$control" packaging/deb/postinst packaging/deb/postrm packaging/deb/prerm
install -D -m 644 packaging/deb/default "$root/etc/default/rosrescue"
install -D -m 644 -t "$root/usr/lib/systemd/system" packaging/systemd/*
if [ -z "$triple" ]; then
    processor=$(dpkg --print-architecture)
    # The other profile strips it.
    [ "$profile" = dist ] || strip "$root/usr/bin/rosrescue"
    # dpkg-shlibdeps runs only where the sources of a package are.
    : >"$stage/debian/control"
    depends=$(cd "$stage" && dpkg-shlibdeps -O debian/rosrescue/usr/bin/rosrescue)
    depends=${depends#shlibs:Depends=}
else
    case $triple in
    x86_64-*) processor=amd64 ;;
    aarch64-*) processor=arm64 ;;
    armv7-*) processor=armhf ;;
    *) echo "build-deb.sh: unknown processor of $triple; there are x86_64, aarch64 and armv7" >&2 && exit 2 ;;
    esac
    # build-all.sh has checked that the program needs no later one, and no other library.
    depends="libc6 (>= 2.17)"
fi

# Completions and manual pages, made from the definition of the command line.
completions() { # SHELL FILE
    mkdir -p "$(dirname "$share/$2")"
    "$program" completions "$1" >"$share/$2"
}
completions bash bash-completion/completions/rosrescue
completions zsh zsh/vendor-completions/_rosrescue
completions fish fish/vendor_completions.d/rosrescue.fish
mkdir -p "$share/man"
"$program" man --folder "$share/man/man1"
gzip -9n "$share"/man/man1/*.1

# The documents, and a book of them if there is an mdBook.
packaging/build-book.sh >/dev/null || [ $? = 3 ]
mkdir -p "$share/doc"
mv target/book-source "$doc"
[ ! -d target/book ] || mv target/book "$doc/html"
cp -r examples/systemd examples/grafana examples/prometheus packaging/keepalived "$doc/examples/"
cp LICENSE "$doc/copyright"
# What Debian asks for in place of CHANGELOG.md, which is there too.
version=${version:-$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)-1}
gzip -9n >"$doc/changelog.Debian.gz" <<END
rosrescue ($version) unstable; urgency=medium

  * See /usr/share/doc/rosrescue/CHANGELOG.md.

 -- The maintainers of rosrescue <maintainers@rosrescue.invalid>  $(LC_ALL=C date -u -R -d "@${SOURCE_DATE_EPOCH:-0}")
END
chmod -R u=rwX,go=rX,a-s "$root"

echo /etc/default/rosrescue >"$control/conffiles"
(cd "$root" && find etc usr -type f -print0 | LC_ALL=C sort -z | xargs -0 md5sum >DEBIAN/md5sums)
{
    cat packaging/deb/control
    echo "Version: $version"
    echo "Architecture: $processor"
    echo "Depends: $depends"
    # In KiB. The size of a folder would depend on this computer's file system.
    find "$root/etc" "$root/usr" -type f -printf '%s\n' |
        awk '{ kib += int(($1 + 1023) / 1024) } END { print "Installed-Size: " kib }'
} >"$control/control"

mkdir -p "$output"
package=$output/rosrescue_${version}_$processor.deb
# Every dpkg reads xz; that of Ubuntu would write zstd. Packages for tests are made quickly.
compression=-Zxz
[ "$profile" = dist ] || compression="-Zgzip -z1"
# shellcheck disable=SC2086 # several words
dpkg-deb $compression --root-owner-group --build "$root" "$package" >/dev/null
echo "$package"
