"""Fields that are hard on float32, and their images and derivatives by the fast code and by float64.

Every number of a field is one that float32 holds exactly, so that what differs is the arithmetic alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.core import Receiver, pixel_directions, unit_vectors
from wrf_mi.core.angles import FloatArray
from wrf_mi.gaussians import Gaussians, oracle
from wrf_mi.gaussians.footprint import Pose
from wrf_mi.gaussians.footprint_constants import CUTOFF, MIN_COSINE
from wrf_mi.gaussians.render import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

ComplexArray = NDArray[np.complex128]
BLENDINGS = ("alpha", "product")
RECEIVER = Receiver(
    "receiver", np.array([5.0, 0.25, 0.125]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
)
ON_THE_EDGE = 1e-3
"""A footprint ends with a jump of 0.011; pixels so near to it, in shares of its radius, may fall to either side."""
LAYERS = 50_000


@dataclass(frozen=True)
class Field:
    """Gaussians, n of them, in float64 arrays of float32 numbers.

    Attributes:
        position_m, scale_m: [n, 3].
        rotation: quaternions (x, y, z, w), any length, [n, 4].
        signal: complex [n].
        opacity: alpha blending's, [n].
        attenuation: product blending's, complex [n].
    """

    position_m: FloatArray
    scale_m: FloatArray
    rotation: FloatArray
    signal: ComplexArray
    opacity: FloatArray
    attenuation: ComplexArray

    def groups(self, blending: str) -> dict[str, FloatArray]:
        """Parameters that a blending has, real, by name, [n, k]."""

        def pair(z: ComplexArray) -> FloatArray:
            return np.stack([z.real, z.imag], axis=1)

        last = {"opacity": self.opacity[:, None]} if blending == "alpha" else {"attenuation": pair(self.attenuation)}
        own = {"position": self.position_m, "scale": self.scale_m, "rotation": self.rotation}
        return own | {"signal": pair(self.signal)} | last


def made(count: int, rng: np.random.Generator, **own: Any) -> Field:
    """An ordinary random field around `RECEIVER`, with ``own`` arrays in place of what is drawn."""
    values: dict[str, Any] = {
        "position_m": placed(rng.uniform(0, 2 * np.pi, count), np.arcsin(rng.uniform(-0.1, 1, count)), rng),
        "scale_m": np.exp(rng.normal(np.log(0.4), 0.5, (count, 3))),
        "rotation": rng.normal(size=(count, 4)),
        "signal": rng.normal(size=(count, 2)) @ [1, 1j],
        "opacity": rng.uniform(0, 1, count),
        "attenuation": np.sqrt(rng.uniform(0, 1, count)) * np.exp(2j * np.pi * rng.uniform(0, 1, count)),
    }
    return Field(**{name: _held_by_float32(value) for name, value in (values | own).items()})


def placed(
    azimuth: FloatArray, elevation: FloatArray, rng: np.random.Generator, distance_m: tuple[float, float] = (1.0, 8.0)
) -> FloatArray:
    """Positions [n, 3] in directions of the receiver's frame, rad, at random distances."""
    away = unit_vectors(azimuth, elevation) * rng.uniform(*distance_m, (len(azimuth), 1))
    return np.asarray(RECEIVER.position_m + away @ RECEIVER.to_world.T)


def _held_by_float32(value: Any) -> Any:
    array = np.asarray(value)
    if np.iscomplexobj(array):
        return array.astype(np.complex64).astype(complex)
    return array.astype(np.float32).astype(float)


N = 40
Rng = np.random.Generator
HARD: Mapping[str, Callable[[Rng], Field]] = {
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
"""Families of fields by name."""


def layers(rng: Rng) -> Field:
    """`LAYERS` Gaussians behind each other: transmittance falls below every float32."""
    place = placed(rng.normal(1, 0.005, LAYERS), rng.normal(0.7, 0.005, LAYERS), rng)
    distance = np.linalg.norm(place - RECEIVER.position_m, axis=1)
    return made(LAYERS, rng, position_m=place, scale_m=np.tile(0.1 * distance[:, None], 3))


def image(field: Field, blending: str, size: tuple[int, int]) -> ComplexArray:
    """By the fast code in float32, [height, width]."""
    plane = perception_plane(*size, mi.Float)
    re, im = splat(on_device(field, blending, mi.Float)[0], device_pose(RECEIVER), plane)
    return (re.numpy().astype(float) + 1j * im.numpy()).reshape(size)


def reference(
    field: Field, blending: str, size: tuple[int, int], sphere: bool = False
) -> tuple[ComplexArray, NDArray[np.bool_]]:
    """By `wrf_mi.gaussians.oracle` in float64, and which pixels lie on no edge of a footprint.

    Args:
        field: what is seen.
        blending: one of `BLENDINGS`.
        size: rows and columns of a hemisphere.
        sphere: the lower hemisphere too, below the upper one.

    Returns:
        Both [height, width], or [2 * height, width].
    """
    directions = pixel_directions(*size)
    if sphere:
        directions = np.concatenate([directions, directions * [1, -1, -1]])
    parts = (field.position_m, field.scale_m, field.rotation)
    own = {"opacity": field.opacity} if blending == "alpha" else {"attenuation": field.attenuation}
    seen = oracle.project(*parts, RECEIVER)
    clear = np.ones(directions.shape[:2], bool)
    for i in seen.order:
        cosine = directions @ seen.direction[i]
        point = directions @ seen.basis[i].T / np.where(cosine > MIN_COSINE, cosine, 1)[..., None]
        reach = np.sqrt(np.einsum("...i,ij,...j->...", point, np.linalg.inv(seen.covariance[i]), point))
        clear &= (np.abs(reach - CUTOFF) > ON_THE_EDGE * CUTOFF) | (cosine < MIN_COSINE / 2)
        clear &= np.abs(cosine - MIN_COSINE) > ON_THE_EDGE * MIN_COSINE
    return oracle.render(*parts, field.signal, RECEIVER, directions, **own), clear


Report = Callable[[Gaussians, Pose], Sequence[Any]]
"""What is made of a field: real arrays, differentiable."""


def gradient(
    field: Field, blending: str, size: tuple[int, int], float_type: Any, seed: int, report: Report | None = None
) -> dict[str, FloatArray]:
    """Derivative of a random linear functional of the image by each group of parameters, [n, k].

    Args:
        field: what is seen.
        blending: one of `BLENDINGS`.
        size: rows and columns of the image.
        float_type: in which all is computed.
        seed: of the functional.
        report: what it is a functional of; None: of the image's real and imaginary part.
    """
    gaussians, parts = on_device(field, blending, float_type)
    for array in (a for part in parts.values() for a in part):
        dr.enable_grad(array)
    if report is None:
        reported: Sequence[Any] = splat(gaussians, pose(float_type), perception_plane(*size, float_type))
    else:
        reported = report(gaussians, pose(float_type))
    rng = np.random.default_rng(seed)
    weights = [rng.normal(size=dr.width(part)).astype(np.float32) for part in reported]
    total: Any = 0
    for part, weight in zip(reported, weights, strict=True):
        total = total + dr.sum(part * to_device(weight, float_type))
    dr.backward(total)
    return {name: np.stack([dr.grad(a).numpy().astype(float) for a in part], axis=1) for name, part in parts.items()}


def felt_values(field: Field, blending: str) -> dict[str, FloatArray]:
    """Parameters by group as derivatives are multiplied with: positions count from the receiver."""
    values = field.groups(blending)
    return values | {"position": values["position"] - RECEIVER.position_m}


def pose(float_type: Any) -> Pose:
    """Of `RECEIVER`, in numbers that float32 holds."""
    return Pose(
        [float_type(float(np.float32(x))) for x in RECEIVER.position_m],
        [[float_type(float(np.float32(x))) for x in row] for row in RECEIVER.to_world],
    )


def on_device(field: Field, blending: str, float_type: Any) -> tuple[Gaussians, dict[str, list[Any]]]:
    """The field's Gaussians, and the arrays that they are made of by group of parameters."""
    parts = {
        name: [to_device(column, float_type) for column in values.T] for name, values in field.groups(blending).items()
    }
    return (
        Gaussians(
            position=parts["position"],
            scale=parts["scale"],
            rotation=parts["rotation"],
            signal=parts["signal"],
            opacity=parts["opacity"][0] if blending == "alpha" else None,
            attenuation=parts["attenuation"] if blending == "product" else None,
            batch=1,
        ),
        parts,
    )
