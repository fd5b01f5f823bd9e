"""Gaussians of a field in a Mitsuba scene: the built-in ``ellipsoids`` shape with further attributes.

    gaussians = field.gaussians(params, tx_pos)
    scene = mi.load_dict({"type": "scene", "gaussians": gaussian_shape(gaussians)})
    params = mi.traverse(scene)  # gaussians.data, gaussians.signal, gaussians.opacity or gaussians.attenuation

The plugins find the shape by `gaussian_shape_of` and read it by `read_gaussians`. Training writes it by
`shape_parameters`, through which gradients flow back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from wrf_mi.core import InputError
from wrf_mi.gaussians.footprint import CUTOFF
from wrf_mi.gaussians.parameters import Gaussians

SIGNAL, OPACITY, ATTENUATION = "signal", "opacity", "attenuation"
"""Attributes of the shape: two floats (re, im), one float (alpha blending), two floats (product blending)."""

DATA_WIDTH = 10
"""Floats per ellipsoid in the shape's ``data``: centre, scale (3 each), quaternion x, y, z, w."""


def gaussian_shape(gaussians: Gaussians, transmitter: int = 0) -> dict[str, Any]:
    """The ``mi.load_dict`` entry of Gaussians as the built-in ``ellipsoids`` shape.

    The ellipsoids end at the footprints' cut-off, three standard deviations. Quaternions are normalised, which the
    shape expects. Parameters in ``mi.traverse``, all differentiable:

    ================ ================ ===== ==============================================================
    parameter        type             unit  meaning
    ================ ================ ===== ==============================================================
    ``data``         Float [n * 10]   m     per Gaussian: centre, standard deviations, quaternion x, y, z, w
    ``signal``       Float [n * 2]          complex signal (re, im), static part and deviation together
    ``opacity``      Float [n]              alpha at the centre in [0, 1): WRF-GS+, alpha blending
    ``attenuation``  Float [n * 2]          complex factor delta (re, im), |delta| < 1: WRF-GS, product blending
    ================ ================ ===== ==============================================================

    Args:
        gaussians: Gaussians of one field, for ``batch`` transmitters.
        transmitter: number of the transmitter, 0 to ``batch - 1``.

    Raises:
        ValueError: no such transmitter, or no Gaussians.
    """
    count = gaussians.count
    if count == 0:
        raise ValueError("gaussian_shape: no Gaussians; Mitsuba's ellipsoids shape needs at least one")
    parameters = shape_parameters(gaussians, transmitter)
    entry: dict[str, Any] = {"type": "ellipsoids", "extent": CUTOFF, "extent_adaptive_clamping": False}
    for name, values in parameters.items():
        entry[name] = mi.TensorXf(dr.detach(values), (count, dr.width(values) // count))
    return entry


def shape_parameters(gaussians: Gaussians, transmitter: int = 0) -> dict[str, Any]:
    """Values of the shape's parameters for these Gaussians: flat ``mi.Float`` arrays, differentiable.

        for name, values in shape_parameters(gaussians).items():
            params[f"gaussians.{name}"] = values
        params.update()

    Args:
        gaussians: Gaussians of one field, for ``batch`` transmitters.
        transmitter: number of the transmitter, 0 to ``batch - 1``.

    Raises:
        ValueError: no such transmitter.
    """
    if not 0 <= transmitter < gaussians.batch:
        raise ValueError(f"transmitter {transmitter}: these Gaussians are for {gaussians.batch}, counted from 0")
    count = gaussians.count
    index = dr.arange(mi.UInt32, count)
    if transmitter:  # opaque: as a constant of kernels, each number would compile new ones
        index += dr.opaque(mi.UInt32, transmitter * count)

    def selected(columns: list[Any]) -> list[Any]:
        return [dr.gather(mi.Float, mi.Float(c), index) for c in columns]

    quaternion = selected(gaussians.rotation)
    length = dr.rsqrt(sum(q * q for q in quaternion))
    position = [mi.Float(p) for p in gaussians.position]
    blending = OPACITY if gaussians.attenuation is None else ATTENUATION
    columns = {
        "data": [*position, *selected(gaussians.scale), *(q * length for q in quaternion)],
        SIGNAL: selected(gaussians.signal),
        blending: selected(gaussians.blending),
    }
    return {name: interleave(c) for name, c in columns.items()}


def interleave(columns: list[Any]) -> Any:
    """Columns [n] as an array [n * k], row by row. Differentiable."""
    if len(columns) == 1:
        return columns[0]
    n = dr.width(columns[0])
    index = dr.arange(mi.UInt32, n) * len(columns)
    out = dr.zeros(mi.Float, n * len(columns))
    for k, column in enumerate(columns):
        dr.scatter(out, column, index + k)
    return out


def deinterleave(values: Any, count: int) -> list[Any]:
    """An array [count * k] as k columns [count]. Differentiable."""
    width = dr.width(values) // count
    index = dr.arange(mi.UInt32, count) * width
    return [dr.gather(mi.Float, values, index + k) for k in range(width)]


def gaussian_shape_of(scene: Any) -> Any:
    """The shape of a ``mi.Scene`` that holds Gaussians: ``ellipsoids`` with a ``signal`` attribute.

    Raises:
        InputError: none, or more than one.
    """
    shapes = [s for s in scene.shapes() if s.is_ellipsoids() and SIGNAL in mi.traverse(s)]
    if len(shapes) != 1:
        problem = "no ellipsoids shape with a signal attribute" if not shapes else f"{len(shapes)} shapes of Gaussians"
        raise InputError(f"scene: {problem}; give it one made by wrf_mi_plugins.shape.gaussian_shape")
    return shapes[0]


def read_gaussians(shape: Any) -> Gaussians:
    """The Gaussians of a shape (batch 1), attached to its parameters for derivatives.

    Raises:
        InputError: the shape has neither or both of ``opacity`` and ``attenuation``, or an attribute of another width.
    """
    parameters: Mapping[str, Any] = mi.traverse(shape)
    count = dr.width(parameters["data"]) // DATA_WIDTH
    blending = [name for name in (OPACITY, ATTENUATION) if name in parameters]
    if len(blending) != 1:
        what = " and ".join(blending) or "neither"
        raise InputError(f"shape {shape.id()}: needs one of opacity and attenuation, has {what}; remove or add one")
    for name, width in ((SIGNAL, 2), (OPACITY, 1), (ATTENUATION, 2)):
        if name in parameters and dr.width(parameters[name]) != width * count:
            size = dr.width(parameters[name])
            raise InputError(f"shape {shape.id()}: {name} has {size} numbers, {count} Gaussians need {width * count}")
    data = deinterleave(parameters["data"], count)
    return Gaussians(
        position=data[0:3],
        scale=data[3:6],
        rotation=data[6:10],
        signal=deinterleave(parameters[SIGNAL], count),
        opacity=parameters.get(OPACITY),
        attenuation=deinterleave(parameters[ATTENUATION], count) if ATTENUATION in parameters else None,
        batch=1,
    )
