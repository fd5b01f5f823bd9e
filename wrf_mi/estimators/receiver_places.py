"""Places of receivers that nobody mapped, estimated from the signal strengths that they received.

The law of distance P = T - 10 gamma log10 |x - p| + e, with T the power at one metre, gamma the exponent and p the
place, is that of the training rows of each such receiver. The error e is shadowing by walls, with an exponential
covariance in the distance between rows, and noise of each row. T, gamma and the variance of e are integrated out in
closed form; the covariance's length and share are summed over. What remains is the posterior density of p, on cells
that are halved where probability is. It may have several modes, as beside a corridor, or be a ring. The estimate is the
highest mode, since models predict by the law of distance, which fits the rows there and not between modes. The standard
deviation of a coordinate is a 1.645th of the distance from the estimate within which 90 % of the probability lies, as
of a normal density: it contains a second mode.

A priori the place is normal about the rows, and its height, which rows at one height hardly tell, `MOUNTED_M` above
them, between floor and ceiling of a scene that encloses the rows.

Source: Rappaport, "Wireless Communications" (2002), section 4.9 (law and exponents); Gudmundson, "Correlation model for
shadow fading in mobile radio systems" (1991), Electronics Letters 27(23) (covariance); Rasmussen and Williams,
"Gaussian Processes for Machine Learning" (2006), section 2.7 (marginal likelihood with a mean of basis functions).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.special import ndtr, ndtri

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.files import MOST_LISTED, listed, readable, write_atomically
from ..core.types import IntArray
from ..parallel.threads import one_blas_thread
from ..tasks.scores import LEVEL, REAL_90
from ..training.session import OnProgress, quiet
from .model import Model, Problem

if TYPE_CHECKING:
    from ..tracing.search.surfaces import Surfaces

logger = logging.getLogger(__name__)

PLACES = "receiver_places.json"  # file of a run with estimated positions

EXPONENT = (3.0, 0.7)  # mean and standard deviation of the exponent a priori
MOUNTED_M = (1.0, 1.0)  # mean height above the transmitters a priori, as of receivers on walls and ceilings, and its sd
AROUND, LEAST_AROUND_M = 0.5, 5.0  # sd of the place a priori, a share of the rows' extent but no less than some rooms
LEAST_M = 0.3  # least distance in the law: a receiver is not in the hand that holds the transmitter
NOISE_DB, NOISE_ROWS = 6.0, 4.0  # standard deviation of rows about the law a priori, which weighs as so many rows do
SHADOW, LEAST_SHADOW_M = (0.05, 0.15), 1.0  # correlation lengths of shadowing as shares of the rows' extent
CORRELATED = (0.3, 0.6, 0.85)  # shares of the variance that shadowing has
MOST_PLACES, GROWTH = 100, 1.2  # places in the fit at most, for which rows are averaged in cubes that grow by a factor
CELLS = (24, 24, 2)  # cells along x, y and z, of equal prior probability, with which the search begins
HALVED, MOST_HALVINGS = 48, 24  # cells that are halved together, those of most probability, and how often at most
FINE, REST = 0.5, 0.05  # cells in standard deviations of the place, and the probability in coarser ones that is left
ZOOMS = 8  # halvings of a cell around the mode
MARGIN_M = 0.1  # least distance from floor and ceiling of a scene
AWAY_M = np.arange(0.05, 2.0, 0.05)  # distances at which a place outside of solids is searched for


def place_of_receiver(
    tx_pos_m: FloatArray,
    power_dbm: FloatArray,
    extent_m: float,
    stated_m: FloatArray,
    height_m: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[FloatArray, FloatArray]:
    """Position [3] of a receiver and its standard deviations [3], metres.

    Args:
        tx_pos_m: positions of the rows that it received [n, 3], metres, n at least 1.
        power_dbm: their signal strengths [n].
        extent_m: size of the area of all rows, metres, by which the place is uncertain a priori.
        stated_m: coordinates [3] that are known, such as a height; NaN for the others.
        height_m: heights that it is between, metres.
    """
    places, power, count = _averaged(tx_pos_m, power_dbm)
    likelihood = _Likelihood(places, power, count, extent_m)
    around_m, is_stated = max(AROUND * extent_m, LEAST_AROUND_M), np.isfinite(stated_m)
    middle = np.where(is_stated, stated_m, places.mean(axis=0) + np.array([0, 0, MOUNTED_M[0]]))
    deviation = np.array([around_m, around_m, np.hypot(MOUNTED_M[1], places[:, 2].std())]) * ~is_stated
    bounds = np.array([[0.0, 1.0]] * 3)
    if not is_stated[2]:
        bounds[2] = ndtr((np.array(height_m) - middle[2]) / deviation[2])

    def positions(quantile: FloatArray) -> FloatArray:
        return np.asarray(middle + deviation * ndtri(quantile))

    low, width, density = _cells(lambda quantile: likelihood(positions(quantile)), positions, bounds, is_stated)
    at_m, mass = positions(low + width / 2), density + np.log(width).sum(axis=1)
    share = np.exp(mass - np.logaddexp.reduce(mass))

    def posterior(at_m: FloatArray, likelihood: FloatArray) -> FloatArray:
        # Over metres, while cells are of quantiles: with the density of the prior.
        return np.asarray(likelihood - np.square((at_m - middle) / np.where(is_stated, 1.0, deviation)).sum(axis=1) / 2)

    best = int(np.argmax(posterior(at_m, density)))
    mode_m, step_m = at_m[best], _sides(positions, low[best], width[best]) / 2
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(ZOOMS):
        tried_m = mode_m + offsets * step_m
        if not is_stated[2]:
            tried_m[:, 2] = np.clip(tried_m[:, 2], *height_m)
        mode_m, step_m = tried_m[np.argmax(posterior(tried_m, likelihood(tried_m)))], step_m / 2

    away_m = np.abs(at_m - mode_m)
    order = np.argsort(away_m, axis=0)
    last = np.argmax(np.cumsum(share[order], axis=0) > LEVEL, axis=0)
    return mode_m, away_m[order[last, np.arange(3)], np.arange(3)] / REAL_90


Positions = Callable[[FloatArray], FloatArray]
"""Positions [n, 3], metres, at quantiles of the prior [n, 3]: space as a cube, equally probable everywhere."""


def _cells(
    likelihood: Positions, positions: Positions, bounds: FloatArray, is_stated: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cells of the cube ``bounds`` [3, 2], fine where the posterior is: least corners, widths [n, 3] and densities [n].

    ``likelihood`` is the logarithm at quantiles [n, 3]; coordinates that are ``is_stated`` [3] are not divided.
    """
    number = np.where(is_stated, 1, CELLS)
    width = np.tile(np.ptp(bounds, axis=1) / number, (int(np.prod(number)), 1))
    low = bounds[:, 0] + width * np.stack(np.unravel_index(np.arange(len(width)), number), axis=1)
    density = likelihood(low + width / 2)
    for _ in range(MOST_HALVINGS):
        at_m, mass = positions(low + width / 2), density + np.log(width).sum(axis=1)
        share = np.exp(mass - np.logaddexp.reduce(mass))
        std_m = np.sqrt(share @ np.square(at_m - share @ at_m))
        most = np.argsort(-mass, kind="stable")[:HALVED]
        relative = _sides(positions, low[most], width[most]) / np.maximum(std_m, np.finfo(float).tiny)
        if share[most][relative.max(axis=1) > FINE].sum() < REST:
            break
        half = width[most] / (1 + (np.arange(3) == relative.argmax(axis=1)[:, None]))
        halves, others = (
            np.concatenate([low[most], low[most] + width[most] - half]),
            np.delete(np.arange(len(low)), most),
        )
        half = np.tile(half, (2, 1))
        density = np.concatenate([density[others], likelihood(halves + half / 2)])
        low, width = np.concatenate([low[others], halves]), np.concatenate([width[others], half])
    return low, width, density


def _sides(positions: Positions, low: FloatArray, width: FloatArray) -> FloatArray:
    """Lengths of cells, metres: twice those between their quarters, as cells at the border of the cube have no end."""
    return 2 * (positions(low + 0.75 * width) - positions(low + 0.25 * width))


def _averaged(tx_pos_m: FloatArray, power_dbm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions [k, 3], metres, mean powers [k], and the number of distinct places in each mean [k].

    Rows at one place share its shadow: together they are one. Places are averaged in cubes, the smallest with which at
    most `MOST_PLACES` remain.
    """

    def means(group: IntArray, *values: FloatArray) -> list[FloatArray]:
        count = np.bincount(group)
        return [np.stack([np.bincount(group, part) / count for part in value.T], axis=-1) for value in values]

    places, group = np.unique(tx_pos_m, axis=0, return_inverse=True)
    (power,) = means(group.ravel(), power_dbm[:, None])
    count, side_m, first = np.ones(len(places)), 0.0, places
    extent_m = float(np.ptp(places, axis=0).max())
    while len(first) > MOST_PLACES:
        side_m = side_m * GROWTH if side_m else extent_m / MOST_PLACES
        first, group = np.unique(np.floor((places - places.min(axis=0)) / side_m), axis=0, return_inverse=True)
    if side_m:
        count = np.bincount(group.ravel()).astype(float)
        places, power = means(group.ravel(), places, power)
    return places, power[:, 0], count


class _Likelihood:
    """Logarithm of the marginal likelihood of powers at places, as a function of the receiver's position."""

    def __init__(self, places_m: FloatArray, power: FloatArray, count: FloatArray, extent_m: float) -> None:
        self._places_m, apart_m, ones = places_m, cdist(places_m, places_m), np.ones(len(places_m))
        lengths_m = {max(share * extent_m, LEAST_SHADOW_M) for share in SHADOW}
        weights, constants = [], []
        for length_m, shadow in product(sorted(lengths_m), CORRELATED):
            covariance = shadow * np.exp(-apart_m / length_m) + (1 - shadow) * np.diag(1 / count)
            inverse = np.linalg.inv(covariance)
            total, of_ones = float(ones @ inverse @ ones), inverse @ ones
            # Without knowledge of the power at one metre, a common level of the rows says nothing.
            weights.append(inverse - np.outer(of_ones, of_ones) / total)
            constants.append(-(np.linalg.slogdet(covariance)[1] + np.log(total)) / 2)
        self._weights, self._constants = np.stack(weights), np.array(constants)[:, None]
        self._of_power = self._weights @ power  # [covariances, n]
        self._power = (self._of_power @ power)[:, None]
        self._exponent = -(NOISE_ROWS + len(power) - 1) / 2

    def __call__(self, at_m: FloatArray) -> FloatArray:
        """At positions [m, 3], metres: [m]."""
        law = -5 * np.log10(cdist(at_m, self._places_m, "sqeuclidean") + LEAST_M**2)  # of exponent 1
        square = np.einsum("cmn,mn->cm", law @ self._weights, law)
        product = self._of_power @ law.T
        mean, trust = EXPONENT[0], (NOISE_DB / EXPONENT[1]) ** 2
        # y - mean law = (exponent - mean) law + e: the exponent is integrated out, then the variance (Student's t).
        explained = (product - mean * square) ** 2 / (square + trust)
        residual = self._power - 2 * mean * product + mean**2 * square - explained
        fits = self._exponent * np.log1p(np.maximum(residual, 0) / (NOISE_ROWS * NOISE_DB**2))
        return np.asarray(np.logaddexp.reduce(fits - np.log1p(square / trust) / 2 + self._constants, axis=0))


def _lacking(record: Record) -> list[int]:
    """Numbers of the receivers of signal strengths whose places are to be estimated."""
    return [k for k, each in enumerate(record.receivers) if not each.is_surveyed] if record.task.shares_law else []


def placed(
    record: Record, rows: IntArray, height_m: tuple[float, float] = (-np.inf, np.inf), on_progress: OnProgress = quiet
) -> Record:
    """The record with estimated positions of receivers that have none, by some rows; NaN remains without any row."""
    lacking = _lacking(record)
    receivers, tx_pos_m = list(record.receivers), record.tx_pos_m[rows]
    extent_m = float(np.linalg.norm(np.ptp(tx_pos_m[:, :2], axis=0))) if len(rows) else 0.0
    for done, number in enumerate(lacking, start=1):
        observed = np.asarray(record.observation[number, rows], float)
        received = np.isfinite(observed)
        if received.any():
            receiver = receivers[number]
            stated_m = np.asarray(receiver.position_m, float)
            if receiver.position_std_m is not None:  # estimated from more rows, from which nothing may remain
                stated_m = np.where(receiver.position_std_m > 0, np.nan, stated_m)
            of_rows = tx_pos_m[received], observed[received]
            with one_blas_thread():  # of matrices of a hundred rows threads would mostly wait for each other
                place_m, std_m = place_of_receiver(*of_rows, extent_m, stated_m, height_m)
            receivers[number] = replace(receiver, position_m=place_m, position_std_m=std_m)
        on_progress("places of receivers", done / len(lacking))
    return replace(record, receivers=tuple(receivers)) if lacking else record


def placed_problem(problem: Problem, split: Split, model: Model, on_progress: OnProgress = quiet) -> Problem:
    """The problem of `placed` receivers by a split's training rows, in a scene outside of its solids.

    The problem itself where all are surveyed, and for a model that does not use their places.
    """
    if not _lacking(problem.record) or not model.uses_places(problem, [split]):
        return problem
    if problem.scene is None:
        return _with_record(problem, placed(problem.record, split.all_train, on_progress=on_progress))
    from ..scene.mesh.surfaces import bounds  # imported where there is a scene
    from ..tracing.paths.solve import Prepared

    # A record without positions is not opened in a scene: until they are estimated, receivers are amid the rows.
    middle_m = np.nanmean(problem.record.tx_pos_m, axis=0)
    amid = tuple(
        receiver if receiver.is_surveyed else replace(receiver, position_m=middle_m)
        for receiver in problem.record.receivers
    )
    opened = _with_record(problem, replace(problem.record, receivers=amid))
    surfaces, height_m = Prepared(opened.opened_scene).surfaces, (-np.inf, np.inf)
    low, high = bounds(surfaces.triangles)[:, 2] + np.array([MARGIN_M, -MARGIN_M])
    tx_m = problem.record.tx_pos_m[:, 2]
    # A ceiling above all rows is above their receivers, too; the height of the ground bounds nothing.
    if low <= np.nanmin(tx_m) and np.nanmax(tx_m) < high:
        height_m = float(low), float(high)
    located = placed(problem.record, split.all_train, height_m, on_progress)
    return _with_record(opened, _outside_solids(located, surfaces))


def _outside_solids(record: Record, surfaces: Surfaces) -> Record:
    """The record with estimated positions that are not inside solids, in the plan the nearest ones."""
    from ..tracing.search.devices import solid_around  # imported where there is a scene

    receivers = list(record.receivers)
    angle = np.arange(0, 2 * np.pi, np.pi / 8)
    around = AWAY_M[:, None, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    around = np.concatenate([np.zeros((1, 3)), around.reshape(-1, 3)])
    for number, receiver in enumerate(receivers):
        if (std_m := receiver.position_std_m) is not None:
            tried_m = receiver.position_m + around * (std_m > 0)
            place_m = tried_m[np.argmax(solid_around(surfaces, tried_m) < 0)]  # the first: the nearest
            std_m = np.hypot(std_m, place_m - receiver.position_m)
            receivers[number] = replace(receiver, position_m=place_m, position_std_m=std_m)
    return replace(record, receivers=tuple(receivers))


def _with_record(problem: Problem, record: Record) -> Problem:
    if record is problem.record:
        return problem
    changed = replace(problem, dataset=record, antennas=AS_STATED, left_out=())
    if "opened_scene" in vars(problem):  # which would be opened anew
        vars(changed)["opened_scene"] = problem.opened_scene
    return changed


def write_places(folder: Path, record: Record) -> None:
    """Write estimated positions and their standard deviations, by the receiver's name, into a run's folder."""
    places = {
        receiver.name: {"position_m": receiver.position_m.tolist(), "std_m": receiver.position_std_m.tolist()}
        for receiver in record.receivers
        if receiver.position_std_m is not None
    }
    if places:
        write_atomically(folder / PLACES, json.dumps(places, indent=1) + "\n")


def stored_places(folder: Path) -> dict[str, dict[str, list[float]]]:
    """Estimated positions and standard deviations that `write_places` stored; empty where all are stated."""
    path = folder / PLACES
    with readable(path, f"{path}: missing", "train the run anew"):
        places: dict[str, dict[str, list[float]]] = json.loads(path.read_text()) if path.exists() else {}
    return places


def stored_problem(problem: Problem, folder: Path) -> Problem:
    """The problem with the positions that a run in a folder has estimated."""
    if not (places := stored_places(folder)):
        return problem  # whose data need not be on this machine
    receivers = list(problem.record.receivers)
    for number, receiver in enumerate(receivers):
        if place := places.get(receiver.name):
            position_m, std_m = np.array(place["position_m"]), np.array(place["std_m"])
            receivers[number] = replace(receiver, position_m=position_m, position_std_m=std_m)
    return _with_record(problem, replace(problem.record, receivers=tuple(receivers)))


def check_placeable(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse receivers in a scene at unknown places that no training row of a split tells.

    Raises:
        InputError: naming them.
    """
    record = problem.record
    for split in splits if problem.scene is not None and record.task.shares_law else ():
        received = np.isfinite(record.seen(split).observation[:, split.all_train])
        lacking = [k for k, receiver in enumerate(record.receivers) if not (receiver.is_surveyed or received[k].any())]
        if lacking:
            names = listed(record.receivers[number].name for number in lacking)
            text = f"position of receiver {names} unknown, without a training row in split {split.name}"
            raise InputError(f"{record.source or record.name}: {text}; give x, y, z, or omit --scene")


def tell_places(problem: Problem) -> None:
    """Log the estimated positions of receivers in a scene, of many those of the least certain ones."""
    receivers = problem.record.receivers if problem.scene is not None else ()
    estimated = [(each, each.position_std_m) for each in receivers if each.position_std_m is not None]
    estimated.sort(key=lambda pair: float(np.linalg.norm(pair[1])), reverse=True)
    for receiver, deviation_m in estimated[:MOST_LISTED]:
        x, y, z = receiver.position_m
        deviations = ", ".join(f"{std:.1f}" for std in deviation_m)
        text = "receiver %s: position estimated at x %.1f, y %.1f, z %.1f m, deviations %s m, used in the scene"
        logger.warning(text, receiver.name, x, y, z, deviations)
    if len(estimated) > MOST_LISTED:
        logger.warning("positions of %d further receivers are estimated more closely", len(estimated) - MOST_LISTED)
