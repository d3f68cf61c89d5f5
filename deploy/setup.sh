#!/usr/bin/env bash
# setup.sh [VENV [with-tests]]: makes a virtual environment with the locked packages, with those of the tests too where
# asked, and sees that headless OpenGL works. Does only what is missing; where nothing is, it needs no network.
set -eu
cd "$(dirname "$0")/.."
venv=${1:-.venv} what=${2:-}
stamp=$venv/.installed
needs_temporary_mb=300 # measured: pip unpacks the largest wheels there
lock=deploy/requirements.lock needs_venv_mb=1050 # measured: the packages themselves
if [ "$what" = with-tests ]; then lock=requirements.lock needs_venv_mb=1300 stamp=$venv/.installed-with-tests; fi
log() { printf 'setup: %s\n' "$*" >&2; }

# Installs Debian packages where the user may; fails where not.
install_packages() {
    command -v apt-get >/dev/null || return 1
    local as_root=()
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    log "installing $*"
    local said
    said=$("${as_root[@]}" apt-get update -qq 2>&1 &&
        "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" 2>&1) ||
        { log "$said"; return 1; }
}

# The packages are locked and have wheels for Python 3.11 to 3.14 (deploy/wheels.txt; but FLIP's on 3.14, which the
# evaluation does without); a newer one would have to build some of them.
find_python() {
    local candidate
    for candidate in ${PYTHON:-} python3 python3.13 python3.14 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    log "Python 3.11, 3.12, 3.13 or 3.14 is needed, found: $(python3 --version 2>&1 || true); name one: make PYTHON=/path/to/python3.13 ..."
    exit 1
}

# Fails, saying what to do, where a folder has less than so many MB free.
check_room() {
    local folder=$1 megabytes=$2 hint=$3 free
    free=$(df -Pm "$folder" | awk 'NR == 2 {print $4}')
    [ "$free" -ge "$megabytes" ] || { log "$folder has $free MB free, $megabytes are needed; $hint"; exit 1; }
}

make_venv() {
    local python
    python=$(find_python)
    log "making $venv with $("$python" --version)"
    rm -rf "$venv"
    if ! "$python" -m venv "$venv" >/dev/null 2>&1; then
        rm -rf "$venv"
        install_packages python3-venv || { log "please install: python3-venv"; exit 1; }
        "$python" -m venv "$venv"
    fi
}

# What is installed names the folder that it was made in: a checkout that was moved or copied is set up anew.
# An environment with the tests' packages has all of the others.
locked=$(cat requirements.lock deploy/requirements.lock pyproject.toml | sha256sum)$(pwd)
is_of_now() { [ -f "$1" ] && [ "$(cat "$1")" = "$locked" ]; }
if ! is_of_now "$stamp" && ! is_of_now "$venv/.installed-with-tests"; then
    check_room "${TMPDIR:-/tmp}" "$needs_temporary_mb" "name another: TMPDIR=/path make ..."
    check_room . "$needs_venv_mb" "that is what the packages in $venv take"
    is_of_now "$venv/.installed" || make_venv
    log "installing the locked packages"
    # What builds this package is among the tests' packages: its lines of their lock.
    awk '/^[a-z]/ {mine = /^setuptools==/} mine' requirements.lock >"$venv/build.lock"
    pip_install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }
    pip_install --require-hashes -r "$lock"
    pip_install --require-hashes -r "$venv/build.lock"
    pip_install --no-build-isolation --no-deps -e .
    echo "$locked" >"$stamp"
fi

graphics="libegl1 libgl1 libgl1-mesa-dri"
works() { "$venv/bin/python" -c 'from renderer.splats.context import gl_context; gl_context()' >/dev/null 2>&1; }
if ! works; then
    # shellcheck disable=SC2086 # the names are words
    install_packages $graphics || true
    works || log "headless OpenGL does not work; rendering needs: $graphics (apt-get install $graphics)"
fi
