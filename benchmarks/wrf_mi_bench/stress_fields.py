"""Random and ill-conditioned fields of Gaussians, their images in float64, and derivatives in float32 and float64.

All parameters are exactly representable in float32, so that differences come from the arithmetic alone.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend import init
from wrf_mi.backend.device import on_device as to_device
from wrf_mi.backend.vectors import Pose
from wrf_mi.core import Receiver, pixel_directions, rotation_matrix, unit_vectors
from wrf_mi.core.angles import FloatArray
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE

from . import field_oracle

init()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

DOUBLE: Any = dr.float64_array_t(mi.Float)

ComplexArray = NDArray[np.complex128]
Size = tuple[int, int]
BLENDINGS = ("alpha", "product")
Rng = np.random.Generator
Family = Callable[[Rng], "StressField"]
RECEIVER = Receiver(
    "receiver", np.array([5.0, 0.25, 0.125]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
)
SIZE, SMALL = (30, 60), (8, 16)  # rows and columns of an image; of one with tens of thousands of layers
ON_THE_EDGE = 1e-3
"""Relative distance to a footprint's edge, where it jumps by 0.011, within which pixels are not compared."""


@dataclass(frozen=True)
class StressField:
    """Positions and scales [n, 3] in m, quaternions (x, y, z, w) of any length [n, 4], complex signals [n], opacity of
    alpha blending [n] and complex attenuation of product blending [n] of n Gaussians."""

    position_m: FloatArray
    scale_m: FloatArray
    rotation: FloatArray
    signal: ComplexArray
    opacity: FloatArray
    attenuation: ComplexArray

    def groups(self, blending: str) -> dict[str, FloatArray]:
        """Real parameters [n, k] of a blending by name."""
        name, last = ("opacity", self.opacity) if blending == "alpha" else ("attenuation", self.attenuation)
        pairs = {
            key: np.stack([z.real, z.imag] if np.iscomplexobj(z) else [z], axis=1)
            for key, z in (("signal", self.signal), (name, last))
        }
        return {"position": self.position_m, "scale": self.scale_m, "rotation": self.rotation} | pairs


def made(count: int, rng: Rng, **replaced: Any) -> StressField:
    """Random field around `RECEIVER`; ``replaced`` arrays replace drawn ones."""
    values: dict[str, Any] = {
        "position_m": placed(rng.uniform(0, 2 * np.pi, count), np.arcsin(rng.uniform(-0.1, 1, count)), rng),
        "scale_m": np.exp(rng.normal(np.log(0.4), 0.5, (count, 3))),
        "rotation": rng.normal(size=(count, 4)),
        "signal": rng.normal(size=(count, 2)) @ [1, 1j],
        "opacity": rng.uniform(0, 1, count),
        "attenuation": np.sqrt(rng.uniform(0, 1, count)) * np.exp(2j * np.pi * rng.uniform(0, 1, count)),
    }
    return StressField(**{name: _held_by_float32(value) for name, value in (values | replaced).items()})


def ordinary(rng: Rng) -> StressField:
    """Random field of 1 to 99 Gaussians."""
    return made(int(rng.integers(1, 100)), rng)


def placed(
    azimuth: FloatArray, elevation: FloatArray, rng: Rng, distance_m: tuple[float, float] = (1.0, 8.0)
) -> FloatArray:
    """Positions [n, 3] at random distances in directions of the receiver's frame (rad)."""
    away = unit_vectors(azimuth, elevation) * rng.uniform(*distance_m, (len(azimuth), 1))
    return np.asarray(RECEIVER.position_m + away @ RECEIVER.to_world.T)


def _held_by_float32(value: Any) -> Any:
    array = np.asarray(value)
    if np.iscomplexobj(array):
        return array.astype(np.complex64).astype(complex)
    return array.astype(np.float32).astype(float)


N = 40
HARD: Mapping[str, Family] = {
    "sizes of 1e-6 to 1e3 m in one field": lambda r: made(N, r, scale_m=10 ** r.uniform(-6, 3, (N, 1)) * np.ones(3)),
    "each axis of 1e-6 to 1e3 m": lambda r: made(N, r, scale_m=10 ** r.uniform(-6, 3, (N, 3))),
    "needles, 1e6 to 1": lambda r: made(N, r, scale_m=np.tile([1, 1e-6, 1e-6], (N, 1))),
    "discs, 1e6 to 1": lambda r: made(N, r, scale_m=np.tile([1, 1, 1e-6], (N, 1))),
    "containing the receiver": lambda r: made(
        N, r, position_m=RECEIVER.position_m + r.normal(0, 0.5, (N, 3)), scale_m=r.uniform(0.5, 3, (N, 3))
    ),
    "10 km away": lambda r: made(
        N, r, position_m=RECEIVER.position_m + 1e4 * r.normal(size=(N, 3)), scale_m=10 ** r.uniform(1, 3, (N, 3))
    ),
    "on the horizon": lambda r: made(N, r, position_m=placed(r.uniform(0, 6, N), r.normal(0, 0.02, N), r)),
    "on the zenith": lambda r: made(
        N, r, position_m=placed(r.uniform(0, 6, N), np.pi / 2 - np.abs(r.normal(0, 0.01, N)), r)
    ),
    "across the azimuth seam": lambda r: made(N, r, position_m=placed(r.normal(0, 0.01, N), r.uniform(0, 1, N), r)),
    "exact ties in depth": lambda r: made(
        N,
        r,
        position_m=RECEIVER.position_m + 2 * r.choice([-1, 1], (N, 3)) * [r.permutation([1.0, 2, 3]) for _ in range(N)],
    ),
    "opacity 0, 1 and 1 - 1e-7": lambda r: made(
        N, r, opacity=r.choice([0, 1, 1 - 1e-7, 1e-7], N), attenuation=r.choice([0, 1, -1, 1j], N)
    ),
    "signals of 1e-15 to 1e15": lambda r: made(
        N, r, signal=10 ** r.uniform(-15, 15, N) * np.exp(2j * np.pi * r.uniform(size=N))
    ),
    "quaternions of length 1e-8 to 1e8": lambda r: made(
        N, r, rotation=r.normal(size=(N, 4)) * 10 ** r.uniform(-8, 8, (N, 1))
    ),
    "one Gaussian": lambda r: made(1, r),
    "none": lambda r: made(0, r),
}
"""Families of ill-conditioned fields."""
HARDEST = ("each axis of 1e-6 to 1e3 m", "needles, 1e6 to 1", "exact ties in depth", "opacity 0, 1 and 1 - 1e-7")
"""Families whose derivatives the quick form compares."""


def layers(rng: Rng, count: int = 50_000, **replaced: Any) -> StressField:
    """Gaussians behind each other, whose transmittance underflows in float32."""
    position_m = placed(rng.normal(1, 0.005, count), rng.normal(0.7, 0.005, count), rng)
    distance = np.linalg.norm(position_m - RECEIVER.position_m, axis=1)
    return made(count, rng, position_m=position_m, scale_m=np.tile(0.1 * distance[:, None], 3), **replaced)


def truth(
    field: StressField, blending: str, size: Size, on_rays: bool = False, sphere: bool = False, every: int = 1
) -> tuple[ComplexArray, NDArray[np.bool_]]:
    """Image [height, width] in float64, and a mask of pixels off all footprints' edges, where the image jumps.

    Splatting takes a Gaussian's response in the tangent plane (`field_oracle`), the Mitsuba plugin the largest one on a
    ray (``on_rays``); both agree in the limit of small angles. With ``sphere`` the lower hemisphere is appended:
    [2 * height, width]; of ``every`` so many rows the first is computed.
    """
    directions = pixel_directions(*size)[::every]
    if sphere:
        directions = np.concatenate([directions, directions * [1, -1, -1]])
    view = field_oracle.project(field.position_m, field.scale_m, field.rotation, RECEIVER)
    responses, clear = np.zeros((len(view.order), *directions.shape[:2])), np.ones(directions.shape[:2], bool)
    for response, i in zip(responses, view.order, strict=True):
        reach = _on_rays(field, i, directions) if on_rays else field_oracle.reach(view, i, directions)
        squared, cosine = reach
        response[:] = np.where((squared < CUTOFF**2) & (cosine > MIN_COSINE), np.exp(-squared / 2), 0)
        off = (np.abs(np.sqrt(squared) - CUTOFF) > ON_THE_EDGE * CUTOFF) | (cosine < MIN_COSINE / 2)
        clear &= off & (np.abs(cosine - MIN_COSINE) > ON_THE_EDGE * MIN_COSINE)
    signal = field.signal[view.order]
    if blending == "alpha":
        return field_oracle.blend_alpha(responses, signal, field.opacity[view.order]), clear
    return field_oracle.blend_product(responses, signal, field.attenuation[view.order]), clear


def _on_rays(field: StressField, index: int, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least squared Mahalanobis distance of a Gaussian on each ray, and cosines to its direction."""
    offset = field.position_m[index] - RECEIVER.position_m
    depth = np.linalg.norm(offset)
    rays = directions @ RECEIVER.to_world.T
    scale = np.sqrt(field.scale_m[index] ** 2 + (LOW_PASS_RAD * depth) ** 2)
    whiten = rotation_matrix(field.rotation[index]).T / scale[:, None]
    centre, along = whiten @ offset, rays @ whiten.T
    t = np.maximum((along @ centre) / (along**2).sum(-1), 0)
    return ((t[..., None] * along - centre) ** 2).sum(-1), rays @ (offset / depth)


Observe = Callable[[Gaussians, Pose], Sequence[Any]]  # differentiable real arrays computed from a field


def gradient(field: StressField, blending: str, float_type: Any, seed: int, observe: Observe) -> dict[str, FloatArray]:
    """Derivative [n, k] of a random linear functional of an observation by each group of parameters."""
    gaussians, parts = on_device(field, blending, float_type)
    for array in (a for part in parts.values() for a in part):
        dr.enable_grad(array)
    observation = observe(gaussians, pose(float_type))
    rng = np.random.default_rng(seed)
    weights = [rng.normal(size=dr.width(part)).astype(np.float32) for part in observation]
    total: Any = 0
    for part, weight in zip(observation, weights, strict=True):
        total = total + dr.sum(part * to_device(weight, float_type))
    dr.backward(total)
    return {name: np.stack([dr.grad(a).numpy().astype(float) for a in part], axis=1) for name, part in parts.items()}


def felt_values(field: StressField, blending: str) -> dict[str, FloatArray]:
    """Factors of the derivatives by group: the parameters, with positions relative to the receiver."""
    values = field.groups(blending)
    return values | {"position": values["position"] - RECEIVER.position_m}


def pose(float_type: Any) -> Pose:
    """Pose of `RECEIVER`, rounded to float32."""
    return Pose(
        [float_type(float(np.float32(x))) for x in RECEIVER.position_m],
        [[float_type(float(np.float32(x))) for x in row] for row in RECEIVER.to_world],
    )


def on_device(field: StressField, blending: str, float_type: Any) -> tuple[Gaussians, dict[str, list[Any]]]:
    """The field's Gaussians, and their arrays by group of parameters."""
    groups = field.groups(blending).items()
    parts = {name: [to_device(column, float_type) for column in values.T] for name, values in groups}
    geometry = {name: parts[name] for name in ("position", "scale", "rotation", "signal")}
    opacity = parts["opacity"][0] if blending == "alpha" else None
    return Gaussians(**geometry, opacity=opacity, attenuation=parts.get("attenuation"), batch=1), parts


def cases(families: Mapping[str, Family], count: int) -> Iterator[tuple[str, StressField, str, int]]:
    """Family, field, blending and seed of each case: ``count`` fields of each family."""
    for name, family in families.items():
        for seed in range(count):
            field = family(np.random.default_rng(seed))
            for blending in BLENDINGS:
                yield name, field, blending, seed
