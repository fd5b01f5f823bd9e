"""Polarised gains of specular paths in NumPy, float64, whole batches of transmitters at once.

The same equations as `wrf_mi.tracing.field_calculator`, which computes them with derivatives in Dr.Jit for chains that
are fixed. Here paths come and go with the transmitter, and derivatives by the few constants of the materials are
differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core.angles import FloatArray
from ...core.antenna import MountedAntenna
from ...tracing.image_method import mirrored
from ...tracing.slab import slab
from .spectrum_rays import Met

ComplexArray = NDArray[np.complex128]
ALONG = 1e-12
"""Squared sine below which a direction lies along a normal: any plane of incidence will do."""
Antennas = tuple[MountedAntenna, MountedAntenna]
"""Of the transmitters and of the receiver."""


@dataclass(frozen=True)
class Slabs:
    """Constants of each object's material, arrays [b].

    Attributes:
        permittivity: relative.
        conductivity: S/m.
        thickness_m: metres.
    """

    permittivity: FloatArray
    conductivity: FloatArray
    thickness_m: FloatArray


def gains(met: Met, slabs: Slabs, antennas: Antennas, frequency_hz: float) -> ComplexArray:
    """Lambda / (4 pi length) times interactions and antennas' fields of each path, without the phase of travelling.

    Args:
        met: p paths.
        slabs: the objects' materials.
        antennas: of the transmitters and of the receiver.
        frequency_hz: of the carrier.

    Returns:
        Shape [p].

    Source: Balanis, "Advanced Engineering Electromagnetics" (2012), sections 7.4 and 5.3.
    """
    length = np.linalg.norm(met.image_m, axis=1)
    arrival = met.image_m / length[:, None]
    depth = met.thing.shape[1]
    directions = [-arrival]
    for level in reversed(range(depth)):
        turned = mirrored(directions[0], met.normal[:, level])
        directions.insert(0, np.where(met.plane[:, level, None] >= 0, turned, directions[0]))
    field: ComplexArray = antennas[0].field(directions[0]).astype(complex)
    for level in range(depth):
        row = np.flatnonzero(met.thing[:, level] >= 0)
        if not len(row):
            continue
        before, after, normal = directions[level][row], directions[level + 1][row], met.normal[row, level]
        which, mirror = met.thing[row, level], met.plane[row, level] >= 0
        cosine = np.abs((before * normal).sum(axis=1))
        c = slab(cosine, slabs.permittivity[which], slabs.conductivity[which], slabs.thickness_m[which], frequency_hz)
        te = np.where(mirror, c.reflected_te, c.transmitted_te)
        tm = np.where(mirror, c.reflected_tm, c.transmitted_tm)
        across = _unit_or(np.cross(before, normal), _any_across(before))
        s, p = (field[row] * across).sum(axis=1), (field[row] * np.cross(across, before)).sum(axis=1)
        field[row] = (te * s)[:, None] * across + (tm * p)[:, None] * np.cross(across, after)
    taken = antennas[1].field(arrival)
    loss = speed_of_light / frequency_hz / (4 * np.pi) / length
    gain: ComplexArray = (taken * field).sum(axis=1) * loss
    return gain


def _any_across(direction: FloatArray) -> FloatArray:
    reference = np.where(np.abs(direction[:, :1]) >= 0.9, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    rest = reference - (direction * reference).sum(axis=1, keepdims=True) * direction
    return np.asarray(rest / np.linalg.norm(rest, axis=1, keepdims=True))


def _unit_or(vector: FloatArray, other: FloatArray) -> FloatArray:
    square = (vector**2).sum(axis=1, keepdims=True)
    return np.where(square > ALONG, vector / np.sqrt(np.where(square > ALONG, square, 1.0)), other)
