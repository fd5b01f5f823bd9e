"""Training: time and memory of default fits, and times of steps compared with the machine's limits.

Each fit runs in a subprocess. Steps have as many Gaussians as the fit ended with. Limits are the measured rates of a
large matrix product and of memory; operations and bytes of a step are counted from the shapes of its arrays.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil

from wrf_mi.backend.device import to_tensor
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians.footprint import depth_order, project
from wrf_mi.gaussians.tiles import TILE_COLUMNS, TILE_ROWS, build_lists, perception_plane
from wrf_mi.runs.folder import METRICS
from wrf_mi.synthetic import load_record
from wrf_mi.tasks.scores import Interval, bootstrap
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.step import device_pose
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
PRODUCT_SIZE = 1536
STREAM_FLOATS = 1 << 26  # an array of 256 MB, which no cache holds
FORWARD, BACKWARD = 28, 63
"""Operations of a pixel and a Gaussian on its tile's list, counted in `wrf_mi.gaussians.blend` (alpha blending): a
multiply-add is two, a root, an exponential or a reciprocal one."""
SHARED_FORWARD, SHARED_BACKWARD = 4, 8  # operations of a further transmitter with the same geometry
QUIET = ("density.every=0", "log_every=1000000", "validate_every=1000000", "checkpoint_every=1000000")


@dataclass(frozen=True)
class Work:
    """Operations of networks and of splatting, forwards and backwards, and least bytes moved, of a step."""

    network_gflop: float
    splat_gflop: float
    moved_gb: float


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


def trainer(model: str, gaussians: int, batch: int) -> Trainer:
    """Trainer with a number of Gaussians and transmitters a step, otherwise default, without end."""
    record = load_record(DATA)
    settings = (*QUIET, f"initial.gaussians={gaussians}", f"batch={batch}", "steps=1000000")
    return Trainer(record, make_splits(record, "official")[0], with_settings(TrainConfig(model=model), settings))


def some_steps(of: Trainer, steps: int = STEPS) -> Callable[[], None]:
    """Call that takes a number of further steps."""

    def call() -> None:
        goal = of.state.step + steps
        of.run(stop=lambda: of.state.step >= goal)

    return call


def work_of(of: Trainer) -> Work:
    """Operations and bytes of a step, from the shapes of its arrays."""
    shapes = {name: tuple(value.shape) for name, value in of.state.mean.items()}
    n, batch, pixels = shapes["position"][1], of.config.batch, int(np.prod(of.graph.form.size))
    flop, moved = 0.0, 0.0
    for name, shape in shapes.items():
        if "." not in name or name.endswith(".bias"):
            continue
        columns = _columns(name, n, batch)
        # Backwards once for the weights and, where it depends on parameters, once for the input.
        products = 2 if name.endswith((".position", ".transmitter")) else 3
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
    """Number of columns of a layer's input: Gaussians, transmitters or pairs of them."""
    if name.startswith("terms.") or name.endswith(".transmitter"):
        return batch
    if name.startswith("attenuation.") or name.endswith((".position", ".feature")):
        return n
    return batch * n


def _visits(of: Trainer) -> float:
    """Number of pairs of a pixel and a Gaussian on its tile's list, for one transmitter."""
    params = {name: dr.detach(value) for name, value in of.state.mean.items()}
    with dr.suspend_grad():
        gaussians = of.field.gaussians(params, to_tensor(of.plan.record.tx_pos_m[:1].T))
        footprints = project(gaussians, device_pose(of.plan.record.receivers[0]))
        order = depth_order(footprints.depth, gaussians.position)
        lists = build_lists(footprints, order, perception_plane(*of.graph.form.size, mi.Float), 1)
    return float(lists.length.numpy().sum()) * TILE_ROWS * TILE_COLUMNS


def product_call(size: int = PRODUCT_SIZE) -> Callable[[], Any]:
    """Matrix product by the code of a network's layers: 2 size^3 operations."""
    rng = np.random.default_rng(0)
    a, b = (to_tensor(rng.standard_normal((size, size))) for _ in range(2))
    return lambda: a @ b


def stream_call(floats: int = STREAM_FLOATS) -> Callable[[], Any]:
    """Reading of an array and writing of another: 8 bytes a number."""
    values = dr.full(mi.Float, 1, floats)
    dr.make_opaque(values)
    return lambda: values * 0.5


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
    """Fits of all models, and their steps beside the machine's best."""
    load_record(DATA)  # missing data are reported first
    fits = {model: fit(model) for model in TITLES}
    trainers = {
        f"{TITLES[model]}, {batch}": trainer(model, fits[model]["gaussians"], batch)
        for model in TITLES
        if model != "kriging"
        for batch in BATCHES
    }
    steps = {name: some_steps(of) for name, of in trainers.items()}
    calls: dict[str, Callable[[], Any]] = {**steps, "product": product_call(), "stream": stream_call()}
    times = interleaved(calls, ROUNDS)
    peak = 2e-6 * PRODUCT_SIZE**3 / bootstrap(times["product"], statistic=np.min).value
    stream = 8e-6 * STREAM_FLOATS / bootstrap(times["stream"], statistic=np.min).value
    of_steps: dict[str, dict[str, Any]] = {}
    for name, of in trainers.items():
        of_steps[name] = {"ms": asdict(bootstrap(times[name] / STEPS)), "least_ms": float(times[name].min() / STEPS)}
        of_steps[name] |= {"work": asdict(work_of(of)), "shares": shares(steps[name])}
    machine = {"product_gflop_s": peak, "stream_gb_s": stream}
    return {"rows": rows(fits, of_steps, machine), "fits": fits, "steps": of_steps, "machine": machine}


def rows(
    fits: Mapping[str, Mapping[str, Any]], steps: Mapping[str, Mapping[str, Any]], machine: Mapping[str, float]
) -> list[dict[str, str]]:
    peak, stream = machine["product_gflop_s"], machine["stream_gb_s"]
    best = f"{peak:.0f} GFLOP/s in a product, {stream:.1f} GB/s read and written"
    lines = [line("the machine's best", best)]
    for model, run in fits.items():
        value = f"{run['seconds']:.0f} s, of processors {run['processor_seconds']:.0f} s; "
        value += f"{run['peak_memory_mb']:.0f} MB; median SSIM {run['ssim']['median']:.3f}"
        asked = f"{ASKED_S} s, {ASKED_MB} MB" if model in ("wrf-gs+", "kriging") else ""
        lines.append(line(f"{TITLES[model]}, fit to its final accuracy", value, asked))
    for name, run in steps.items():
        title, _, batch = name.rpartition(", ")
        where = f"{title}, a step of {batch} transmitter{'s' if int(batch) > 1 else ''}"
        work, ms = Work(**run["work"]), Interval(**run["ms"])
        # At best arithmetic and transfers overlap.
        limit_ms = 1e3 * max((work.network_gflop + work.splat_gflop) / peak, work.moved_gb / stream)
        value = f"{ms} ms; {work.network_gflop:.3f} GFLOP in networks, {work.splat_gflop:.3f} in splatting, "
        value += f"{1e3 * work.moved_gb:.0f} MB moved: at least {limit_ms:.2f} ms, {100 * limit_ms / ms.value:.0f} %"
        lines.append(line(where, value))
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in run["shares"].items())
        lines.append(line(f"{where}: where its time goes", parts))
    return lines
