"""How a field's Gaussians stand in a Mitsuba scene: the built-in ``ellipsoids`` shape with attributes of ours.

    gaussians = field.gaussians(params, tx_pos)
    scene = mi.load_dict({"type": "scene", "gaussians": gaussian_shape(gaussians)})
    params = mi.traverse(scene)  # gaussians.data, gaussians.signal, gaussians.opacity or gaussians.attenuation

Every plugin of this package that looks for Gaussians in a scene finds them by `gaussian_shapes`, and reads them by
`read_gaussians`. A step of training writes them by `shape_parameters`, through which gradients flow back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from wrf_mi.core import InputError
from wrf_mi.gaussians.footprint_constants import CUTOFF
from wrf_mi.gaussians.parameters import Gaussians

SIGNAL, OPACITY, ATTENUATION = "signal", "opacity", "attenuation"
"""Attributes of the shape: two floats (re, im), one float (alpha blending), two floats (product blending)."""

DATA_WIDTH = 10
"""Floats per ellipsoid in the shape's ``data``: centre, scale (3 each), quaternion x, y, z, w."""


def gaussian_shape(gaussians: Gaussians, transmitter: int = 0) -> dict[str, Any]:
    """The ``mi.load_dict`` entry of Gaussians as the built-in ``ellipsoids`` shape.

    Its ellipsoids end at the footprints' cut-off, three standard deviations. Quaternions are normalised, which the
    shape expects. What it exposes in ``mi.traverse``, all differentiable:

    ================ ================ ===== ==============================================================
    parameter        type             unit  meaning
    ================ ================ ===== ==============================================================
    ``data``         Float [n * 10]   m     per Gaussian: centre, standard deviations, quaternion x, y, z, w
    ``signal``       Float [n * 2]          complex signal (re, im), static part and deviation together
    ``opacity``      Float [n]              alpha at the centre in [0, 1): WRF-GS+, alpha blending
    ``attenuation``  Float [n * 2]          complex factor delta (re, im), |delta| < 1: WRF-GS, product blending
    ================ ================ ===== ==============================================================

    Args:
        gaussians: of one field, for ``batch`` transmitters.
        transmitter: which of them, 0 to ``batch - 1``.

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
    """What to assign to the shape's parameters for these Gaussians: flat ``mi.Float`` arrays, differentiable.

        for name, values in shape_parameters(gaussians).items():
            params[f"gaussians.{name}"] = values
        params.update()

    Args:
        gaussians: of one field, for ``batch`` transmitters.
        transmitter: which of them, 0 to ``batch - 1``.

    Raises:
        ValueError: no such transmitter.
    """
    if not 0 <= transmitter < gaussians.batch:
        raise ValueError(f"transmitter {transmitter}: these Gaussians are for {gaussians.batch}, counted from 0")
    count = gaussians.count
    own = dr.arange(mi.UInt32, count) + transmitter * count

    def one(columns: list[Any]) -> list[Any]:
        return [dr.gather(mi.Float, mi.Float(c), own) for c in columns]

    quaternion = one(gaussians.rotation)
    length = dr.rsqrt(sum(q * q for q in quaternion))
    position = [mi.Float(p) for p in gaussians.position]
    columns = {
        "data": [*position, *one(gaussians.scale), *(q * length for q in quaternion)],
        SIGNAL: one(gaussians.signal),
    }
    if gaussians.opacity is not None:
        columns[OPACITY] = one([gaussians.opacity])
    if gaussians.attenuation is not None:
        columns[ATTENUATION] = one(gaussians.attenuation)
    return {name: interleave(c) for name, c in columns.items()}


def interleave(columns: list[Any]) -> Any:
    """Columns [n] as one array [n * k], the k values of a row beside each other. Differentiable."""
    if len(columns) == 1:
        return columns[0]
    n = dr.width(columns[0])
    index = dr.arange(mi.UInt32, n) * len(columns)
    out = dr.zeros(mi.Float, n * len(columns))
    for k, column in enumerate(columns):
        dr.scatter(out, column, index + k)
    return out


def _columns(values: Any, count: int) -> list[Any]:
    width = dr.width(values) // count
    index = dr.arange(mi.UInt32, count) * width
    return [dr.gather(mi.Float, values, index + k) for k in range(width)]


def gaussian_shapes(scene: Any) -> list[Any]:
    """The shapes of a ``mi.Scene`` that hold Gaussians: ``ellipsoids`` with a ``signal`` attribute."""
    return [s for s in scene.shapes() if s.is_ellipsoids() and SIGNAL in mi.traverse(s)]


def gaussian_shape_of(scene: Any) -> Any:
    """The one shape of a ``mi.Scene`` that holds Gaussians.

    Raises:
        InputError: none, or more than one.
    """
    shapes = gaussian_shapes(scene)
    if len(shapes) != 1:
        found = "no ellipsoids shape with a signal attribute" if not shapes else f"{len(shapes)} shapes of Gaussians"
        raise InputError(f"scene: {found}; give it one made by wrf_mi_plugins.shape.gaussian_shape")
    return shapes[0]


def read_gaussians(shape: Any) -> Gaussians:
    """The Gaussians of a shape (batch 1), attached to its parameters for derivatives.

    Raises:
        InputError: the shape has neither or both of ``opacity`` and ``attenuation``, or an attribute of another width.
    """
    parameters: Mapping[str, Any] = mi.traverse(shape)
    count = dr.width(parameters["data"]) // DATA_WIDTH
    data = _columns(parameters["data"], count)
    blending = [name for name in (OPACITY, ATTENUATION) if name in parameters]
    if len(blending) != 1:
        what = " and ".join(blending) or "neither"
        raise InputError(f"shape {shape.id()}: needs one of opacity and attenuation, has {what}; remove or add one")
    for name, width in ((SIGNAL, 2), (OPACITY, 1), (ATTENUATION, 2)):
        if name in parameters and dr.width(parameters[name]) != width * count:
            given = dr.width(parameters[name])
            raise InputError(f"shape {shape.id()}: {name} has {given} numbers, {count} Gaussians need {width * count}")
    return Gaussians(
        position=data[0:3],
        scale=data[3:6],
        rotation=data[6:10],
        signal=_columns(parameters[SIGNAL], count),
        opacity=parameters.get(OPACITY),
        attenuation=_columns(parameters[ATTENUATION], count) if ATTENUATION in parameters else None,
        batch=1,
    )
