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
device="${WRF_MI_GPU:-cuda}"
within() {  # within SECONDS COMMAND...: a rehearsal on a slower machine has all the time that it takes
    if [[ "$device" == cuda ]]; then timeout --signal=INT "$@"; else "${@:2}"; fi
}
status=0
# Benchmarks first, as they are the figures that only such a machine gives; each part stops at its share of the time.
within 300 "$python" -m wrf_mi.apps.commands bench gpu --out "$out" --runs "$out/gpu-runs" 2>&1 | tee "$out/gpu.log" || status=1
tests=(tests/gaussians tests/graph tests/tracing tests/training tests/models)
if [[ "$device" == cuda ]]; then
    within 60 "$python" -m pytest -q -m gpu tests 2>&1 | tee "$out/gpu-tests.log" || status=1
fi
# Kernels of a GPU are compiled by processors, on which the workers share it.
WRF_MI_TEST_BACKEND="$device" within 110 "$python" -m pytest -q --maxfail=20 -n "${WORKERS:-8}" --dist loadfile \
    -m "not gpu and not slow" "${tests[@]}" 2>&1 | tee "$out/gpu-suites.log" || status=1
echo "results: $out"
exit $status
