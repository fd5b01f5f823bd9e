#!/bin/sh
# Tests with the lowest versions of the dependencies that pyproject.toml allows, in an environment of its own.
set -eu
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
begin=$(date +%s)
step() {
    echo "lowest versions: $1 ($(($(date +%s) - begin)) s so far)" >&2
}
step "1 of 3, environment"
.venv/bin/python -m venv "$folder/venv"
python=$folder/venv/bin/python
"$python" -m pip install -q uv
step "2 of 3, packages: about a minute"
"$folder/venv/bin/uv" pip install --quiet --python "$python" --resolution lowest-direct -e '.[lidar,cluster,argos,tests]'
"$folder/venv/bin/uv" pip list --quiet --python "$python"
# Newer packages below these warn that the older ones use what they will drop.
step "3 of 3, tests: some minutes"
"$python" -m pytest -q -p no:cacheprovider -o filterwarnings=default ${1:-tests/core tests/datasets tests/receivers tests/scene tests/tasks tests/gaussians tests/tracing tests/models/interpolation tests/runs}
step "done"
