"""Polarised gains of specular paths and their waves at an array, in NumPy, for whole batches of transmitters.

`wrf_mi.tracing.field_calculator` evaluates the same equations with derivatives in Dr.Jit for fixed chains. Here paths
vary with the transmitter, and derivatives by the few constants of materials are differences.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import scipy.sparse as sparse
from scipy.constants import speed_of_light

from ...core.angles import FloatArray
from ...core.antenna import MountedAntenna
from ...core.types import IntArray
from ...tracing.image_method import mirrored
from ...tracing.slab import slab
from .spectrum_loss import ComplexArray, Spectrometer
from .spectrum_rays import ChainPaths, ChainTable

ALONG = 1e-12
"""Squared sine below which a direction lies along a normal, and any plane of incidence serves."""


def gains(
    paths: ChainPaths, slabs: FloatArray, antennas: tuple[MountedAntenna, MountedAntenna], frequency_hz: float
) -> ComplexArray:
    """Lambda / (4 pi length) times interactions and antennas' fields, [p], without the phase of travelling.

    Args:
        paths: p paths.
        slabs: the objects' materials [3, b], see `Room`.
        antennas: antennas of the transmitters and of the receiver.
        frequency_hz: carrier frequency.

    Source: Balanis, "Advanced Engineering Electromagnetics" (2012), sections 7.4 and 5.3.
    """
    length = np.linalg.norm(paths.image_m, axis=1)
    arrival = paths.image_m / length[:, None]
    depth = paths.objects.shape[1]
    directions = [-arrival]
    for level in reversed(range(depth)):
        turned = mirrored(directions[0], paths.normal[:, level])
        directions.insert(0, np.where(paths.plane[:, level, None] >= 0, turned, directions[0]))
    field: ComplexArray = antennas[0].field(directions[0]).astype(complex)
    for level in range(depth):
        row = np.flatnonzero(paths.objects[:, level] >= 0)
        if not len(row):
            continue
        before, after, normal = directions[level][row], directions[level + 1][row], paths.normal[row, level]
        mirror = paths.plane[row, level] >= 0
        permittivity, conductivity, thickness_m = slabs[:, paths.objects[row, level]]
        c = slab(np.abs((before * normal).sum(axis=1)), permittivity, conductivity, thickness_m, frequency_hz)
        te = np.where(mirror, c.reflected_te, c.transmitted_te)
        tm = np.where(mirror, c.reflected_tm, c.transmitted_tm)
        across = np.cross(before, normal)
        along = (across**2).sum(axis=1) <= ALONG
        across[along] = np.cross(before[along], np.eye(3)[np.abs(before[along]).argmin(axis=1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        s, p = (field[row] * across).sum(axis=1), (field[row] * np.cross(across, before)).sum(axis=1)
        field[row] = (te * s)[:, None] * across + (tm * p)[:, None] * np.cross(across, after)
    loss = speed_of_light / frequency_hz / (4 * np.pi) / length
    return np.asarray((antennas[1].field(arrival) * field).sum(axis=1) * loss)


class Waves:
    """Waves of transmitters [n, 3] at each element of an array.

    Attributes:
        paths, sum: the transmitters' paths, p in all, and the sparse matrix [n, p] that sums over them.
        moved: displacement of each path's image by a unit displacement of each plane, [q, p, 3].
    """

    def __init__(self, table: ChainTable, tx_pos_m: FloatArray, instrument: Spectrometer) -> None:
        self.paths, self.instrument = table(tx_pos_m), instrument
        # An image moves by twice a plane's displacement, mirrored at the planes that reflect after it: exactly linear.
        count = len(self.paths)
        self.moved = np.zeros((len(table.normal), count, 3))
        levels = table.chain[self.paths.chain]
        for level in range(levels.shape[1]):
            row = np.flatnonzero(levels[:, level] >= 0)
            shift = 2 * table.normal[levels[row, level]]
            for after in reversed(range(level)):  # towards the receiver, where the chain begins
                shift = mirrored(shift, table.normal[levels[row, after]])
            np.add.at(self.moved, (levels[row, level], row), shift)
        entries = np.ones(count), (self.paths.tx, np.arange(count))
        self.sum = sparse.csr_matrix(entries, shape=(len(tx_pos_m), count))

    def image(self, offset_m: FloatArray) -> FloatArray:
        """The transmitters' images less the array's origin with planes displaced by ``offset_m`` [q], [p, 3]."""
        result: FloatArray = self.paths.image_m + np.einsum("q,qpi->pi", offset_m, self.moved)
        return result

    def gain(self, slabs: FloatArray, path: IntArray | None = None) -> ComplexArray:
        """Gains of all or some paths with materials ``slabs`` [3, b]."""
        paths = self.paths
        if path is not None:
            paths = ChainPaths(*(getattr(paths, field.name)[path] for field in fields(ChainPaths)))
        return gains(paths, slabs, self.instrument.antennas, self.instrument.frequency_hz)

    def steering(self, offset_m: FloatArray) -> ComplexArray:
        """Spherical wave of each path at the elements with displaced planes, of amplitude one at the origin: [p, m]."""
        return spherical_waves(self.image(offset_m), self.instrument)


def spherical_waves(image_m: FloatArray, instrument: Spectrometer) -> ComplexArray:
    """Waves [p, m] at the array's elements from points [p, 3] relative to its origin, of amplitude one there."""
    length = np.linalg.norm(image_m, axis=1)[:, None]
    distance = np.linalg.norm(image_m[:, None] - instrument.elements_m, axis=-1)
    return np.asarray(length / distance * np.exp(-1j * instrument.wavenumber * distance))
