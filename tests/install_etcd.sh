# Unpacks Debian's etcd for the tests, where there is none, and makes it known to this shell:
#
#     . tests/install_etcd.sh
#
# Not by installing it: that would start an etcd as a service of this computer.

. tests/apt_get.sh

etcd_works() {
    command -v etcd >/dev/null && etcd --version | grep -Eq '^etcd Version: (3\.([4-9]|[1-9][0-9])|[4-9])' &&
        command -v etcdctl >/dev/null
}

unpack_etcd() {
    (cd "$etcd_folder" && apt-get download -qq etcd-server etcd-client &&
        dpkg -x etcd-server_*.deb . && dpkg -x etcd-client_*.deb .)
}

etcd_folder="${CARGO_TARGET_DIR:-$PWD/target}/etcd"
PATH="$etcd_folder/usr/bin:$PATH"
if ! etcd_works; then
    mkdir -p "$etcd_folder"
    # The lists may be missing, old, or in the middle of somebody else's update.
    if ! { unpack_etcd || { apt_get update -qq && unpack_etcd; }; } || ! etcd_works; then
        echo "there is no etcd 3.4 or later here, and apt-get cannot download one (etcd-server and etcd-client of Debian 12)" >&2
        exit 1
    fi
fi
