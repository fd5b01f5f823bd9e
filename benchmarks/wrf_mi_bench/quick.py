"""The quick benchmark: ratios of interleaved pairs of calls, held against stored ones.

Absolute times depend on the machine and on what else it does; the ratio of two calls that take turns in one process
does so much less. On a CPU it is one of processor times on one thread, which others on the machine hardly change: with
times on the clock and two threads the same ratios moved up to nine times. A ratio here is of what the package does over
what it would do without the part that is measured, so that a larger one is worse. `wrf-mi bench --quick` fails where
the whole 95 % interval of a ratio lies above `WORSE` times the stored one.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.backend import init
from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.core import InputError, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.files import one_line, write_atomically
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians.render import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.receivers.instruments import SpectrumInstrument
from wrf_mi.runs.folder import versions
from wrf_mi.runs.timing import Call, Interval, Within, interleaved, one_blas_thread, ratio
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.step import CompiledPredictor, device_pose
from wrf_mi.training.trainer import Trainer

from .bench import BenchFailed, machine
from .stock import StockRenderer, rgb_variant
from .traced import random_field, scene_of

FILE = "quick.json"
WORSE = 2.0
"""Times the stored ratio; below that a slower machine or a busy one would fail."""
HEIGHT, WIDTH = 90, 360
REPEATS, MOST_S = 15, 5.0
"""Pairs of each kind; no further one begins after so many seconds."""


@dataclass(frozen=True)
class Pair:
    """Two calls whose times are compared.

    Attributes:
        name: of the ratio, in the stored file.
        title: for the table: what over what.
        make: gives both calls, ready: ours and the other.
    """

    name: str
    title: str
    make: Callable[[], tuple[Call, Call]]


def _splatting() -> tuple[Call, Call]:
    gaussians, receiver = random_field(0, "alpha", 500, 5.0, opacity=0.3)
    pose, plane = device_pose(receiver), perception_plane(HEIGHT, WIDTH, mi.Float)
    return lambda: splat(gaussians, pose, plane), Within(_stock(gaussians, receiver).render, rgb_variant)


def _integrator() -> tuple[Call, Call]:
    gaussians, receiver = random_field(0, "alpha", 500, 5.0, opacity=0.3)
    scene = scene_of(gaussians, receiver)
    params, data = mi.traverse(scene), mi.traverse(scene)["gaussians.data"].numpy().copy()
    stock = _stock(gaussians, receiver)

    def ours() -> Any:
        params["gaussians.data"] = to_float(data)
        params.update()
        return mi.render(scene)

    def theirs() -> Any:
        stock.field(gaussians)

    return ours, Within(theirs, rgb_variant)


def _stock(gaussians: Any, receiver: Any) -> StockRenderer:
    stock = StockRenderer(receiver, HEIGHT, WIDTH)
    stock.field(gaussians)
    return stock


def _record(rows: int) -> Record:
    """Made-up spectra: what is measured does not depend on what they show."""
    rng = np.random.default_rng(0)
    return Record(
        name="made-up",
        task="spectrum",
        tx_pos_m=transmitter_path(rows),
        receivers=(RECEIVER,),
        observation=rng.random((1, rows, HEIGHT, WIDTH)).astype(np.float32),
    )


def _training() -> tuple[Call, Call]:
    record = _record(20)
    settings = (
        "steps=100000",
        "density.every=0",
        "log_every=100000",
        "validate_every=100000",
        "holdout_steps_fraction=0",
    )
    config = with_settings(TrainConfig(), settings)
    frozen, fresh = (Trainer(record, make_splits(record, "random")[0], config) for _ in range(2))

    def ours() -> None:
        frozen.run(stop=lambda: True)  # asked after each step: one is taken

    def theirs() -> None:
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            fresh.run(stop=lambda: True)

    return ours, theirs


def _batch() -> tuple[Call, Call]:
    count, rng = 16, np.random.default_rng(0)
    trainer = Trainer(_record(count), make_splits(_record(count), "random")[0], TrainConfig())
    params = {name: to_tensor(values) for name, values in trainer.state.params().items()}
    field, pose = trainer.field, device_pose(RECEIVER)
    plane, positions = perception_plane(HEIGHT, WIDTH, mi.Float), transmitter_path(count)
    positions = positions[rng.permutation(count)]
    together, alone = CompiledPredictor(field), CompiledPredictor(field)
    dr.eval(params)

    def ours() -> Any:
        return together(params, to_tensor(positions.T), pose, plane)

    def theirs() -> Any:
        return [dr.eval(alone(params, to_tensor(one[:, None]), pose, plane)) for one in positions]

    return ours, theirs


def _tracer() -> RayTracer:
    array_m = planar_array(4, 4, SPACING_M)
    receivers = (replace(RECEIVER, array_m=array_m),)
    instrument = SpectrumInstrument(receivers, np.array([FREQUENCY_HZ]), size=(HEIGHT, WIDTH))
    return RayTracer("laboratory", instrument, TraceOptions(rays=1 << 14))


def _kept_rays() -> tuple[Call, Call]:
    tracer, one = _tracer(), transmitter_path(1)
    return lambda: tracer(one), lambda: _tracer_anew(tracer, one)


def _tracer_anew(tracer: RayTracer, tx_pos_m: Any) -> Any:
    paths = trace_paths(tracer.scene, tx_pos_m, tracer.instrument.receivers, tracer.options).paths
    return tracer.instrument.observe(paths)


def _gains() -> tuple[Call, Call]:
    scene, tx, options = open_scene("laboratory", FREQUENCY_HZ), transmitter_path(64), TraceOptions(rays=1 << 14)
    traced = trace_paths(scene, tx, RECEIVER, options)
    return lambda: recompute(traced, scene), lambda: trace_paths(scene, tx, RECEIVER, options)


def _physics() -> tuple[Call, Call]:
    """The physics model of a room without a measurement evaluates the paths that the tracer finds, in NumPy."""
    from wrf_mi.models.physics.selection import kind_of

    tracer, one = _tracer(), transmitter_path(1)
    kind = kind_of(_record(20), True)
    receivers, carrier_hz = tracer.instrument.receivers, np.array([FREQUENCY_HZ])
    record = Record("made-up", "spectrum", one, receivers, _record(1).observation, frequencies_hz=carrier_hz)
    model = kind.fit(record, np.zeros(0, np.int64), tracer.scene, kind.settings(), 0, lambda what, share: None)
    return lambda: model.predict(one, 0).mean, lambda: tracer(one)


def on_cpu() -> bool:
    """Whether kernels run on processors, whose time this process knows."""
    return init().name != "cuda"


@contextmanager
def one_thread() -> Iterator[None]:
    """Dr.Jit's kernels on one thread."""
    before = dr.thread_count()
    init(threads=1)
    try:
        yield
    finally:
        init(threads=before)


PAIRS: list[Pair] = [
    Pair("splatting", "splatting 500 Gaussians over `volprim_rf_basic`", _splatting),
    Pair("integrator", "our Mitsuba integrator over `volprim_rf_basic`, geometry new", _integrator),
    Pair("frozen", "a frozen training step over one that is traced anew", _training),
    Pair("batch", "16 transmitters at once over one after the other", _batch),
    Pair("kept-rays", "a traced spectrum with kept rays over one with new ones", _kept_rays),
    Pair("gains", "new gains of known paths over tracing anew, 64 transmitters", _gains),
    Pair("physics", "a physics model's prediction over the ray tracer's, one transmitter", _physics),
]
"""All that is compared."""


def measure_pairs(
    pairs: Sequence[Pair] = PAIRS, repeats: int = REPEATS, most_s: float = MOST_S
) -> dict[str, dict[str, Any]]:
    """Ratio of each pair with its interval, and the median times in ms."""
    found = {}
    for pair in pairs:
        ours, theirs = pair.make()
        with one_thread():
            times = interleaved({"ours": ours, "theirs": theirs}, repeats, most_s=most_s, processor=on_cpu())
        own = ratio(times["ours"], times["theirs"])
        found[pair.name] = vars(own) | {f"{name}_ms": float(np.median(ms)) for name, ms in times.items()}
        print(f"{pair.title}: {own}", file=sys.stderr)
    return found


def worse(measured: Mapping[str, Mapping[str, float]], stored: Mapping[str, Mapping[str, float]]) -> list[str]:
    """A line for each ratio whose whole interval is above `WORSE` times the stored one; those not stored yet pass."""
    return [
        f"{name} {Interval(one['value'], one['low'], one['high'])} is above {WORSE:g} times the stored "
        f"{stored[name]['value']:.3g}"
        for name, one in measured.items()
        if name in stored and one["low"] > WORSE * stored[name]["value"]
    ]


def quick(out: Path, store: bool, pairs: Sequence[Pair] = PAIRS) -> dict[str, Any]:
    """Measure all pairs, and store them or hold them against what is stored.

    Returns:
        What is (or would be) stored.
    """
    file = file_of(out)
    stored = None if store else read_stored(file)
    start = time.perf_counter()
    with one_blas_thread():
        found = measure_pairs(pairs)
    result = {
        "case": "quick",
        "title": "interleaved pairs",
        "command": f"wrf-mi bench --quick --backend {init().name} --store",
        "wall_seconds": time.perf_counter() - start,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
        "versions": versions(),
        "figures": {"ratios": found},
    }
    if stored is None:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(file, json.dumps(result, indent=1) + "\n")
    elif lines := worse(found, stored):
        raise BenchFailed(f"bench --quick: {'; '.join(lines)}")
    return result


def file_of(out: Path) -> Path:
    """Stored ratios of the backend that this process computes with: ``quick.json``, or ``quick-cuda.json``."""
    return out / (FILE if (own := init().name) == "llvm" else FILE.replace(".", f"-{own}."))


def read_stored(file: Path) -> dict[str, dict[str, float]]:
    """Stored ratios."""
    try:
        content = json.loads(file.read_text())
        ratios: dict[str, dict[str, float]] = content["figures"]["ratios"]
        backend = content["versions"]["backend"].split()[0]
    except FileNotFoundError:
        raise InputError(f"{file}: no stored ratios; measure them with `wrf-mi bench --quick --store`") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: not readable ({one_line(error)}); restore it") from None
    if backend != (own := init().name):
        raise InputError(f"{file}: ratios of the backend {backend}; store those of {own} in another folder with --out")
    return ratios


def ratio_table(ratios: Mapping[str, Mapping[str, float]], pairs: Sequence[Pair] = PAIRS) -> str:
    """Markdown table of stored ratios."""
    titles = {pair.name: pair.title for pair in pairs}
    lines = ["| ratio | measured (95 % interval) | medians |", "| --- | --- | --- |"]
    for name, one in ratios.items():
        value = Interval(one["value"], one["low"], one["high"])
        lines.append(
            f"| {titles[name]} | **{value.value:.2g}** ({value.low:.2g} to {value.high:.2g}) "
            f"| {one['ours_ms']:.3g} ms, {one['theirs_ms']:.3g} ms |"
        )
    return "\n".join(lines)
