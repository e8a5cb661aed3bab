#!/bin/sh
# releases.sh [NAME…]: in each release, with its own rosmaster, rospy and roscpp, runs the paper's four cases, deaths of
# master, worker and both, an outage of a minute, hangs and the differential test, and writes a row into
# docs/compatibility.md. NAME is one of the releases below, with `+http1.0` to force HTTP/1.0. Each takes some 8 minutes,
# and as long again for the installation the first time.
#
# rosrescue and the tests are compiled once, in the oldest release, because programs linked with its C library run in all
# later ones.
set -eu
cd "$(dirname "$0")/../.."
checkout=$PWD
field=$checkout/target/field
oldest=ubuntu-16.04
build=$field/build/debug

if [ $# = 0 ]; then
    set -- ubuntu-16.04 ubuntu-18.04 ubuntu-20.04 debian-11 ubuntu-22.04 ubuntu-22.04+http1.0 debian-12 \
        debian-12+http1.0 debian-13 debian-13+http1.0
fi

run() { # RELEASE COMMAND...
    root=$field/$1/root
    shift
    tests/field/release.sh run "$root" "$@"
}

# Prints the name of the test program that cargo has compiled last.
program() { # NAME
    find "$build/deps" -name "$1-*" ! -name '*.*' -printf '%T@ %p\n' | sort -n | tail -n 1 | cut -d ' ' -f 2
}

# Prints "12 of 12", and which tests failed if any did.
count() { # LOG PATTERN
    awk -v pattern="^test ($2)" '
        $0 ~ pattern { name = $2; sub(/^test [^ ]+ \.\.\. /, "") }
        $0 ~ /^ok$|^FAILED$/ && name { all++; if ($0 == "ok") good++; else bad = bad " " name; name = "" }
        END { printf "%d of %d", good, all; if (bad) printf ", failed:%s", bad }' "$1"
}

# Prints how many numbered messages the tests have checked, from the last line about each talker.
messages() { # LOG
    awk '
        function add(name) { for (name in last) sum += last[name]; delete last }
        /^---- .* stdout ----$/ { add() }
        /^[0-9]+ messages of / { last[$4] = $1 }
        END { add(); print sum + 0 }' "$1"
}

differences() { # LOG
    awk '
        /^test (a_bare|through_rosrescue).* \.\.\. ok$/ || /^[0-9]+ sequences, / { if ($2 == "sequences,") { n += $1; calls += $3 } }
        /panicked at/ { bad++ }
        END { printf "%d in %d sequences, %d calls", bad, n, calls }' "$1"
}

# Prints which HTTP the master speaks, according to `rosrescue check`.
speaks() { # RELEASE SETARCH...
    release=$1
    shift
    # shellcheck disable=SC2016 # in the release
    run "$release" "$@" sh -c '
        ROS_HOME=/tmp rosmaster --core -p 11399 >/dev/null 2>&1 &
        for _ in $(seq 100); do
            if answers=$("$1" check --master http://127.0.0.1:11399 --port 11398 2>/dev/null | grep -o "answers: HTTP.*"); then
                break
            fi
            sleep 0.2
        done
        kill $!
        "$1" check --port 11398 2>/dev/null | grep -o "rosmaster, .*" | head -n 1
        echo "${answers#answers: }"' sh "$build/rosrescue"
}

mkdir -p "$field"
cargo fetch --locked
tests/field/release.sh make "$oldest" "$field/$oldest/root"
run "$oldest" sh -c 'cd "$1" && cargo test --locked --offline --no-run --test robot --test differential --target-dir target/field/build' \
    sh "$checkout"

status=0
for name; do
    release=${name%+*}
    tests/field/release.sh make "$release" "$field/$release/root"
    log=$field/$name.log
    force=
    case $name in
        *+http1.0) force='setarch x86_64 --uname-2.6' ;;
    esac
    unordered=
    case $release in
        ubuntu-16.04 | ubuntu-18.04) unordered=ROSRESCUE_UNORDERED=1 ;;
    esac
    begin=$(date +%s)
    # shellcheck disable=SC2086 # splitting is intended
    run "$release" $force env $unordered ROSRESCUE_AWAY_SECONDS=60 \
        "$(program robot)" --test-threads 2 --show-output paper:: outage::long master::hung \
        >"$log" 2>&1 || status=1
    # shellcheck disable=SC2086 # splitting is intended
    run "$release" $force env $unordered \
        ROSRESCUE_SEQUENCES=12 ROSRESCUE_CRASH_SEQUENCES=12 ROSRESCUE_CRASHES=3 ROSRESCUE_CALLS=150 \
        "$(program differential)" --test-threads 2 --show-output --exact \
        a_bare_rosmaster_answers_as_the_model_does no_crash_of_the_master_is_visible_through_rosrescue \
        >"$log.differential" 2>&1 || status=1
    # shellcheck disable=SC2086 # splitting is intended
    said=$(speaks "$release" $force)
    version=$(echo "$said" | sed -n '1s/rosmaster, \([^,]*\).*/\1/p')
    http=$(echo "$said" | sed -n '2s/ .*//p; 2s/,.*//p' | head -n 1)
    python=$(echo "$said" | sed -n '2s/.*Python \([0-9.]*\).*/\1/p')
    /usr/bin/python3 tests/field/row.py docs/compatibility.md releases \
        "$(echo "${release%-*}" | sed 's/./\u&/') ${release#*-}, ${http%,}$(test -z "$force" || echo ' forced')" \
        "$version" "$python" \
        "$(count "$log" 'paper::cases|paper::case_2')" "$(count "$log" 'paper::case_3')" \
        "$(count "$log" 'outage::long')" "$(count "$log" 'master::hung')" \
        "0 of $(messages "$log")" "$(differences "$log.differential")" "$(date +%F)"
    echo "$name: $(grep '^test result' "$log"); $(($(date +%s) - begin)) s"
done
exit "$status"
