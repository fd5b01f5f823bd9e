"""Planes shifted and tilted until the phases of the paths that they mirror fit what was measured (Gauss-Newton)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.walls import Walls
from .csi_paths import Images, images_of

NUMBERS = 5
"""Parameters of a plane: shift (m), two tilts (rad), logarithm and phase of what it reflects."""
STEPS = 3

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Model:
    """Image sources with all that is fitted to channels.

    Attributes:
        scan: the planes as they were given.
        change: of each plane [q, NUMBERS].
        walls: the planes with their changes.
        images: of all antennas, one after the other.
        source: antenna of each chain [c].
        source_m: antennas [r, 3].
        k: wave numbers [subcarriers], rad/m.
        reflection: coefficient of a plane of no change.
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
        """The same with other changes of the planes."""
        walls = self.scan.moved(change[:, :3])
        images = images_of(walls, self.source_m[self.source], self.images.plane)
        return replace(self, change=change, walls=walls, images=images)

    def factor(self) -> Complex:
        """What each chain's mirrors and instrument do to the amplitude [c]."""
        plane = self.images.plane
        used = plane >= 0
        own = self.reflection * np.exp(self.change[:, 3] + 1j * self.change[:, 4])
        each = np.where(used, own[np.where(used, plane, 0)], 1) if len(own) else np.ones(plane.shape, complex)
        return np.asarray(each.prod(axis=1) * self.gain[self.source])

    def path_gain(self, chain: IntArray, position_m: FloatArray) -> Complex:
        """Gain of paths [p, subcarriers]: factor * exp(-j k L) / (2 k L), free-space loss of isotropic antennas."""
        length = np.linalg.norm(position_m - self.images.image_m[chain, -1], axis=1)[:, None]
        return self.factor()[chain, None] * np.exp(-1j * self.k * length) / (2 * self.k * length)

    def length_slope(self, chain: IntArray, position_m: FloatArray) -> FloatArray:
        """Derivative of lengths [p, b, 3] by shift and tilts of each level's plane."""
        away = self.images.image_m[chain, -1] - position_m
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        return np.einsum("plkd,pd->plk", self.images.slope[chain], away)

    def phase_sd(self, chain: IntArray, position_m: FloatArray, covariance: FloatArray) -> FloatArray:
        """Standard deviation of the phases [p] for a covariance of all planes' parameters, at the middle subcarrier."""
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
    """What paths make of channels: which paths, and how likely each is.

    Attributes:
        channel: measured [n, subcarriers].
        row: of each path [p].
        chain: of each [p].
        position_m: of the moving end [p, 3].
        there: probability of each [p].
        precision: of each row's residual [n].
    """

    channel: Complex
    row: IntArray
    chain: IntArray
    position_m: FloatArray
    there: FloatArray
    precision: FloatArray

    def residual(self, model: Model) -> Complex:
        """Measured less the mean of what is predicted [n, subcarriers]."""
        gain = self.there[:, None] * model.path_gain(self.chain, self.position_m)
        left = self.channel.astype(complex)
        np.subtract.at(left, self.row, gain)
        return left


def refit(model: Model, explained: Explained, prior_sd: FloatArray) -> tuple[Model, FloatArray]:
    """A few steps of Levenberg and Marquardt for the planes' parameters.

    Args:
        model: to begin with.
        explained: the paths, held as they are.
        prior_sd: standard deviation of each plane's parameters about zero [q, NUMBERS]; 0 holds one.

    Returns:
        The model, and the covariance of all parameters [NUMBERS q, NUMBERS q].
    """
    sd = np.maximum(prior_sd.reshape(-1), 1e-12)
    damping = 1e-6

    def cost(candidate: Model) -> float:
        left = np.square(np.abs(explained.residual(candidate))).sum(axis=1)
        return float(explained.precision @ left + np.square(candidate.change.reshape(-1) / sd).sum())

    best = cost(model)
    normal = np.zeros((len(sd), len(sd)))
    for _ in range(STEPS):
        normal, right = _normal_equations(model, explained)
        right = right - model.change.reshape(-1) / sd**2
        while damping < 1e6:
            # In units of the prior: parameters of metres, rad and none beside each other.
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
    chain = explained.chain
    slope = model.length_slope(chain, explained.position_m)
    gain = explained.there[:, None] * model.path_gain(chain, explained.position_m)
    left = explained.residual(model)
    size = NUMBERS * len(model.scan)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for carrier, k in enumerate(model.k):
        jacobian = np.zeros((len(left), size), complex)
        for level in range(slope.shape[1]):
            plane = model.images.plane[chain, level]
            use = plane >= 0
            own = gain[use, carrier]
            parts = [*(-1j * k * own * slope[use, level, part] for part in range(3)), own, 1j * own]
            for part, values in enumerate(parts):
                np.add.at(jacobian, (explained.row[use], NUMBERS * plane[use] + part), values)
        weighted = jacobian.conj().T * explained.precision
        normal += (weighted @ jacobian).real
        right += (weighted @ left[:, carrier]).real
    return normal, right
