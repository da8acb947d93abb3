#!/usr/bin/env bash
# Sets this folder up: system libraries, .venv, pinned packages, depthba itself in editable mode.
# Does nothing twice: what is there already is left as it is.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH="$PATH:/usr/sbin:/sbin"
PYTHON="${PYTHON:-python3}"

fail() {
    echo "setup: $*" >&2
    exit 1
}

# Shared libraries that open3d loads when it is imported, and the Debian packages that hold them.
system_libraries() {
    local missing=() library package
    command -v ldconfig >/dev/null || return 0
    while read -r library package; do
        ldconfig -p | grep -F "$library " >/dev/null || missing+=("$package")
    done <<'LIST'
libEGL.so.1 libegl1
libGL.so.1 libgl1
libX11.so.6 libx11-6
libgomp.so.1 libgomp1
libusb-1.0.so.0 libusb-1.0-0
LIST
    [ "${#missing[@]}" -eq 0 ] && return 0

    command -v apt-get >/dev/null || fail "install the libraries of these Debian packages, then try again: ${missing[*]}"
    local root=()
    if [ "$(id -u)" -ne 0 ]; then
        # asks for a password only where somebody is there to give it
        if command -v sudo >/dev/null && { sudo -n true 2>/dev/null || { [ -t 0 ] && sudo -v; }; }; then
            root=(sudo)
        else
            fail "no root and no sudo here: ask for 'apt-get install ${missing[*]}', then try again"
        fi
    fi
    echo "setup: installing ${missing[*]}"
    # apt speaks only where it fails
    "${root[@]}" apt-get update -qq
    "${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -qq -y \
        --no-install-recommends -o Dpkg::Use-Pty=0 "${missing[@]}" >/dev/null
}

virtual_environment() {
    "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
        fail "$("$PYTHON" --version 2>&1) is too old, Python 3.11 or newer is needed (PYTHON=… names another)"
    # one that was moved or whose Python is gone is made anew
    if ! .venv/bin/python -c 'import pip' 2>/dev/null ||
        [ "$(.venv/bin/python -c 'import sys; print(sys.prefix)')" != "$PWD/.venv" ]; then
        "$PYTHON" -m venv --clear .venv ||
            fail "cannot make .venv: on Debian and Ubuntu, 'apt-get install python3-venv' brings what is missing"
    fi
}

packages() {
    # the build backend first, so that it is pinned like everything else
    .venv/bin/python -m pip install --quiet --disable-pip-version-check \
        --constraint constraints.txt hatchling editables
    .venv/bin/python -m pip install --quiet --disable-pip-version-check \
        --constraint constraints.txt --no-build-isolation \
        --editable '.[sim,eval,rig,cameras,convert,distributed,docs,dev]'
}

system_libraries
virtual_environment
echo "setup: installing the packages into .venv (about 3 GB; minutes the first time)"
packages
echo "setup: compiling the kernels"
.venv/bin/python -m depthba.optimiser.warm
echo "setup: done; now '. .venv/bin/activate', then 'depthba demo' shows it at work"
