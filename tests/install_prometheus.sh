# Unpacks promtool of Debian's prometheus for the tests if it is missing, and adds it to the PATH of this shell:
#
#     . tests/install_prometheus.sh
#
# It does not install the package, because that would start Prometheus as a service on this computer.

. tests/apt_get.sh

unpack_promtool() {
    (cd "$prometheus_folder" && apt-get download -qq prometheus && dpkg -x prometheus_*.deb .)
}

prometheus_folder="${CARGO_TARGET_DIR:-$PWD/target}/prometheus"
PATH="$prometheus_folder/usr/bin:$PATH"
if ! command -v promtool >/dev/null; then
    mkdir -p "$prometheus_folder"
    # The package lists may be missing or old, or another program may be updating them.
    if ! { unpack_promtool || { apt_get update -qq && unpack_promtool; }; } || ! command -v promtool >/dev/null; then
        echo "promtool is not installed, and apt-get cannot download it (prometheus of Debian 12)" >&2
        exit 1
    fi
fi
