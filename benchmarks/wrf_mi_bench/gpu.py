"""Run time on a GPU beside two and all cores of the same machine's CPU; `wrf_mi_bench.elsewhere` has the differences.

`wrf_mi_bench.gpu_job` measures each in a process of its own. Fits to their final scores run on the GPU alone, since
those of the CPU take many minutes; their scores are to be compared with the stored ones of `waits` and `training`.
"""

import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wrf_mi.backend import BackendError, choose
from wrf_mi.core import InputError
from wrf_mi.parallel import run_module
from wrf_mi.runs.folder import METRICS
from wrf_mi.runs.sweep import markdown_table
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.stored import SCAN

from .bench import RFID, BenchFailed
from .comparison import say

JOB = "wrf_mi_bench.gpu_job"
GPU, TWO, ALL = "GPU", "2 cores", "all cores"
DEVICE = os.environ.get("WRF_MI_GPU", "cuda")  # ``llvm`` rehearses the measurement without a GPU
BACKENDS = {GPU: (DEVICE, 0), TWO: ("llvm", 2), ALL: ("llvm", 0)}
"""Backend and number of threads, 0 for all, by column."""
FITS: Mapping[str, tuple[str, ...]] = {
    "WRF-GS+, rfid-lab": ("train", RFID, "--model", "wrf-gs+"),
    "WRF-GS, rfid-lab": ("train", RFID, "--model", "wrf-gs"),
    "factorised, rfid-lab": ("train", RFID, "--model", "factorised"),
    "joint fit, laboratory": ("train", "laboratory", "--model", "wrf-gs+", "--scene", "SCENE"),
    "correct, laboratory": ("correct", "laboratory", "--scene", "SCENE"),
    "hybrid, laboratory": ("train", "laboratory", "--scene", "SCENE"),
}
ASKED = {
    "WRF-GS+, rfid-lab": "0.970 in 20 s",
    "joint fit, laboratory": "15 s",
    "splatting, 1,000,000 Gaussians": "10 ms",
    "predictions of factorised, 4096 at once": "100,000 a second",
    "predictions of joint, 256 at once": "1,000 a second",
}
"""Figures asked of an H100 or H200."""


def main() -> dict[str, Any]:
    """All backends of this machine; `InputError` where no GPU works."""
    try:
        choose(DEVICE)
    except BackendError as error:
        raise InputError(f"bench gpu: {error}") from None
    rows = fits()
    measured = {name: _measured(*BACKENDS[name]) for name in BACKENDS}
    devices = {GPU: measured[GPU]["device"], TWO: f"{measured[TWO]['device']}, 2 cores"}
    devices[ALL] = f"{measured[ALL]['device']}, {os.cpu_count()} cores"
    for axes in zip(*(measured[name]["axes"] for name in BACKENDS), strict=True):
        for at, size in enumerate(axes[0]["sizes"]):
            values = {
                name: f"{axis['ms'][at]:.3g} ms"
                for name, axis in zip(BACKENDS, axes, strict=True)
                if at < len(axis["ms"])
            }
            rows.append(_row(f"{axes[0]['title']}, {size:,} {axes[0]['work']}", values))
    for model, sizes in measured[GPU]["predictions"].items():
        for size in sizes:
            rates = {name: f"{measured[name]['predictions'][model][size]:,.0f} a second" for name in BACKENDS}
            rows.append(_row(f"predictions of {model}, {size} at once", rates))
    for title in measured[GPU]["kernels"]:
        of = {name: measured[name]["kernels"][title] for name in BACKENDS}
        text = {name: f"{k['launches']} launches, {k['ms']:.2g} ms, idle {k['idle']:.0%}" for name, k in of.items()}
        rows.append(_row(f"a step of {title}", text))
    return {"rows": rows, "devices": devices}


def _row(what: str, values: Mapping[str, str]) -> dict[str, Any]:
    return {"what": what, "value": values[GPU], "asked": ASKED.get(what, ""), **values}


def fits() -> list[dict[str, Any]]:
    """Rows of fits to their final scores on this process's backend, each in a process."""
    rows = []
    with tempfile.TemporaryDirectory() as work:
        scene = str(Path(work) / "scene")
        _run("mesh", str(Path(load_record("laboratory").source) / SCAN), "--out", scene)
        for number, (what, arguments) in enumerate(FITS.items()):
            out = Path(work) / str(number)
            start = time.perf_counter()
            _run(*(scene if word == "SCENE" else word for word in arguments), "--out", str(out))
            text = f"{time.perf_counter() - start:.1f} s"
            if (out / METRICS).exists():
                metrics = json.loads((out / METRICS).read_text())
                text = f"{metrics['train_seconds']:.1f} s to median SSIM {metrics['ssim']['median']:.4f}"
            say("gpu", f"{what}: {text}")
            rows.append(_row(what, {GPU: text}))
    return rows


def _run(*arguments: str) -> None:
    status, message = run_module("wrf_mi.cli", arguments)
    if status != 0:
        raise BenchFailed(f"bench gpu: `wrf-mi {' '.join(arguments)}` ended with status {status} {message}".rstrip())


def _measured(backend: str, threads: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "axes.json"
        status, message = run_module(JOB, [str(file), backend, str(threads)])
        if status != 0:
            raise BenchFailed(f"bench gpu: its process of {backend} ended with status {status} {message}".rstrip())
        read: dict[str, Any] = json.loads(file.read_text())
        return read


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table: a column for the GPU, two cores and all cores."""
    lines = ([row["what"], *(row.get(name, "") for name in BACKENDS), row["asked"]] for row in rows)
    return markdown_table(["what", *BACKENDS, "asked of the GPU"], lines)
