"""Positions whose measurement lowers the expected error of a run's map most.

Errors of the predictions are a Gaussian process (`wrf_mi.models.error_prior`). With C the covariance of the errors at
all positions after the training rows, a measurement at c with noise of variance s lowers the variance at t by

    C(t, c)^2 / (C(c, c) + s),

whatever it will read. So measurements can be planned one after the other before any is made: each is the candidate with
the greatest reduction, summed over the map and over receivers, after which C loses that rank.

Where the walls of a scene are known, strengths depend on the loss at each surface, which its material states only
roughly. These losses are terms of the process whose columns are the derivatives of the traced power
(`wrf_mi.tracing.surface_shares`): a measurement behind a wall tells what all paths through that wall lose.

Source: Seo, Wallat, Graepel and Obermayer, "Gaussian process regression: active data selection and test point
rejection" (2000) (the reduction over the map, after Cohn); Krause, Singh and Guestrin, "Near-optimal sensor placements
in Gaussian processes" (2008), JMLR 9 (greedy choice); Picheny, Ginsbourger, Roustant, Haftka and Kim, "Adaptive designs
of experiments for accurate approximation of a target region" (2010) (weights about a threshold).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import write_csv
from ..core.receivers import receiver_index
from ..models import Inputs
from ..models.error_prior import ErrorPrior, with_columns
from ..models.interpolation.kriging import Kriging
from ..runs.folder import load_rows
from ..runs.run import Run, open_run
from ..tasks import task_of
from ..training.session import OnProgress, quiet
from .coverage import coverage_probability
from .grid import area_of, candidates_of

Criterion = Literal["error", "coverage"]
Worth = Callable[[int | None, FloatArray | None], FloatArray]
"""Factors [p] of the reductions at p positions from the index of the choice before, or from a start."""
MOST_TARGETS, MOST_CANDIDATES = 600, 1500
"""Positions at which errors count, and candidates: covariances between all of them are kept for each receiver."""
SURFACE_DB = 3.0
"""Standard deviation of the loss at a surface about that of its material, a choice: a factor of two in thickness or
permittivity changes a slab's transmission by 0.6 dB (3 cm of wood) to 10 dB (20 cm of concrete), and its reflection by
3 to 11 dB (ITU-R P.2040, root mean square over 0.9, 2.4 and 5.8 GHz at normal incidence)."""
LEAST_SHARE = 0.02  # largest share of a surface over all positions, below which it is left out
THRESHOLD_DBM = -90.0


@dataclass(frozen=True)
class Plan:
    """Planned measurements in their order.

    Attributes:
        tx_pos_m: positions [k, 3], metres.
        expected_error: root of the mean variance over the map before any and after each of them [k + 1], in the unit of
            an observation (dB for strengths), mean over receivers.
        walked_m: distance of each position from the one before [k], from the start for the first; NaN without one.
        candidates_m, targets_m: positions that could be chosen, and positions of the map [m, 3].
        std: standard deviations of the errors at ``targets_m`` before and after, [2, m], mean over receivers.
    """

    tx_pos_m: FloatArray
    expected_error: FloatArray
    walked_m: FloatArray
    candidates_m: FloatArray
    targets_m: FloatArray
    std: FloatArray

    def write(self, file: str | Path) -> Path:
        """Write positions to centimetres with their order, expected error after each, and distance walked, as CSV."""
        columns = (
            np.arange(1, len(self.tx_pos_m) + 1),
            *self.tx_pos_m.round(2).T,
            self.expected_error[1:],
            self.walked_m,
        )
        header = ("order", "x", "y", "z", "expected_error", "walked_m")
        return write_csv(Path(file), header, zip(*columns, strict=True))


def plan(
    run: Run | str | Path,
    count: int = 10,
    *,
    candidates_m: FloatArray | None = None,
    area_m: tuple[FloatArray, FloatArray] | None = None,
    criterion: Criterion = "error",
    threshold_dbm: float | None = None,
    walk_m: float | None = None,
    start_m: FloatArray | None = None,
    receivers: Sequence[int | str] | None = None,
    step_m: float | None = None,
    height_m: float | None = None,
    on_progress: OnProgress = quiet,
) -> Plan:
    """Choose positions to measure next.

    Args:
        run: run of any model, or its folder, with one fitted model.
        count: number of positions.
        candidates_m: positions that can be measured [n, 3], metres; None: the map's.
        area_m: lower and upper corner [2] of the area whose errors count, metres; None: the scene, or all rows of the
            data.
        criterion: ``"error"``: the expected error over the map; ``"coverage"``: that about a threshold of received
            power, of models that state standard deviations.
        threshold_dbm: threshold of ``"coverage"``; None: -90 dBm.
        walk_m: distance that is worth half of a reduction: farther positions are chosen for more than twice as much;
            None: distances do not count.
        start_m: position [3] from which the first is walked to; None: from nowhere.
        receivers: names, or numbers from 0, whose errors count; None: all.
        step_m: spacing of the map; None: 0.25 m, more for large areas.
        height_m: height of the map; None: the median of the training rows.
        on_progress: progress callback: stage and fraction done.

    Raises:
        InputError: positions, receivers or a criterion that the run cannot be planned with.
    """
    opened = run if isinstance(run, Run) else open_run(run)
    known = opened.receivers
    numbers = range(len(known)) if receivers is None else [receiver_index(known, name) for name in receivers]
    map_m = candidates_of(opened, step_m, height_m, _area(opened, area_m)).positions_m
    targets_m, choices_m = _thinned(map_m, MOST_TARGETS), _candidates(candidates_m, map_m)
    _check(count, len(choices_m), criterion, threshold_dbm, walk_m)
    positions_m = np.concatenate([targets_m, choices_m])
    is_target = np.arange(len(positions_m)) < len(targets_m)
    on_progress("planning: the process of the errors", 0.0)
    priors = error_priors(opened, numbers, positions_m)
    covariances = []
    for done, prior in enumerate(priors, start=1):
        covariances.append(prior.posterior(positions_m))
        on_progress("planning: the process of the errors", done / len(priors))
    weights = np.ones((len(numbers), len(positions_m))) * is_target
    if criterion == "coverage":
        weights *= _about(opened, numbers, positions_m, THRESHOLD_DBM if threshold_dbm is None else threshold_dbm)
    start = None if start_m is None else np.asarray(start_m, float)
    worth, noise = _walking(positions_m, walk_m), [prior.new_noise for prior in priors]
    chosen, before, after = greedy(covariances, noise, weights, ~is_target, count, worth, start, on_progress)
    variances = np.stack([before, *after])[:, :, is_target]
    way_m = np.concatenate([[[np.nan] * 3 if start is None else start], positions_m[chosen]])
    walked_m = np.linalg.norm(np.diff(way_m, axis=0), axis=1)
    error, std = np.sqrt(variances.mean(axis=(1, 2))), np.sqrt(variances[[0, -1]].mean(axis=1))
    return Plan(positions_m[chosen], error, walked_m, choices_m, targets_m, std)


def _check(
    count: int, candidates: int, criterion: Criterion, threshold_dbm: float | None, walk_m: float | None
) -> None:
    if not 0 < count <= candidates:
        raise InputError(f"count {count}: give a number from 1 to {candidates}, that of the candidates")
    if walk_m is not None and not walk_m > 0:
        raise InputError(f"walk {walk_m:g} m: give a distance above 0")
    if criterion not in ("error", "coverage") or (criterion == "error" and threshold_dbm is not None):
        raise InputError(f"criterion {criterion}: choose error, or coverage with or without a threshold")


def greedy(
    covariances: Sequence[FloatArray],
    noise: Sequence[float],
    weights: FloatArray,
    allowed: NDArray[np.bool_],
    count: int,
    worth: Worth | None = None,
    start: FloatArray | None = None,
    on_progress: OnProgress = quiet,
) -> tuple[list[int], FloatArray, list[FloatArray]]:
    """Positions that lower weighted variances most, one after the other.

    Args:
        covariances: covariances [p, p] of the errors at p positions for each receiver; changed in place.
        noise: variance of a further observation of each receiver.
        weights: weights of the variances, [receivers, p].
        allowed: positions that may be chosen [p].
        count: number of choices.
        worth: factor [p] of the reductions, from the position before (None: none).
        start: position before the first choice.
        on_progress: progress callback.

    Returns:
        Indices of the choices, variances [receivers, p] before, and after each.
    """
    before = np.stack([covariance.diagonal() for covariance in covariances])
    free, chosen, after = np.array(allowed, bool), list[int](), list[FloatArray]()
    for number in range(count):
        gain = np.zeros(len(free))
        for covariance, variance, weight in zip(covariances, noise, weights, strict=True):
            used = np.flatnonzero(weight)
            gain += weight[used] @ np.square(covariance[used]) / (covariance.diagonal() + variance)
        if worth is not None:
            gain = gain * worth(chosen[-1] if chosen else None, start)
        best = int(np.argmax(np.where(free, gain, -np.inf)))
        chosen.append(best)
        free[best] = False
        for covariance, variance in zip(covariances, noise, strict=True):
            column = covariance[:, best].copy()
            covariance -= np.outer(column, column / (column[best] + variance))
        after.append(np.stack([np.maximum(covariance.diagonal(), 0) for covariance in covariances]))
        on_progress("planning: positions", (number + 1) / count)
    return chosen, before, after


def error_priors(run: Run, receivers: Sequence[int], positions_m: FloatArray) -> list[ErrorPrior]:
    """Processes of the errors of some receivers of a run.

    That which the model states; of other models the field of the observations themselves about its mean. In a scene,
    strengths have a term for each surface that matters at the positions [m, 3] or at the training rows.
    """
    record, rows = run.problem.record, load_rows(run.folder, run.problem.record).all_train
    priors = []
    for receiver in receivers:
        prior = run.fitted.error_prior(receiver)
        if prior is None:
            kriging = Kriging(seed=run.config.seed)
            prior = kriging.fit(record.tx_pos_m[rows], record.observation[receiver, rows]).error_prior()
        priors.append(prior)
    scene = run.problem.opened_scene
    if scene is None or not task_of(record).in_decibel:
        return priors
    from ..models.hybrid.strengths import TRACE
    from ..tracing.surface_shares import surface_shares

    asked = [record.receivers[receiver] for receiver in receivers]
    every = np.unique(np.concatenate([positions_m, *(prior.measured_m for prior in priors)]), axis=0)
    shares = surface_shares(scene, every, asked, TRACE, record.tx_antenna)
    matters = shares.max(axis=(0, 1)) >= LEAST_SHARE
    index = {row.tobytes(): place for place, row in enumerate(every)}

    def of_receiver(prior: ErrorPrior, table: FloatArray) -> ErrorPrior:
        def columns(at_m: FloatArray) -> FloatArray:
            return table[[index[row.tobytes()] for row in np.ascontiguousarray(at_m)]]

        covariance = with_columns(prior.covariance, columns, np.full(table.shape[1], SURFACE_DB))
        return replace(prior, covariance=covariance)

    return [of_receiver(prior, table[:, matters]) for prior, table in zip(priors, shares, strict=True)]


def _about(run: Run, receivers: Sequence[int], positions_m: FloatArray, threshold_db: float) -> FloatArray:
    """Weights [receivers, m]: variance of being above a threshold, 1/4 where it is most uncertain."""
    task, weights = task_of(run.problem.record), []
    if task.level_kind == "relative":
        raise InputError(f"{run.folder}: its {task.name} observations are not in dBm; plan for the error")
    for receiver in receivers:
        level = task.level(run.fitted.predict(Inputs(positions_m), receiver))
        if level.std is None:
            raise InputError(f"{run.folder}: the model states no standard deviation; train with --intervals")
        probability = coverage_probability(level.mean, level.std, threshold_db)
        weights.append(probability * (1 - probability))
    return np.stack(weights)


def _walking(positions_m: FloatArray, walk_m: float | None) -> Worth | None:
    if walk_m is None:
        return None

    def worth(last: int | None, start: FloatArray | None) -> FloatArray:
        place = start if last is None else positions_m[last]
        if place is None:
            return np.ones(len(positions_m))
        return np.asarray(1 / (1 + cdist(place[None], positions_m)[0] / walk_m))

    return worth


def _area(run: Run, area_m: tuple[FloatArray, FloatArray] | None) -> tuple[FloatArray, FloatArray]:
    if area_m is None:
        return area_of(run, run.problem.record.tx_pos_m)
    low, high = (np.asarray(corner, float) for corner in area_m)
    if not (low < high).all():
        raise InputError(f"area {low.tolist()} to {high.tolist()}: give lower and then upper x, y in metres")
    return low, high


def _candidates(candidates_m: FloatArray | None, map_m: FloatArray) -> FloatArray:
    if candidates_m is None:
        return _thinned(map_m, MOST_CANDIDATES)
    stated = np.atleast_2d(np.asarray(candidates_m, float))
    if stated.shape[1] != 3 or not np.isfinite(stated).all():
        raise InputError("candidates: give finite x, y, z in metres for each")
    if len(stated) > MOST_CANDIDATES:
        raise InputError(f"{len(stated)} candidates, the limit is {MOST_CANDIDATES}; give fewer")
    return np.unique(stated, axis=0)


def _thinned(positions_m: FloatArray, most: int) -> FloatArray:
    """At most so many positions, a seeded draw."""
    if len(positions_m) <= most:
        return positions_m
    # Drawn at random: the farthest points of a lattice are those of a coarser lattice in a part of it, and of this one
    # in the rest, so that errors would count more there.
    chosen = np.random.default_rng(0).choice(len(positions_m), most, replace=False)
    return positions_m[np.sort(chosen)]
