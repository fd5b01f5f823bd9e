"""Mitsuba integrator of this package compared with splatting, and its time with ``volprim_rf_basic``'s.

It fails in the polarised variants that Sionna RT needs, so it runs in the rgb variant, one ray for each direction.
Colours cannot be negative, so a complex signal S with largest magnitude a is rendered as the channels

    1/2 + Re S / 2a,   1/2 + Im S / 2a,   1/2

and recovered by subtracting the third, as the blending is linear. The integrator stops at 1 % transmittance and after
64 Gaussians, absorbs at most 0.9999, and makes ellipsoids of low opacity smaller.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import wrf_mi_plugins
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import to_float, to_vectors
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

from .stress_fields import BLENDINGS, made, on_device

HEIGHT, WIDTH = 90, 360
LOWEST_SSIM, LARGEST_ERROR = 0.99, 0.02
"""Bounds for small Gaussians: SSIM of magnitudes, relative L2 error of complex values."""
DISTANCE_M = (2.0, 8.0)

SMALL_DEG = 2.0  # largest angular standard deviation of Gaussians whose projection is close to exact

Floats = NDArray[np.float32]

DEGREE_0 = 0.28209479177387814  # the spherical harmonic of degree 0: a colour is this times its coefficient, plus 1/2
Image = NDArray[np.complex128]


def random_field(
    seed: int, blending: str, count: int = 300, size_deg: float = SMALL_DEG, ratio: float = 2.0, opacity: float = 0.8
) -> tuple[Gaussians, Receiver]:
    """Gaussians in random directions above a receiver at a random pose, with the receiver.

    Two or more: one at the zenith, one on the azimuth seam. ``size_deg``, ``ratio`` and ``opacity`` are the largest
    angular standard deviation, ratio between the axes of a Gaussian, and opacity.
    """
    rng = np.random.default_rng(seed)
    quaternion = rng.standard_normal(4)
    receiver = Receiver("receiver", rng.normal(0, 3, 3), quaternion / np.linalg.norm(quaternion))
    azimuth, elevation = rng.uniform(0, 2 * np.pi, count), np.arcsin(rng.uniform(0, 1, count))
    azimuth[0], elevation[0], elevation[1] = 0.0, np.radians(20), np.pi / 2
    distance = rng.uniform(*DISTANCE_M, count)
    position = receiver.position_m + (unit_vectors(azimuth, elevation) * distance[:, None]) @ receiver.to_world.T
    axes = np.exp(-rng.uniform(0, np.log(ratio), (count, 3)))
    scale = np.tan(np.radians(size_deg)) * distance[:, None] * axes / axes.max(axis=1, keepdims=True)
    delta = rng.uniform(0, 0.95, count) * np.exp(1j * rng.uniform(0, 2 * np.pi, count))
    values = {"position_m": position, "scale_m": scale, "rotation": rng.standard_normal((count, 4))}
    values |= {"signal": rng.standard_normal((count, 2)) @ [1, 1j], "attenuation": delta}
    drawn = made(count, rng, **values, opacity=rng.uniform(0.05, opacity, count))
    return on_device(drawn, blending, mi.Float)[0], receiver


def scene_of(gaussians: Gaussians, receiver: Receiver, height: int = HEIGHT, width: int = WIDTH, **more: Any) -> Any:
    """``mi.Scene`` with Gaussians, the receiver's perception plane and this package's integrator."""
    from wrf_mi_plugins.sensor import receiver_to_world
    from wrf_mi_plugins.shape import gaussian_shape

    wrf_mi_plugins.register_all()
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "wrf_traced"},
            "sensor": {
                "type": "wrf_perception_plane",
                "to_world": receiver_to_world(receiver.position_m, receiver.orientation_xyzw),
                "film": film | {"rfilter": {"type": "box"}},
            },
            "gaussians": gaussian_shape(gaussians),
        }
        | more
    )


def traced(gaussians: Gaussians, receiver: Receiver) -> Image:
    """Complex image [HEIGHT, WIDTH] by ``mi.render``."""
    return np.asarray(mi.render(scene_of(gaussians, receiver)).numpy(), float) @ np.array([1, 1j])


def splatted(gaussians: Gaussians, receiver: Receiver) -> Image:
    """Complex image [HEIGHT, WIDTH] by splatting."""
    re, im = splat(gaussians, device_pose(receiver), perception_plane(HEIGHT, WIDTH, mi.Float))
    return (re.numpy().astype(float) + 1j * im.numpy()).reshape(HEIGHT, WIDTH)


def difference(a: Image, b: Image) -> dict[str, float]:
    """SSIM of the magnitudes of images a and b, scaled to b's largest, and relative L2 errors."""
    top = np.abs(b).max()
    return {
        "ssim": float(structural_similarity(np.abs(a) / top, np.abs(b) / top, data_range=1)),
        "magnitude_error": float(np.linalg.norm(np.abs(a) - np.abs(b)) / np.linalg.norm(b)),
        "complex_error": float(np.linalg.norm(a - b) / np.linalg.norm(b)),
    }


def against_splatted(fields: int = 20, **field: Any) -> list[dict[str, float]]:
    """`difference` of traced and splatted for each blending on each of ``fields`` random fields."""
    scenes = (random_field(seed, blending, **field) for seed in range(fields) for blending in BLENDINGS)
    return [difference(traced(*scene), splatted(*scene)) for scene in scenes]


def worst(differences: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {
        "lowest_ssim": min(f["ssim"] for f in differences),
        "largest_magnitude_error": max(f["magnitude_error"] for f in differences),
        "largest_complex_error": max(f["complex_error"] for f in differences),
    }


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

    def render(self) -> Any:
        """Channels, a tensor [height, width, 3]."""
        with rgb_variant():
            return mi.render(self._scene, spp=1)

    def field(self, gaussians: Gaussians) -> NDArray[np.complex64]:
        """Complex field [height, width] of Gaussians of one transmitter with opacities (alpha blending)."""
        if gaussians.opacity is None or gaussians.batch != 1:
            raise ValueError("volprim_rf_basic blends by opacity, and Gaussians of one transmitter; give such")
        inverse = dr.rsqrt(sum(q * q for q in gaussians.rotation))
        columns = [*gaussians.position, *gaussians.scale, *(q * inverse for q in gaussians.rotation)]
        dr.eval(columns, gaussians.signal, gaussians.opacity)
        signal = np.stack([part.numpy() for part in gaussians.signal], axis=1)
        top = float(np.hypot(*signal.T).max()) or 1.0
        colour = np.concatenate([signal / (2 * top * DEGREE_0), np.zeros((len(signal), 1))], axis=1)
        data = np.stack([column.numpy() for column in columns], axis=1)
        values = {"data": data, "opacities": gaussians.opacity.numpy(), "sh_coeffs": colour.astype(np.float32)}
        with rgb_variant():
            if len(data) != self._count:
                self._scene, self._count = self._build(*values.values()), len(data)
                self._params = mi.traverse(self._scene)
            for name, array in values.items():
                key = f"gaussians.{name}"
                self._params[key] = type(self._params[key])(np.ascontiguousarray(array, np.float32).ravel())
            self._params.update()
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
