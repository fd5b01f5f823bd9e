"""Vectors, rotations, poses and complex numbers on Dr.Jit arrays of any float type, with derivatives.

A vector is a list of three arrays, a complex number a pair (re, im).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from . import init

# Dr.Jit loads an LLVM when it is imported, so the choice must be made before.
init()

import drjit as dr
import mitsuba as mi

Vector = list[Any]
Complex = tuple[Any, Any]
Float64: Any = dr.float64_array_t(mi.Float)  # double precision of the present backend: phases k d of thousands of rad


@dataclass
class Pose:
    """A receiver's pose on the device: position (three arrays of width 1) and rotation to the world (3 x 3)."""

    position: Vector
    to_world: list[Vector]

    def to_local(self, v: Vector) -> Vector:
        """A world vector in the receiver's frame (R^T v)."""
        return [sum((self.to_world[k][i] * v[k] for k in (1, 2)), self.to_world[0][i] * v[0]) for i in range(3)]


def dot(a: Vector, b: Vector) -> Any:
    """Scalar product of two vectors."""
    return dr.fma(a[0], b[0], dr.fma(a[1], b[1], a[2] * b[2]))


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product of two vectors."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def tangent_basis(n: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors perpendicular to the unit vector n and to each other.

    Source: Duff et al. 2017, "Building an orthonormal basis, revisited", J. Comput. Graph. Techn. 6.
    """
    x, y, z = n
    # The sign of z keeps sign + z away from zero, on both hemispheres; it is constant in the derivative.
    sign: Any = dr.copysign(type(z)(1), dr.detach(z))
    a = -dr.rcp(sign + z)
    b = x * y * a
    return [dr.fma(sign * x * x, a, 1), sign * b, -sign * x], [b, dr.fma(y * y, a, sign), -y]


def principal_axes(quaternion: list[Any]) -> list[Vector]:
    """World directions of a frame's axes (columns of its rotation) from unnormalised quaternions x, y, z, w."""
    x, y, z, w = quaternion
    # 2 / |q|^2 normalises without a root, whose derivative is unbounded at zero.
    f = 2 / (x * x + y * y + z * z + w * w)
    return [
        [1 - f * (y * y + z * z), f * (x * y + z * w), f * (x * z - y * w)],
        [f * (x * y - z * w), 1 - f * (x * x + z * z), f * (y * z + x * w)],
        [f * (x * z + y * w), f * (y * z - x * w), 1 - f * (x * x + y * y)],
    ]


def centre_distance(a: Vector, b: Vector) -> Any:
    """Distance of points in float64, detached."""
    double: Any = dr.float64_array_t(type(a[0]))
    x, y, z = (double(dr.detach(p)) - double(dr.detach(q)) for p, q in zip(a, b, strict=True))
    return dr.sqrt(x * x + y * y + z * z)


def times(a: Sequence[Any], b: Complex) -> Complex:
    """Product of complex numbers."""
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def conjugate_times(a: Sequence[Any], b: Complex) -> Complex:
    """Conjugate of a, times b; a real number a is a sequence of one."""
    if len(a) == 1:
        return a[0] * b[0], a[0] * b[1]
    return a[0] * b[0] + a[1] * b[1], a[0] * b[1] - a[1] * b[0]


def complex_exponential(logarithm: Any, phase: Any) -> Complex:
    """Complex numbers of a logarithmic amplitude and a phase in rad."""
    sine, cosine = dr.sincos(phase)
    amplitude = dr.exp(logarithm)
    return amplitude * cosine, amplitude * sine
