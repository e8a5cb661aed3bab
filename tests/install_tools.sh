# Installs missing programs that only tests use. To be sourced after tests/install_ros.sh.

has_libfaketime() {
    for library in /usr/lib/*/faketime/libfaketimeMT.so.1; do
        [ ! -r "$library" ] || return 0
    done
    return 1
}

has_pam_systemd() {
    for library in /lib/*/security/pam_systemd.so; do
        [ ! -r "$library" ] || return 0
    done
    return 1
}

has_dhcp() {
    busybox udhcpd --help 2>&1 | grep -q udhcpd && busybox udhcpc --help 2>&1 | grep -q udhcpc
}

tools_missing() {
    need libfaketime has_libfaketime
    need catkin command -v catkin_make
    need cmake command -v cmake
    need make command -v make
    need debootstrap command -v debootstrap
    need systemd-sysv test -x /lib/systemd/systemd
    need dbus command -v dbus-daemon
    need libpam-systemd has_pam_systemd
    need dpkg-dev command -v dpkg-shlibdeps
    need keepalived command -v keepalived
    need busybox has_dhcp
}

# shellcheck disable=SC2046 # splitting is intended
install_missing $(tools_missing)
