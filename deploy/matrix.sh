#!/usr/bin/env bash
# matrix.sh FOLDER [SUITE...]: what a newcomer does, on bare Debian systems: set-up and demos in fresh clones, as root and
# without rights, in a folder with a space and an umlaut, with umask 077, 400 MB for TMPDIR, LANG=C and tr_TR, without
# OpenGL, and a second time without network. Run by hand, as root; needs debootstrap, about 4 GB in FOLDER and the network.
#
# Prints a row of a table a step: suite, circumstances, step, ok or its exit code, seconds, and the last line of stderr
# where it did not end well. A step that is to fail is ok where it fails within 20 s and names what is missing.
# Ends with 1 where a step is not ok, or where two packed files of one demo differ.
set -u
here=$(cd "$(dirname "$0")/.." && pwd)
work=$(mkdir -p "$1" && cd "$1" && pwd)
shift
mirror=${MIRROR:-http://deb.debian.org/debian}
odd_path="srv/Grüße an alle"
failed=0

# A bare system with what README asks for, and a user without rights.
make_root() {
    local suite=$1 root=$work/$1
    [ -f "$root/.ready" ] && return
    if [ ! -f "$root/etc/debian_version" ]; then
        debootstrap --variant=minbase --include=ca-certificates,git,make,python3,python3-venv "$suite" "$root" "$mirror" \
            >"$work/$suite.log" 2>&1 || { echo "debootstrap of $suite failed, see $work/$suite.log" >&2; exit 2; }
    fi
    cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/ca-certificates.crt"
    cp /etc/resolv.conf /etc/hosts "$root/etc/"
    echo 'Acquire::Check-Valid-Until "false";' >"$root/etc/apt/apt.conf.d/snapshot" # a mirror of a date is past its own
    chroot "$root" useradd --create-home plain
    inside "$suite" root "" "apt-get update -qq && apt-get install -qq --no-install-recommends locales &&
        localedef -i tr_TR -f UTF-8 tr_TR.UTF-8" >>"$work/$suite.log" 2>&1 || { echo "no locales, see $work/$suite.log" >&2; exit 2; }
    install -d -m 1777 "$root/pip"
    touch "$root/.ready"
}

# inside SUITE USER NAMESPACES COMMAND: in the root, with its own mounts and processes.
inside() {
    local root=$work/$1 user=$2 more=$3 command=$4
    # shellcheck disable=SC2086,SC2016 # words; expanded by the inner shell
    MATRIX_COMMAND=$command MATRIX_USER=$user MATRIX_ROOT=$root unshare --mount --pid --fork --kill-child $more bash -c '
        mount --make-rprivate / && mount -t proc proc "$MATRIX_ROOT/proc" && mount --rbind /dev "$MATRIX_ROOT/dev" &&
        mount -t tmpfs -o mode=1777 tmpfs "$MATRIX_ROOT/dev/shm" && mkdir -p "$MATRIX_ROOT/small" &&
        mount -t tmpfs -o mode=1777,size="${SMALL_MB:-400}m" tmpfs "$MATRIX_ROOT/small" &&
        { ip link set lo up 2>/dev/null || true; } &&
        exec chroot "$MATRIX_ROOT" su "$MATRIX_USER" -s /bin/bash -w "$(env | sed -n "s/^\([A-Z_]*\)=.*/\1/p" | paste -sd,)" \
            -c "$MATRIX_COMMAND"'
}

# step SUITE CIRCUMSTANCES USER NAMESPACES EXPECTED NAME COMMAND: one row. EXPECTED is ok, or what a failure has to say.
step() {
    local suite=$1 what=$2 user=$3 more=$4 expected=$5 name=$6 command=$7 begun took code said result
    begun=$(date +%s)
    inside "$suite" "$user" "$more" "$command" >"$work/out" 2>"$work/err" </dev/null
    code=$? took=$(($(date +%s) - begun)) said=""
    if [ "$expected" = ok ]; then
        result=ok
        [ $code = 0 ] || { result="exit $code" said=$(tail -n 1 "$work/err") failed=1; }
    else
        result="refused" said=$(grep -e "$expected" "$work/err" | tail -n 1)
        if [ $code = 0 ] || [ -z "$said" ] || grep -q Traceback "$work/err"; then
            result="NOT as expected ($code)" said=$(tail -n 1 "$work/err") failed=1
        fi
    fi
    cat "$work/out" "$work/err" >"$work/last-$suite-${name//[^a-z]/-}.log"
    printf '| %s | %s | %s | %s | %s | %s |\n' "$suite" "$what" "$name" "$result" "$took" "${said//|//}"
}

clone() { # a fresh one, owned by who will use it
    local suite=$1 user=$2 path=$work/$1/$3
    rm -rf "$path" && mkdir -p "$(dirname "$path")" && git clone -q --depth 1 "file://$here" "$path"
    chroot "$work/$suite" chown -R "$user:" "/$3"
}

same_bytes() {
    local demo=$1 suite file sums
    sums=$(for suite in $suites; do
        for file in "$work/$suite/$odd_path"*/"$demo"/*.splatpress; do [ -f "$file" ] && sha256sum <"$file"; done
    done | sort -u | wc -l)
    if [ "$sums" = 1 ]; then echo "$demo: the same bytes everywhere"; else
        echo "$demo: $sums different packed files, of 1" && failed=1
    fi
}

suites=${*:-bookworm trixie}
echo "| Debian | as | step | result | seconds | says |"
echo "|---|---|---|---|---|---|"
for suite in $suites; do
    make_root "$suite"
    python=$(chroot "$work/$suite" python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    enter="cd '/$odd_path' && export PIP_CACHE_DIR=/pip/\$(id -un) LANG=C &&"
    what="plain user, space and umlaut, umask 077, LANG=C, no OpenGL, Python $python"
    clone "$suite" plain "$odd_path"
    step "$suite" "$what" plain "" "libegl1" "make demo" "umask 077; $enter make demo"
    step "$suite" "$what" plain "" ok "demo --no-render" "umask 077; $enter .venv/bin/splatpress demo --no-render --out packed"
    what="root, the same folder"
    clone "$suite" root "$odd_path"
    SMALL_MB=200 step "$suite" "$what, TMPDIR of 200 MB" root "" "TMPDIR" "make demo" "$enter TMPDIR=/small make demo"
    step "$suite" "$what" root "" ok "make demo" "$enter make demo"
    step "$suite" "$what, no network" root --net ok "make demo again" "$enter make demo"
    step "$suite" "$what, no network" root --net ok "demo --scan points" "$enter .venv/bin/splatpress demo --scan points"
    step "$suite" "$what, no network" root --net ok "demo --scan volume" "$enter .venv/bin/splatpress demo --scan volume"
    mv "$work/$suite/$odd_path" "$work/$suite/$odd_path, moved"
    what="plain user, umask 077, TMPDIR of 400 MB, LANG=tr_TR.UTF-8"
    clone "$suite" plain "$odd_path"
    step "$suite" "$what" plain "" ok "make demo" "umask 077; $enter LANG=tr_TR.UTF-8 TMPDIR=/small make demo"
    step "$suite" "$what, no network" plain --net ok "make demo again" "umask 077; $enter LANG=tr_TR.UTF-8 TMPDIR=/small make demo"
    echo "<!-- .venv of $suite: $(du -sm "$work/$suite/$odd_path/.venv" | cut -f1) MB -->"
done
for demo in demo-output demo-output-points demo-output-volume; do same_bytes "$demo"; done
exit $failed
