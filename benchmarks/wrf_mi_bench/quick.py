"""Quick benchmark: ratios of the times of interleaved pairs of calls, compared with stored ratios.

Ratios depend less on the machine and its load than times. On a CPU they are ratios of processor times on one thread,
as those of elapsed times on two threads varied nine times more. A larger ratio is worse. `wrf-mi bench --quick` fails
where the whole 95 % interval of a ratio lies above `WORSE` times the stored one.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from threadpoolctl import threadpool_limits

from wrf_mi.backend import init
from wrf_mi.backend.device import Recorded, on_device, to_tensor
from wrf_mi.core import InputError, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.files import one_line, write_atomically
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.graph import Batch
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.tasks.scores import Interval
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.training.config import TrainConfig, calibration_config
from wrf_mi.training.step import TrainingData, device_pose
from wrf_mi.training.trainer import Trainer

from .bench import BenchFailed, provenance
from .declared import lined
from .timing import Call, Within, interleaved, ratio
from .traced import StockRenderer, rgb_variant
from .workloads import HEIGHT, WIDTH, field, integrator, record, splatting, tracer

FILE = "quick.json"
WORSE = 2.0  # allowed ratio of a measured to a stored ratio; machines and their load change ratios by less
REPEATS, MOST_S = 15, 5.0  # rounds of a pair, and seconds after which no further round begins
OPTIONS = TraceOptions(transmission=False, rays=1 << 14)
ONLY_STEPS = ("log_every=100000", "validate_every=100000", "density.every=0", "holdout_steps_fraction=0")
"""Settings of a fit of nothing but steps."""

STEPS = 25  # steps of a call, where the end of a run of one step would count


@dataclass(frozen=True)
class Pair:
    """Two calls whose times are compared: name in the stored file, title in the table, and maker of both calls."""

    name: str
    title: str
    make: Callable[[], tuple[Call, Call]]


def _evaluated(way: Callable[..., Call], anew: bool) -> tuple[Call, Call]:
    gaussians, receiver = field(500, 5.0, opacity=0.3)
    stock = StockRenderer(receiver, HEIGHT, WIDTH)
    stock.field(gaussians)
    return way(gaussians, receiver), Within(partial(stock.field, gaussians) if anew else stock.render, rgb_variant)


def endless_trainer(record: Record, model: str = "wrf-gs+", *options: str) -> Trainer:
    """Trainer of nothing but steps on a random split."""
    config = with_settings(TrainConfig(model=model), ["steps=100000", *ONLY_STEPS, *options])
    return Trainer(record, make_splits(record, "random")[0], config)


def _training() -> tuple[Call, Call]:
    frozen, fresh = (endless_trainer(record(20)) for _ in range(2))

    def ours() -> None:
        frozen.run(stop=lambda: True)  # asked after each step: one is taken

    def theirs() -> None:
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            fresh.run(stop=lambda: True)

    return ours, theirs


def _batch() -> tuple[Call, Call]:
    number, rng = 16, np.random.default_rng(0)
    trainer = Trainer(record(number), make_splits(record(number), "random")[0], TrainConfig())
    params = {name: to_tensor(values) for name, values in trainer.state.params().items()}
    pose, plane = device_pose(RECEIVER), perception_plane(HEIGHT, WIDTH, mi.Float)
    positions = transmitter_path(number)[rng.permutation(number)]
    dr.eval(params)

    def spectra(params: Any, tx_pos: Any, pose: Any, plane: Any) -> Any:
        return trainer.graph.observation(0, None)(params, Batch(tx_pos, None, None, pose, plane))

    together, alone = Recorded(spectra), Recorded(spectra)

    def ours() -> Any:
        return together(params, to_tensor(positions.T), pose, plane)

    def theirs() -> Any:
        return [dr.eval(alone(params, to_tensor(position[:, None]), pose, plane)) for position in positions]

    return ours, theirs


def _new_rays() -> Iterator[TraceOptions]:
    """Options whose rays no call has shot yet: what rays found is kept in the process."""
    return (replace(OPTIONS, seed=seed) for seed in count(OPTIONS.seed + 1))


def _kept_rays() -> tuple[Call, Call]:
    laboratory, tx_pos_m, new = tracer(OPTIONS), transmitter_path(1), _new_rays()

    def theirs() -> Any:
        paths = trace_paths(laboratory.scene, tx_pos_m, laboratory.instrument.receivers, next(new)).paths
        return laboratory.instrument.observe(paths)

    return lambda: laboratory(tx_pos_m), theirs


def _gains() -> tuple[Call, Call]:
    scene, tx = open_scene("laboratory", FREQUENCY_HZ), transmitter_path(64)
    traced, new = trace_paths(scene, tx, RECEIVER, OPTIONS), _new_rays()
    return lambda: recompute(traced, scene), lambda: trace_paths(scene, tx, RECEIVER, next(new))


def _alone() -> tuple[Call, Call]:
    """Ours trains the paths of spectra by the graph, theirs by Adam on paths, receiver and loss as such: without
    Gaussians a step should cost at most 1.05 times as much.
    """
    receivers, carrier = (replace(RECEIVER, array_m=planar_array(4, 4, SPACING_M)),), np.array([FREQUENCY_HZ])
    room_record, split = record(20, receivers=receivers, frequencies_hz=carrier), make_splits(record(20), "random")[0]
    config = with_settings(
        calibration_config(["gain", "materials"], room_record.task.settings_of_paths), ["steps=100000", *ONLY_STEPS]
    )
    trainer = Trainer(room_record, split, config, scene=open_scene("laboratory", FREQUENCY_HZ))
    graph, targets, batch = trainer.graph, trainer.plan.targets, trainer.schedule.rows[0]
    traced_field = graph.trace(room_record.tx_pos_m, 0)[0]
    assert traced_field is not None
    adam = Adam(lr=0.05, params={name: to_tensor(value) for name, value in trainer.state.params().items()})
    names, model, size = list(adam), graph.models[0], targets.observed.shape[2:]
    loss_of = partial(trainer.plan.task.loss, ssim_weight=config.loss.ssim_weight)

    def step(adam: Any, data: TrainingData, rows: Any, receiver: Any) -> Any:
        truth = data.select(rows, receiver, HEIGHT * WIDTH)[1]
        loss = loss_of(model(traced_field({name: adam[name] for name in names}, rows), None), truth, len(batch), *size)
        dr.backward(loss)
        adam.step(eval=False)
        dr.eval(adam, loss)
        return dr.detach(loss)

    recorded = Recorded(step, lambda: graph.arrays(0, traced_field))
    data = TrainingData.of(targets)
    rows, receiver = on_device(batch, mi.UInt32), dr.opaque(mi.UInt32, 0)

    def ours() -> None:
        last = trainer.state.step + STEPS
        trainer.run(stop=lambda: trainer.state.step == last)

    def theirs() -> None:
        for _ in range(STEPS):
            dr.eval(recorded(adam, data, rows, receiver))
            dr.sync_thread()

    return ours, theirs


@contextmanager
def one_thread() -> Iterator[None]:
    """Context with Dr.Jit's kernels on one thread."""
    before = dr.thread_count()
    init(threads=1)
    try:
        yield
    finally:
        init(threads=before)


PAIRS: list[Pair] = [
    Pair("splatting", "splatting 500 Gaussians over `volprim_rf_basic`", partial(_evaluated, splatting, anew=False)),
    Pair(
        "integrator",
        "our Mitsuba integrator over `volprim_rf_basic`, geometry new",
        partial(_evaluated, integrator, anew=True),
    ),
    Pair("frozen", "a frozen training step over one that is traced anew", _training),
    Pair("batch", "16 transmitters at once over one after the other", _batch),
    Pair(
        "paths-alone", f"{STEPS} steps of the graph without Gaussians over {STEPS} of the traced paths as such", _alone
    ),
    Pair("kept-rays", "a traced spectrum with kept rays over one with new ones", _kept_rays),
    Pair("gains", "new gains of known paths over tracing anew, 64 transmitters", _gains),
]
"""All pairs, ours and the other call."""


def measure_pairs(
    pairs: Sequence[Pair] = PAIRS, repeats: int = REPEATS, most_s: float = MOST_S
) -> dict[str, dict[str, Any]]:
    """Ratio of each pair with its interval, and the median times in ms."""
    ratios = {}
    for pair in pairs:
        ours, theirs = pair.make()
        with one_thread():
            calls, processor = {"ours": ours, "theirs": theirs}, init().name != "cuda"
            times = interleaved(calls, repeats, most_s=most_s, processor=processor)
        interval = ratio(times["ours"], times["theirs"])
        ratios[pair.name] = vars(interval) | {f"{name}_ms": float(np.median(ms)) for name, ms in times.items()}
        print(f"{pair.title}: {interval}", file=sys.stderr)
    return ratios


def worse(measured: Mapping[str, Mapping[str, float]], stored: Mapping[str, Mapping[str, float]]) -> list[str]:
    """A line for each ratio whose whole interval is above `WORSE` times the stored one; those not stored yet pass."""
    return [
        f"{name} {Interval(interval['value'], interval['low'], interval['high'])} is above {WORSE:g} times the stored "
        f"{stored[name]['value']:.3g}"
        for name, interval in measured.items()
        if name in stored and interval["low"] > WORSE * stored[name]["value"]
    ]


def quick(out: Path, store: bool, pairs: Sequence[Pair] = PAIRS) -> dict[str, Any]:
    """Ratios of all pairs, stored in ``out`` or else compared with stored ones (`BenchFailed` where one is worse)."""
    # Ratios of each backend have a file.
    file = out / (FILE if (name := init().name) == "llvm" else FILE.replace(".", f"-{name}."))
    stored = None if store else read_stored(file)
    start = time.perf_counter()
    with threadpool_limits(1, "blas"):
        ratios = measure_pairs(pairs)
    result = {
        "case": "quick",
        "title": "interleaved pairs",
        "command": f"wrf-mi bench --quick --backend {init().name} --store",
        "wall_seconds": time.perf_counter() - start,
        **provenance(__name__),
        "figures": {"ratios": ratios},
    }
    if stored is None:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(file, json.dumps(result, indent=1) + "\n")
    elif lines := worse(ratios, stored):
        raise BenchFailed(f"bench --quick: {'; '.join(lines)}")
    return result


def read_stored(file: Path) -> dict[str, dict[str, float]]:
    try:
        content = json.loads(file.read_text())
        ratios: dict[str, dict[str, float]] = content["figures"]["ratios"]
        backend = content["versions"]["backend"].split()[0]
    except FileNotFoundError:
        raise InputError(f"{file}: no stored ratios; measure them with `wrf-mi bench --quick --store`") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: not readable ({one_line(error)}); restore it") from None
    if backend != (name := init().name):
        raise InputError(f"{file}: ratios of the backend {backend}; store those of {name} in another folder with --out")
    return ratios


def ratio_table(ratios: Mapping[str, Mapping[str, float]]) -> str:
    """Markdown table of ratios by the names of their pairs."""
    titles = {ratio_pair.name: ratio_pair.title for ratio_pair in PAIRS}
    line = "| {title} | **{value:.2g}** ({low:.2g} to {high:.2g}) | {ours_ms:.3g} ms, {theirs_ms:.3g} ms |"
    rows = [{"title": titles[name], **pair} for name, pair in ratios.items()]
    return lined("| ratio | measured (95 % interval) | medians |", line)(rows)
