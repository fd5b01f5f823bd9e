"""Positions that tell most of the least certain surface of a scene.

The loss of an interaction with surface s differs by theta_s dB from that of the scene's materials. A strength is linear
in these differences, J theta + f + noise, with the derivatives J of the traced power (`wrf_mi.tracing.surface_shares`)
and the process f of the model's errors. Measurements at c by all receivers add the information

    sum over receivers of j j^T / v,    j = J_c - k^T K^-1 J_rows,    v = C(c, c) + noise,

with C the covariance of f after all rows before, K theirs and k that with c: what f explains is not told of a surface.

Source: Rasmussen and Williams, "Gaussian Processes for Machine Learning" (2006), equation 2.41 (explicit basis
functions); Krause, Singh and Guestrin, "Near-optimal sensor placements in Gaussian processes" (2008) (greedy choice).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from ...core.angles import FloatArray
from ...core.files import readable
from ...estimators.error_prior import JITTER, ErrorPrior
from ...scene.correction_data import FILE, KEY
from ...training.session import OnProgress, quiet

SURFACE_DB = 3.0
"""Standard deviation of the loss at a surface about that of its material, a choice: a factor of two in thickness or
permittivity changes a slab's transmission by 0.6 dB (3 cm of wood) to 10 dB (20 cm of concrete), and its reflection by
3 to 11 dB (ITU-R P.2040, root mean square over 0.9, 2.4 and 5.8 GHz at normal incidence)."""
CONSTANTS = ("permittivity", "conductivity", "thickness_m")  # of ``sd_log`` in ``correction.json``, in its order
SMALL = 1e-12  # power of a coefficient that has no decibels
Worth = Callable[[int | None, FloatArray | None], FloatArray]
"""Factors [p] of the reductions at p positions from the index of the choice before, or from a start."""


@dataclass(frozen=True)
class Losses:
    """What is known of the losses at surfaces.

    Attributes:
        names: objects of the scene [s].
        std_db: standard deviations [s], dB.
        knows_rows: whether the training rows are known in them already, as those of a corrected scene.
    """

    names: tuple[str, ...]
    std_db: FloatArray
    knows_rows: bool


@dataclass
class Told:
    """Errors of one receiver at p positions and how they depend on the losses; changed as rows are added.

    ``covariance`` [p, p] is that of the process after the training rows, ``slope`` [p, s] the derivatives by the losses
    less what the process explains of them, ``information`` [s, s] that of the training rows about the losses, and
    ``noise`` the variance of a further observation.
    """

    covariance: FloatArray
    slope: FloatArray
    information: FloatArray
    noise: float

    @classmethod
    def of(cls, prior: ErrorPrior, positions_m: FloatArray, of_rows: FloatArray, of_positions: FloatArray) -> Told:
        """The process after the training rows, with derivatives [n, s] at these and [p, s] at positions [p, 3]."""
        count = len(prior.measured_m)
        total = prior.covariance(*[np.concatenate([prior.measured_m, positions_m])] * 2)
        rows, cross = total[:count, :count], total[:count, count:]
        rows[np.diag_indices(count)] += prior.noise + JITTER * total.diagonal().max()
        if not count:
            return cls(total, of_positions.copy(), np.zeros((of_positions.shape[1],) * 2), prior.new_noise)
        factor = cho_factor(rows, lower=True)
        information = of_rows.T @ cho_solve(factor, of_rows)
        slope = of_positions - cross.T @ cho_solve(factor, of_rows)
        covariance = total[count:, count:] - cross.T @ cho_solve(factor, cross)
        return cls(covariance, slope, information, prior.new_noise)

    def variance(self, losses: FloatArray) -> FloatArray:
        """Variances [p] of the errors, with the covariance [s, s] of the losses."""
        total = self.covariance.diagonal() + np.einsum("ps,st,pt->p", self.slope, losses, self.slope)
        return np.asarray(np.maximum(total, 0))

    def measure(self, place: int) -> None:
        """Add an observation at a position."""
        column = self.covariance[:, place].copy()
        weight = column / (column[place] + self.noise)
        self.slope -= np.outer(weight, self.slope[place])
        self.covariance -= np.outer(weight, column)


def losses_of(scene: str | Path | None, names: Sequence[str], frequency_hz: float) -> Losses:
    """Standard deviations of losses, by the objects' names: as corrected, else `SURFACE_DB`.

    Raises:
        InputError: ``correction.json`` is not what a correction writes.
    """
    std, path, knows = np.full(len(names), SURFACE_DB), Path(scene or "") / FILE, False
    if scene is not None and path.is_file():
        with readable(path, f"{path}: missing", "correct the scene again"):
            facts = json.loads(path.read_text(encoding="utf-8"))
            knows = facts.get(KEY) is not None
            fitted = [each for each in facts["materials"] if each["sd_log"] is not None and not each["absent"]]
            constants = np.array([[each[name][1] for name in CONSTANTS] for each in fitted]).reshape(-1, 3)
            spread = np.array([each["sd_log"][:3] for each in fitted]).reshape(-1, 3)
            objects = np.array([each["surface"] for each in fitted], str)
        of_surface = loss_std_db(constants, spread, frequency_hz)
        for place, name in enumerate(names):
            if (same := objects == name).any():  # the least certain of an object's planes
                std[place] = of_surface[same].max()
    return Losses(tuple(names), std, knows)


def loss_std_db(constants: FloatArray, sd_log: FloatArray, frequency_hz: float) -> FloatArray:
    """Standard deviations [n] of the loss of slabs at normal incidence, dB, mean over the power both ways.

    Args:
        constants: relative permittivity, conductivity in S/m and thickness in metres [n, 3].
        sd_log: standard deviations of the logarithms of permittivity - 1, of conductivity and of thickness [n, 3].
        frequency_hz: carrier, Hz.
    """
    logarithm = np.log(np.maximum(constants - np.array([1.0, 0, 0]), SMALL))
    middle, square = _powers(logarithm, frequency_hz), np.zeros((2, len(constants)))
    for place in range(3):
        # Differences over the whole deviation: interference in a slab bends the loss within it.
        step = np.zeros(3)
        step[place] = 1.0
        ends = [10 * np.log10(_powers(logarithm + sign * step * sd_log, frequency_hz)) for sign in (1, -1)]
        square += np.square((ends[0] - ends[1]) / 2)
    return np.asarray(np.sqrt((middle * square).sum(axis=0) / middle.sum(axis=0)))


def _powers(logarithm: FloatArray, frequency_hz: float) -> FloatArray:
    """Reflected and transmitted shares of the power [2, n]."""
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import columns_on_device
    from ...tracing.slabs import slab

    if not len(logarithm):
        return np.zeros((2, 0))
    values = np.exp(logarithm) + np.array([1.0, 0, 0])
    columns = columns_on_device([np.ones(len(values)), *values.T], dr.float64_array_t(mi.Float))
    cosine, permittivity, conductivity, thickness_m = columns
    coefficients = slab(cosine, permittivity, conductivity, thickness_m, frequency_hz)
    both = coefficients.reflected_te, coefficients.transmitted_te  # at normal incidence TM has the same magnitudes
    return np.stack([np.maximum(np.array(dr.squared_norm(each), float), SMALL) for each in both])


def take_best(
    gain: FloatArray, free: NDArray[np.bool_], chosen: list[int], worth: Worth | None, start: FloatArray | None
) -> int:
    """Index of the largest gain [p], times its worth, among free positions; it is added to those chosen."""
    if worth is not None:
        gain = gain * worth(chosen[-1] if chosen else None, start)
    best = int(np.argmax(np.where(free, gain, -np.inf)))
    chosen.append(best)
    free[best] = False
    return best


def greedy_losses(
    receivers: Sequence[Told],
    std_db: FloatArray,
    measurable: NDArray[np.bool_],
    allowed: NDArray[np.bool_],
    count: int,
    worth: Worth | None = None,
    start: FloatArray | None = None,
    on_progress: OnProgress = quiet,
) -> tuple[list[int], FloatArray, FloatArray]:
    """Positions each of which lowers the variance of the measurable loss that is the least certain before it most.

    Args:
        receivers: errors of each receiver; changed in place.
        std_db: standard deviations of the losses [s] before the rows of ``Told.information``, dB.
        measurable: losses [s] that a strength at some position that may be chosen depends on.
        allowed: positions that may be chosen [p].
        count: number of choices.
        worth: factor [p] of the reductions, from the position before (None: none).
        start: position before the first choice.
        on_progress: progress callback.

    Returns:
        Indices of the choices, standard deviations of the losses before and after each [count + 1, s], dB, and
        variances of the errors before and after all [2, receivers, p].
    """
    information = np.diag(1 / np.square(std_db)) + sum(each.information for each in receivers)
    losses = np.asarray(np.linalg.inv(information), float)
    free, chosen, std = np.array(allowed, bool), list[int](), [np.sqrt(losses.diagonal())]
    before = np.stack([each.variance(losses) for each in receivers])
    for number in range(count):
        target = int(np.argmax(np.where(measurable, losses.diagonal(), -np.inf)))
        slopes = np.stack([each.slope for each in receivers], axis=1)  # [p, receivers, s]
        spread = slopes @ losses
        total = spread @ slopes.transpose(0, 2, 1)  # covariances of what all receivers report at a position
        noise = [np.maximum(each.covariance.diagonal(), 0) + each.noise for each in receivers]
        total[:, np.arange(len(receivers)), np.arange(len(receivers))] += np.stack(noise, axis=1)
        gain = np.einsum("pr,pr->p", spread[..., target], np.linalg.solve(total, spread[..., target, None])[..., 0])
        best = take_best(gain, free, chosen, worth, start)
        losses -= spread[best].T @ np.linalg.solve(total[best], spread[best])
        for each in receivers:
            each.measure(best)
        std.append(np.sqrt(np.maximum(losses.diagonal(), 0)))
        on_progress("planning: positions", (number + 1) / count)
    after = np.stack([each.variance(losses) for each in receivers])
    return chosen, np.stack(std), np.stack([before, after])
