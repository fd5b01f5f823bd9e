"""Run time on a GPU and on all cores of the same machine's CPU, and the differences of what they compute.

`wrf_mi_bench.gpu_job` measures each in a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wrf_mi.backend import BackendError, choose
from wrf_mi.core import InputError

from .bench import BenchFailed

JOB = "wrf_mi_bench.gpu_job"


def main() -> dict[str, Any]:
    """Both backends of this machine.

    Raises:
        InputError: no GPU works here.
    """
    try:
        choose("cuda")
    except BackendError as error:
        raise InputError(f"bench gpu: {error}") from None
    found = {backend: _measured(backend) for backend in ("cuda", "llvm")}
    devices = {name: one["device"] for name, one in found.items()}
    devices["llvm"] += f", {os.cpu_count()} cores"
    rows = []
    for gpu, cpu in zip(found["cuda"]["axes"], found["llvm"]["axes"], strict=True):
        for size, fast, slow in zip(gpu["sizes"], gpu["ms"], cpu["ms"], strict=False):
            row = {"what": f"{gpu['title']}, {size:,} {gpu['work']}", "value": f"{slow / fast:.2g}", "asked": ""}
            rows.append({**row, "gpu_ms": fast, "cpu_ms": slow, **devices})
    return {"rows": [*rows, *_differences()], "axes": {name: one["axes"] for name, one in found.items()}}


def _measured(backend: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "axes.json"
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
        done = subprocess.run([sys.executable, "-m", JOB, str(file), backend], env=environment)
        if done.returncode != 0:
            raise BenchFailed(f"bench gpu: its process of {backend} ended with status {done.returncode}")
        read: dict[str, Any] = json.loads(file.read_text())
        return read


def _differences() -> list[dict[str, Any]]:
    """Differences between one thread of the CPU and the GPU, as `wrf_mi_bench.elsewhere` has them."""
    from .elsewhere import BOUNDS, HEADS, Variant, computed, differences

    one, other = (computed(Variant(backend, backend=backend), small=False)[0] for backend in ("llvm", "cuda"))
    return [
        {"what": f"difference, {HEADS[name]}", "value": f"{value:.1e}", "asked": f"at most {BOUNDS[name]:g}"}
        for name, value in differences(one, other).items()
    ]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table: times on both, and how many times faster the GPU is; then the differences."""
    timed = [row for row in rows if "gpu_ms" in row]
    lines = [
        f"| what | {timed[0]['cuda']} | {timed[0]['llvm']} | times faster |",
        "| --- | --- | --- | --- |",
        *(f"| {row['what']} | {row['gpu_ms']:.3g} ms | {row['cpu_ms']:.3g} ms | **{row['value']}** |" for row in timed),
        "",
        "| between CPU and GPU | largest | bound |",
        "| --- | --- | --- |",
        *(f"| {row['what']} | **{row['value']}** | {row['asked']} |" for row in rows if "gpu_ms" not in row),
    ]
    return "\n".join(lines)
