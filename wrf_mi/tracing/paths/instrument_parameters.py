"""Pose, gain and antenna patterns of a receiver as parameters, for traced paths and Gaussians alike.

Pose: corrections to the stated one, which stays in float64: the position p = p0 + t in the world's frame, the
orientation R = R0 E(r) with a rotation E about the receiver's axes. E is the Cayley transform, the unit quaternion in
the direction of (r / 2, 1), a turn by 2 atan(abs(r) / 2): for small r the rotation vector, and smooth at zero. Source:
Shuster, "A survey of attitude representations" (1993).

Antenna pattern: a smooth complex factor of direction,

    F(u) = exp(sum_{l=1..L} sum_m (a_lm + j b_lm) Y_lm(u))

with real spherical harmonics Y_lm of degree 1 and up. It multiplies a pattern of Sionna RT (isotropic by default) in
both polarisations; degree 0, a constant, is the instrument's gain. Zero coefficients give F = 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.vectors import Complex, Float64, Pose, Vector, complex_exponential, principal_axes, times
from ...core import Receiver
from ...core.angles import FloatArray

TX_PATTERN = "pattern.transmitter"  # name of the parameter [2, c] of the transmitters' pattern


def gain_name(receiver: Receiver) -> str:
    """Name of the parameter [2]: logarithm of the instrument's amplitude, and its phase in rad."""
    return f"receiver.{receiver.name}.gain"


def pattern_name(receiver: Receiver) -> str:
    """Name of the parameter [2, c] of the receiver's pattern."""
    return f"receiver.{receiver.name}.pattern"


def instrument_parameters(receiver: Receiver, pattern_degree: int) -> dict[str, NDArray[np.float32]]:
    """Initial values by name: the stated pose and gain, and with a degree of patterns those of both antennas."""
    shapes: dict[str, tuple[int, ...]] = {**dict.fromkeys(pose_names(receiver), (3,)), gain_name(receiver): (2,)}
    if pattern_degree:
        shapes |= {name: (2, (pattern_degree + 1) ** 2 - 1) for name in (pattern_name(receiver), TX_PATTERN)}
    return {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}


def pose_names(receiver: Receiver) -> tuple[str, str]:
    """Names of the parameters of position [3] in metres and of rotation [3] in rad, zeros as stated."""
    return f"receiver.{receiver.name}.position", f"receiver.{receiver.name}.turn"


def receiver_pose(receiver: Receiver, parameters: Mapping[str, Any], float_type: Any) -> Pose:
    """Corrected pose in a float type, by tensors [3] of position and rotation; missing: as stated. Differentiable."""

    def correction(name: str) -> list[Any]:
        if name not in parameters:
            return [float_type(0)] * 3
        return [float_type(component(parameters[name], i)) for i in range(3)]

    # p = p0 + t, and the columns of R0 E(r): E's axes in the stated frame.
    moved, turned = (correction(name) for name in pose_names(receiver))
    position = [float(x) + t for x, t in zip(receiver.position_m, moved, strict=True)]
    columns = principal_axes([*(0.5 * r for r in turned), float_type(1)])
    rotation = receiver.to_world
    to_world = [[sum(float(rotation[i, k]) * columns[j][k] for k in range(3)) for j in range(3)] for i in range(3)]
    return Pose(position, to_world)


def moved_m(receiver: Receiver, parameters: Mapping[str, Any]) -> FloatArray:
    """Corrected position of the receiver on the host, [3], metres."""
    name = pose_names(receiver)[0]
    shift = dr.detach(parameters[name]).numpy() if name in parameters else np.zeros(3)
    return receiver.position_m + np.asarray(shift, float).reshape(3)


def component(tensor: Any, i: int) -> Any:
    """Entry ``i`` of a flattened tensor as an array of width 1. Differentiable."""
    flat = tensor.array
    return dr.gather(type(flat), flat, dr.uint32_array_t(type(flat))(i))


def spread_pose(pose: Pose, count: int) -> Pose:
    """A pose as arrays of ``count`` values."""
    # The derivative of a gather is a sum in the same kernel; broadcast numbers would take a kernel for each of the
    # twelve.
    table = dr.concat([*pose.position, *(c for row in pose.to_world for c in row)])
    kind: Any = type(table)
    wide = [dr.gather(kind, table, dr.full(dr.uint32_array_t(kind), i, count)) for i in range(12)]
    return Pose(wide[:3], [wide[3:6], wide[6:9], wide[9:12]])


def with_antennas(
    gain: Complex, receiver: Receiver, parameters: Mapping[str, Any], arrival: Vector, departure: Vector
) -> Complex:
    """Gains of paths times those of the instrument and of both patterns that are parameters. Differentiable."""
    if (name := gain_name(receiver)) in parameters:
        float_type = type(gain[0])
        gain = times(gain, complex_exponential(*(float_type(component(parameters[name], i)) for i in (0, 1))))
    for name, direction in ((pattern_name(receiver), arrival), (TX_PATTERN, departure)):
        if name in parameters:
            gain = times(gain, pattern_factor(parameters[name], direction))
    return gain


def pattern_factor(coefficients: Any, direction: Vector) -> Complex:
    """Complex factor F(u) of directions u in the antenna's frame, three arrays [p], in their type. Differentiable.

    ``coefficients``: real and imaginary parts by degree and order, tensor [2, (L + 1)^2 - 1].
    Source: real spherical harmonics as in Sloan, "Efficient spherical harmonic evaluation" (2013), JCGT 2(2).
    """
    float_type = type(direction[0])
    count, paths = coefficients.shape[1], dr.width(direction[0])
    vector_type: Any = dr.float64_array_t(mi.Vector3f) if float_type == Float64 else mi.Vector3f
    # Without the constant, degree 0, which the instrument's gain is.
    harmonics = dr.sh_eval(vector_type(*direction), int(np.sqrt(count + 1)) - 1)[1:]
    tensor_type: Any = dr.tensor_t(float_type)
    # A matrix product: the reverse pass of a sum would have a kernel for each coefficient.
    table = tensor_type(dr.concat(harmonics), (count, paths))
    series = (tensor_type(coefficients) @ table).array
    index = dr.arange(dr.uint32_array_t(float_type), paths)
    return complex_exponential(*(dr.gather(float_type, series, index + part * paths) for part in (0, 1)))
