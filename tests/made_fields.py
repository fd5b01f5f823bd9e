"""Fields of Gaussians from arrays and all around a receiver, and their images by the oracle in float64."""

from typing import Any

import numpy as np
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Receiver, pixel_directions
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.training.step import device_pose

RECEIVER = Receiver("r", np.array([0.3, -0.2, 0.1]), np.array([0.1, -0.3, 0.2, 0.9]))
POSE = device_pose(RECEIVER, Float64)
SIZE = (23, 61)
"""No whole number of tiles either way."""
COUNT, BATCH = 40, 2


def device_gaussians(float_type: Any, batch: int = 1, **arrays: Any) -> Gaussians:
    """Gaussians from arrays [coordinates, count]; signals and attenuations are complex, what is left out is None."""
    arrays = {"opacity": None, "attenuation": None} | arrays
    for name, values in arrays.items():
        rows = [values.real, values.imag] if np.iscomplexobj(values) else values
        if name == "opacity":
            arrays[name] = None if values is None else on_device(values, float_type)
        elif values is not None:
            arrays[name] = [on_device(np.ascontiguousarray(row), float_type) for row in rows]
    return Gaussians(**arrays, batch=batch)


def fields(seed: int) -> Gaussians:
    """Gaussians all around the receiver, below its horizon too, signals of two decades, some nearly opaque."""
    rng, total = np.random.default_rng(seed), BATCH * COUNT
    position = rng.normal(0, 1.5, (3, COUNT)) + RECEIVER.position_m[:, None]
    position[:, 0] = RECEIVER.position_m + 0.01  # contains the receiver
    return device_gaussians(
        Float64,
        BATCH,
        position=position,
        scale=np.exp(rng.normal(-1, 0.7, (3, total))),
        rotation=rng.standard_normal((4, total)),
        signal=10 ** rng.uniform(-2, 0, total) * np.exp(2j * np.pi * rng.random(total)),
        opacity=rng.uniform(0.05, 0.999, total),
    )


def oracle_image(gaussians, receiver, size, chosen=None, transmitter=0, **more):
    """The image of a transmitter's Gaussians, of all or the chosen ones; ``more`` replaces their opacities."""
    chosen = np.arange(gaussians.count) if chosen is None else chosen
    start = transmitter * gaussians.count

    def columns(parts: list[Any], start: int = start) -> np.ndarray:
        return np.stack([part.numpy()[start + chosen].astype(float) for part in parts], axis=1)

    signal = columns(gaussians.signal) @ [1, 1j]
    geometry = columns(gaussians.position, 0), columns(gaussians.scale), columns(gaussians.rotation)
    if gaussians.attenuation is not None:
        more = {"attenuation": columns(gaussians.attenuation) @ [1, 1j]}
    elif not more:
        more = {"opacity": columns([gaussians.opacity])[:, 0]}
    return oracle.render(*geometry, signal, receiver, pixel_directions(*size), **more)


def off_edges(image: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """The share of pixels on a cut-off, which may fall to either side in float32, and the others' relative L2 error."""
    off = np.abs(image - expected) > 1e-3 * np.abs(expected).max()
    return float(off.mean()), float(np.linalg.norm((image - expected)[~off]) / np.linalg.norm(expected))
