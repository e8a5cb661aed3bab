#!/bin/sh
# packaging/docker/build-image.sh PACKAGE [NAME]: makes an image of rosrescue alone, for `proxy` beside the container of a
# master, out of a Debian package of packaging/build-all.sh: the program and Debian's C library, without a shell. It runs
# as user 10001. Needs podman and Debian's apt-get; no registry. `core` needs an image with ROS: see Dockerfile.
set -eu
package=$(realpath "$1")
name=${2:-rosrescue}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
root=$work/root
mkdir -p "$root/var/lib/rosrescue" "$root/etc" "$work/libc"
dpkg-deb --fsys-tarfile "$package" | tar x -C "$root" ./usr/bin/rosrescue
chmod 777 "$root/var/lib/rosrescue"
processor=$(dpkg-deb -f "$package" Architecture)
(cd "$work" && apt-get download -qq "libc6:$processor" "libgcc-s1:$processor" &&
    for library in libc6_*.deb libgcc-s1_*.deb; do dpkg-deb -x "$library" libc; done)
# The loader, the libraries that the program names (libgcc unless build-all.sh made the package), and those that look up
# host names.
(cd "$work/libc" && find . -name 'ld-linux*' -o -name 'libc.so*' -o -name 'libm.so*' -o -name 'libpthread.so*' \
    -o -name 'libdl.so*' -o -name 'libgcc_s.so*' -o -name 'libnss_dns.so*' -o -name 'libnss_files.so*' -o -name 'libresolv.so*') |
    tar c -C "$work/libc" -T - | tar x -C "$root"
echo "rosrescue:x:10001:10001::/var/lib/rosrescue:/" >"$root/etc/passwd"
echo "hosts: files dns" >"$root/etc/nsswitch.conf"
cat >"$work/Containerfile" <<'END'
FROM scratch
COPY root /
USER 10001
ENV ROS_LOG_DIR=/var/lib/rosrescue
VOLUME /var/lib/rosrescue
EXPOSE 11311
HEALTHCHECK --interval=5s CMD ["/usr/bin/rosrescue", "wait", "--uri", "http://localhost:11311", "--timeout", "1"]
ENTRYPOINT ["/usr/bin/rosrescue"]
CMD ["proxy"]
END
podman build --quiet --format docker --tag "$name" "$work"
