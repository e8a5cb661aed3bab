# Unpacks Debian's etcd for the tests if it is missing, and adds it to the PATH of this shell:
#
#     . tests/install_etcd.sh
#
# It does not install the package, because that would start etcd as a service on this computer.

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
    # The package lists may be missing or old, or another program may be updating them.
    if ! { unpack_etcd || { apt_get update -qq && unpack_etcd; }; } || ! etcd_works; then
        echo "etcd 3.4 or later is not installed, and apt-get cannot download it (etcd-server and etcd-client of Debian 12)" >&2
        exit 1
    fi
fi
