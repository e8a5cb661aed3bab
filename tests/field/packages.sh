#!/bin/sh
# packages.sh FOLDER [RELEASE/PROCESSOR]...: tries the Debian packages in FOLDER (of packaging/build-all.sh) in new
# installations of these releases, or of all. Each package is installed, runs the release's rosmaster through its death,
# is upgraded from the version before with the state in place, removed and purged. Prints one row of Markdown for each.
# Where the release has no rosmaster, the package is only installed, upgraded and purged. On amd64 the release's systemd
# also runs the service through deaths, an upgrade and a second installation.
#
# Needs root, debootstrap, dpkg-dev, and for ARM qemu-user-static with binfmt_misc. Takes one to three minutes for each,
# with ARM ten. Installations are kept in target/field/packages.
set -eu

checkout=$(cd "$(dirname "$0")/../.." && pwd)
packages=$(cd "$1" && pwd)
shift
roots=${CARGO_TARGET_DIR:-$checkout/target}/field/packages
mkdir -p "$roots"
[ $# -gt 0 ] || set -- xenial/amd64 bionic/amd64 focal/amd64 jammy/amd64 noble/amd64 bullseye/amd64 bookworm/amd64 \
    trixie/amd64 bullseye/arm64 bookworm/arm64 trixie/arm64 bullseye/armhf bookworm/armhf trixie/armhf

# Installs a release with its rosmaster, once.
make() { # SUITE PROCESSOR
    root=$roots/$1-$2
    [ ! -d "$root" ] || return 0
    rm -rf "$root.new"
    archive=${ROSRESCUE_TEST_DEBIAN:-http://deb.debian.org/debian} python=python3 components=main
    check=--keyring=/usr/share/keyrings/debian-archive-keyring.gpg
    case $1 in
        xenial | bionic | focal | jammy | noble)
            archive=${ROSRESCUE_TEST_UBUNTU:-http://archive.ubuntu.com/ubuntu} components=main,universe
            check=--no-check-gpg
            ;;
    esac
    case $1 in xenial | bionic) python=python ;; esac
    # Debian 12's debootstrap does not know Ubuntu 24.04, but makes all Ubuntus alike. 24.04 has no rosmaster.
    like=$1 rosmaster=$python-rosmaster
    case $1 in noble) like=jammy rosmaster=python3 ;; esac
    # A caller that asks whether it worked has switched off `set -e`.
    debootstrap --arch="$2" --variant=minbase "$check" --components="$components" "$1" "$root.new" "$archive" \
        "/usr/share/debootstrap/scripts/$like" >&2 || return 1
    in_root "$root.new" apt-get install -y --no-install-recommends "$rosmaster" procps systemd-sysv dbus >&2 || return 1
    rm -rf "$root.new"/var/cache/apt/archives/*.deb
    echo "127.0.0.1 localhost" >"$root.new/etc/hosts"
    mv "$root.new" "$root"
}

# Runs a command in an installation, with a network of its own. Nothing survives it.
in_root() { # FOLDER COMMAND...
    network=
    [ "$2" = apt-get ] || network=--net
    unshare $network --mount --pid --fork --kill-child --propagation private sh -euc '
        root=$1
        shift
        ip link set lo up 2>/dev/null || true
        mount --rbind /dev "$root/dev"
        mount -t proc proc "$root/proc"
        exec env -i DEBIAN_FRONTEND=noninteractive LC_ALL=C.UTF-8 HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin chroot "$root" "$@"
    ' sh "$@"
}

# Makes a call to the master, in an installation.
# shellcheck disable=SC2016 # in the installation
call='python=$(command -v python3 || command -v python)
call() { "$python" -c "
try: from xmlrpc.client import ServerProxy
except ImportError: from xmlrpclib import ServerProxy
print(ServerProxy(\"http://127.0.0.1:11311\").$1)"; }'

# Boots an installation with its own systemd and runs a script there. Nothing survives it.
booted() { # FOLDER SCRIPT
    computer=$roots/booted-$$/computer
    mkdir -p "$computer"
    unshare --mount --pid --net --uts --ipc --fork --kill-child \
        "$checkout/tests/support/boot_systemd.sh" "$computer" /bin/true "$1/given" "$1" &
    unshare=$!
    status=1 waited=0
    until first=$(cat "/proc/$unshare/task/$unshare/children") && [ "$(cat "/proc/${first% }/comm")" = systemd ]; do
        [ $((waited += 1)) -lt 100 ] && kill -0 $unshare || break
        sleep 0.1
    done
    nsenter -t "${first% }" -m -p -n -u -i -C -r -w env -i HOME=/root DEBIAN_FRONTEND=noninteractive LC_ALL=C.UTF-8 \
        PATH=/usr/sbin:/usr/bin:/sbin:/bin sh -euc "$2" && status=0
    kill -KILL $unshare
    wait $unshare || true
    # Its processes take a moment to end.
    until unshare --mount "$checkout/tests/support/boot_systemd.sh" --forget "$computer" 2>/dev/null; do
        [ $((waited += 1)) -lt 200 ] || break
        sleep 0.1
    done
    rm -r "$roots/booted-$$"
    return $status
}

# The same package as an earlier version.
earlier() { # PACKAGE NEW_PACKAGE
    parts=$(mktemp -d)
    dpkg-deb -R "$1" "$parts"
    sed -i 's/^Version: .*/Version: 0.1.9-1/' "$parts/DEBIAN/control"
    dpkg-deb -Zgzip -z1 -b "$parts" "$2" >&2
    rm -rf "$parts"
}

# Runs the service of a release's systemd, and prints the result.
service() { # FOLDER
    # shellcheck disable=SC2016 # in the installation
    if booted "$1" "$call"'
        waited=0
        until systemctl is-system-running | grep -Ex "running|degraded"; do
            [ $((waited += 1)) -lt 300 ]
            sleep 0.1
        done 2>/dev/null
        main() { systemctl show --property=MainPID rosrescue.service | cut -d= -f2; }
        kept() {
            call "getParam(\"/test\", \"/kept\")" | grep " 7]"
            until rosrescue status --json | grep -q "\"open\": true"; do sleep 0.1; done
        }
        install() {
            dpkg -i "$1" 2>&1 | tee /tmp/said
            ! grep -i error /tmp/said
        }
        useradd --create-home robot
        # Twice: the first removal must leave nothing that disturbs the second installation.
        for round in 1 2; do
            install /given/old.deb
            rosrescue install --yes --run-as robot
            systemctl is-active rosrescue.service
            call "setParam(\"/test\", \"/kept\", 7)"
            kept
            before=$(main)
            kill -KILL "$before"
            kept
            test "$(main)" != "$before"
            kill -KILL $(pgrep -f "bin[/]rosmaster")
            kept
            install /given/new.deb
            before=$(pgrep -f "bin[/]rosmaster")
            systemctl kill --signal=KILL --kill-who=main rosrescue.service
            kept
            test "$(pgrep -f "bin[/]rosmaster")" = "$before"
            dpkg -r rosrescue
            test -z "$(pgrep -x rosrescue)$(pgrep -f "bin[/]rosmaster")"
            test -z "$(find /etc/systemd /run/systemd/system -name "*rosrescue*")"
            rm -rf /home/robot/.ros
        done
        dpkg -P rosrescue
    ' >"$1.service.log" 2>&1; then
        echo "service passed with $(chroot "$1" systemctl --version | head -n 1)"
    else
        tail -n 20 "$1.service.log" >&2
        echo "service failed, see $1.service.log"
    fi
}

if command -v lintian >/dev/null; then
    lintian --fail-on error "$packages"/*.deb >&2
fi
for place in "$@"; do
    suite=${place%/*} processor=${place#*/}
    make "$suite" "$processor" || { echo "| $suite | $processor | not tried: it cannot be installed here |" && continue; }
    root=$roots/$suite-$processor
    rm -rf "$root/given"
    mkdir "$root/given"
    cp "$packages"/*_"$processor".deb "$root/given/new.deb"
    earlier "$root/given/new.deb" "$root/given/old.deb"
    # shellcheck disable=SC2016 # in the installation
    if in_root "$root" sh -euc "$call"'
        list() { find / -xdev \( -path /proc -o -path /dev -o -path /given -o -path /tmp -o -path /root -o -path /var/lib/dpkg -o -path /var/log -o -path /var/cache \) -prune -o -print | sort; }
        start() {
            ROS_IP=127.0.0.1 ROS_LOG_DIR=/tmp/log rosrescue core --no-rosout >>/tmp/said 2>&1 &
            rosrescue wait --timeout 150 || { cat /tmp/said; exit 1; }
        }
        # An earlier run may have failed.
        dpkg -P rosrescue
        rm -rf /tmp/log /tmp/said
        list >/tmp/before
        begin=$(date +%s)
        dpkg -i /given/old.deb
        if ! command -v rosmaster; then
            dpkg -i /given/new.deb
            rosrescue --version
            dpkg -P rosrescue
            list >/tmp/after
            diff /tmp/before /tmp/after
            exit
        fi
        start
        echo "installed and running after $(($(date +%s) - begin)) s"
        call "setParam(\"/test\", \"/kept\", 7)"
        kill -9 $(pgrep -f "bin[/]rosmaster")
        call "getParam(\"/test\", \"/kept\")" | grep " 7]"
        # Calls pass to the next master.
        until rosrescue status --json | grep -q "\"open\": true"; do sleep 0.1; done
        dpkg -i /given/new.deb
        pkill -9 -x rosrescue
        master=$(pgrep -f "bin[/]rosmaster")
        start
        call "getParam(\"/test\", \"/kept\")" | grep " 7]"
        until rosrescue status --json | grep -q "\"open\": true"; do sleep 0.1; done
        test "$(pgrep -f "bin[/]rosmaster")" = "$master"
        rosrescue --version
        pkill -TERM -o -x rosrescue
        while pgrep -x rosrescue; do sleep 0.1; done >/dev/null
        test -z "$(pgrep -f bin[/]rosmaster)"
        dpkg -r rosrescue
        test ! -e /usr/bin/rosrescue
        dpkg -P rosrescue
        list >/tmp/after
        diff /tmp/before /tmp/after
    ' >"$root.log" 2>&1; then
        how=$(grep -o "running after .*" "$root.log") || how="installed, upgraded and purged without a rosmaster"
        # systemd 229 of Ubuntu 16.04 does not boot with control groups of version 2. Ubuntu 24.04 has no rosmaster.
        case $place in
        xenial/* | noble/* | */arm*) ;;
        *) how="$how, $(service "$root")" ;;
        esac
        echo "| $suite | $processor | $how, $(grep "^rosrescue " "$root.log" | tail -n 1) |"
    else
        tail -n 20 "$root.log" >&2
        echo "| $suite | $processor | failed, see $root.log |"
    fi
done
