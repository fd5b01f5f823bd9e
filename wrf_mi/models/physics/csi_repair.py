"""Planes shifted and tilted until the phases of the paths that they mirror fit the measured channels (Gauss-Newton)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.walls import Walls
from .csi_paths import Images, images_of

NUMBERS = 5
"""Parameters of a plane: shift (m), two tilts (rad), logarithm and phase of its reflection coefficient."""
STEPS = 3

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Model:
    """Image sources with all parameters that are fitted to channels.

    Attributes:
        scan, walls: planes as given, and with their changes.
        change: parameters of each plane [q, NUMBERS].
        images: images of all antennas, antenna by antenna.
        source, source_m: antenna of each chain [c], and antennas [r, 3].
        k: wave numbers [subcarriers], rad/m.
        reflection: coefficient of an unchanged plane.
        gain: complex factor of each antenna [r].
    """

    scan: Walls
    change: FloatArray
    walls: Walls
    images: Images
    source: IntArray
    source_m: FloatArray
    k: FloatArray
    reflection: complex
    gain: Complex

    def changed(self, change: FloatArray) -> Model:
        """The model with other parameters of the planes."""
        walls = self.scan.moved(change[:, :3])
        images = images_of(walls, self.source_m[self.source], self.images.plane)
        return replace(self, change=change, walls=walls, images=images)

    def path_gain(self, chain: IntArray, position_m: FloatArray) -> Complex:
        """Gain of paths [p, subcarriers]: factor * exp(-j k L) / (2 k L), free-space loss of isotropic antennas."""
        plane = self.images.plane
        # An entry beyond the last plane stands for "no reflection" (index -1).
        each = np.append(self.reflection * np.exp(self.change[:, 3] + 1j * self.change[:, 4]), 1)
        factor = each[plane].prod(axis=1) * self.gain[self.source]
        length = np.linalg.norm(position_m - self.images.image_m[chain, -1], axis=1)[:, None]
        return np.asarray(factor[chain, None] * np.exp(-1j * self.k * length) / (2 * self.k * length))

    def length_slope(self, chain: IntArray, position_m: FloatArray) -> FloatArray:
        """Derivative of lengths [p, b, 3] by shift and tilts of each level's plane."""
        away = self.images.image_m[chain, -1] - position_m
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        result: FloatArray = np.einsum("plkd,pd->plk", self.images.slope[chain], away)
        return result

    def phase_sd(self, chain: IntArray, position_m: FloatArray, covariance: FloatArray) -> FloatArray:
        """Standard deviation of phases [p] by the covariance of all planes' parameters, at the middle subcarrier."""
        if not len(covariance):
            return np.zeros(len(chain))
        slope = self.length_slope(chain, position_m) * np.median(self.k)
        plane = self.images.plane[chain]
        used = (plane >= 0)[..., None]
        turn = np.concatenate([slope, np.zeros_like(slope[..., :1]), np.ones_like(slope[..., :1])], axis=2) * used
        index = NUMBERS * np.where(plane >= 0, plane, 0)[..., None] + np.arange(NUMBERS)
        flat, index = turn.reshape(len(chain), -1), index.reshape(len(chain), -1)
        variance = np.zeros(len(chain))
        for a in range(flat.shape[1]):
            for b in range(flat.shape[1]):
                variance += flat[:, a] * flat[:, b] * covariance[index[:, a], index[:, b]]
        return np.sqrt(np.maximum(variance, 0))


@dataclass(frozen=True)
class Explained:
    """Channels [n, subcarriers], the paths [p] that explain them, and precisions of the residuals [n]."""

    channel: Complex
    row: IntArray
    chain: IntArray
    position_m: FloatArray
    probability: FloatArray
    precision: FloatArray

    def expected_gain(self, model: Model) -> Complex:
        """Gain of each path times its probability [p, subcarriers]."""
        return np.asarray(self.probability[:, None] * model.path_gain(self.chain, self.position_m))

    def residual(self, model: Model) -> Complex:
        """Measured channels less their expectation [n, subcarriers]."""
        residual = self.channel.astype(complex)
        np.subtract.at(residual, self.row, self.expected_gain(model))
        return residual


def refit(model: Model, explained: Explained, prior_sd: FloatArray) -> tuple[Model, FloatArray]:
    """A few steps of Levenberg and Marquardt for the planes' parameters, with fixed paths.

    ``prior_sd`` [q, NUMBERS] are standard deviations of each plane's parameters about zero; 0 fixes one. Returns the
    model, and the covariance of all parameters [NUMBERS q, NUMBERS q].
    """
    sd = np.maximum(prior_sd.reshape(-1), 1e-12)
    damping = 1e-6

    def cost(candidate: Model) -> float:
        square = np.square(np.abs(explained.residual(candidate))).sum(axis=1)
        return float(explained.precision @ square + np.square(candidate.change.reshape(-1) / sd).sum())

    best = cost(model)
    normal = np.zeros((len(sd), len(sd)))
    for _ in range(STEPS):
        normal, right = _normal_equations(model, explained)
        right = right - model.change.reshape(-1) / sd**2
        while damping < 1e6:
            # In units of the prior: the parameters are metres, radians and pure numbers.
            scaled = sd[:, None] * normal * sd + np.eye(len(sd))
            scaled[np.diag_indices(len(sd))] *= 1 + damping
            step = sd * np.linalg.solve(scaled, sd * right)
            candidate = model.changed(model.change + step.reshape(model.change.shape))
            value = cost(candidate)
            if value <= best:
                model, best, damping = candidate, value, damping / 10
                break
            damping = max(damping, 1e-6) * 10
        else:
            break
    scaled = sd[:, None] * normal * sd + np.eye(len(sd))
    return model, sd[:, None] * np.linalg.inv(scaled) * sd


def _normal_equations(model: Model, explained: Explained) -> tuple[FloatArray, FloatArray]:
    """J^H W J and J^H W r, real parts, for all planes' parameters."""
    slope = model.length_slope(explained.chain, explained.position_m)
    gain, residual = explained.expected_gain(model), explained.residual(model)
    size = NUMBERS * len(model.scan)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for carrier, k in enumerate(model.k):
        jacobian = np.zeros((len(residual), size), complex)
        for level in range(slope.shape[1]):
            plane = model.images.plane[explained.chain, level]
            use = plane >= 0
            wave = gain[use, carrier]
            columns = [*(-1j * k * wave * slope[use, level, part] for part in range(3)), wave, 1j * wave]
            for part, values in enumerate(columns):
                np.add.at(jacobian, (explained.row[use], NUMBERS * plane[use] + part), values)
        weighted = jacobian.conj().T * explained.precision
        normal += (weighted @ jacobian).real
        right += (weighted @ residual[:, carrier]).real
    return normal, right
