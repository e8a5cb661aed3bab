#!/bin/sh
# Measures every table of docs/benchmarks.md on this computer and writes them, with the present commit in each caption.
# Takes twenty minutes on two cores, five of them for the build. Nothing else should run meanwhile.
set -eu
cd "$(dirname "$0")/.."

[ -z "$(git status --porcelain)" ] || {
    echo "commit your changes first: each table names the commit that was measured" >&2
    exit 1
}
for program in haproxy nginx; do
    command -v "$program" >/dev/null || {
        echo "some programs are not installed; run: apt-get install haproxy nginx-light" >&2
        exit 1
    }
done
. tests/install_ros.sh
. tests/install_etcd.sh
cargo bench --locked --no-run

bench() {
    name=$1
    shift
    cargo bench --locked --bench "$name" -- "$@" --write-docs
}

bench pauses --kills 20 --away 15
bench pauses --kills 20 --deaths worker,both
bench pauses --kills 10 --deaths nobody,worker,both --load 16
bench table1 --nodes 1,10,80 --synthetic 6 --real 2
ROSRESCUE_HTTP_1_0=1 bench table1 --nodes 80 --synthetic 6 --real 0
bench compare --seconds 0.5 --storms 5 --launches 2 --notifies 2
bench computers --kills 10 --seconds 0.5 --hours 12
# A missed link fails this benchmark, and is a result.
bench links --mode bare,core,proxy,standing-in,kills,follower --starts 1 --links 2160 || true
/usr/bin/python3 benches/summary.py
