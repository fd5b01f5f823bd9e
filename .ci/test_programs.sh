#!/bin/sh
# Programs that tests alone need: a browser, and npm's splat-transform in .venv. POSIX sh.
# Where they cannot be installed, their tests are skipped, in continuous integration (CI=true) they fail.
set -eu
cd "$(dirname "$0")/.."
. .ci/system.sh
prefix=$(pwd)/.venv

missing() {
    echo "tests: no $1: $2" >&2
}

found=
for browser in chromium chromium-browser google-chrome; do
    command -v "$browser" >/dev/null && found=$browser
done
if [ -z "$found" ]; then
    echo "tests: installing chromium, 400 MB on the disk: seconds after the download" >&2
    apt_install chromium >/dev/null || missing chromium "sudo apt-get install -y chromium"
fi
# The last version for Debian 12's Node.js 18.
splat_transform=@playcanvas/splat-transform@2.7.1
if ! { [ -x "$prefix/bin/splat-transform" ] || command -v splat-transform >/dev/null; }; then
    echo "tests: installing $splat_transform, 200 MB on the disk: seconds after the download" >&2
    command -v npm >/dev/null || apt_install "nodejs npm" >/dev/null || missing npm "sudo apt-get install -y nodejs npm"
    npm install --global --silent --prefix "$prefix" "$splat_transform" >/dev/null ||
        missing splat-transform "npm install --global $splat_transform"
fi
