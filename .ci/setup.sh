#!/bin/sh
# From an empty Debian, Ubuntu, Fedora or macOS to a working .venv; `make` calls it. POSIX sh.
# Installs system packages only as root or with a sudo that asks nothing; else it stops with the line to run.
set -eu
cd "$(dirname "$0")/.."
venv=.venv
. .ci/system.sh

stop() {
    echo "set-up: $*" >&2
    exit 1
}

begin=$(date +%s)
step() {
    echo "set-up: step $1 ($(($(date +%s) - begin)) s so far)" >&2
}

new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

step "1 of 4, Python and $venv: seconds"
if ! { new_enough "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; }; then
    python=
    for candidate in ${PYTHON:-} python3 python3.13 python3.12 python3.11; do
        if new_enough "$candidate"; then
            python=$candidate
            break
        fi
    done
    [ -n "$python" ] || stop "no Python 3.11 or newer found: install one, or name it: make PYTHON=/path/to/python3"
    # Debian and Ubuntu keep what makes a virtual environment in a package of its own.
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        apt_install "$package" ||
            stop "$python cannot make virtual environments: sudo apt-get update && sudo apt-get install -y $package"
    fi
    "$python" -m venv --clear "$venv"
fi
# pip's last line every five seconds: what it collects, downloads with size, builds or installs.
step "2 of 4, the package and its dependencies, 1.5 GB on the disk: a minute or two after the downloads"
"$venv/bin/python" -m pip install -e '.[dev]' >"$venv/pip.log" &
pip=$!
trap 'kill "$pip" 2>/dev/null; exit 130' INT TERM
shown=
while kill -0 "$pip" 2>/dev/null; do
    line=$(tail -n 1 "$venv/pip.log" | cut -c 1-100)
    [ "$line" = "$shown" ] || echo "set-up:   $(($(date +%s) - begin)) s $line" >&2
    shown=$line
    sleep 5
done
trap - INT TERM
wait "$pip" || stop "pip could not install the package; see $venv/pip.log"
# Python that starts in the folder above a clone `wrf_mi` takes that folder for the package, unless the path has this one.
pwd >"$("$venv/bin/python" -c 'import site; print(site.getsitepackages()[0])')/clone_of_wrf_mi.pth"
# Matplotlib looks through all fonts once.
"$venv/bin/python" -c 'import matplotlib.font_manager' 2>/dev/null || true
step "3 of 4, libraries of Open3D: seconds"
# Open3D, which `wrf-mi mesh` uses, is linked against what depth cameras and windows need.
open3d_needs="libusb-1.0-0 libgl1 libegl1 libx11-6"
if ! "$venv/bin/python" -c 'import open3d' 2>/dev/null; then
    apt_install "$open3d_needs" || true
    "$venv/bin/python" -c 'import open3d' 2>/dev/null ||
        stop "Open3D cannot be loaded: sudo apt-get update && sudo apt-get install -y $open3d_needs"
fi
step "4 of 4, LLVM: seconds, a minute where it is installed"
"$venv/bin/python" -m wrf_mi.apps.commands doctor --install-llvm
