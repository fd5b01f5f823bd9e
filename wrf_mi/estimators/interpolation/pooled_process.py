"""Gaussian processes of several receivers that share part of their mean.

    y_r(x) = phi_r(x) . beta + f_r(x) + e,    beta ~ N(0, diag(sd^2)),  f_r ~ GP(0, k),  e ~ Student-t

beta is common to all receivers and learned from all of them; the fields f_r are independent, so that the exact
posterior needs one Cholesky factor for each receiver (`wrf_mi.estimators.interpolation.kriging_equations`). The noise's
heavy tails are reached by reweighting: a row with a large residual has a larger variance.

Source: Rasmussen and Williams, "Gaussian Processes for Machine Learning" (2006), sections 2.2 and 2.7 (mean with
explicit basis functions); Lange, Little and Taylor, "Robust statistical modeling using the t distribution" (1989),
JASA 84 (the weights).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...parallel.threads import on_threads, one_blas_thread
from .kriging_equations import Block, KrigingSystem

Result = TypeVar("Result")
Kernel = Callable[[Any, Any], FloatArray]
"""Covariance [n, m] of the field between two sets of inputs."""

THREADED_ROWS = 6000
"""Rows of all receivers from which these are computed on threads; to start those takes more time for fewer."""
JITTER = 1e-9  # noise added to coincident inputs, as a share of the field's variance
DEGREES = 4.0  # degrees of freedom of the noise's Student-t distribution: fades are deep


def of_each(work: Callable[[Any], Result], parts: Sequence[Any], rows: int) -> list[Result]:
    """Results of ``work(part)``, on threads where so many rows take longer than to start these."""
    if rows > THREADED_ROWS:
        return on_threads(work, parts)
    with one_blas_thread():
        return [work(part) for part in parts]


class Basis(NamedTuple):
    """Columns [n, p] of phi that are not zero for a receiver, and their numbers [p] among the coefficients beta [k]."""

    columns: FloatArray
    used: IntArray


@dataclass(frozen=True)
class ReceiverObservations:
    """Observations of one receiver: numbers of their inputs [n], phi [n], y [n], variance of the noise [n]."""

    rows: IntArray
    basis: Basis
    value: FloatArray
    variance: FloatArray


class Coefficients:
    """Normal distribution of the coefficients beta, given information of receivers that are independent given it.

    Its precision is that of the prior, and for each receiver a block of what its observations tell. Coefficients of one
    receiver alone are coupled with the common ones and with no other's, so that each has an inverse of its own.

    Args:
        prior_sd: prior standard deviations [k].
        bases: columns of each receiver, and the numbers of their coefficients [p].
        information: block of each receiver [p, p].
        projected: right-hand side of each receiver [p].
    """

    def __init__(
        self,
        prior_sd: FloatArray,
        bases: Sequence[Basis],
        information: Sequence[FloatArray],
        projected: Sequence[FloatArray],
    ) -> None:
        used = [basis.used for basis in bases]
        count = np.bincount(np.concatenate([*used, np.zeros(0, np.int64)]), minlength=len(prior_sd))
        prior, common = 1 / np.square(prior_sd), np.flatnonzero(count != 1)
        place = np.searchsorted(common, np.arange(len(prior_sd)))
        precision, right = np.diag(prior[common]), np.zeros(len(common))
        self._parts = list[tuple[Any, ...]]()
        self.log_determinant = 0.0
        for basis, block, value in zip(bases, information, projected, strict=True):
            unshared = count[basis.used] == 1
            shared, own_prior = place[basis.used[~unshared]], np.diag(prior[basis.used[unshared]])
            inverse = np.linalg.inv(block[np.ix_(unshared, unshared)] + own_prior)
            twins = _twins(basis.columns, unshared)
            # Schur complement: what is left of the common coefficients' precision, A - A (A + L)^-1 A.
            if twins is None:
                coupling = block[np.ix_(~unshared, unshared)] @ inverse
                precision[np.ix_(shared, shared)] += (
                    block[np.ix_(~unshared, ~unshared)] - coupling @ block[np.ix_(unshared, ~unshared)]
                )
                right[shared] += value[~unshared] - coupling @ value[unshared]
            else:
                # Without noise A is 1e14 times L, and the difference rounding: it is L - L (A + L)^-1 L.
                chosen = own_prior[:, twins]
                coupling = (np.eye(len(own_prior))[:, twins] - inverse @ chosen).T
                precision[np.ix_(shared, shared)] += chosen[twins] - chosen.T @ inverse @ chosen
                right[shared] += chosen.T @ inverse @ value[unshared]
            self.log_determinant -= float(np.linalg.slogdet(inverse)[1])
            self._parts.append((unshared, shared, inverse, coupling))
        self.log_determinant += float(np.linalg.slogdet(precision)[1])
        self._common = np.linalg.inv(precision)
        self.mean = np.zeros(len(prior_sd))
        self.mean[common] = self._common @ right
        for number, value, (unshared, shared, inverse, coupling) in zip(used, projected, self._parts, strict=True):
            self.mean[number[unshared]] = inverse @ value[unshared] - coupling.T @ self.mean[common[shared]]

    def covariance(self, receiver: int) -> FloatArray:
        """Covariance [p, p] of the coefficients of a receiver."""
        unshared, shared, inverse, coupling = self._parts[receiver]
        common = self._common[np.ix_(shared, shared)]
        result = np.empty((len(unshared), len(unshared)))
        result[np.ix_(~unshared, ~unshared)], across = common, -common @ coupling
        result[np.ix_(~unshared, unshared)], result[np.ix_(unshared, ~unshared)] = across, across.T
        result[np.ix_(unshared, unshared)] = inverse - coupling.T @ across
        return result


def _twins(columns: FloatArray, unshared: NDArray[np.bool_]) -> list[int] | None:
    """For each common column of a receiver the place of an equal one among its own; None where one has none."""
    places = [
        next((j for j, other in enumerate(columns.T[unshared]) if np.array_equal(column, other)), None)
        for column in columns.T[~unshared]
    ]
    return None if None in places else [place for place in places if place is not None]


class LeftOut(NamedTuple):
    """Posterior without a fold: beta [k]; and mean and variance of phi . beta + f at the fold's observations [m]."""

    beta: FloatArray
    mean: list[FloatArray]  # of each receiver
    variance: list[FloatArray]  # of each receiver


class PooledProcess:
    """The posterior of all receivers.

    ``inputs`` are those of all observations, of which ``take`` gives some, such as `Poses`; ``parts`` the observations
    of each receiver, possibly without rows; ``prior_sd`` [k] the standard deviations of
    beta, above zero; ``point_variance`` is k(x, x); ``rounds`` reweight rows for Student-t noise; ``beta`` [k] is the
    posterior mean of the shared coefficients.

    Raises:
        numpy.linalg.LinAlgError: a covariance that is not positive definite.
    """

    def __init__(
        self,
        inputs: Any,
        parts: Sequence[ReceiverObservations],
        kernel: Kernel,
        prior_sd: FloatArray,
        point_variance: float,
        rounds: int = 0,
    ) -> None:
        self._inputs, self._kernel, self._prior_sd, self._point_variance = inputs, kernel, prior_sd, point_variance
        # Receivers that share inputs share their covariances, which cost as much as their factors.
        shared = sum(len(part.rows) ** 2 for part in parts) > len(inputs) ** 2
        every = kernel(inputs, inputs) if shared else None
        self._solve(parts, every)
        for _ in range(rounds):
            self._solve(self._reweighted([part.variance for part in parts]), every)

    def _solve(self, parts: Sequence[ReceiverObservations], every: FloatArray | None) -> None:
        kernel, jitter, self._parts = self._kernel, JITTER * self._point_variance, parts

        def system(p: ReceiverObservations) -> KrigingSystem:
            inputs = self._inputs.take(p.rows)
            covariance = kernel(inputs, inputs) if every is None else every[np.ix_(p.rows, p.rows)]
            return KrigingSystem(covariance, p.variance + jitter, p.basis.columns)

        self._systems = of_each(system, parts, sum(len(p.value) for p in parts))
        triples = [(system, part.basis.used, part.value) for system, part in zip(self._systems, parts, strict=True)]
        # Receivers are independent given beta: their information adds up to the prior's (equation 2.41).
        self._bases = [part.basis for part in parts]
        self._information = [each.information for each in self._systems]
        self._projected = [each.projected(value) for each, _, value in triples]
        self._coefficients = Coefficients(self._prior_sd, self._bases, self._information, self._projected)
        self.beta = self._coefficients.mean
        self._weights = [each.weights(value, self.beta[used]) for each, used, value in triples]

    @property
    def cost(self) -> float:
        """Minus twice the logarithm of the marginal likelihood of the observations, up to a constant."""
        # y ~ N(0, K + B S B^T), by the lemmas of inversion and determinants: rows of receivers share beta alone.
        pairs = list(zip(self._systems, self._parts, strict=True))
        square = sum(float(part.value @ system.solve(part.value)) for system, part in pairs)
        square -= sum(float(self.beta[p.basis.used] @ of) for p, of in zip(self._parts, self._projected, strict=True))
        volume = self._coefficients.log_determinant + float(2 * np.log(self._prior_sd).sum())
        return square + volume + sum(system.log_determinant for system in self._systems)

    def predict(self, receiver: int, inputs: Any, basis: Basis) -> tuple[FloatArray, FloatArray]:
        """Mean and variance [m] of phi . beta + f, without noise, at m inputs with phi ``basis``."""
        cross = self._kernel(inputs, self._inputs.take(self._parts[receiver].rows))
        mean = self.trend(basis) + cross @ self._weights[receiver]
        covariance = self._coefficients.covariance(receiver)
        return mean, self._systems[receiver].variance(self._point_variance, cross, basis.columns, covariance)

    def without(self, folds: Sequence[Sequence[IntArray]]) -> list[LeftOut]:
        """Posteriors without the observations of each fold, by the factors and the noise of all.

        A fold has numbers of the observations of each receiver, ascending.
        """

        def blocks(receiver: int) -> list[Block]:
            rows = [fold[receiver] for fold in folds]
            return self._systems[receiver].without(rows, self._parts[receiver].value)

        numbers = range(len(self._parts))
        of_receivers = of_each(blocks, numbers, sum(len(part.value) for part in self._parts))
        results = []
        for fold, of_fold in zip(folds, zip(*of_receivers, strict=True), strict=True):
            information = [every - block.information for every, block in zip(self._information, of_fold, strict=True)]
            projected = [every - block.projected for every, block in zip(self._projected, of_fold, strict=True)]
            left = Coefficients(self._prior_sd, self._bases, information, projected)
            means, variances = list[FloatArray](), list[FloatArray]()
            for receiver, (part, rows, block) in enumerate(zip(self._parts, fold, of_fold, strict=True)):
                means.append(part.value[rows] - block.error + block.gap @ left.mean[part.basis.used])
                # Rounding may take both below zero where there is next to no noise.
                field = np.maximum(block.variance - part.variance[rows], 0)
                trend = np.einsum("mp,mp->m", block.gap @ left.covariance(receiver), block.gap)
                variances.append(field + np.maximum(trend, 0))
            results.append(LeftOut(left.mean, means, variances))
        return results

    def trend(self, basis: Basis) -> FloatArray:
        """Posterior mean [m] of phi . beta."""
        return np.asarray(basis.columns @ self.beta[basis.used])

    def weights(self, receiver: int) -> tuple[Any, FloatArray]:
        """Inputs of a receiver's observations, and weights [n] of the field's covariances with them in a mean."""
        return self._inputs.take(self._parts[receiver].rows), self._weights[receiver]

    def residuals(self, beta: FloatArray | None = None) -> list[tuple[IntArray, FloatArray]]:
        """Of each receiver the numbers of its inputs [n], and what phi . beta leaves; ``beta``: that of all rows."""
        chosen = self.beta if beta is None else beta
        return [(part.rows, part.value - part.basis.columns @ chosen[part.basis.used]) for part in self._parts]

    def _reweighted(self, variance: Sequence[FloatArray]) -> list[ReceiverObservations]:
        """Parts with the noise variances that their residuals imply for Student-t noise.

        The expected squared residual, posterior variance of the field included, is compared with the squared scale
        ``variance`` of each row's noise, [n] for each receiver: v = s (degrees + e^2 / s) / (degrees + 1).
        """

        def reweighted(receiver: int) -> ReceiverObservations:
            part, system, weights = self._parts[receiver], self._systems[receiver], self._weights[receiver]
            scale = variance[receiver]
            # y - f = V K^-1 (y - B beta); the field's posterior variance is the diagonal of V - V K^-1 V.
            residual = part.variance * weights
            square = residual**2 + np.maximum(part.variance - part.variance**2 * system.inverse_diagonal, 0)
            return replace(part, variance=scale * (DEGREES + square / scale) / (DEGREES + 1))

        return of_each(reweighted, range(len(variance)), sum(len(scale) for scale in variance))
