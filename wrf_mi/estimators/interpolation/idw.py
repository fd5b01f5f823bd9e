"""Inverse-distance weighting of the nearest measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from ...core import InputError, Split
from ...core.angles import FloatArray
from ..model import Problem
from .by_receiver import ByReceiverModel, ReceiverRows, Single, observed_rows


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
        distance += self.softening_m
        nearest = distance[:, :1]
        # Relative to the nearest, so that tiny distances do not overflow; where rows coincide, they alone count.
        with np.errstate(divide="ignore", invalid="ignore"):
            weight = np.where(nearest > 0, (nearest / distance) ** self.power, distance == 0)
        weight /= weight.sum(axis=1, keepdims=True)
        blended = np.empty((len(positions), *self._values.shape[1:]), np.result_type(self._values, np.float32))
        # Row by row: the neighbours of all rows together would take k times the memory of the images.
        for row, (w, i) in enumerate(zip(weight, neighbour, strict=True)):
            blended[row] = np.tensordot(w, self._values[i], axes=1)
        return blended


@dataclass(frozen=True)
class IdwSettings:
    """Settings of inverse-distance weighting.

    Attributes:
        neighbours: number of training rows that are blended; null: the task's, as in the reference of every run.
        power: exponent of the distance.
        softening_m: added to every distance, metres; null: the task's.
    """

    neighbours: int | None = None
    power: float = 2.0
    softening_m: float | None = None


class Idw(ByReceiverModel):
    """Inverse-distance weighting of each receiver's rows."""

    name, settings = "idw", IdwSettings
    source = "Shepard, 'A two-dimensional interpolation function for irregularly-spaced data' (1968)"
    summary = "inverse-distance weighting"

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of weights where a single row is taken."""
        return dict.fromkeys(("power", "softening_m"), "one neighbour has all weight") if _count(problem) == 1 else {}

    def fit_single(self, rows: ReceiverRows) -> InverseDistance:
        """Keep the rows of a receiver."""
        settings: IdwSettings = rows.problem.settings
        task, k = rows.problem.record.task, _count(rows.problem)
        softening_m = task.softening_m if settings.softening_m is None else settings.softening_m
        return InverseDistance(k, settings.power, softening_m).fit(rows.tx_pos_m, rows.observation)


def _count(problem: Problem) -> int:
    stated: int | None = problem.settings.neighbours
    return problem.record.task.neighbours if stated is None else stated


MODEL = Idw()
