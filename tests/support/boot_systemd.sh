#!/bin/sh
# boot_systemd.sh FOLDER PROGRAM GIVEN [SYSTEM]: becomes a systemd that is process 1 in its own namespaces, over a copy of
# the files of SYSTEM, an installed Debian or Ubuntu (default: this computer's), that vanishes with it. PROGRAM appears there
# as /opt/rosrescue/rosrescue, the folder GIVEN as /given.
# Needs root. Its control group, named after the folder of FOLDER, stays until `boot_systemd.sh --forget FOLDER`.
#
#     unshare --mount --pid --net --uts --ipc --fork --kill-child boot_systemd.sh FOLDER PROGRAM GIVEN
#     unshare --mount boot_systemd.sh --forget FOLDER
set -eu
forgets=
if [ "$1" = --forget ]; then
    forgets=yes
    shift
fi
folder=$1
mount -t tmpfs tmpfs "$folder"
mkdir "$folder/groups"
mount -t cgroup2 cgroup2 "$folder/groups"
group=$folder/groups/$(basename "$(dirname "$folder")")
if [ -n "$forgets" ]; then
    find "$group" -depth -type d -exec rmdir {} +
    exit
fi
program=$2
given=$3
# Two systemds in one control group would remove each other's groups and end each other's processes.
mkdir "$group"
echo 0 >"$group/cgroup.procs"
mkdir "$folder/upper" "$folder/work" "$folder/root"
mount -t overlay -o "lowerdir=${4:-/},upperdir=$folder/upper,workdir=$folder/work" overlay "$folder/root"
root=$folder/root
mkdir -p "$root/opt/rosrescue"
: >"$root/opt/rosrescue/rosrescue"
mount --bind "$program" "$root/opt/rosrescue/rosrescue"
mkdir -p "$root/given"
mount --bind "$given" "$root/given"
mount -t proc proc "$root/proc"
mount -o bind,ro "$root/proc/sys" "$root/proc/sys"
mount -t sysfs -o ro sysfs "$root/sys"
mount -t tmpfs -o mode=755 tmpfs "$root/dev"
for device in null zero full random urandom tty; do
    : >"$root/dev/$device"
    mount --bind "/dev/$device" "$root/dev/$device"
done
mkdir "$root/dev/pts" "$root/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666 devpts "$root/dev/pts"
ln -s pts/ptmx "$root/dev/ptmx"
mount -t tmpfs tmpfs "$root/run"
mount -t tmpfs -o mode=1777 tmpfs "$root/tmp"
ip link set lo up
hostname robot
echo robot >"$root/etc/hostname"
echo "127.0.0.1 localhost robot" >"$root/etc/hosts"
: >"$root/etc/machine-id"
# No services of this computer, and an empty journal, which the tests read.
rm -rf "$root"/etc/systemd/system/*.wants "$root"/var/log/journal
for unit in sysctl modules-load remount-fs udevd udev-trigger; do
    ln -sf /dev/null "$root/etc/systemd/system/systemd-$unit.service"
done
cat >"$root/etc/systemd/system/multi-user.target" <<'UNIT'
[Unit]
Requires=basic.target
After=basic.target
AllowIsolate=yes
UNIT
# shellcheck disable=SC2016 # in the new namespace
exec env -i container=rosrescue-test PATH=/usr/sbin:/usr/bin:/sbin:/bin unshare --cgroup sh -euc '
    mount -t cgroup2 cgroup2 "$1/sys/fs/cgroup"
    exec chroot "$1" /lib/systemd/systemd --unit=multi-user.target --log-target=journal --show-status=no
' sh "$root"
