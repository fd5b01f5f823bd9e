"""Inverse-distance weighting of the nearest measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.task import NEIGHBOURS
from ...core.types import IntArray
from ...training.selection import rows_at_receiver
from ..held_out import hold_out_once
from ..model import Fitted, Problem, Session, known_positions
from .by_receiver import ByReceiver, ByReceiverModel, ReceiverRows, Single, observed_rows

COUNTS = (4, 8, 16, 32, 64, 100)  # numbers of neighbours that held-out training rows choose from
MOST_APART = 0.01
"""Largest distance of held-out rows from those that predict them in the order of the record, over its range.

On a path that is another visit. Leaving out more rows makes the nearest ones farther in space than those of test rows:
on flat-ble's path with 30 % of the rows 0.20 m at 0.25, test rows 0.07 m.
"""


@dataclass(eq=False)
class InverseDistance(Single):
    """Inverse-distance weighting of the nearest training rows.

    A prediction is sum_i w_i y_i / sum_i w_i over the ``k`` nearest training positions with w_i = (d_i + s)^-power;
    where training positions coincide with the requested position and s = 0, their mean.

    Args:
        k: number of neighbours, at least 1; all rows where there are fewer.
        power: exponent of the distance.
        softening_m: s in metres. Rows much nearer than that weigh the same, so that their noise averages out.

    Source: Shepard, "A two-dimensional interpolation function for irregularly-spaced data" (1968).
    """

    k: int = 4
    power: float = 2.0
    softening_m: float = 0.0
    tx_pos_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    value: NDArray[Any] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.k < 1:
            raise InputError(f"k = {self.k}: IDW needs at least one neighbour")
        if not self.softening_m >= 0:
            raise InputError(f"softening {self.softening_m} m: choose 0 or more")
        self._tree, self._values = KDTree(self.tx_pos_m), self.value

    def fit(self, tx_pos: ArrayLike, observation: ArrayLike) -> InverseDistance:
        """Keep the rows at positions [n, 3], metres, that were observed: observations [n, ...] without NaN.

        Raises:
            InputError: no rows, none that was observed, or two different numbers of them.
        """
        positions, values, _ = observed_rows(tx_pos, observation)
        return replace(self, tx_pos_m=positions, value=values)

    def predict(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> NDArray[np.floating]:
        """Observations [m, ...] at positions [m, 3] in metres; headings are not used."""
        positions = np.asarray(tx_pos, float)
        k = min(self.k, len(self._values))
        # A list of neighbours keeps their axis where there is a single one.
        distance, neighbour = self._tree.query(positions, k=list(range(1, k + 1)))
        weight = _weights(distance + self.softening_m, self.power)
        weight /= weight.sum(axis=1, keepdims=True)
        blended = np.empty((len(positions), *self._values.shape[1:]), np.result_type(self._values, np.float32))
        # Row by row: the neighbours of all rows together would take k times the memory of the images.
        for row, (w, i) in enumerate(zip(weight, neighbour, strict=True)):
            blended[row] = np.tensordot(w, self._values[i], axes=1)
        return blended


def _weights(distance: FloatArray, power: float) -> FloatArray:
    """Weights, up to a factor, of neighbours at ascending distances [..., k]."""
    nearest = distance[..., :1]
    # Relative to the nearest, so that tiny distances do not overflow; where rows coincide, they alone count.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(nearest > 0, (nearest / distance) ** power, distance == 0)


@dataclass(frozen=True)
class IdwSettings:
    """Settings of inverse-distance weighting.

    Attributes:
        neighbours: number of training rows that are blended; null: 4, 8, 16, 32, 64 or 100, by the mean score of
            held-out training rows, as in the reference of every run.
        power: exponent of the distance.
        softening_m: added to every distance, metres; null: the task's.
    """

    neighbours: int | None = None
    power: float = 2.0
    softening_m: float | None = None


class FittedIdw(ByReceiver):
    """Inverse-distance weighting of the rows of each receiver."""

    def facts(self) -> dict[str, Any]:
        """Number of neighbours, the same for all receivers."""
        return {NEIGHBOURS: next(model.k for model in self.models if isinstance(model, InverseDistance))}


class Idw(ByReceiverModel):
    """Inverse-distance weighting of each receiver's rows."""

    name, settings, fitted = "idw", IdwSettings, FittedIdw
    source = "Shepard, 'A two-dimensional interpolation function for irregularly-spaced data' (1968)"
    summary = "inverse-distance weighting"

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of weights where a single row is taken."""
        single = problem.settings.neighbours == 1
        return dict.fromkeys(("power", "softening_m"), "one neighbour has all weight") if single else {}

    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Keep the rows of each receiver, and choose the number of neighbours where none is stated.

        Raises:
            InputError: unknown positions, or a receiver that received none of the rows.
        """
        if problem.settings.neighbours is None:
            known_positions(problem.record, split.all_train, self.name)
            chosen = replace(problem.settings, neighbours=best_count(problem, split))
            problem = replace(problem, settings=chosen)
        return super().fit(problem, split, session)

    def fit_single(self, rows: ReceiverRows) -> InverseDistance:
        """Keep the rows of a receiver."""
        settings: IdwSettings = rows.problem.settings
        assert settings.neighbours is not None
        how = settings.neighbours, settings.power, _softening_m(rows.problem)
        return InverseDistance(*how).fit(rows.tx_pos_m, rows.observation)


def _softening_m(problem: Problem) -> float:
    softening_m: float | None = problem.settings.softening_m
    return problem.record.task.softening_m if softening_m is None else softening_m


def best_count(problem: Problem, split: Split) -> int:
    """Number of neighbours of `COUNTS` with the best mean score of held-out training rows of all receivers.

    Rows are held out as far from the others as test rows are: in space (`wrf_mi.training.selection.hold_out`), and in
    the order of the record, since consecutive rows of a path resemble each other more than another visit's. Where no
    rows can be held out, it is the task's number.
    """
    record, task, rows = problem.record, problem.record.task, hold_out_once(problem, split)
    if rows is None:
        return task.neighbours
    fold_record, held_out, apart = record.seen(rows.fold), rows.held_out, _rows_apart(split)
    softening_m, total = _softening_m(problem), np.zeros(len(COUNTS))
    for receiver in np.unique(held_out.receiver):
        training_rows, values = (
            rows_at_receiver(fold_record, rows.fold.all_train, receiver),
            record.observation[receiver],
        )
        tested, blends = list[int](), list[NDArray[Any]]()
        for row in held_out.row[held_out.receiver == receiver]:
            # By place alone flat-ble's path chose 8, with 0.4 dB more error on another path than 100.
            usable = _at_nearest_carrier(record, training_rows[np.abs(training_rows - row) >= apart], row)
            if len(usable):
                distance_m = np.linalg.norm(record.tx_pos_m[usable] - record.tx_pos_m[row], axis=1) + softening_m
                nearest = np.argsort(distance_m)[: COUNTS[-1]]
                weight = _weights(distance_m[nearest], problem.settings.power)
                blends.append(_blends(values[usable[nearest]], weight))
                tested.append(row)
        if tested:
            scores = task.mixtures(np.stack(blends, axis=1), values[tested])
            every = np.repeat(np.eye(len(COUNTS)), len(tested), axis=0)  # all weight to each number in turn
            total += scores(every, np.tile(np.arange(len(tested)), len(COUNTS))).reshape(len(COUNTS), -1).sum(axis=1)
    return COUNTS[int(total.argmax())]


def _rows_apart(split: Split) -> float:
    """Median distance of test rows from the nearest training row in the order of the record, in rows."""
    if not len(split.test):
        return 0.0
    between = KDTree(split.all_train[:, None]).query(split.test[:, None])[0]
    return min(float(np.median(between)), MOST_APART * float(np.ptp(split.all_train)))


def _at_nearest_carrier(record: Record, rows: IntArray, row: int) -> IntArray:
    """Those of some rows at the carrier that is nearest to that of a row; all of them where the data have one."""
    if record.carriers_hz is None or not len(rows):
        return rows
    away = np.abs(np.log(record.carriers_hz[rows] / record.carriers_hz[row]))
    return np.asarray(rows[away == away.min()])


def _blends(values: NDArray[Any], weight: FloatArray) -> NDArray[Any]:
    """Blends [c, ...] of the nearest of some values [k, ...] by each of `COUNTS`, given their weights [k]."""
    weight = weight.astype(values.real.dtype)
    blend, blends = np.zeros(values.shape[1:], values.dtype), []
    # Each number of neighbours adds the farther ones to the sum of those before.
    for first, last in pairwise((0, *COUNTS)):
        blend = blend + np.tensordot(weight[first:last], values[first:last], axes=1)
        blends.append(blend / weight[:last].sum())
    return np.stack(blends)


MODEL = Idw()
