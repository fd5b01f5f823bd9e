"""Training: time and memory to the final accuracy, and how far a step is from what the machine can do.

Each fit runs in a process of its own, with the default settings. A step is then timed with as many Gaussians as the fit
ended with, beside the machine's own best in the same run: the rate of a large matrix product, and the rate at which
memory is read and written. What a step computes and moves is counted from the shapes of its arrays.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.backend.device import to_tensor
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians.footprint import depth_order, project
from wrf_mi.gaussians.tiles import TILE_COLUMNS, TILE_ROWS, build_lists, perception_plane
from wrf_mi.parallel import run_module
from wrf_mi.runs.api import train
from wrf_mi.runs.timing import Interval, bootstrap, interleaved
from wrf_mi.synthetic import load_record
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.step import device_pose
from wrf_mi.training.trainer import Trainer, peak_memory_mb

from .bench import BenchFailed

DATA = "rfid-lab"
TITLES = {"wrf-gs+": "WRF-GS+", "wrf-gs": "WRF-GS", "factorised": "factorised", "physics": "physics"}
ASKED_S, ASKED_MB = 180, 2 * 1024
"""Of the physics model and of WRF-GS+, on two cores."""
BATCHES = (1, 4)
"""Transmitters of a timed step: the default, and a group that shares its geometry where that stands still."""
STEPS, ROUNDS = 10, 9
"""Steps of one timed call, and calls."""
PRODUCT_SIZE = 1536
STREAM_FLOATS = 1 << 26
"""An array of 256 MB, which no cache holds."""
FORWARD, BACKWARD = 28, 63
"""Operations for one pixel and one Gaussian on its tile's list, counted in `wrf_mi.gaussians.blend` (alpha blending): a
multiply-add is two, a root, an exponential or a reciprocal one."""
SHARED_FORWARD, SHARED_BACKWARD = 4, 8
"""Of these, what a further transmitter of the same geometry adds."""
QUIET = ("density.every=0", "log_every=1000000", "validate_every=1000000", "checkpoint_every=1000000")


@dataclass(frozen=True)
class Work:
    """What one step computes and moves.

    Attributes:
        network_gflop: of the networks' products, forwards and backwards.
        splat_gflop: of the pixels' walks.
        moved_gb: read and written at least: each product's operands and result, hidden layers, Adam's arrays, images.
    """

    network_gflop: float
    splat_gflop: float
    moved_gb: float

    @property
    def gflop(self) -> float:
        """All of it."""
        return self.network_gflop + self.splat_gflop


def fit(model: str) -> dict[str, Any]:
    """One fit with the default settings on the authors' split, in this process."""
    record = load_record(DATA)
    processor = time.process_time()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "run"
        train(record, folder, model)
        metrics = json.loads((folder / "metrics.json").read_text())
    return {
        "seconds": metrics["train_seconds"],
        "processor_seconds": time.process_time() - processor,
        "peak_memory_mb": peak_memory_mb(),
        "ssim": metrics["ssim"],
        "gaussians": metrics.get("gaussians"),
        "steps": metrics.get("steps"),
    }


fit_wrf_gs_plus, fit_wrf_gs, fit_factorised, fit_physics = (partial(fit, model) for model in TITLES)
FITS = dict(zip(TITLES, ("fit_wrf_gs_plus", "fit_wrf_gs", "fit_factorised", "fit_physics"), strict=True))
"""By model the function of this module that fits it in a process of its own, whose peak memory is then the fit's."""


def fit_alone(model: str) -> dict[str, Any]:
    """`fit` in a process of its own."""
    with tempfile.TemporaryDirectory() as work:
        out = Path(work) / "fit.json"
        status, said = run_module("wrf_mi_bench.check", [f"{__name__.rpartition('.')[2]}:{FITS[model]}", str(out)])
        if status != 0:
            raise BenchFailed(f"training: fitting {model} ended with status {status} {said}".rstrip())
        result: dict[str, Any] = json.loads(out.read_text())
        return result


def trainer(model: str, gaussians: int, batch: int) -> Trainer:
    """A fit of so many Gaussians and transmitters a step, all else the default, that goes on for ever."""
    record = load_record(DATA)
    own = (*QUIET, f"initial.gaussians={gaussians}", f"batch={batch}", "steps=1000000")
    return Trainer(record, make_splits(record, "official")[0], with_settings(TrainConfig(model=model), own))


def some_steps(of: Trainer, steps: int = STEPS) -> Callable[[], None]:
    """A call that takes a few more steps."""

    def call() -> None:
        goal = of.state.step + steps
        of.run(stop=lambda: of.state.step >= goal)

    return call


def work_of(of: Trainer) -> Work:
    """What a step of a fit computes and moves, from the shapes of its arrays."""
    shapes = {name: tuple(value.shape) for name, value in of.state.mean.items()}
    n, batch = shapes["position"][1], of.config.batch
    height, width = of.graph.form.size
    pixels = height * width
    flop, moved = 0.0, 0.0
    for name, shape in shapes.items():
        if "." not in name or name.endswith(".bias"):
            continue
        columns = _columns(name, n, batch)
        # Backwards once for the weights and, where it depends on parameters, once for the input.
        encoded = name.endswith((".position", ".transmitter"))
        products = 2 if encoded else 3
        outputs, inputs = shape
        flop += products * 2 * outputs * inputs * columns
        # Operands and result of each, and the layer's bias and rectifier, forwards and backwards.
        moved += 4 * (products * (outputs * inputs + inputs * columns + outputs * columns) + 4 * outputs * columns)
    if of.config.model == "factorised":
        terms = shapes["signal"][0]
        flop += 3 * 2 * batch * terms * 2 * n
        moved += 4 * 3 * (batch * terms + 2 * terms * n + 2 * batch * n)
    visits, sets = _visits(of), 1 if of.field.static_geometry else batch
    splat = visits * (sets * (FORWARD + BACKWARD) + (batch - sets) * (SHARED_FORWARD + SHARED_BACKWARD))
    count = sum(int(np.prod(shape)) for shape in shapes.values())
    # Adam reads value, gradient and two moments, the mean is read; all but the gradient are written again.
    moved += 4 * 9 * count
    # Field, its gradient, grey, truth, and four arrays of the similarity's windows twice.
    moved += 4 * batch * pixels * 20
    return Work(flop / 1e9, splat / 1e9, moved / 1e9)


def _columns(name: str, n: int, batch: int) -> int:
    """For how many columns a layer's matrix is used: Gaussians, transmitters or pairs of them."""
    if name.startswith("terms.") or name.endswith(".transmitter"):
        return batch
    if name.startswith("attenuation.") or name.endswith((".position", ".feature")):
        return n
    return batch * n


def _visits(of: Trainer) -> float:
    """Pixels times Gaussians on their tiles' lists, for one transmitter."""
    params = {name: dr.detach(value) for name, value in of.state.mean.items()}
    with dr.suspend_grad():
        gaussians = of.field.gaussians(params, to_tensor(of.record.tx_pos_m[:1].T))
        footprints = project(gaussians, device_pose(of.record.receivers[0]))
        order = depth_order(footprints.depth, gaussians.position)
        lists = build_lists(footprints, order, perception_plane(*of.graph.form.size, mi.Float), 1)
    return float(lists.length.numpy().sum()) * TILE_ROWS * TILE_COLUMNS


def product_call(size: int = PRODUCT_SIZE) -> Callable[[], Any]:
    """A large matrix product, the same code as a network's layers: 2 size^3 operations."""
    rng = np.random.default_rng(0)
    a, b = (to_tensor(rng.standard_normal((size, size))) for _ in range(2))
    return lambda: a @ b


def stream_call(floats: int = STREAM_FLOATS) -> Callable[[], Any]:
    """Read an array and write another: 8 bytes a number."""
    values = dr.full(mi.Float, 1, floats)
    dr.make_opaque(values)
    return lambda: values * 0.5


KINDS = {"BatchedGemm": "products of networks"}
WALKS = "two longest kernels, the walks of splatting"


def shares(call: Callable[[], Any]) -> dict[str, float]:
    """What the time of a call goes to, shares of all, by Dr.Jit's kernel history."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        call()  # recorded anew, as recordings belong to such flags
        dr.sync_thread()
        dr.kernel_history_clear()
        start = time.perf_counter()
        call()
        dr.sync_thread()
        whole = 1e3 * (time.perf_counter() - start)
        history = dr.kernel_history()
    by_kind: dict[str, float] = {}
    by_kernel: dict[str, float] = {}
    for entry in history:
        kind, spent = str(entry["type"]).rpartition(".")[2], entry["execution_time"]
        by_kind[kind] = by_kind.get(kind, 0.0) + spent
        if kind == "JIT":
            key = str(entry["hash"])
            by_kernel[key] = by_kernel.get(key, 0.0) + spent
    walks = sum(sorted(by_kernel.values())[-2:])
    parts = {
        KINDS["BatchedGemm"]: by_kind.get("BatchedGemm", 0.0),
        WALKS: walks,
        "other kernels": sum(by_kernel.values()) - walks,
        "sorts, sums and copies": sum(by_kind.values()) - by_kind.get("BatchedGemm", 0.0) - by_kind.get("JIT", 0.0),
    }
    parts["launching them, Python"] = max(whole - sum(parts.values()), 0.0)
    return {name: value / whole for name, value in parts.items()}


def main() -> dict[str, Any]:
    """Fits of all models, and their steps beside the machine's best."""
    load_record(DATA)  # what is missing is said first
    fits = {model: fit_alone(model) for model in TITLES}
    trainers = {
        f"{TITLES[model]}, {batch}": trainer(model, fits[model]["gaussians"], batch)
        for model in TITLES
        if model != "physics"
        for batch in BATCHES
    }
    steps = {name: some_steps(of) for name, of in trainers.items()}
    calls: dict[str, Callable[[], Any]] = {**steps, "product": product_call(), "stream": stream_call()}
    times = interleaved(calls, ROUNDS)
    peak = 2e-6 * PRODUCT_SIZE**3 / bootstrap(times["product"], np.min).value
    stream = 8e-6 * STREAM_FLOATS / bootstrap(times["stream"], np.min).value
    found = {
        name: {
            "ms": asdict(bootstrap(times[name] / STEPS)),
            "least_ms": float(times[name].min() / STEPS),
            "work": asdict(work_of(of)),
            "shares": shares(steps[name]),
        }
        for name, of in trainers.items()
    }
    machine = {"product_gflop_s": peak, "stream_gb_s": stream}
    return {"rows": rows(fits, found, machine), "fits": fits, "steps": found, "machine": machine}


def rows(
    fits: Mapping[str, Mapping[str, Any]], steps: Mapping[str, Mapping[str, Any]], machine: Mapping[str, float]
) -> list[dict[str, str]]:
    """Lines of the table."""
    peak, stream = machine["product_gflop_s"], machine["stream_gb_s"]
    lines = [_line("the machine's best", f"{peak:.0f} GFLOP/s in a product, {stream:.1f} GB/s read and written")]
    for model, one in fits.items():
        said = (
            f"{one['seconds']:.0f} s, of processors {one['processor_seconds']:.0f} s; {one['peak_memory_mb']:.0f} MB; "
            f"median SSIM {one['ssim']['median']:.3f}"
        )
        asked = f"{ASKED_S} s, {ASKED_MB} MB" if model in ("wrf-gs+", "physics") else ""
        lines.append(_line(f"{TITLES[model]}, fit to its final accuracy", said, asked))
    for name, one in steps.items():
        title, _, batch = name.rpartition(", ")
        plural = "s" if int(batch) > 1 else ""
        where = f"{title}, a step of {batch} transmitter{plural}"
        work = Work(**one["work"])
        # Both at once would be the best: arithmetic hides what is moved, or the other way round.
        limit_ms = 1e3 * max(work.gflop / peak, work.moved_gb / stream)
        ms = Interval(**one["ms"])
        lines.append(
            _line(
                where,
                f"{ms} ms; {work.network_gflop:.3f} GFLOP in networks, {work.splat_gflop:.3f} in splatting, "
                f"{1e3 * work.moved_gb:.0f} MB moved: at least {limit_ms:.2f} ms, {100 * limit_ms / ms.value:.0f} %",
            )
        )
        lines.append(_line(f"{where}: where its time goes", _shares(one["shares"].items())))
    return lines


def _shares(parts: Iterable[tuple[str, float]]) -> str:
    return ", ".join(f"{name} {100 * share:.0f} %" for name, share in parts)


def _line(what: str, value: str, asked: str = "") -> dict[str, str]:
    return {"what": what, "value": value, "asked": asked}
