"""Waves of specular paths at an array, and the loss of observed spectra, in NumPy for batches of transmitters.

An instrument scales each spectrum to its extremes, so only the shape counts: with s the observed and b the predicted
magnitudes on a grid of directions, both as vectors of unit length, 1 - (s . b)^2 is about the share of the power that
is predicted wrongly. With an unknown variance for each row the logarithm of the likelihood falls by half the degrees of
freedom times the logarithm of that share, which is the loss; structural similarity falls nearly linearly with it.

`wrf_mi.tracing.field_calculator` evaluates the same gains with derivatives in Dr.Jit for fixed chains. Here paths vary
with the transmitter, and derivatives by the few constants of materials are differences.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist

from ...core import Antenna, Receiver
from ...core.angles import FloatArray, pixel_directions
from ...core.antenna import ANTENNA, MountedAntenna
from ...core.types import IntArray
from ...receivers.array import array_response, bartlett_spectrum, minmax_scale
from ...tracing.image_method import mirrored
from ...tracing.slab import slab
from .spectrum_rays import ChainPaths, ChainTable

ComplexArray = NDArray[np.complex128]
FREEDOM = 15.0
"""Half the degrees of freedom of a spectrum of 16 signals without common scale and phase."""
FLOOR = 0.01
"""Share that counts as well explained: the effect of eight bits and small objects."""
ROWS, COLUMNS = 10, 18
"""Directions of the grid: a 4 x 4 array's spectrum has 49 degrees of freedom."""
ALONG = 1e-12
"""Squared sine below which a direction lies along a normal, and any plane of incidence serves."""


@dataclass(frozen=True)
class Grid:
    """Some pixels of a spectrum: rows [r], columns [c], conjugate response of the array there [r * c, m]."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    steering: ComplexArray

    @classmethod
    def of(cls, height: int, width: int, array_m: FloatArray, frequency_hz: float) -> Grid:
        """An even grid over ``height`` elevations and ``width`` azimuths for an array [m, 3] in metres."""
        row = np.linspace(0, height, min(ROWS, height), endpoint=False).astype(np.int64) + height // ROWS // 2
        row = np.unique(row[row < height])
        column = np.unique(np.linspace(0, width, min(COLUMNS, width), endpoint=False).astype(np.int64))
        directions = pixel_directions(height, width)[np.ix_(row, column)].reshape(-1, 3)
        return cls(row, column, array_response(array_m, directions, frequency_hz).conj())

    def shapes(self, spectra: NDArray[np.float32]) -> FloatArray:
        """Observed spectra [n, height, width] as unit vectors on the grid [n, r * c]; zero spectra as 0."""
        values = spectra[:, self.row][:, :, self.column].reshape(len(spectra), -1).astype(float)
        norm = np.linalg.norm(values, axis=1, keepdims=True)
        return np.asarray(np.divide(values, norm, out=np.zeros_like(values), where=norm > 0))

    def loss(self, signals: ComplexArray, shapes: FloatArray) -> FloatArray:
        """Losses [n], at least 0, of element signals [n, m] of any unit; shapes [n, r * c] are from `shapes`."""
        _, magnitude, norm = self._magnitude(signals)
        likeness = (shapes * magnitude).sum(axis=1) / norm[:, 0]
        return np.asarray(FREEDOM * np.log1p((1 - likeness**2) / FLOOR))

    def loss_and_slope(self, signals: ComplexArray, shapes: FloatArray) -> tuple[FloatArray, ComplexArray]:
        """As `loss`, and its derivative G [n, m]: a change dh of the signals changes a loss by 2 Re(conj(G) . dh)."""
        field, magnitude, norm = self._magnitude(signals)
        likeness = (shapes * magnitude).sum(axis=1, keepdims=True) / norm
        slope = -2 * likeness * (shapes / norm - likeness * magnitude / norm**2)
        share = 1 - likeness[:, 0] ** 2
        slope *= FREEDOM / (share + FLOOR)[:, None]
        return FREEDOM * np.log1p(share / FLOOR), (slope / (2 * magnitude) * field) @ self.steering.conj()

    def _magnitude(self, signals: ComplexArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
        """Field of element signals [n, m] at the directions [n, r * c], its magnitude, and the norm of that [n, 1]."""
        field = signals @ self.steering.T
        power = np.square(field.real) + np.square(field.imag)
        # The root has no derivative at zero: a millionth of the mean is far below the resolution of 8 bits.
        magnitude = np.sqrt(power + 1e-6 * power.mean(axis=1, keepdims=True) + np.finfo(float).tiny)
        return field, magnitude, np.linalg.norm(magnitude, axis=1, keepdims=True)


@dataclass(frozen=True)
class Spectrometer:
    """A receiver's array that reports spectra [height, width] at a carrier frequency, and the transmitters' antenna."""

    receiver: Receiver
    frequency_hz: float
    height: int
    width: int
    tx_antenna: Antenna = ANTENNA

    @property
    def wavenumber(self) -> float:
        """2 pi over the wavelength, rad/m."""
        return float(2 * np.pi * self.frequency_hz / speed_of_light)

    @property
    def wavelength_m(self) -> float:
        """Wavelength, metres."""
        return float(speed_of_light / self.frequency_hz)

    @property
    def array_m(self) -> FloatArray:
        """Elements [m, 3], receiver's frame, metres."""
        assert self.receiver.array_m is not None, "see `wrf_mi.models.physics.spectrum.fit_spectrum`"
        return self.receiver.array_m

    @cached_property
    def antennas(self) -> tuple[MountedAntenna, MountedAntenna]:
        """Antennas of the transmitters and of the elements."""
        receiver = self.receiver
        return self.tx_antenna.mounted(), receiver.antenna.mounted(receiver.orientation_xyzw)

    @cached_property
    def elements_m(self) -> FloatArray:
        """Elements less the origin, world frame [m, 3]."""
        return np.asarray(self.array_m @ self.receiver.to_world.T)

    @cached_property
    def grid(self) -> Grid:
        """Directions on which spectra are compared."""
        return Grid.of(self.height, self.width, self.array_m, self.frequency_hz)

    def report(self, signals: ComplexArray) -> NDArray[np.float32]:
        """Spectra of element signals [n, m] as the instrument scales them, [n, height, width]."""
        grid = self.array_m, self.frequency_hz, self.height, self.width
        images = [minmax_scale(bartlett_spectrum(signal, *grid)) for signal in signals]
        return np.array(images, np.float32).reshape(-1, self.height, self.width)


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
        return np.asarray(self.paths.image_m + np.einsum("q,qpi->pi", offset_m, self.moved))

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
    distance = cdist(image_m, instrument.elements_m)
    return np.asarray(length / distance * np.exp(-1j * instrument.wavenumber * distance))
