"""Fits of a traced spectrum: where planes are and what they are of, and how strong each path is where.

Both fits minimise the sum of the rows' losses (`wrf_mi.models.physics.spectrum_loss`) plus half the squared distance
from what was thought before, in standard deviations: a maximum a posteriori estimate. They go by L-BFGS (Nocedal and
Wright, "Numerical Optimization" (2006), section 7.2) with exact derivatives by signals; those by the constants of a
material are differences.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.optimize import minimize

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import mirrored
from .spectrum_gains import Antennas, Slabs, gains
from .spectrum_loss import Grid
from .spectrum_rays import ChainTable, Met

ComplexArray = NDArray[np.complex128]

SPREAD = (0.8, 1.5, 0.8)
"""Standard deviation of the logarithms of a material's susceptibility, conductivity and thickness around those given:
factors of 2.2 and 4.5, the spread of building materials in ITU-R P.2040 around concrete."""
STEP = 1e-4
"""Of differences by logarithms."""
LEAST_ROWS = 5
"""Transmitters that must see a chain before its amplitude may vary with the place."""


@dataclass(frozen=True)
class Constants:
    """What a room is of; q planes of the mesh, b objects.

    Attributes:
        offset_m: displacement of each plane along its normal, shape [q].
        slabs: of the objects.
    """

    offset_m: FloatArray
    slabs: Slabs

    def vector(self) -> FloatArray:
        """Offsets, then logarithms of susceptibility, conductivity and thickness, shape [q + 3 b]."""
        s = self.slabs
        susceptibility = np.maximum(s.permittivity - 1, 1e-3)
        return np.concatenate(
            [self.offset_m, *(np.log(v) for v in (susceptibility, np.maximum(s.conductivity, 1e-6), s.thickness_m))]
        )

    def with_vector(self, vector: FloatArray) -> Constants:
        """The constants of another vector."""
        q, b = len(self.offset_m), len(self.slabs.permittivity)
        x, y, z = vector[q : q + b], vector[q + b : q + 2 * b], vector[q + 2 * b :]
        return Constants(vector[:q], Slabs(1 + np.exp(x), np.exp(y), np.exp(z)))

    def deviation(self, offset_sd_m: float) -> FloatArray:
        """Standard deviation of each entry of the vector."""
        b = len(self.slabs.permittivity)
        return np.concatenate([np.full(len(self.offset_m), offset_sd_m), *(np.full(b, s) for s in SPREAD)])


class Waves:
    """What paths of some transmitters bring to each element of an array.

    Args:
        table: of the chains.
        tx_pos_m: transmitters [n, 3], metres.
        elements_m: of the array less its origin [m, 3], world frame, metres.
        antennas: of the transmitters and of the elements.
        frequency_hz: of the carrier.
    """

    def __init__(
        self, table: ChainTable, tx_pos_m: FloatArray, elements_m: FloatArray, antennas: Antennas, frequency_hz: float
    ) -> None:
        self.met, self.count, self._antennas, self._elements = table(tx_pos_m), len(tx_pos_m), antennas, elements_m
        self._hz, self.wavenumber = frequency_hz, 2 * np.pi * frequency_hz / speed_of_light
        # An image moves by twice a plane's displacement, mirrored by what reflects after it: exactly linear.
        self._moved = np.zeros((len(table.normal), len(self.met), 3))
        levels = table.chain[self.met.chain]
        for level in range(levels.shape[1]):
            row = np.flatnonzero(levels[:, level] >= 0)
            shift = 2 * table.normal[levels[row, level]]
            for after in reversed(range(level)):  # towards the receiver, which is the chain's beginning
                shift = mirrored(shift, table.normal[levels[row, after]])
            np.add.at(self._moved, (levels[row, level], row), shift)
        self.sum = sparse.csr_matrix(
            (np.ones(len(self.met)), (self.met.tx, np.arange(len(self.met)))), shape=(self.count, len(self.met))
        )

    def image(self, offset_m: FloatArray) -> FloatArray:
        """The transmitters' images less the array's origin with displaced planes, [p, 3]."""
        return self.met.image_m + np.einsum("q,qpi->pi", offset_m, self._moved)

    def gain(self, constants: Constants, path: IntArray | None = None) -> ComplexArray:
        """Gain of all or some paths."""
        met = self.met
        if path is not None:
            met = Met(*(getattr(met, name)[path] for name in ("tx", "chain", "image_m", "thing", "plane", "normal")))
        return gains(met, constants.slabs, self._antennas, self._hz)

    def steering(self, offset_m: FloatArray) -> ComplexArray:
        """Spherical wave of each path at the elements, of amplitude one at the origin: [p, m]."""
        image = self.image(offset_m)
        length = np.linalg.norm(image, axis=1)[:, None]
        distance = np.linalg.norm(image[:, None] - self._elements, axis=-1)
        waves: ComplexArray = length / distance * np.exp(-1j * self.wavenumber * distance)
        return waves

    def slopes(self, constants: Constants, gain: ComplexArray) -> list[tuple[IntArray, ComplexArray]]:
        """For each entry of the constants' vector, the paths that it touches and the derivative of their gains.

        Displacements count as a phase of the gain: what they do to the direction of arrival is small.
        """
        image = self.image(constants.offset_m)
        towards = image / np.linalg.norm(image, axis=1, keepdims=True)
        out = []
        for moved in self._moved:
            path = np.flatnonzero(moved.any(axis=1))
            out.append((path, -1j * self.wavenumber * (towards[path] * moved[path]).sum(axis=1) * gain[path]))
        vector, b = constants.vector(), len(constants.slabs.permittivity)
        touched = [np.flatnonzero((self.met.thing == thing).any(axis=1)) for thing in range(b)]
        for index in range(len(self._moved), len(vector)):
            path = touched[(index - len(self._moved)) % b]
            changed = vector.copy()
            changed[index] += STEP
            out.append((path, (self.gain(constants.with_vector(changed), path) - gain[path]) / STEP))
        return out


def fit_constants(
    waves: Waves,
    shapes: FloatArray,
    grid: Grid,
    start: Constants,
    prior: Constants,
    offset_sd_m: float,
    steps: int,
    amplitude: ComplexArray | None = None,
) -> Constants:
    """Planes' displacements and materials that fit best.

    Args:
        waves: of the training rows.
        shapes: their spectra, see `Grid.shapes`.
        grid: of these.
        start: where the search begins.
        prior: what is thought before.
        offset_sd_m: standard deviation of displacements, metres.
        steps: of L-BFGS at most.
        amplitude: factor of each path [p]; None: 1.
    """
    centre, deviation = prior.vector(), prior.deviation(offset_sd_m)
    factor = np.ones(len(waves.met)) if amplitude is None else amplitude

    def objective(z: FloatArray) -> tuple[float, FloatArray]:
        constants = prior.with_vector(centre + z * deviation)
        gain, steering = waves.gain(constants) * factor, waves.steering(constants.offset_m)
        losses, slope = grid.loss(waves.sum @ (gain[:, None] * steering), shapes)
        by_gain = ((waves.sum.T @ slope) * steering.conj()).sum(axis=1) * np.conj(factor)
        each = [
            2 * (by_gain[path].conj() * change).real.sum()
            for path, change in waves.slopes(constants, waves.gain(constants))
        ]
        return float(losses.sum() + (z**2).sum() / 2), np.array(each) * deviation + z

    z0 = (start.vector() - centre) / deviation
    found = minimize(objective, z0, jac=True, method="L-BFGS-B", options={"maxiter": steps, "maxcor": 30})
    return prior.with_vector(centre + found.x * deviation)


def scan_offsets(
    waves: Waves,
    shapes: FloatArray,
    grid: Grid,
    start: Constants,
    offset_sd_m: float,
    amplitude: ComplexArray | None = None,
) -> Constants:
    """Try displacements within two deviations, plane by plane: phases have several minima. As `fit_constants`."""
    gain, best = waves.gain(start) * (1 if amplitude is None else amplitude), start
    for plane in range(len(start.offset_m)):
        if not waves._moved[plane].any():
            continue
        scores = []
        for value in np.linspace(-2, 2, 13) * offset_sd_m:
            offset = best.offset_m.copy()
            offset[plane] = value
            losses, _ = grid.loss(waves.sum @ (gain[:, None] * waves.steering(offset)), shapes)
            scores.append((losses.sum() + (value / offset_sd_m) ** 2 / 2, value))
        offset = best.offset_m.copy()
        offset[plane] = min(scores)[1]
        best = replace(best, offset_m=offset)
    return best


@dataclass(frozen=True)
class Maps:
    """Amplitude of each chain as a smooth function of the transmitter's image: 1 + sum of Gaussians.

    Attributes:
        chain: of each Gaussian, shape [k].
        centre_m: of each, the image less the array's origin [k, 3]; NaN: a constant.
        scale_m: standard deviation of the Gaussians.
        weight: complex, shape [k].
    """

    chain: IntArray
    centre_m: FloatArray
    scale_m: float
    weight: ComplexArray

    def matrix(self, met: Met) -> sparse.csr_matrix:
        """Value of each Gaussian at each path, [p, k], left out below 1 %."""
        order = np.argsort(met.chain, kind="stable")
        edges = np.searchsorted(met.chain[order], np.arange(met.chain.max(initial=0) + 2))
        rows, columns, values = [], [], []
        constant = np.isnan(self.centre_m[:, 0])
        for chain in np.unique(self.chain):
            if chain + 1 >= len(edges):
                continue
            path, own = order[edges[chain] : edges[chain + 1]], np.flatnonzero(self.chain == chain)
            centre = np.where(constant[own, None], 0.0, self.centre_m[own])
            square = ((met.image_m[path][:, None] - centre) ** 2).sum(axis=-1)
            value = np.where(constant[own], 1.0, np.exp(-square / (2 * self.scale_m**2)))
            i, j = np.nonzero(value > 0.01)
            rows.append(path[i])
            columns.append(own[j])
            values.append(value[i, j])
        if not rows:
            return sparse.csr_matrix((len(met), len(self.chain)))
        places = np.concatenate(rows), np.concatenate(columns)
        return sparse.csr_matrix((np.concatenate(values), places), shape=(len(met), len(self.chain)))

    def amplitude(self, met: Met) -> ComplexArray:
        """Factor of each path [p]."""
        factor: ComplexArray = 1 + self.matrix(met) @ self.weight
        return factor


def map_places(met: Met, chain_length: IntArray, scale_m: float, reflections: int) -> Maps:
    """Gaussians of weight zero for chains of few reflections: one constant each, and one every ``scale_m`` or so.

    Args:
        met: paths of the training rows.
        chain_length: reflections of each chain.
        scale_m: see `Maps`.
        reflections: chains of more have only a constant.
    """
    chains, centres = [], []
    for chain in np.unique(met.chain):
        path = np.flatnonzero(met.chain == chain)
        if len(path) < LEAST_ROWS:
            continue
        chains.append(chain)
        centres.append(np.full(3, np.nan))
        if chain_length[chain] > reflections:
            continue
        image, nearest, index = met.image_m[path], np.full(len(path), np.inf), 0
        while nearest[index] > scale_m:  # farthest point first
            chains.append(chain)
            centres.append(image[index])
            nearest = np.minimum(nearest, np.linalg.norm(image - image[index], axis=1))
            index = int(nearest.argmax())
    return Maps(np.array(chains, np.int64), np.reshape(centres, (-1, 3)), scale_m, np.zeros(len(chains), complex))


def fit_maps(
    waves: Waves,
    shapes: FloatArray,
    grid: Grid,
    constants: Constants,
    maps: Maps,
    deviation: float,
    steps: int,
) -> Maps:
    """Weights of the Gaussians that fit best, ``deviation`` being their standard deviation before."""
    matrix, k = maps.matrix(waves.met), len(maps.chain)
    gain = waves.gain(constants)
    waved = gain[:, None] * waves.steering(constants.offset_m)

    def objective(z: FloatArray) -> tuple[float, FloatArray]:
        w = (z[:k] + 1j * z[k:]) * deviation
        losses, slope = grid.loss(waves.sum @ ((1 + matrix @ w)[:, None] * waved), shapes)
        by_weight = matrix.T @ ((waves.sum.T @ slope) * waved.conj()).sum(axis=1)
        change = 2 * deviation * by_weight
        return float(losses.sum() + (z**2).sum() / 2), np.concatenate([change.real, change.imag]) + z

    z0 = np.concatenate([maps.weight.real, maps.weight.imag]) / deviation
    found = minimize(objective, z0, jac=True, method="L-BFGS-B", options={"maxiter": steps, "maxcor": 20})
    return replace(maps, weight=(found.x[:k] + 1j * found.x[k:]) * deviation)
