"""Ray tracing: phases and delays compared with mirror images, derivatives with central differences in float32."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.furnished import write_scene

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
"""Bound on the relative error of a derivative through ray tracing against central differences in float32."""
DELAY = 1e-6
"""Bound on the relative error of Sionna RT's delays: 17 roundings of float32."""
HALLS: tuple[tuple[float, tuple[float, float, float]], ...] = (
    (28e9, (100.0, 60.0, 12.0)),
    (915e6, (10_000.0, 4_000.0, 300.0)),
)
"""Carrier and size in metres."""
ROOM = (6.0, 5.0, 3.0)
CARRIER_HZ = 2.4e9
LEAST_SLOPE = 0.05
"""Floor of a slope relative to the median slope; those of metals are below rounding."""


def box_sheets(size_m: tuple[float, float, float]) -> dict[str, Any]:
    """Meshes of the six sides of a box."""
    spans = [(0.0, side) for side in size_m]
    return {
        f"{axis}{at:g}": sheet(axis, at, *(span for other, span in enumerate(spans) if other != axis))
        for axis in range(3)
        for at in (0.0, size_m[axis])
    }


def phases(count: int = 30) -> list[Row]:
    """Rows of traced phases and of Sionna RT's float32 delays, compared with mirror images in closed form."""
    return [row for frequency_hz, size_m in HALLS for row in _phases(frequency_hz, size_m, count)]


def _phases(frequency_hz: float, size_m: tuple[float, float, float], count: int) -> list[Row]:
    """Rows of a metal hall with up to two reflections."""
    rng = np.random.default_rng(0)
    tx, rx = rng.uniform(0.1, 0.9, (count, 3)) * size_m, rng.uniform(0.1, 0.9, 3) * size_m
    with tempfile.TemporaryDirectory() as work:
        parts = {name: ("itu_metal", wall) for name, wall in box_sheets(size_m).items()}
        scene = open_scene(write_scene(Path(work), parts, "Hall of metal"), frequency_hz)
        options = TraceOptions(max_depth=2, rays=1 << 14)
        paths = trace_paths(scene, tx, replace(RECEIVER, position_m=rx), options).paths
        delays_s = _sionna_delays(scene, tx, rx)
    worst, single, delay = Worst(), Worst(), Worst()
    metres, counted = 0.0, 0
    for index, position_m in enumerate(tx):
        found, exact = np.sort(paths.length_m[paths.tx == index]), _mirror_images(position_m, rx, np.array(size_m))
        theirs = speed_of_light * delays_s[index]
        for lengths, errors in ((found, worst), (found.astype(np.float32), single)):
            errors.add(np.abs(lengths - exact).max() if len(lengths) == len(exact) else np.inf)
        # Sionna RT finds some paths of large halls two or three times, by both triangles of a wall.
        off = np.abs(theirs[:, None] - exact) if len(theirs) else np.full((1, len(exact)), np.inf)
        counted += len(theirs)
        metres = max(metres, float(off.min(axis=0).max()), float(off.min(axis=1).max()))
        delay.add(max((off.min(axis=0) / exact).max(), (off / exact).min(axis=1).max()))
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    where = f"{frequency_hz / 1e9:g} GHz in {size_m[0]:g} m"
    more = f" rad; with lengths in float32 {wavenumber * single.error:.0e} rad"
    return [
        row(f"phase at {where}, {len(paths)} paths", wavenumber * worst.error, PHASE, more),
        row(
            f"Sionna RT's own delays at {where}, {counted} paths",
            delay.error,
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
    """Rows of derivatives in a room with constant paths, compared with central differences."""
    with tempfile.TemporaryDirectory() as work:
        kinds = ("itu_concrete", "itu_brick", "itu_plasterboard", "itu_glass", "itu_wood", "itu_concrete")
        parts = {n: (kind, wall) for kind, (n, wall) in zip(kinds, box_sheets(ROOM).items(), strict=True)}
        parts["partition"] = ("itu_chipboard", sheet(0, 3.1, (0.0, 2.36), (0.0, 2.0)))
        thickness = {kind: 0.02 for kind in (*kinds, "itu_chipboard")}
        scene = open_scene(write_scene(Path(work), parts, "Room"), CARRIER_HZ, thickness)
    rng = np.random.default_rng(0)
    tx = np.array([1.9, 1.8, 1.3]) + rng.uniform(-0.3, 0.3, (count, 3))
    # The antenna turns with its array, so that reports depend on the rotation.
    receiver = Receiver("array", np.array([4.2, 2.9, 0.4]), np.array([0.0, 0.0, 0.0, 1.0]), Antenna(frame="array"))
    options = TraceOptions(max_depth=2, transmission=True, rays=1 << 12)
    traced = trace_paths(scene, tx, receiver, options)
    return [_solver_gradients(scene, traced), *_physics_gradients(scene, traced, receiver, options)]


Reports = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""Flat differentiable reports by name, from parameters as tensors."""


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
        # The reverse pass evaluates the field again and needs these materials.
        kept.enter_context(with_materials(scene, constants))
        return field_of(scene, buffer, traced.ends(), traced.rays, loop_mode="evaluated")

    def reports(given: Mapping[str, Any]) -> Mapping[str, Any]:
        parts = field(given)
        # Power relative to what was traced, as dB in float32 are too coarse for differences.
        power = sum(dr.square(part) for part in parts) * scale
        return {"gains": dr.concat([part * 1e3 for part in parts]), "power": power}

    kept = ExitStack()
    worst = Worst()
    for name, found in _against_differences(reports, values, {}, 0.2, kept.close).items():
        worst.add(found.error, f"{found.where}, {name}")
    return worst.row(f"derivatives of Sionna RT's fields by {len(values)} constants of materials", TRACED_GRADIENT)


def _physics_gradients(scene: Any, traced: TraceResult, receiver: Receiver, options: TraceOptions) -> list[Row]:
    """Rows of reports of the traced side in float32 by materials, pose, gain and patterns."""
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

    def reports(given: Mapping[str, Any]) -> Mapping[str, Any]:
        paths = field(given)
        return {name: model(paths, None) for name, model in models.items()}

    found = _against_differences(reports, values, steps, 0.02)
    by = f"by {len(values)} parameters"
    return [w.row(f"derivatives of the traced side, {name}, {by}", TRACED_GRADIENT) for name, w in found.items()]


def _against_differences(
    of: Reports,
    values: Mapping[str, FloatArray],
    steps: Mapping[str, float],
    step: float,
    done: Callable[[], None] = lambda: None,
) -> dict[str, Worst]:
    """Errors of derivatives of random functionals of float32 reports, relative to central differences.

    Sums over a report are NumPy's, in float64, so that only the report is tested.

    Args:
        of: reports of parameters.
        values: parameters.
        steps: longest steps of some parameters, see `_slope`.
        step: longest step of the others.
        done: called when reports and their derivatives are no longer needed.

    Returns:
        Worst error and parameter of each report.
    """
    weights: dict[str, FloatArray] = {}
    slopes: dict[str, dict[str, FloatArray]] = {}
    fixed = {name: to_tensor(value) for name, value in values.items()}
    with dr.suspend_grad():
        for name, report in of(fixed).items():
            weights[name] = np.random.default_rng(3).normal(size=dr.width(report))
    done()
    for name, weight in weights.items():
        tensors = {key: to_tensor(value) for key, value in values.items()}
        dr.enable_grad(tensors)
        report = of(tensors)[name]
        dr.backward(dr.sum(report * on_device(weight, type(report))))
        slopes[name] = {key: np.asarray(dr.grad(value).numpy(), float) for key, value in tensors.items()}
        done()

    def along(key: str, way: FloatArray, by: float) -> FloatArray:
        with dr.suspend_grad():
            reports = of(fixed | {key: to_tensor(values[key] + by * way)})
            found = [reports[name].numpy().astype(float) @ weight for name, weight in weights.items()]
        done()
        return np.array(found)

    rng = np.random.default_rng(4)
    ways = {key: rng.normal(size=v.shape) if v.size > 1 else np.ones(v.shape) for key, v in values.items()}
    sizes = {key: _slope(partial(along, key, way), steps.get(key, step)) for key, way in ways.items()}
    worst = {name: Worst() for name in weights}
    for number, name in enumerate(weights):
        least = LEAST_SLOPE * float(np.median([abs(size[number]) for size in sizes.values()]))
        for key, way in ways.items():
            size = float(sizes[key][number])
            worst[name].add(abs(size - float((slopes[name][key] * way).sum())) / max(abs(size), least), key)
    return worst


def _slope(of: Callable[[float], FloatArray], longest: float, halvings: int = 4) -> FloatArray:
    """Derivatives at 0 by fourth-order central differences of halved steps: the two estimates that agree best.

    Source: Ridders, "Accurate computation of F'(x)" (1982), for choosing the step by the estimates alone.
    """
    steps = longest * 0.5 ** np.arange(halvings + 1)
    second = np.array([(of(h) - of(-h)) / (2 * h) for h in steps])
    fourth = (4 * second[1:] - second[:-1]) / 3
    best = np.abs(np.diff(fourth, axis=0)).argmin(axis=0)
    each = np.arange(fourth.shape[1])
    return np.asarray((fourth[best, each] + fourth[best + 1, each]) / 2)
