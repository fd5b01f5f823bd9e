"""Mitsuba integrator of this package compared with splatting, and its time with ``volprim_rf_basic``'s."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
import wrf_mi_plugins
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import to_float
from wrf_mi.core import Receiver, unit_vectors
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.render import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

from .comparison import line
from .stock import StockRenderer, rgb_variant
from .timing import Within, interleaved, ratio

HEIGHT, WIDTH = 90, 360
BLENDINGS = ("alpha", "product")
LOWEST_SSIM, LARGEST_ERROR = 0.99, 0.02
"""Bounds for small Gaussians: SSIM of magnitudes, relative L2 error of complex values."""
DISTANCE_M = (2.0, 8.0)

SMALL_DEG = 2.0  # largest angular standard deviation of Gaussians whose projection is close to exact

Image = NDArray[np.complex128]


def random_field(
    seed: int, blending: str, count: int = 300, size_deg: float = SMALL_DEG, ratio: float = 2.0, opacity: float = 0.8
) -> tuple[Gaussians, Receiver]:
    """Gaussians in random directions above a receiver at a random pose, with the receiver.

    Args:
        seed: seed of the random numbers.
        blending: ``"alpha"`` or ``"product"``.
        count: number of Gaussians, two or more: one at the zenith, one on the azimuth seam.
        size_deg: largest angular standard deviation.
        ratio: largest ratio between the axes of a Gaussian.
        opacity: largest opacity.
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

    def columns(values: Any) -> list[Any]:
        return [to_float(column) for column in np.transpose(values)]

    product = blending == "product"
    return Gaussians(
        position=columns(position),
        scale=columns(scale),
        rotation=columns(rng.standard_normal((count, 4))),
        signal=columns(rng.standard_normal((count, 2))),
        opacity=None if product else columns(rng.uniform(0.05, opacity, (count, 1)))[0],
        attenuation=columns(np.stack([delta.real, delta.imag], axis=1)) if product else None,
        batch=1,
    ), receiver


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
    result = []
    for seed in range(fields):
        for blending in BLENDINGS:
            gaussians, receiver = random_field(seed, blending, **field)
            result.append(difference(traced(gaussians, receiver), splatted(gaussians, receiver)))
    return result


def worst(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The worst of several `difference`."""
    return {
        "lowest_ssim": min(f["ssim"] for f in found),
        "largest_magnitude_error": max(f["magnitude_error"] for f in found),
        "largest_complex_error": max(f["complex_error"] for f in found),
    }


def by_size(sizes_deg: tuple[float, ...] = (1, 2, 3, 5, 10, 15, 20), fields: int = 3) -> list[dict[str, float]]:
    """Mean `difference` by angular size, for round Gaussians and for axes of 2 : 1.

    Projection neglects the tilt against the line of sight, of first order in the size and zero for round Gaussians, and
    the extent in depth, of second order (`wrf_mi_plugins.ray_response`).
    """
    rows = []
    for size in sizes_deg:
        for axes in (1.0, 2.0):
            # The overlap is that of 300 Gaussians of 2 degrees, except at the largest sizes.
            count = max(30, int(300 * (2 / size) ** 2))
            found = against_splatted(fields, size_deg=size, ratio=axes, count=min(count, 1000))
            means = {name: float(np.mean([f[name] for f in found])) for name in found[0]}
            rows.append({"size_deg": float(size), "ratio": axes} | means)
    return rows


def pace(size_deg: float, count: int = 10_000, repeats: int = 7) -> dict[str, float]:
    """Median times of interleaved renders in ms, by this package and by ``volprim_rf_basic`` in the rgb variant.

    ``traced_ms`` is a render after the geometry changed, ``again_ms`` after the signals changed. Updates of the scene,
    in which Mitsuba builds its BVH, do not count.
    """
    gaussians, receiver = random_field(0, "alpha", count, size_deg, opacity=0.1)
    opacity: Any = gaussians.opacity
    scene = scene_of(gaussians, receiver)
    params = mi.traverse(scene)
    # Copied, as an update of the scene frees the memory.
    data, signal = (params[f"gaussians.{name}"].numpy().copy() for name in ("data", "signal"))
    stock = StockRenderer(receiver, HEIGHT, WIDTH)
    colour = np.random.default_rng(0).standard_normal((count, 3)).astype(np.float32)
    stock.load(data.reshape(count, -1), opacity.numpy(), colour)

    @contextmanager
    def changed(key: str, values: NDArray[np.float32]) -> Iterator[None]:
        params[f"gaussians.{key}"] = to_float(values)
        params.update()
        yield

    calls = {
        "traced_ms": Within(partial(mi.render, scene), partial(changed, "data", data)),
        "again_ms": Within(partial(mi.render, scene), partial(changed, "signal", signal)),
        "stock_ms": Within(stock.render, rgb_variant),
    }
    times = interleaved(calls, repeats, 1)
    return {
        "size_deg": float(size_deg),
        "gaussians": float(count),
        **{name: float(np.median(ms)) for name, ms in times.items()},
        "stock_over_traced": ratio(times["stock_ms"], times["traced_ms"]).value,
        "stock_over_again": ratio(times["stock_ms"], times["again_ms"]).value,
    }


def main() -> dict[str, Any]:
    """All figures, with rows for the table."""
    small = against_splatted()
    figures: dict[str, Any] = {
        "small": {"fields": len(small), **worst(small)},
        "by_size": by_size(),
        "pace": [pace(size) for size in (1.0, 2.0, 7.0)],
    }
    least, most = figures["small"]["lowest_ssim"], 100 * figures["small"]["largest_complex_error"]
    what = f"traced against splatted, worst of {len(small)} renders of random fields of small Gaussians"
    asked = f"{LOWEST_SSIM:g}, {100 * LARGEST_ERROR:g} %"
    rows = [line(what, f"SSIM {least:.4f}, L2 error {most:.2f} %", asked)]
    for found in figures["pace"]:
        what = f"10,000 Gaussians of {found['size_deg']:g}°, 360 x 90: `volprim_rf_basic`'s time over ours"
        rows.append(line(what, f"{found['stock_over_traced']:.1f} ({found['traced_ms']:.0f} ms)", "1"))
    return {"rows": rows, **figures}
