"""Fields of Gaussians all around a receiver in float64, and their images, for tests of what may be left out."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.core import Receiver
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

Float64 = dr.float64_array_t(mi.Float)
RECEIVER = Receiver("r", np.array([0.3, -0.2, 0.1]), np.array([0.1, -0.3, 0.2, 0.9]))
POSE = device_pose(RECEIVER, Float64)
SIZE = (23, 61)
COUNT, BATCH = 40, 2


def fields(seed: int, product: bool, low: float = 0.05, high: float = 0.999, count: int = COUNT) -> Gaussians:
    """Gaussians all around the receiver, below its horizon too, signals of two decades, some nearly opaque."""
    rng = np.random.default_rng(seed)
    where = rng.normal(0, 1.5, (3, count)) + RECEIVER.position_m[:, None]
    where[:, 0] = RECEIVER.position_m + 0.01  # contains the receiver
    strength = 10 ** rng.uniform(-2, 0, BATCH * count) * np.exp(2j * np.pi * rng.random(BATCH * count))
    alpha = rng.uniform(low, high, BATCH * count)
    delta = (1 - alpha) * np.exp(2j * np.pi * rng.random(BATCH * count))
    return Gaussians(
        position=[Float64(x) for x in where],
        scale=[Float64(np.exp(rng.normal(-1, 0.7, BATCH * count))) for _ in range(3)],
        rotation=[Float64(x) for x in rng.standard_normal((4, BATCH * count))],
        signal=[Float64(strength.real.copy()), Float64(strength.imag.copy())],
        opacity=None if product else Float64(alpha),
        attenuation=[Float64(delta.real.copy()), Float64(delta.imag.copy())] if product else None,
        batch=BATCH,
    )


def image(gaussians: Gaussians) -> np.ndarray:
    re, im = splat(gaussians, POSE, perception_plane(*SIZE, Float64))
    return re.numpy() + 1j * im.numpy()
