#!/bin/sh
# fresh_debian.sh CACHE FOLDER COMMAND...: runs COMMAND in a fresh Debian (or Ubuntu) of this computer's own release,
# made by debootstrap. FOLDER appears there as /given. All changes by COMMAND vanish. CACHE is made once, which takes
# about a minute. Needs root and debootstrap.
set -eu
cache=$1
folder=$2
shift 2
if [ ! -d "$cache" ]; then
    . /etc/os-release
    # The same archive as this computer's apt uses.
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' "Codename: $VERSION_CODENAME" | head -n 1)
    attempts=0
    until
        rm -rf "$cache.new"
        debootstrap --variant=minbase "$VERSION_CODENAME" "$cache.new" "$mirror" >"$cache.log" 2>&1
    do
        attempts=$((attempts + 1))
        if [ "$attempts" -eq 3 ]; then
            echo "fresh_debian.sh: debootstrap cannot install $VERSION_CODENAME:" >&2
            tail -n 3 "$cache.log" >&2
            exit 1
        fi
        sleep 5
    done
    rm -rf "$cache.new"/var/cache/apt/archives/*.deb
    mv "$cache.new" "$cache"
fi
exec unshare --mount --pid --net --fork --kill-child sh -eu -c '
    cache=$1 folder=$2
    shift 2
    mount -t tmpfs tmpfs /mnt
    mkdir /mnt/upper /mnt/work /mnt/root
    mount -t overlay -o "lowerdir=$cache,upperdir=/mnt/upper,workdir=/mnt/work" overlay /mnt/root
    mkdir /mnt/root/given
    mount --bind "$folder" /mnt/root/given
    mount -t proc proc /mnt/root/proc
    exec env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root DEBIAN_FRONTEND=noninteractive \
        chroot /mnt/root "$@"
' sh "$cache" "$folder" "$@"
