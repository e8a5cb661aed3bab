# A function that runs apt-get, for scripts that install packages. To be sourced.

# How long to wait while another program uses the package manager, in seconds.
apt_patience=600

# Runs apt-get as root. Waits while another program holds one of the package manager's locks. apt's own option
# for that, DPkg::Lock::Timeout, does not cover the lock that `update` takes (apt 2.6.1).
apt_get() { # ARGUMENTS...
    if [ "$(id -u)" = 0 ]; then
        as_root=
    elif command -v sudo >/dev/null; then
        as_root=sudo
    else
        echo "apt-get $1 needs root or sudo" >&2
        return 1
    fi
    apt_errors=$(mktemp)
    apt_waited=0
    while :; do
        apt_status=0
        $as_root env LC_ALL=C DEBIAN_FRONTEND=noninteractive apt-get "$@" 2>"$apt_errors" || apt_status=$?
        if [ "$apt_status" = 0 ] || ! apt_lock=$(grep -m 1 'Could not get lock' "$apt_errors"); then
            break
        fi
        if [ "$apt_waited" -ge "$apt_patience" ]; then
            echo "another program has been using the package manager for $apt_patience s; try again later" >&2
            break
        fi
        if [ "$apt_waited" = 0 ]; then
            echo "waiting up to $apt_patience s for another program that uses the package manager: ${apt_lock#E: }" >&2
        fi
        sleep 2
        apt_waited=$((apt_waited + 2))
    done
    cat "$apt_errors" >&2
    rm -f "$apt_errors"
    return "$apt_status"
}
