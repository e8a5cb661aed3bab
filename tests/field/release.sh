#!/bin/sh
# release.sh make NAME FOLDER: makes FOLDER a release of Debian or Ubuntu with its own ROS 1, a compiler and what the
# test nodes need. FOLDER is made whole or not at all. Takes two to four minutes and 0.7 to 1.5 GB.
#
# release.sh run FOLDER COMMAND...: runs COMMAND in it, as root, with this checkout and Rust's toolchain at their own
# places. Mounts are private and end with COMMAND.
#
# Releases come from the public archives, or from ROSRESCUE_TEST_UBUNTU and ROSRESCUE_TEST_DEBIAN. Needs root and
# debootstrap.
set -eu

checkout=$(cd "$(dirname "$0")/../.." && pwd)

fail() { # MESSAGE
    echo "release.sh: $1" >&2
    exit 1
}

suite() { # NAME
    case $1 in
        ubuntu-16.04) echo xenial ;;
        ubuntu-18.04) echo bionic ;;
        ubuntu-20.04) echo focal ;;
        ubuntu-22.04) echo jammy ;;
        debian-11) echo bullseye ;;
        debian-12) echo bookworm ;;
        debian-13) echo trixie ;;
        *) fail "no release $1" ;;
    esac
}

archive() { # NAME
    case $1 in
        ubuntu-*) echo "${ROSRESCUE_TEST_UBUNTU:-http://archive.ubuntu.com/ubuntu}" ;;
        *) echo "${ROSRESCUE_TEST_DEBIAN:-http://deb.debian.org/debian}" ;;
    esac
}

components() { # NAME
    case $1 in
        ubuntu-*) echo main,universe ;;
        *) echo main ;;
    esac
}

# Releases name the Python packages differently.
packages() { # NAME
    case $1 in
        ubuntu-16.04 | ubuntu-18.04) python=python messages="python-roscpp-msgs python-genpy python-roslib python-rosgraph-msgs" ;;
        *) python=python3 messages=python3-roscpp-msg ;;
    esac
    for package in rosmaster rospy rosparam roslaunch std-msgs; do
        echo "$python-$package"
    done
    echo "$messages" rosout libroscpp-dev libstd-msgs-dev g++ pkg-config procps
}

make() { # NAME FOLDER
    [ ! -d "$2" ] || return 0
    suite=$(suite "$1")
    mkdir -p "$(dirname "$2")"
    rm -rf "$2.new"
    keyring=/usr/share/keyrings/${1%%-*}-archive-keyring.gpg
    check=--keyring=$keyring
    # Debian has no package of Ubuntu's keyring. What is made here runs tests, and nothing else.
    if [ ! -r "$keyring" ]; then
        echo "release.sh: there is no $keyring: the signature of $1 is not checked" >&2
        check=--no-check-gpg
    fi
    debootstrap --variant=minbase "$check" --components="$(components "$1")" "$suite" "$2.new" \
        "$(archive "$1")" >"$2.log" 2>&1 || {
        tail -n 3 "$2.log" >&2
        fail "debootstrap cannot make $1"
    }
    # shellcheck disable=SC2046 # words are what is wanted
    in_root "$2.new" apt-get install -y --no-install-recommends $(packages "$1") >>"$2.log" 2>&1 || {
        tail -n 3 "$2.log" >&2
        fail "the ROS of $1 cannot be installed"
    }
    rm -rf "$2.new"/var/cache/apt/archives/*.deb
    # The test nodes name the Python that they run with.
    case $1 in
        ubuntu-16.04 | ubuntu-18.04) ln -sf python2.7 "$2.new/usr/bin/python3" ;;
    esac
    # Its compiler takes C++ of 1998 for granted, and its packages name libraries as its linker does not take them.
    if [ "$1" = ubuntu-16.04 ]; then
        cat >"$2.new/usr/local/bin/g++" <<'END'
#!/bin/sh
for word; do
    shift
    set -- "$@" "${word#-l:}"
done
exec /usr/bin/g++ -std=gnu++11 "$@"
END
        chmod +x "$2.new/usr/local/bin/g++"
    fi
    mv "$2.new" "$2"
}

in_root() { # FOLDER COMMAND...
    folder=$1
    shift
    unshare --mount --propagation private sh -eu -c '
        root=$1 checkout=$2
        shift 2
        mount --rbind /dev "$root/dev"
        mount --rbind /proc "$root/proc"
        mount -t tmpfs tmpfs "$root/tmp"
        for folder in "$checkout" "$HOME/.rustup" "$HOME/.cargo"; do
            [ -d "$folder" ] || continue
            mkdir -p "$root$folder"
            mount --bind "$folder" "$root$folder"
        done
        # The roscpp nodes are compiled by the compiler of the release.
        mkdir -p "$root/nodes" "$checkout/target/field/build/ros-nodes"
        mount --bind "$root/nodes" "$root$checkout/target/field/build/ros-nodes"
        exec env DEBIAN_FRONTEND=noninteractive LC_ALL=C.UTF-8 PATH="$HOME/.cargo/bin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin" \
            chroot "$root" "$@"
    ' sh "$folder" "$checkout" "$@"
}

case $1 in
    make) make "$2" "$3" ;;
    run)
        shift
        in_root "$@"
        ;;
    *) fail "make or run?" ;;
esac
