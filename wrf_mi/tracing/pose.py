"""Receiver pose as parameters, for traced paths and Gaussians alike.

Parameters are corrections to the stated pose, which stays in float64: the position p = p0 + t in the world's frame,
the orientation R = R0 E(r) with a rotation E about the receiver's axes. E is the Cayley transform, the
unit quaternion in the direction of (r / 2, 1), a turn by 2 atan(abs(r) / 2): for small r the rotation vector, and
smooth at zero. Source: Shuster, "A survey of attitude representations" (1993).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..core import Receiver
from ..core.angles import FloatArray
from ..gaussians.footprint import Pose, principal_axes


def pose_names(receiver: Receiver) -> tuple[str, str]:
    """Names of the parameters of position [3] in metres and of rotation [3] in rad."""
    return f"receiver.{receiver.name}.position", f"receiver.{receiver.name}.turn"


def pose_parameters(receiver: Receiver) -> dict[str, NDArray[np.float32]]:
    """Parameters of the stated pose: zeros [3] for position and rotation."""
    return {name: np.zeros(3, np.float32) for name in pose_names(receiver)}


def receiver_pose(receiver: Receiver, parameters: Mapping[str, Any], float_type: Any) -> Pose:
    """Corrected pose of a receiver. Differentiable in both parameters.

    Args:
        receiver: stated pose.
        parameters: the receiver's position and rotation, tensors [3]; missing ones are zero.
        float_type: float type of the result and of the sum with the stated position.
    """

    def correction(name: str) -> list[Any]:
        if name not in parameters:
            return [float_type(0)] * 3
        return [float_type(component(parameters[name], i)) for i in range(3)]

    moved, turned = (correction(name) for name in pose_names(receiver))
    position = [float(x) + t for x, t in zip(receiver.position_m, moved, strict=True)]
    columns = principal_axes([*(0.5 * r for r in turned), float_type(1)])
    stated = receiver.to_world
    to_world = [[sum(float(stated[i, k]) * columns[j][k] for k in range(3)) for j in range(3)] for i in range(3)]
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
    """A pose as arrays of ``count`` values.

    The derivative of a gather is a sum in the same kernel; broadcast numbers would take a kernel for each of the
    twelve.
    """
    table = dr.concat([*pose.position, *(c for row in pose.to_world for c in row)])
    kind: Any = type(table)
    wide = [dr.gather(kind, table, dr.full(dr.uint32_array_t(kind), i, count)) for i in range(12)]
    return Pose(wide[:3], [wide[3:6], wide[6:9], wide[9:12]])
