"""Fits of a traced spectrum: displacements, materials, amplitudes that vary with the position, residual kriging.

All fits minimise the sum of the rows' losses (`wrf_mi.models.physics.spectrum_waves`) plus half the squared distance
from the prior in standard deviations: a maximum a posteriori estimate. They use L-BFGS (Nocedal and Wright, "Numerical
Optimization" (2006), section 7.2) with exact derivatives by signals, and differences by constants of materials.

Spectra minus predictions correlate over a wavelength or so: small objects, diffraction and scattering that no surface
explains. Their posterior mean (simple kriging, exponential covariance) is added to a prediction. Where the room
explains spectra badly, the field may also be the residual of a share of the prediction about an unknown mean (ordinary
kriging): share 0 is kriging of the spectra, share 1 kriging of residuals. Held-out rows choose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.optimize import minimize

from ...core.angles import FloatArray
from ...core.types import IntArray
from ..interpolation.kriging_equations import KrigingSystem, correlation
from .spectrum_rays import ChainPaths
from .spectrum_waves import ComplexArray, Waves

SPREAD = (0.8, 1.5, 0.8)
"""Standard deviation of the logarithms of a material's susceptibility, conductivity and thickness about those given:
factors of 2.2 and 4.5, the spread of building materials in ITU-R P.2040 around concrete."""
STEP = 1e-4
"""Step of differences by logarithms."""
LEAST_ROWS = 5
"""Least number of transmitters that see a chain whose amplitude is learned."""
COMPONENTS = 64
"""Principal images of the residuals at most: the square of a 4 x 4 array's spectrum has 49 degrees of freedom."""
LEAST_VALUE = 0.01
"""Smaller values of a Gaussian are dropped."""


@dataclass(frozen=True)
class Constants:
    """Fitted displacements [q] of a room's planes along their normals, and materials [3, b] of its objects (`Room`)."""

    offset_m: FloatArray
    slabs: FloatArray

    def vector(self) -> FloatArray:
        """Offsets, then logarithms of susceptibility, conductivity and thickness, shape [q + 3 b]."""
        permittivity, conductivity, thickness = self.slabs
        positive = np.maximum(permittivity - 1, 1e-3), np.maximum(conductivity, 1e-6), thickness
        return np.concatenate([self.offset_m, *np.log(positive)])

    def with_vector(self, vector: FloatArray) -> Constants:
        """The constants of another vector."""
        offset, logarithms = np.split(vector, [len(self.offset_m)])
        slabs = np.exp(logarithms.reshape(3, -1))
        slabs[0] += 1
        return Constants(offset, slabs)

    def deviation(self, offset_sd_m: float) -> FloatArray:
        """Prior standard deviation of each entry of the vector."""
        return np.concatenate([np.full(len(self.offset_m), offset_sd_m), np.repeat(SPREAD, self.slabs.shape[1])])


def gain_slopes(waves: Waves, constants: Constants, gain: ComplexArray) -> list[tuple[IntArray, ComplexArray]]:
    """For each entry of the constants' vector, the paths that depend on it and the derivative of their gains.

    A displacement counts as a phase of the gain: its effect on the direction of arrival is small.
    """
    image = waves.image(constants.offset_m)
    towards = image / np.linalg.norm(image, axis=1, keepdims=True)
    slopes = []
    for moved in waves.moved:
        path = np.flatnonzero(moved.any(axis=1))
        turn = -1j * waves.instrument.wavenumber * (towards[path] * moved[path]).sum(axis=1)
        slopes.append((path, turn * gain[path]))
    vector, b = constants.vector(), constants.slabs.shape[1]
    touched = [np.flatnonzero((waves.paths.objects == index).any(axis=1)) for index in range(b)]
    for number, path in enumerate(3 * touched, start=len(waves.moved)):
        changed = vector.copy()
        changed[number] += STEP
        slopes.append((path, (waves.gain(constants.with_vector(changed).slabs, path) - gain[path]) / STEP))
    return slopes


def _minimised(
    loss: Callable[[FloatArray], tuple[FloatArray, FloatArray]], start: FloatArray, steps: int, memory: int
) -> FloatArray:
    """Minimum of the rows' losses plus half the square of the argument, by L-BFGS of ``steps`` steps."""

    def objective(z: FloatArray) -> tuple[float, FloatArray]:
        losses, slope = loss(z)
        return float(losses.sum() + (z**2).sum() / 2), slope + z

    found = minimize(objective, start, jac=True, method="L-BFGS-B", options={"maxiter": steps, "maxcor": memory})
    return np.asarray(found.x)


def fit_constants(
    waves: Waves,
    shapes: FloatArray,
    start: Constants,
    prior: Constants,
    offset_sd_m: float,
    steps: int,
    factor: ComplexArray | float = 1.0,
) -> Constants:
    """Displacements of planes and materials of greatest posterior probability, from ``start``.

    The waves and shapes (see `Grid.shapes`) are those of the training rows; the prior has the mean ``prior`` and, for
    displacements, the standard deviation ``offset_sd_m``; ``factor`` [p] multiplies each path.
    """
    centre, deviation = prior.vector(), prior.deviation(offset_sd_m)

    def loss(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        constants = prior.with_vector(centre + z * deviation)
        plain, steering = waves.gain(constants.slabs), waves.steering(constants.offset_m)
        losses, slope = waves.instrument.grid.loss_and_slope(waves.sum @ ((plain * factor)[:, None] * steering), shapes)
        by_gain = ((waves.sum.T @ slope) * steering.conj()).sum(axis=1) * np.conj(factor)
        each = [2 * (by_gain[path].conj() * change).real.sum() for path, change in gain_slopes(waves, constants, plain)]
        return losses, np.array(each) * deviation

    return prior.with_vector(centre + _minimised(loss, (start.vector() - centre) / deviation, steps, 30) * deviation)


def scan_offsets(
    waves: Waves, shapes: FloatArray, start: Constants, offset_sd_m: float, factor: ComplexArray | float = 1.0
) -> Constants:
    """Best displacements within two deviations, plane by plane, as phases have several minima; see `fit_constants`."""
    gain, offset = waves.gain(start.slabs) * factor, start.offset_m.copy()
    for plane in np.flatnonzero(waves.moved.any(axis=(1, 2))):
        scores = []
        for value in np.linspace(-2, 2, 13) * offset_sd_m:
            offset[plane] = value
            losses = waves.instrument.grid.loss(waves.sum @ (gain[:, None] * waves.steering(offset)), shapes)
            scores.append((losses.sum() + (value / offset_sd_m) ** 2 / 2, value))
        offset[plane] = min(scores)[1]
    return replace(start, offset_m=offset)


@dataclass(frozen=True)
class Maps:
    """Amplitude of each chain as a smooth function of the transmitter's image: 1 + sum of k Gaussians.

    Each Gaussian has a chain [k], a complex weight [k] and a centre [k, 3] (an image less the array's origin; NaN: a
    constant); ``scale_m`` is the standard deviation of all.
    """

    chain: IntArray
    centre_m: FloatArray
    scale_m: float
    weight: ComplexArray

    def matrix(self, paths: ChainPaths) -> sparse.csr_matrix:
        """Value of each Gaussian at each path, [p, k]."""
        order = np.argsort(paths.chain, kind="stable")
        edges = np.searchsorted(paths.chain[order], np.arange(self.chain.max(initial=-1) + 2))
        constant = np.isnan(self.centre_m[:, 0])
        empty = np.zeros(0, np.int64)
        entries = [(np.zeros(0), empty, empty)]
        for chain in np.unique(self.chain):
            path, column = order[edges[chain] : edges[chain + 1]], np.flatnonzero(self.chain == chain)
            centre = np.where(constant[column, None], 0.0, self.centre_m[column])
            square = ((paths.image_m[path][:, None] - centre) ** 2).sum(axis=-1)
            value = np.where(constant[column], 1.0, np.exp(-square / (2 * self.scale_m**2)))
            i, j = np.nonzero(value > LEAST_VALUE)
            entries.append((value[i, j], path[i], column[j]))
        values, rows, columns = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_matrix((values, (rows, columns)), shape=(len(paths), len(self.chain)))

    def amplitude(self, paths: ChainPaths) -> ComplexArray:
        """Factor of each path [p]."""
        return np.asarray(1 + self.matrix(paths) @ self.weight)


def map_centres(paths: ChainPaths, chain_length: IntArray, scale_m: float, reflections: int) -> Maps:
    """Gaussians of weight zero: a constant for each chain, and one every ``scale_m`` up to so many ``reflections``."""
    chains, centres = [], []
    for chain in np.unique(paths.chain):
        path = np.flatnonzero(paths.chain == chain)
        if len(path) < LEAST_ROWS:
            continue
        chains.append(chain)
        centres.append(np.full(3, np.nan))
        if chain_length[chain] > reflections:
            continue
        image, nearest, index = paths.image_m[path], np.full(len(path), np.inf), 0
        while nearest[index] > scale_m:  # farthest point first
            chains.append(chain)
            centres.append(image[index])
            nearest = np.minimum(nearest, np.linalg.norm(image - image[index], axis=1))
            index = int(nearest.argmax())
    return Maps(np.array(chains, np.int64), np.reshape(centres, (-1, 3)), scale_m, np.zeros(len(chains), complex))


def fit_maps(waves: Waves, shapes: FloatArray, constants: Constants, maps: Maps, deviation: float, steps: int) -> Maps:
    """Weights of greatest posterior probability, ``deviation`` being their prior standard deviation."""
    matrix, k = maps.matrix(waves.paths), len(maps.chain)
    arriving = waves.gain(constants.slabs)[:, None] * waves.steering(constants.offset_m)

    def loss(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        weight = (z[:k] + 1j * z[k:]) * deviation
        losses, slope = waves.instrument.grid.loss_and_slope(
            waves.sum @ ((1 + matrix @ weight)[:, None] * arriving), shapes
        )
        change = 2 * deviation * (matrix.T @ ((waves.sum.T @ slope) * arriving.conj()).sum(axis=1))
        return losses, np.concatenate([change.real, change.imag])

    start = np.concatenate([maps.weight.real, maps.weight.imag]) / deviation
    found = _minimised(loss, start, steps, 20)
    return replace(maps, weight=np.asarray((found[:k] + 1j * found[k:]) * deviation, complex))


@dataclass(frozen=True)
class ResidualField:
    """The field that is kriged: residual of a share of the room's prediction, of zero or unknown mean (``centred``).

    Its correlation length is in wavelengths; ``noise`` is the variance by which two spectra at one position differ, as
    a share of the field's.
    """

    share: float
    wavelengths: float
    noise: float
    centred: bool


RESIDUALS = tuple(ResidualField(1.0, length, 0.5, False) for length in (0.6, 1.2, 2.4))
"""Fields for a room that explains most."""
MIXES = {
    "kriging of spectra": ResidualField(0.0, 10.0, 0.1, True),
    "half of room, kriging of what it leaves": ResidualField(0.5, 10.0, 0.1, True),
    "room, kriging of what it leaves": ResidualField(1.0, 10.0, 0.1, True),
}
"""Fields where the room explains less, by name. With a length of whole rooms interpolation is nearly linear, and a few
rows suffice."""


@dataclass(frozen=True)
class ResidualKriging:
    """Kriging of the residuals of n training rows at positions ``place_m`` [n, 3].

    ``weight`` [n, k] is the inverse covariance times principal values less their mean; ``image`` [k, height, width] and
    ``mean`` [k] are principal images and mean; the residual is added to ``share`` of the room's prediction.
    """

    place_m: FloatArray
    length_m: float
    weight: FloatArray
    image: NDArray[np.float32]
    mean: FloatArray
    share: float

    @classmethod
    def of(
        cls,
        position_m: FloatArray,
        spectra: NDArray[np.float32],
        predicted: NDArray[np.float32],
        field: ResidualField,
        wavelength_m: float,
    ) -> ResidualKriging:
        """Fit to training spectra and the room's predictions of them, [n, height, width] each."""
        residual = spectra - field.share * predicted
        flat = residual.reshape(len(residual), -1)
        # Principal images by the rows' Gram matrix, as there are fewer rows than pixels.
        value, vector = np.linalg.eigh(flat.astype(float) @ flat.T.astype(float))
        kept = np.flatnonzero(value > value[-1] * 1e-9)[::-1][:COMPONENTS]
        scale = np.sqrt(value[kept])
        image = (vector[:, kept] / scale).T @ flat
        length_m = field.wavelengths * wavelength_m
        scaled, values = position_m / length_m, vector[:, kept] * scale
        trend = np.ones((len(position_m), int(field.centred)))
        system = KrigingSystem(correlation(scaled, scaled), field.noise, trend)
        mean = system.coefficients(values)
        images = image.reshape(-1, *residual.shape[1:]).astype(np.float32)
        return cls(position_m, length_m, system.weights(values, mean), images, mean.sum(axis=0), field.share)

    def __call__(self, position_m: FloatArray, predicted: NDArray[np.float32]) -> NDArray[np.float32]:
        """Spectra [m, height, width] in 0..1 at positions [m, 3], given the room's predictions of them."""
        alike = correlation(position_m / self.length_m, self.place_m / self.length_m)
        value = (alike @ self.weight + self.mean).astype(np.float32)
        added = np.tensordot(value, self.image, axes=1)
        return np.asarray(np.clip(np.float32(self.share) * predicted + added, 0, 1))
