"""The tracer under stress: phases and delays against mirror images, derivatives against differences in float32."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.backend.device import on_device, to_float, to_tensor
from wrf_mi.core import Antenna
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.types import Receiver
from wrf_mi.graph.combine import ArrayReceiver, CsiReceiver, PowerReceiver
from wrf_mi.tracing import TraceOptions, TraceResult, open_scene, trace_paths
from wrf_mi.tracing.buffer import to_buffer
from wrf_mi.tracing.fields import field_of
from wrf_mi.tracing.materials import with_materials
from wrf_mi.tracing.surfaces import scene_surfaces
from wrf_mi.tracing.traced_field import TracedField, TracedOptions

from .stress_fields import RECEIVER
from .stress_rows import PHASE, Row, Worst, row

TRACED_GRADIENT = 1e-2
"""Relative error of a derivative through the tracer against central differences in float32."""
DELAY = 1e-6
"""Relative error of Sionna RT's delays: 17 roundings of float32, those of mirrored corners, their sums and roots."""
HALLS: tuple[tuple[float, tuple[float, float, float]], ...] = (
    (28e9, (100.0, 60.0, 12.0)),
    (915e6, (10_000.0, 4_000.0, 300.0)),
)
"""Carrier and size in metres."""
ROOM = (6.0, 5.0, 3.0)
CARRIER_HZ = 2.4e9
LEAST_SLOPE = 0.05
"""Of the median slope: a smaller one, a metal's, is compared with that; roundings would drown it."""


def box_sheets(size_m: tuple[float, float, float]) -> dict[str, Any]:
    """The six sides of a box."""
    spans = [(0.0, side) for side in size_m]
    return {
        f"{axis}{at:g}": sheet(axis, at, *(span for other, span in enumerate(spans) if other != axis))
        for axis in range(3)
        for at in (0.0, size_m[axis])
    }


def phases(count: int = 30) -> list[Row]:
    """Phases of traced paths against mirror images in closed form, and Sionna RT's own delays, which are float32."""
    return [row for frequency_hz, size_m in HALLS for row in _phases(frequency_hz, size_m, count)]


def _phases(frequency_hz: float, size_m: tuple[float, float, float], count: int) -> list[Row]:
    """Halls of metal, up to two reflections."""
    rng = np.random.default_rng(0)
    tx, rx = rng.uniform(0.1, 0.9, (count, 3)) * size_m, rng.uniform(0.1, 0.9, 3) * size_m
    with tempfile.TemporaryDirectory() as work:
        parts = {name: ("itu_metal", wall) for name, wall in box_sheets(size_m).items()}
        scene = open_scene(write_scene(Path(work), parts, "Hall of metal"), frequency_hz)
        options = TraceOptions(max_depth=2, rays=1 << 14)
        paths = trace_paths(scene, tx, replace(RECEIVER, position_m=rx), options).paths
        delays_s = _sionna_delays(scene, tx, rx)
    worst, single, own = Worst(), Worst(), Worst()
    metres, counted = 0.0, 0
    for index, place in enumerate(tx):
        found, exact = np.sort(paths.length_m[paths.tx == index]), _mirror_images(place, rx, np.array(size_m))
        theirs = speed_of_light * delays_s[index]
        for lengths, errors in ((found, worst), (found.astype(np.float32), single)):
            errors.add(np.abs(lengths - exact).max() if len(lengths) == len(exact) else np.inf)
        # In large halls it finds some paths two or three times, by the two triangles of a wall.
        off = np.abs(theirs[:, None] - exact) if len(theirs) else np.full((1, len(exact)), np.inf)
        counted += len(theirs)
        metres = max(metres, float(off.min(axis=0).max()), float(off.min(axis=1).max()))
        own.add(max((off.min(axis=0) / exact).max(), (off / exact).min(axis=1).max()))
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    where = f"{frequency_hz / 1e9:g} GHz in {size_m[0]:g} m"
    more = f" rad; with lengths in float32 {wavenumber * single.error:.0e} rad"
    return [
        row(f"phase at {where}, {len(paths)} paths", wavenumber * worst.error, PHASE, more),
        row(
            f"Sionna RT's own delays at {where}, {counted} paths",
            own.error,
            DELAY,
            f" of the delay: {metres * 1e3:.2g} mm, {wavenumber * metres:.0e} rad",
        ),
    ]


def _sionna_delays(scene: Any, tx_pos_m: FloatArray, rx_pos_m: FloatArray) -> list[FloatArray]:
    """Delays of Sionna RT's own solver in s, for each transmitter: up to two reflections."""
    from sionna import rt

    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Receiver("rx", mi.Point3f(*map(float, rx_pos_m))))
    delays = []
    for place in tx_pos_m:
        scene.add(rt.Transmitter("tx", mi.Point3f(*map(float, place))))
        paths = rt.PathSolver()(scene, max_depth=2, samples_per_src=1 << 15, refraction=False, seed=1)
        tau = np.asarray(paths.tau.numpy(), float).ravel()
        delays.append(tau[np.asarray(paths.valid.numpy(), bool).ravel()])
        scene.remove("tx")
    scene.remove("rx")
    return delays


def _mirror_images(tx: FloatArray, rx: FloatArray, size: FloatArray, depth: int = 2) -> FloatArray:
    """Lengths of all paths of up to ``depth`` reflections in a box, sorted.

    Source: Allen and Berkley, "Image method for efficiently simulating small-room acoustics" (1979), JASA 65(4).
    """
    numbers = np.array(np.meshgrid(*[np.arange(-depth, depth + 1)] * 3)).reshape(3, -1).T
    numbers = numbers[np.abs(numbers).sum(axis=1) <= depth]
    image = np.where(numbers % 2 == 0, numbers * size + tx, (numbers + 1) * size - tx)
    return np.sort(np.linalg.norm(image - rx, axis=1))


def traced_gradients(count: int = 6) -> list[Row]:
    """Derivatives of what is traced in a room against central differences, the paths kept.

    Args:
        count: of transmitters.
    """
    with tempfile.TemporaryDirectory() as work:
        kinds = ("itu_concrete", "itu_brick", "itu_plasterboard", "itu_glass", "itu_wood", "itu_concrete")
        parts = {n: (kind, wall) for kind, (n, wall) in zip(kinds, box_sheets(ROOM).items(), strict=True)}
        parts["partition"] = ("itu_chipboard", sheet(0, 3.1, (0.0, 2.36), (0.0, 2.0)))
        thickness = {kind: 0.02 for kind in (*kinds, "itu_chipboard")}
        scene = open_scene(write_scene(Path(work), parts, "Room"), CARRIER_HZ, thickness)
    rng = np.random.default_rng(0)
    tx = np.array([1.9, 1.8, 1.3]) + rng.uniform(-0.3, 0.3, (count, 3))
    # Turned with its array, so that reports depend on how it is turned.
    receiver = Receiver("array", np.array([4.2, 2.9, 0.4]), np.array([0.0, 0.0, 0.0, 1.0]), Antenna(frame="array"))
    options = TraceOptions(max_depth=2, transmission=True, rays=1 << 12)
    traced = trace_paths(scene, tx, receiver, options)
    return [_solver_gradients(scene, traced), *_physics_gradients(scene, traced, receiver, options)]


Reported = Callable[[Mapping[str, Any]], Any]


def _solver_gradients(scene: Any, traced: TraceResult) -> Row:
    """Sionna RT's fields, float32, by the materials of the room: gains and powers."""
    surfaces, known = scene_surfaces(scene), scene.radio_materials
    buffer = to_buffer(traced.legs(surfaces), surfaces, valid=True)
    names = sorted({known[scene.objects[name].radio_material.name].name for name in traced.paths.object_names})
    power = np.bincount(traced.paths.tx, np.abs(traced.paths.gain) ** 2)
    scale = to_float(1 / power[traced.paths.tx])
    values = {}
    for name in names:
        values[f"permittivity {name}"] = np.log(np.ravel(known[name].relative_permittivity.numpy()) - 1)
        values[f"conductivity {name}"] = np.log(np.ravel(known[name].conductivity.numpy()))

    def field(given: Mapping[str, Any]) -> Any:
        constants = {
            n: (1 + dr.exp(given[f"permittivity {n}"].array), dr.exp(given[f"conductivity {n}"].array)) for n in names
        }
        # The calculator is asked again in the reverse pass, when the materials have to be these.
        kept.enter_context(with_materials(scene, constants))
        return field_of(scene, buffer, traced.ends(), traced.rays, loop_mode="evaluated")

    kept = ExitStack()
    reports: dict[str, Reported] = {
        "gains": lambda given: dr.concat([part * 1e3 for part in field(given)]),
        # In shares of what was traced: dB in float32 are too coarse for differences.
        "power": lambda given: sum(dr.square(part) for part in field(given)) * scale,
    }
    worst = Worst()
    for report, of in reports.items():
        _against_differences(of, values, {}, 0.2, worst, report, kept.close)
    return worst.row(f"derivatives of Sionna RT's fields by {len(values)} constants of materials", TRACED_GRADIENT)


def _physics_gradients(scene: Any, traced: TraceResult, receiver: Receiver, options: TraceOptions) -> list[Row]:
    """What the receivers of the physics model report of its traced side, in float32, by materials, pose, gain and
    patterns."""
    field = TracedField(scene, traced.tx_pos_m, receiver, TracedOptions(options, 2, gain=300.0), traced=traced)
    rng, elements = np.random.default_rng(1), planar_array(3, 3, 0.06)
    values = {name: value.astype(float) for name, value in field.parameters().items()}
    for name in values:
        if name.startswith("pattern.") or name.endswith((".position", ".turn")):
            values[name] = values[name] + rng.normal(0, 0.02, values[name].shape)
    # 1 mm is a twentieth of a radian, and reports turn sharply where waves cancel.
    steps = {name: 5e-4 for name in values if name.endswith((".position", ".turn"))}
    models: dict[str, Any] = {
        "array": ArrayReceiver(12, 40, elements, CARRIER_HZ),
        "rssi": PowerReceiver(12, 40, (CARRIER_HZ,)),
        "csi": CsiReceiver(12, 40, (CARRIER_HZ, 1.01 * CARRIER_HZ)),
    }
    rows = []
    for name, model in models.items():
        worst = Worst()
        _against_differences(_reporter(model, field), values, steps, 0.02, worst)
        what = f"derivatives of the traced side, {name}, by {len(values)} parameters"
        rows.append(worst.row(what, TRACED_GRADIENT))
    return rows


def _reporter(model: Any, field: TracedField) -> Reported:
    return lambda given: model(field(given), None)


def _against_differences(
    of: Reported,
    values: Mapping[str, FloatArray],
    steps: Mapping[str, float],
    step: float,
    worst: Worst,
    where: str = "",
    done: Callable[[], None] = lambda: None,
) -> None:
    """Compare derivatives of a random functional of a float32 report with central differences of float32 reports.

    Sums over a report are NumPy's, in float64: what is tested is the report.

    Args:
        of: the report, a flat array, of parameters as tensors.
        values: of the parameters.
        steps: the longest step of some, see `_slope`.
        step: of the others.
        worst: takes the errors, each relative to the difference.
        where: said with the worst.
        done: called after each report when it is no longer needed.
    """
    rng = np.random.default_rng(3)
    tensors = {name: to_tensor(value) for name, value in values.items()}
    dr.enable_grad(tensors)
    report = of(tensors)
    weight = rng.normal(size=dr.width(report))
    dr.backward(dr.sum(report * on_device(weight, type(report))))
    slopes = {name: np.asarray(dr.grad(value).numpy(), float) for name, value in tensors.items()}
    done()
    fixed = {name: to_tensor(value) for name, value in values.items()}

    def along(name: str, way: FloatArray) -> Callable[[float], float]:
        def moved(by: float) -> float:
            with dr.suspend_grad():
                found = of(fixed | {name: to_tensor(values[name] + by * way)}).numpy().astype(float)
            done()
            return float(found @ weight)

        return moved

    errors, sizes = {}, {}
    for name, value in values.items():
        way = rng.normal(size=value.shape) if value.size > 1 else np.ones(value.shape)
        sizes[name] = _slope(along(name, way), steps.get(name, step))
        errors[name] = abs(sizes[name] - float((slopes[name] * way).sum()))
    least = LEAST_SLOPE * float(np.median(np.abs(list(sizes.values()))))
    for name, error in errors.items():
        worst.add(error / max(abs(sizes[name]), least), f"{name}, {where}" if where else name)


def _slope(of: Callable[[float], float], longest: float, halvings: int = 4) -> float:
    """Derivative at 0 by central differences of the fourth order: of steps halved, the two that agree best.

    Long steps feel the curvature, short ones the roundings; where neither matters the estimates agree.

    Source: Ridders, "Accurate computation of F'(x)" (1982), for choosing the step by the estimates alone.
    """
    steps = longest * 0.5 ** np.arange(halvings + 1)
    second = [(of(h) - of(-h)) / (2 * h) for h in steps]
    fourth = [(4 * near - far) / 3 for far, near in pairwise(second)]
    apart = [abs(a - b) for a, b in pairwise(fourth)]
    best = int(np.argmin(apart))
    return (fourth[best] + fourth[best + 1]) / 2
