"""Positions whose measurement lowers the expected error of a run's map most.

Errors of the predictions are a Gaussian process (`wrf_mi.estimators.error_prior`). With C the covariance of errors at
all positions after the training rows, a measurement at c with noise of variance s lowers the variance at t by

    C(t, c)^2 / (C(c, c) + s),

whatever it will read. So measurements can be planned one after the other before any is made: each is the candidate with
the greatest reduction, summed over the map and over receivers, after which C loses that rank.

Where a scene was corrected by measurements, strengths depend on the loss at each surface, which the correction knows
within the standard deviations of its materials. These losses are terms of the process whose columns are the derivatives
of the traced power (`wrf_mi.tracing.surface_shares`): a measurement behind a wall tells what all paths through it lose.
Scenes as stated have no such terms: a fit that keeps the stated materials would not learn the losses.
The criterion ``"material"`` lowers the least certain of them (`wrf_mi.apps.maps.plan_losses`).

Source: Seo, Wallat, Graepel and Obermayer, "Gaussian process regression: active data selection and test point
rejection" (2000) (the reduction over the map, after Cohn); Krause, Singh and Guestrin, "Near-optimal sensor placements
in Gaussian processes" (2008), JMLR 9 (greedy choice); Picheny, Ginsbourger, Roustant, Haftka and Kim, "Adaptive designs
of experiments for accurate approximation of a target region" (2010) (weights about a threshold).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import write_csv
from ...core.receivers import receiver_index
from ...estimators.error_prior import ErrorPrior, with_columns
from ...estimators.interpolation.kriging import Kriging
from ...models import Inputs, Problem
from ...runs.folder import load_rows
from ...runs.run import Run, open_run
from ...scene.correction_data import read_correction_data
from ...tasks import task_of
from ...training.session import OnProgress, quiet
from .coverage import coverage_probability
from .grid import area_of, candidates_of, reachable, with_standing_room
from .plan_losses import Losses, Told, Worth, greedy_losses, losses_of, take_best

logger = logging.getLogger(__name__)

Criterion = Literal["error", "coverage", "material"]
Lowered = tuple[list[int], FloatArray, FloatArray, Mapping[str, tuple[float, float]]]
"""Choices, the criterion before and after each, variances before and after all, and losses by surface (`Plan`)."""
MOST_TARGETS, MOST_CANDIDATES = 600, 1500
"""Positions at which errors count, and candidates: covariances between all of them are kept for each receiver."""
LEAST_SHARE = 0.02  # largest share of a surface over all positions, below which it is left out
THRESHOLD_DBM = -90.0


@dataclass(frozen=True)
class Plan:
    """Planned measurements in their order.

    Attributes:
        tx_pos_m: positions [k, 3], metres.
        expected_error: root of the mean variance over the map before any and after each of them [k + 1], in the unit of
            an observation (dB for strengths), mean over receivers; of the criterion ``"material"`` the standard
            deviation of the least certain loss at a surface, dB.
        walked_m: distance of each position from the one before [k], from the start for the first; NaN without one.
        candidates_m, targets_m: positions that could be chosen, and positions of the map [m, 3].
        std: standard deviations of the errors at ``targets_m`` before and after, [2, m], mean over receivers.
        surfaces: surfaces of the criterion ``"material"`` with the standard deviation of the loss before and after, dB.
    """

    tx_pos_m: FloatArray
    expected_error: FloatArray
    walked_m: FloatArray
    candidates_m: FloatArray
    targets_m: FloatArray
    std: FloatArray
    surfaces: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def write(self, file: str | Path) -> Path:
        """Write positions to centimetres with their order, expected error after each, and distance walked, as CSV."""
        # Four significant digits: errors of spectra are hundredths.
        error = [float(f"{value:.4g}") for value in self.expected_error[1:]]
        columns = np.arange(1, len(self.tx_pos_m) + 1), *self.tx_pos_m.round(2).T, error, self.walked_m.round(3)
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
        candidates_m: positions that can be measured [n, 3], metres; None: the map's, half a metre from walls, that are
            reached from training rows without passing a wall.
        area_m: lower and upper corner [2] of the area whose errors count, metres; None: the scene, or all rows of the
            data.
        criterion: ``"error"``: the expected error over the map; ``"coverage"``: that about a threshold of received
            power, of models that state standard deviations; ``"material"``: the loss at the least certain surface of
            the run's scene, of strengths.
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
    free_m = _walkable(opened, map_m) if candidates_m is None else map_m
    targets_m, choices_m = _thinned(map_m, MOST_TARGETS), _candidates(candidates_m, free_m)
    _check(count, len(choices_m), criterion, threshold_dbm, walk_m)
    positions_m = np.concatenate([targets_m, choices_m])
    is_target = np.arange(len(positions_m)) < len(targets_m)
    on_progress("planning: the process of the errors", 0.0)
    start = None if start_m is None else np.asarray(start_m, float)
    search: dict[str, Any] = {"worth": _walking(positions_m, walk_m), "start": start, "on_progress": on_progress}
    if criterion == "material":
        lowered = _lower_losses(opened, numbers, positions_m, ~is_target, count, search)
    else:
        threshold = (THRESHOLD_DBM if threshold_dbm is None else threshold_dbm) if criterion == "coverage" else None
        lowered = _lower_errors(opened, numbers, positions_m, is_target, count, threshold, search)
    chosen, error, variances, surfaces = lowered
    way_m = np.concatenate([[[np.nan] * 3 if start is None else start], positions_m[chosen]])
    walked_m, std = np.linalg.norm(np.diff(way_m, axis=0), axis=1), np.sqrt(variances[:, :, is_target].mean(axis=1))
    return Plan(positions_m[chosen], error, walked_m, choices_m, targets_m, std, surfaces)


def _lower_errors(
    run: Run,
    receivers: Sequence[int],
    positions_m: FloatArray,
    is_target: NDArray[np.bool_],
    count: int,
    threshold_dbm: float | None,
    search: Mapping[str, Any],
) -> Lowered:
    """Choices by the error at targets, or about a threshold."""
    priors = error_priors(run, receivers, positions_m)
    weights = np.ones((len(receivers), len(positions_m))) * is_target
    if threshold_dbm is not None:
        weights *= _about(run, receivers, positions_m, threshold_dbm)
    covariances, noise = [prior.posterior(positions_m) for prior in priors], [prior.new_noise for prior in priors]
    chosen, before, after = greedy(covariances, noise, weights, ~is_target, count, **search)
    error = np.sqrt(np.stack([before, *after])[:, :, is_target].mean(axis=(1, 2)))
    return chosen, error, np.stack([before, after[-1]]), {}


def _lower_losses(
    run: Run,
    receivers: Sequence[int],
    positions_m: FloatArray,
    allowed: NDArray[np.bool_],
    count: int,
    search: Mapping[str, Any],
) -> Lowered:
    """Choices by the least certain loss."""
    losses, told = _told(run, receivers, positions_m)
    # A loss on which no strength at any candidate depends cannot be measured, however uncertain it is.
    measurable = np.max([np.abs(each.slope[allowed]).max(axis=0) for each in told], axis=0) >= LEAST_SHARE
    if not measurable.any():
        raise InputError("criterion material: no path to a candidate meets a surface; give other candidates")
    chosen, std_db, variances = greedy_losses(told, losses.std_db, measurable, allowed, count, **search)
    std_db = std_db[:, measurable]
    of_surface = zip(compress(losses.names, measurable), std_db[0], std_db[-1], strict=True)
    surfaces = {name: (float(before), float(after)) for name, before, after in of_surface}
    return chosen, std_db.max(axis=1), variances, surfaces


def _check(
    count: int, candidates: int, criterion: Criterion, threshold_dbm: float | None, walk_m: float | None
) -> None:
    if not 0 < count <= candidates:
        raise InputError(f"count {count}: give a number from 1 to {candidates}, that of the candidates")
    if walk_m is not None and not walk_m > 0:
        raise InputError(f"walk {walk_m:g} m: give a distance above 0")
    if criterion not in get_args(Criterion) or (criterion != "coverage" and threshold_dbm is not None):
        raise InputError(f"criterion {criterion}: choose error, material, or coverage with or without a threshold")


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
        best = take_best(gain, free, chosen, worth, start)
        for covariance, variance in zip(covariances, noise, strict=True):
            column = covariance[:, best].copy()
            covariance -= np.outer(column, column / (column[best] + variance))
        after.append(np.stack([np.maximum(covariance.diagonal(), 0) for covariance in covariances]))
        on_progress("planning: positions", (number + 1) / count)
    return chosen, before, after


def model_priors(run: Run, receivers: Sequence[int]) -> list[ErrorPrior]:
    """Processes of the errors of some receivers.

    That which the model of a run states; of other models the field of the observations themselves about its mean.
    """
    record, rows = run.problem.record, load_rows(run.folder, run.problem.record).all_train
    priors = []
    for receiver in receivers:
        prior = run.fitted.error_prior(receiver)
        if prior is None:
            kriging = Kriging(seed=run.config.seed)
            prior = kriging.fit(record.tx_pos_m[rows], record.observation[receiver, rows]).error_prior()
        priors.append(prior)
    return priors


def error_priors(run: Run, receivers: Sequence[int], positions_m: FloatArray) -> list[ErrorPrior]:
    """Processes of the errors of some receivers, with the losses of a corrected scene.

    They have a term for each surface that matters at the positions [m, 3] or at the training rows.
    """
    priors, problem = model_priors(run, receivers), _scene_problem(run)
    if read_correction_data(problem.scene) is None or not task_of(problem.record).in_decibel:
        return priors
    every, losses, shares = _shares(problem, receivers, priors, positions_m)
    return with_surface_losses(priors, every, losses, shares)


def _scene_problem(run: Run) -> Problem:
    """The problem with the scene of the fit: the one that it corrected, where there is one."""
    from ...stages.fitted import PATHS
    from ...stages.scene import in_scene

    return in_scene(run.problem, run.folder / "parts" / PATHS)


def _shares(
    problem: Problem, receivers: Sequence[int], priors: Sequence[ErrorPrior], positions_m: FloatArray
) -> tuple[FloatArray, Losses, FloatArray]:
    """Positions, also those of training rows, and derivatives at them by the losses at surfaces that matter."""
    from ...stages.strengths import TRACE
    from ...tasks.conditions import scene_carrier
    from ...tracing.surface_shares import surface_shares

    record = problem.record
    asked = [record.receivers[receiver] for receiver in receivers]
    every = np.unique(np.concatenate([positions_m, *(prior.measured_m for prior in priors)]), axis=0)
    names, shares = surface_shares(problem.opened_scene, every, asked, TRACE, record.tx_antenna)
    matters = shares.max(axis=(0, 1)) >= LEAST_SHARE
    losses = losses_of(problem.scene, list(compress(names, matters)), scene_carrier(record))
    return every, losses, shares[:, :, matters]


def _told(run: Run, receivers: Sequence[int], positions_m: FloatArray) -> tuple[Losses, list[Told]]:
    """Losses at surfaces, and errors of receivers by them after the training rows."""
    priors, problem = model_priors(run, receivers), _scene_problem(run)
    if problem.opened_scene is None or not task_of(problem.record).in_decibel:
        raise InputError(f"{run.folder}: criterion material needs signal strengths in a scene; train with --scene")
    every, losses, shares = _shares(problem, receivers, priors, positions_m)
    index = {row.tobytes(): place for place, row in enumerate(every)}

    def at(positions_m: FloatArray, table: FloatArray) -> FloatArray:
        return np.asarray(table[[index[row.tobytes()] for row in np.ascontiguousarray(positions_m)]])

    told = []
    for prior, table in zip(priors, shares, strict=True):
        each = Told.of(prior, positions_m, at(prior.measured_m, table), at(positions_m, table))
        # What the rows of a correction tell is in its standard deviations already.
        told.append(replace(each, information=each.information * (not losses.knows_rows)))
    return losses, told


def with_surface_losses(
    priors: Sequence[ErrorPrior], positions_m: FloatArray, losses: Losses, shares: FloatArray
) -> list[ErrorPrior]:
    """Processes with a term for each loss, by derivatives [receivers, m, s] at all positions [m, 3] that are needed."""
    index = {row.tobytes(): place for place, row in enumerate(positions_m)}

    def of_receiver(prior: ErrorPrior, table: FloatArray) -> ErrorPrior:
        def columns(at_m: FloatArray) -> FloatArray:
            return table[[index[row.tobytes()] for row in np.ascontiguousarray(at_m)]]

        return replace(prior, covariance=with_columns(prior.covariance, columns, losses.std_db))

    return [of_receiver(prior, table) for prior, table in zip(priors, shares, strict=True)]


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


def _walkable(run: Run, map_m: FloatArray) -> FloatArray:
    """Positions of the map with room to stand, reached from the training rows; how many are not is logged."""
    scene, record = run.problem.opened_scene, run.problem.record
    room_m = with_standing_room(scene, map_m)
    reached = reachable(scene, room_m, record.tx_pos_m[load_rows(run.folder, record).all_train])
    if not reached.any():
        remedy = "check the frame of the scene, or give candidates"
        raise InputError(f"{run.folder}: walls are between all training rows and every position of the map; {remedy}")
    if unreached := np.count_nonzero(~reached):
        text = "%d of %d positions are behind walls as seen from all training rows, and are not proposed; "
        logger.warning(text + "give candidates if one can walk there", unreached, len(room_m))
    return room_m[reached]


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
