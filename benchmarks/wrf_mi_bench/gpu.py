"""Run time on a GPU and on all cores of the same machine's CPU; `wrf_mi_bench.elsewhere` has the differences.

`wrf_mi_bench.gpu_job` measures each in a process of its own.
"""

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wrf_mi.backend import BackendError, choose
from wrf_mi.core import InputError
from wrf_mi.parallel import run_module
from wrf_mi.runs.sweep import markdown_table

from .bench import BenchFailed

JOB = "wrf_mi_bench.gpu_job"


def main() -> dict[str, Any]:
    """Both backends of this machine; `InputError` where no GPU works."""
    try:
        choose("cuda")
    except BackendError as error:
        raise InputError(f"bench gpu: {error}") from None
    measured = {backend: _measured(backend) for backend in ("cuda", "llvm")}
    devices = {name: of_backend["device"] for name, of_backend in measured.items()}
    devices["llvm"] += f", {os.cpu_count()} cores"
    rows = []
    for gpu, cpu in zip(measured["cuda"]["axes"], measured["llvm"]["axes"], strict=True):
        for size, fast, slow in zip(gpu["sizes"], gpu["ms"], cpu["ms"], strict=False):
            row = {"what": f"{gpu['title']}, {size:,} {gpu['work']}", "value": f"{slow / fast:.2g}", "asked": ""}
            rows.append({**row, "gpu_ms": fast, "cpu_ms": slow, **devices})
    return {"rows": rows, "axes": {name: of_backend["axes"] for name, of_backend in measured.items()}}


def _measured(backend: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "axes.json"
        status, message = run_module(JOB, [str(file), backend])
        if status != 0:
            raise BenchFailed(f"bench gpu: its process of {backend} ended with status {status} {message}".rstrip())
        read: dict[str, Any] = json.loads(file.read_text())
        return read


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table: times on both, and how many times faster the GPU is."""
    times = ((f"{row['gpu_ms']:.3g} ms", f"{row['cpu_ms']:.3g} ms") for row in rows)
    lines = ([row["what"], *of_row, f"**{row['value']}**"] for row, of_row in zip(rows, times, strict=True))
    return markdown_table(["what", rows[0]["cuda"], rows[0]["llvm"], "times faster"], lines)
