#!/usr/bin/env bash
# All measurements and tests that need a GPU, in at most eight minutes; results are stored in OUT.
#
#   benchmarks/gpu.sh [OUT]      (default: benchmarks/results)
#
# PYTHON names a Python with the package's dependencies (default: .venv/bin/python). WRF_MI_GPU=llvm rehearses it on
# a machine without a GPU: tests that need one are left out, and all columns are the CPU's.
set -uo pipefail
cd "$(dirname "$0")/.."
python="${PYTHON:-.venv/bin/python}"
out="${1:-benchmarks/results}"
mkdir -p "$out"
export PYTHONPATH="$PWD:$PWD/benchmarks:$PWD/plugins:$PWD/scenes${PYTHONPATH:+:$PYTHONPATH}"
for data in "${WRF_MI_DATA:-}" shared/data ../shared/data; do
    if [[ -d "$data" ]]; then export WRF_MI_DATA="$(cd "$data" && pwd)"; break; fi
done
status=0
# Benchmarks first, as they are the figures that only such a machine gives; each part stops at its share of the time.
timeout --signal=INT 300 "$python" -m wrf_mi.cli bench gpu --out "$out" --runs "$out/gpu-runs" 2>&1 | tee "$out/gpu.log" || status=1
if [[ "${WRF_MI_GPU:-cuda}" == cuda ]]; then
    timeout --signal=INT 60 "$python" -m pytest -q -m gpu tests 2>&1 | tee "$out/gpu-tests.log" || status=1
fi
WRF_MI_TEST_BACKEND="${WRF_MI_GPU:-cuda}" timeout --signal=INT 110 "$python" -m pytest -q --maxfail=20 \
    -m "not gpu and not slow" tests/gaussians tests/graph tests/tracing tests/training tests/models 2>&1 |
    tee "$out/gpu-suites.log" || status=1
echo "results: $out"
exit $status
