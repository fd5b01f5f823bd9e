"""Mitsuba's integrator of Gaussians, ``volprim_rf_basic``, for receivers of this package.

It fails in the polarised variants that Sionna RT needs, so it runs in the rgb variant, one ray for each direction.
Colours cannot be negative, so a complex signal S with largest magnitude a is rendered as the channels

    1/2 + Re S / 2a,   1/2 + Im S / 2a,   1/2

and recovered by subtracting the third, as the blending is linear. The integrator stops at 1 % transmittance and after
64 Gaussians, absorbs at most 0.9999, and makes ellipsoids of low opacity smaller.
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

DEGREE_0 = 0.28209479177387814  # the spherical harmonic of degree 0: a colour is this times its coefficient, plus 1/2


@contextmanager
def rgb_variant() -> Iterator[None]:
    """Context in Mitsuba's rgb variant of the present backend.

    Entering takes a quarter of a second, so timed calls are in it already (`wrf_mi_bench.timing.Within`).
    """
    before: Any = mi.variant()
    rgb = before.replace("mono_polarized", "rgb")
    try:
        if rgb != before:
            mi.set_variant(rgb)
        yield
    finally:
        if rgb != before:
            mi.set_variant(before)


class StockRenderer:
    """Renderer of Gaussians for a receiver and a size of the spectrum."""

    def __init__(self, receiver: Receiver, height: int, width: int) -> None:
        self.receiver, self.height, self.width = receiver, height, width
        self._scene: Any = None
        self._count = -1

    def load(self, data: Floats, opacity: Floats, colour: Floats) -> None:
        """Load centres, standard deviations (m) and quaternions (x, y, z, w) [n, 10], opacity [n] and colour [n, 3]."""
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
        """Channels, a tensor [height, width, 3]."""
        with rgb_variant():
            return mi.render(self._scene, spp=1)

    def field(self, gaussians: Gaussians) -> NDArray[np.complex64]:
        """Complex field [height, width] of Gaussians of one transmitter with opacities (alpha blending)."""
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
            """Rays of the receiver; sensor classes belong to a variant."""

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
