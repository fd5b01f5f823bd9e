"""Calls of parts of the package at a given size, for the benchmarks of time and memory."""

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import to_float
from wrf_mi.core import Receiver, Record
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import random_gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.tasks import SPECTRUM
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.step import device_pose

from .timing import Call
from .traced import random_field, scene_of

HEIGHT, WIDTH = 90, 360
COVER_DEG2 = 7.0**2 * 270
"""Squared angular size times number of the default field, so that the overlap is the same at every number."""


def size_deg(count: int) -> float:
    """Angular size of each of ``count`` Gaussians with the overlap of the default field."""
    return float(np.sqrt(COVER_DEG2 / count))


def splatting(gaussians: Any, receiver: Any, height: int = HEIGHT, width: int = WIDTH) -> Call:
    pose, plane = device_pose(receiver), perception_plane(height, width, mi.Float)
    return lambda: splat(gaussians, pose, plane)


def integrator(gaussians: Any, receiver: Any) -> Call:
    """`mi.render` after the geometry changed, Mitsuba's BVH included."""
    scene = scene_of(gaussians, receiver)
    params = mi.traverse(scene)
    data = params["gaussians.data"].numpy().copy()

    def call() -> Any:
        params["gaussians.data"] = to_float(data)
        params.update()
        return mi.render(scene)

    return call


def field(count: int, size: float | None = None, opacity: float = 0.4) -> Any:
    """Random Gaussians and their receiver."""
    return random_field(0, "alpha", count, size_deg(count) if size is None else size, opacity=opacity)


def parameters(model: Any, count: int, size: float) -> dict[str, NDArray[np.float32]]:
    """Initial parameters of a field, with Gaussians of random shapes and rotations around `RECEIVER`."""
    rng = np.random.default_rng(0)
    params = model.init(random_gaussians([RECEIVER], count, rng, size_deg=size), rng)
    params["log_scale"] += rng.normal(0, 0.3, (3, count)).astype(np.float32)
    params["rotation"] = rng.standard_normal((4, count)).astype(np.float32)
    return dict(params)


def tracer(options: TraceOptions) -> RayTracer:
    """Ray tracer of the laboratory for spectra of a 4 x 4 array."""
    receivers = (replace(RECEIVER, array_m=planar_array(4, 4, SPACING_M)),)
    instrument = Instrument("array", receivers, np.array([FREQUENCY_HZ]), size=(HEIGHT, WIDTH))
    return RayTracer("laboratory", instrument, options)


def strengths(rows: int, receivers: int, length_m: float = 40.0, width_m: float = 40.0) -> Record:
    """Signal strengths in a rectangle, with shadowing that is smooth over metres."""
    rng = np.random.default_rng(0)
    tx_m, rx_m = (rng.uniform((0, 0, 1), (length_m, width_m, 2), (count, 3)) for count in (rows, receivers))
    waves, phases = rng.normal(0, 0.4, (receivers, 12, 2)), rng.uniform(0, 2 * np.pi, (receivers, 12, 1))
    power_dbm = 2 * np.cos(waves @ tx_m[:, :2].T + phases).sum(axis=1) + rng.normal(0, 2, (receivers, rows))
    power_dbm -= 40 + 20 * np.log10(np.linalg.norm(tx_m - rx_m[:, None], axis=2))
    places = tuple(Receiver(f"r{k}", place, np.array(UPRIGHT)) for k, place in enumerate(rx_m))
    return Record("walk", "rssi", tx_m, places, power_dbm.astype(np.float32), frequencies_hz=np.array([2.44e9]))


def record(rows: int, **more: Any) -> Record:
    observation = np.random.default_rng(0).random((1, rows, HEIGHT, WIDTH)).astype(np.float32)
    facts = {"receivers": (RECEIVER,)} | more
    return Record("random", SPECTRUM, transmitter_path(rows), observation=observation, **facts)
