"""Training: time and memory of default fits, and times of steps with the kinds of work that they consist of.

Each fit runs in a subprocess. Steps have as many Gaussians as the fit ended with.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import psutil

from wrf_mi.core import Record
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.runs.folder import METRICS
from wrf_mi.synthetic import load_record
from wrf_mi.tasks.scores import Interval, bootstrap
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.trainer import Trainer

from .bench import run_command
from .comparison import line
from .timing import history_of, interleaved

DATA = "rfid-lab"
TITLES = {"wrf-gs+": "WRF-GS+", "wrf-gs": "WRF-GS", "factorised": "factorised", "kriging": "kriging"}
ASKED_S, ASKED_MB = 180, 2 * 1024  # bounds on time and memory of kriging and of WRF-GS+, on two cores
BATCHES = (1, 4)
"""Transmitters of a timed step: the default, and a group that shares its geometry where that stands still."""
STEPS, ROUNDS = 10, 9  # steps of one timed call, and calls
QUIET = ("density.every=0", "log_every=1000000", "validate_every=1000000", "checkpoint_every=1000000")


def fit(model: str) -> dict[str, Any]:
    """Time, memory and accuracy of a fit with default settings on the authors' split, in a subprocess."""

    def processor_s() -> float:
        times = psutil.Process().cpu_times()  # of all finished subprocesses
        return float(times.children_user + times.children_system)

    before = processor_s()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "run"
        run_command(("train", DATA, "--model", model), folder, "bench training: ")
        metrics = json.loads((folder / METRICS).read_text())
    figures = {key: metrics.get(key) for key in ("peak_memory_mb", "ssim", "gaussians", "steps")}
    return {"seconds": metrics["train_seconds"], "processor_seconds": processor_s() - before, **figures}


def trainer(record: Record, model: str, *options: str) -> Trainer:
    """Trainer with further settings, otherwise default, without end, on the official split or else a random one."""
    settings = with_settings(TrainConfig(model=model), (*QUIET, "steps=1000000", *options))
    return Trainer(record, make_splits(record, "official" if record.official else "random")[0], settings)


def some_steps(of: Trainer, steps: int = STEPS) -> Callable[[], None]:
    """Call that takes a number of further steps."""

    def call() -> None:
        goal = of.state.step + steps
        of.run(stop=lambda: of.state.step >= goal)

    return call


PRODUCTS, WALKS = "products of networks", "two longest kernels, the walks of splatting"


def shares(call: Callable[[], Any]) -> dict[str, float]:
    """Shares of the time of a call by kind of work, from Dr.Jit's kernel history."""
    total_ms, history = history_of(call)
    by_kind: Counter[str] = Counter()
    by_kernel: Counter[str] = Counter()
    for entry in history:
        kind = str(entry["type"]).rpartition(".")[2]
        by_kind[kind] += entry["execution_time"]
        if kind == "JIT":
            by_kernel[str(entry["hash"])] += entry["execution_time"]
    walks = sum(time for _, time in by_kernel.most_common(2))
    products, kernels = by_kind.pop("BatchedGemm", 0.0), by_kind.pop("JIT", 0.0)
    parts = {PRODUCTS: products, WALKS: walks, "other kernels": kernels - walks}
    parts["sorts, sums and copies"] = sum(by_kind.values())
    parts["launching them, Python"] = max(total_ms - sum(parts.values()), 0.0)
    return {name: value / total_ms for name, value in parts.items()}


def main() -> dict[str, Any]:
    """Fits of all models, and times of their steps."""
    record = load_record(DATA)  # missing data are reported first
    fits = {model: fit(model) for model in TITLES}
    trainers = {
        f"{TITLES[model]}, {batch}": trainer(
            record, model, f"initial.gaussians={fits[model]['gaussians']}", f"batch={batch}"
        )
        for model in TITLES
        if model != "kriging"
        for batch in BATCHES
    }
    steps = {name: some_steps(of) for name, of in trainers.items()}
    times = interleaved(steps, ROUNDS)
    of_steps = {
        name: {"ms": asdict(bootstrap(times[name] / STEPS)), "shares": shares(call)} for name, call in steps.items()
    }
    return {"rows": rows(fits, of_steps), "fits": fits, "steps": of_steps}


def rows(fits: Mapping[str, Mapping[str, Any]], steps: Mapping[str, Mapping[str, Any]]) -> list[dict[str, str]]:
    lines = []
    for model, run in fits.items():
        value = f"{run['seconds']:.0f} s, of processors {run['processor_seconds']:.0f} s; "
        value += f"{run['peak_memory_mb']:.0f} MB; median SSIM {run['ssim']['median']:.3f}"
        asked = f"{ASKED_S} s, {ASKED_MB} MB" if model in ("wrf-gs+", "kriging") else ""
        lines.append(line(f"{TITLES[model]}, fit to its final accuracy", value, asked))
    for name, run in steps.items():
        title, _, batch = name.rpartition(", ")
        where = f"{title}, a step of {batch} transmitter{'s' if int(batch) > 1 else ''}"
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in run["shares"].items())
        lines += [line(where, f"{Interval(**run['ms'])} ms"), line(f"{where}: where its time goes", parts)]
    return lines
