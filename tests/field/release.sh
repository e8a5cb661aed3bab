#!/bin/sh
# release.sh make NAME FOLDER: installs a release of Debian or Ubuntu into FOLDER, with its own ROS 1, a compiler and
# everything that the test nodes need. FOLDER is complete or does not exist. Takes two to four minutes and 0.7 to 1.5 GB.
#
# release.sh run FOLDER COMMAND...: runs COMMAND in it as root, with this checkout and the Rust toolchain at the same
# paths as outside. Mounts are private and end with COMMAND.
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

# The names of Python packages depend on the release.
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
    # Debian has no package with Ubuntu's keyring. The result is used for tests only.
    if [ ! -r "$keyring" ]; then
        echo "release.sh: $keyring is missing, so the signature of $1 is not checked" >&2
        check=--no-check-gpg
    fi
    debootstrap --variant=minbase "$check" --components="$(components "$1")" "$suite" "$2.new" \
        "$(archive "$1")" >"$2.log" 2>&1 || {
        tail -n 3 "$2.log" >&2
        fail "debootstrap cannot make $1"
    }
    # shellcheck disable=SC2046 # splitting is intended
    in_root "$2.new" apt-get install -y --no-install-recommends $(packages "$1") >>"$2.log" 2>&1 || {
        tail -n 3 "$2.log" >&2
        fail "the ROS of $1 cannot be installed"
    }
    rm -rf "$2.new"/var/cache/apt/archives/*.deb
    # The test nodes name the Python with which they run.
    case $1 in
        ubuntu-16.04 | ubuntu-18.04) ln -sf python2.7 "$2.new/usr/bin/python3" ;;
    esac
    # Its compiler defaults to C++98, and its packages name libraries in a form that its linker does not accept.
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
        # The compiler of the release compiles the roscpp nodes.
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
