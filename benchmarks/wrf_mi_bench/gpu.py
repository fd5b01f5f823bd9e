"""Run time on a GPU beside two and all cores of the same machine's CPU; `wrf_mi_bench.elsewhere` has the differences.

`wrf_mi_bench.gpu_job` measures each in a process of its own. Fits to their final scores run on the GPU alone, since
those of the CPU take many minutes; their scores are to be compared with the stored ones of `waits`.

A machine with a GPU may be there for some minutes only: the GPU's figures are measured first, the CPU's while
`ENOUGH_S` have not passed, and each part is kept by the content of the packages' files, so that a further call
measures what is missing.
"""

import json
import os
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi.backend import BackendError, choose
from wrf_mi.core import InputError
from wrf_mi.parallel import run_module
from wrf_mi.runs.folder import METRICS
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.stored import SCAN

from .bench import RFID, BenchFailed
from .comparison import command, kept_work, say
from .declared import lined
from .sources import fit_key, source_files

JOB = "wrf_mi_bench.gpu_job"
GPU, TWO, ALL = "GPU", "2 cores", "all cores"
DEVICE = os.environ.get("WRF_MI_GPU", "cuda")  # ``llvm`` rehearses the measurement without a GPU
RUNS = Path("runs/bench/gpu")
ENOUGH_S = 240  # seconds after which no further backend is measured
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
FEW = {"train": ("--set", "steps=200"), "hybrid": ("--preset", "fast"), "correct": ("--n-train", "40")}
"""Options of fits in a rehearsal, whose times and scores mean nothing."""
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
    start, place = time.perf_counter(), RUNS / DEVICE / fit_key(source_files())
    rows, measured = fits(place), dict[str, dict[str, Any]]()
    for name, (backend, threads) in BACKENDS.items():
        if name != GPU and DEVICE == "cuda" and time.perf_counter() - start > ENOUGH_S:
            say("gpu", f"{name}: left out after {ENOUGH_S} s; call it again")
            continue
        say("gpu", name)
        measured[name] = kept_work(place, name, partial(_measured, backend, threads))
    devices = {name: f"{of['device']}, {BACKENDS[name][1] or os.cpu_count()} cores" for name, of in measured.items()}
    for axes in zip(*(of["axes"] for of in measured.values()), strict=True):
        for at, size in enumerate(axes[0]["sizes"]):
            values = {
                name: f"{axis['ms'][at]:.3g} ms"
                for name, axis in zip(measured, axes, strict=True)
                if at < len(axis["ms"])
            }
            rows.append(_row(f"{axes[0]['title']}, {size:,} {axes[0]['work']}", values))
    for model, sizes in measured[GPU]["predictions"].items():
        for size in sizes:
            rates = {name: f"{measured[name]['predictions'][model][size]:,.0f} a second" for name in measured}
            rows.append(_row(f"predictions of {model}, {size} at once", rates))
    for title in measured[GPU]["kernels"]:
        of = {name: measured[name]["kernels"][title] for name in measured}
        text = {name: f"{k['launches']} launches, {k['ms']:.2g} ms, idle {k['idle']:.0%}" for name, k in of.items()}
        rows.append(_row(f"a step of {title}", text))
    return {"rows": rows, "devices": devices}


def _row(what: str, values: Mapping[str, str]) -> dict[str, Any]:
    return {"what": what, "value": values[GPU], "asked": ASKED.get(what, ""), **values}


def fits(place: Path) -> list[dict[str, Any]]:
    """Rows of fits to their final scores on this process's backend, each in a process."""
    rows = []
    for what in FITS:
        text = kept_work(place, what.replace(", ", "-"), partial(_fit, what))
        say("gpu", f"{what}: {text}")
        rows.append(_row(what, {GPU: text}))
    return rows


def _fit(what: str, folder: Path) -> str:
    """Time and score of a fit."""
    words, scene, out = FITS[what], str(folder / "scene"), folder / "run"
    if "SCENE" in words:
        command("mesh", Path(load_record("laboratory").source) / SCAN, "--out", scene)
    few = () if DEVICE == "cuda" else FEW["hybrid" if what.startswith("hybrid") else words[0]]
    seconds = command(*(scene if word == "SCENE" else word for word in words), *few, "--out", out)
    text = f"{seconds:.1f} s"
    if (out / METRICS).exists():
        metrics = json.loads((out / METRICS).read_text())
        text = f"{metrics['train_seconds']:.1f} s to median SSIM {metrics['ssim']['median']:.4f}"
    return text


def _measured(backend: str, threads: int, folder: Path) -> dict[str, Any]:
    folder.mkdir(parents=True)
    file = folder / "axes.json"
    status, message = run_module(JOB, [str(file), backend, str(threads)])
    if status != 0:
        raise BenchFailed(f"bench gpu: its process of {backend} ended with status {status} {message}".rstrip())
    return dict(json.loads(file.read_text()))


table = lined(
    f"| what | {' | '.join(BACKENDS)} | asked of the GPU |",
    f"| {{what}} | {' | '.join(f'{{{name}}}' for name in BACKENDS)} | {{asked}} |",
    lambda row: {**dict.fromkeys(BACKENDS, ""), **row},
)
"""A column for the GPU, two cores and all cores."""
