"""Mitsuba's own integrator of Gaussians, ``volprim_rf_basic``, for our receivers: what there is without this package.

It fails in the variants with polarisation that Sionna RT needs, so it runs in the rgb variant of the same backend, one
ray for each direction. Its colours cannot be negative, so complex signals go through its three channels as

    1/2 + Re S / 2a,   1/2 + Im S / 2a,   1/2,   a the largest magnitude,

and come back by subtracting the third from the others: the blending is linear. Left as they are: it stops at 1 %
transmittance and after 64 Gaussians, lets at most 0.9999 be absorbed, and makes ellipsoids of low opacity smaller.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import to_float, to_vectors
from wrf_mi.core import Receiver, pixel_directions
from wrf_mi.gaussians.parameters import Gaussians

Floats = NDArray[np.float32]

DEGREE_0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is this times its coefficient, plus 1/2."""


@contextmanager
def rgb_variant() -> Iterator[None]:
    """Mitsuba's rgb variant of the present backend, for a while.

    Changing it takes a quarter of a second, as Mitsuba then defines its Python integrators anew: whoever times calls of
    `StockRenderer` enters this context before (`wrf_mi.runs.timing.Within`).
    """
    own: Any = mi.variant()
    other = own.replace("mono_polarized", "rgb")
    if own == other:
        yield
        return
    mi.set_variant(other)
    try:
        yield
    finally:
        mi.set_variant(own)


class StockRenderer:
    """Renders Gaussians from a receiver's place."""

    def __init__(self, receiver: Receiver, height: int, width: int) -> None:
        self.receiver, self.height, self.width = receiver, height, width
        self._scene: Any = None
        self._count = -1

    def load(self, data: Floats, opacity: Floats, colour: Floats) -> None:
        """Put Gaussians into the scene, whose acceleration structure is then built anew."""
        with rgb_variant():
            if len(opacity) != self._count:
                self._scene, self._count = self._build(data, opacity, colour), len(opacity)
                self._params = mi.traverse(self._scene)
                return
            for name, values in (("data", data), ("opacities", opacity), ("sh_coeffs", colour)):
                key = f"gaussians.{name}"
                self._params[key] = type(self._params[key])(np.ascontiguousarray(values, np.float32).ravel())
            self._params.update()

    def render(self) -> Any:
        """The three channels, a tensor [height, width, 3]."""
        with rgb_variant():
            return mi.render(self._scene, spp=1)

    def field(self, gaussians: Gaussians) -> NDArray[np.complex64]:
        """The complex field [height, width] of Gaussians with opacities (alpha blending), for one transmitter."""
        if gaussians.opacity is None or gaussians.batch != 1:
            raise ValueError("volprim_rf_basic blends by opacity, and Gaussians of one transmitter; give such")
        columns = [*gaussians.position, *gaussians.scale, *_normalised(gaussians.rotation)]
        dr.eval(columns, gaussians.signal, gaussians.opacity)
        signal = np.stack([part.numpy() for part in gaussians.signal], axis=1)
        top = float(np.hypot(*signal.T).max()) or 1.0
        colour = np.concatenate([signal / (2 * top * DEGREE_0), np.zeros((len(signal), 1))], axis=1)
        data = np.stack([column.numpy() for column in columns], axis=1)
        self.load(data, gaussians.opacity.numpy(), colour.astype(np.float32))
        channels = self.render().numpy()
        field: NDArray[np.complex64] = 2 * top * ((channels[..., :2] - channels[..., 2:]) @ np.array([1, 1j]))
        return field

    def _build(self, data: Floats, opacity: Floats, colour: Floats) -> Any:
        height, width = self.height, self.width
        table = pixel_directions(height, width).reshape(-1, 3) @ self.receiver.to_world.T
        direction = to_vectors(table, mi.Vector3f)
        origin = mi.Point3f(*self.receiver.position_m.tolist())

        class Rays(mi.Sensor):
            """Sensors are classes of one variant, so this one needs its own."""

            def sample_ray_differential(
                self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
            ) -> Any:
                row, column = mi.UInt32(sample2.y * height), mi.UInt32(sample2.x * width)
                ray = mi.Ray3f(origin, dr.gather(mi.Vector3f, direction, row * width + column, active))
                return mi.RayDifferential3f(ray), mi.Spectrum(1)

        mi.register_sensor("wrf_bench_rays", Rays)
        count = len(opacity)
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
                "sensor": {
                    "type": "wrf_bench_rays",
                    "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
                    "sampler": {"type": "independent", "sample_count": 1},
                },
                "gaussians": {
                    "type": "ellipsoids",
                    "data": mi.TensorXf(to_float(data), (count, 10)),
                    "opacities": mi.TensorXf(to_float(opacity), (count, 1)),
                    "sh_coeffs": mi.TensorXf(to_float(colour), (count, 3)),
                },
            }
        )


def _normalised(quaternion: list[Any]) -> list[Any]:
    length = dr.rsqrt(sum(q * q for q in quaternion))
    return [q * length for q in quaternion]
