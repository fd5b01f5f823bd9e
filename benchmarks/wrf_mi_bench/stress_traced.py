"""Ray tracing: phases and delays compared with mirror images in closed form."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core.angles import FloatArray
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

from .stress_fields import RECEIVER
from .stress_rows import PHASE, Row, Worst, row

DELAY = 1e-6  # bound on the relative error of Sionna RT's delays: 17 roundings of float32
HALLS: tuple[tuple[float, tuple[float, float, float]], ...] = (
    (28e9, (100.0, 60.0, 12.0)),
    (915e6, (10_000.0, 4_000.0, 300.0)),
)
"""Carrier and size in metres."""


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
