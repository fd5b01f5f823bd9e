"""Scores of a training's held-out rows, and what they choose beside its state: reach and phase error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core import Split
from ..core.types import FloatArray, IntArray
from .by_distance import Reach, choose_reach
from .evaluator import Request
from .fit_plan import FIELD, FitPlan
from .gains import improves
from .loop import FitState
from .predictor import Predictor

PHASE_ERRORS = (0.5, 1.0, 1.5)  # phase errors that are tried, rad: beyond, phases are uniform


@dataclass(frozen=True)
class HeldOutObservations:
    """Predicted observations of training rows that a fit had not seen when it chose its state."""

    receiver: IntArray  # number of the receiver of each [q]
    row: IntArray  # row of the record [q]
    predicted: NDArray[Any]  # predicted observations [q, ...]


class Validation:
    """Scores and predictions of held-out rows.

    Attributes:
        scores: scores of the held-out rows at the last validation, port by port.
    """

    def __init__(self, plan: FitPlan) -> None:
        self.plan, self.scores = plan, np.zeros(0)

    def reach(self, chosen: bool, length_m: float) -> Reach | None:
        """Reach around the rows that train before or after a state is ``chosen``; None: Gaussians count everywhere."""
        plan = self.plan
        if not plan.graph.corrects:
            return None
        # Once a state is chosen, the held-out rows train, too, unless they stay out to the end.
        joined = chosen and plan.schedule.joined < plan.loop.steps
        rows = plan.split.all_train if joined else plan.selection.train
        return Reach(self._positions(plan.targets.received(rows)), length_m)

    def score(self, predict: Predictor, state: FitState) -> float:
        """Median of `scores` by a state, all receivers pooled; NaN without held-out rows.

        Where Gaussians correct paths, it chooses the reach of the state.
        """
        plan, rows, reach = self.plan, self._held_out(bool(state.chosen)), self.reach(bool(state.chosen), state.reach_m)
        if not any(map(len, rows)):
            self.scores = np.zeros(0)
        elif reach is not None:
            lengths = [state.reach_m]
            if plan.chooses and not state.chosen:
                lengths = reach.lengths(self._positions(rows)) if plan.trains == FIELD and state.step else [0.0]
            # The state keeps the reach with which it is scored, so that the best state has the best reach.
            state.reach_m, self.scores = choose_reach(
                reach, lengths, partial(self._scores, predict, rows), plan.task.higher_is_better
            )
        elif plan.graph.scene is not None:
            self.scores = self._scores(predict, rows)
        else:
            record, validation = plan.record, self._split(state.chosen).validation
            predicted = [predict.of_rows(record, validation, r) for r in range(len(record.receivers))]
            scored = zip(predicted, record.observation[:, validation], strict=True)
            self.scores = np.concatenate([np.ravel(plan.task.training_score(*pair)) for pair in scored])
        return float(np.nanmedian(self.scores)) if len(self.scores) else float("nan")

    def choosing_score(self, score: float) -> float:
        """The score by which a state is chosen, given that of the last validation."""
        if not self.plan.chooses or not len(self.scores):
            return score
        return float(np.nanmean(self.scores))  # rows far from training rows count, and a mean has less variance

    def _split(self, chosen: bool | int) -> Split:
        """Split whose validation rows are scored before or after a state is ``chosen``."""
        return self.plan.split if chosen else self.plan.selection

    def _held_out(self, chosen: bool) -> list[IntArray]:
        """Conditions of each port that are held out before or after a state is ``chosen``."""
        return self.plan.targets.received(self._split(chosen).validation)

    def _positions(self, rows: Sequence[IntArray]) -> tuple[FloatArray, ...]:
        """Positions [n, 3] in metres of the rows of each receiver, from those of each port."""
        plan = self.plan
        receivers = range(len(plan.record.receivers))
        return tuple(plan.record.tx_pos_m[np.concatenate([rows[port] for port in plan.ports(r)])] for r in receivers)

    def facts(self, chosen: bool) -> dict[str, Any]:
        """Fields of `Progress` on the rows of `scores`, before or after a state is ``chosen``."""
        plan, split = self.plan, self._split(chosen)
        record, test = plan.record, plan.split.test
        facts: dict[str, Any] = {"validation_rows": len(split.validation)}
        if not record.has_positions or not len(self.scores):
            return facts
        trained = cKDTree(record.tx_pos_m[split.train])
        by_port = plan.graph.corrects or plan.graph.scene is not None  # the order of `score`
        scored = self._held_out(chosen) if by_port else [split.validation] * len(record.receivers)
        away_m = trained.query(record.tx_pos_m[np.concatenate(scored)])[0]
        facts["validation_m"] = float(np.median(away_m))
        if not len(test):
            return facts
        # Validation rows are compared with test rows as they are predicted: by a field that all of these rows trained.
        training_rows = split.all_train if plan.schedule.joined < plan.loop.steps else split.train
        facts["test_m"] = float(np.median(cKDTree(record.tx_pos_m[training_rows]).query(record.tx_pos_m[test])[0]))
        far = (away_m >= facts["test_m"]) & np.isfinite(self.scores)
        if not far.any():
            return facts
        rows = len(np.unique(np.concatenate(scored)[far]))
        return facts | {"far_score": float(np.median(self.scores[far])), "far_rows": rows}

    def _predicted(self, predict: Predictor, rows: Sequence[IntArray], reach: Reach | None = None) -> NDArray[Any]:
        """Predictions of known rows of each port, port by port, whose paths need no search."""
        plan, predicted = self.plan, list[NDArray[Any]]()
        for port, port_rows in enumerate(rows):
            tx_pos_m = plan.record.tx_pos_m[port_rows]
            weight = None if reach is None else reach.weight(tx_pos_m, port // plan.graph.carriers)
            # Traced fields hold all training rows, held-out ones too: scores need no further search for paths.
            request = Request(tx_pos_m, port, plan.traced_fields[port], plan.slots(port, port_rows), weight)
            predicted.append(predict.of_request(request))
        return np.concatenate(predicted)

    def _observed(self, rows: Sequence[IntArray]) -> NDArray[Any]:
        observed, carriers = self.plan.record.observation, self.plan.graph.carriers
        return np.concatenate([observed[port // carriers, port_rows] for port, port_rows in enumerate(rows)])

    def _scores(self, predict: Predictor, rows: Sequence[IntArray], reach: Reach | None = None) -> FloatArray:
        return np.ravel(self.plan.task.training_score(self._predicted(predict, rows, reach), self._observed(rows)))

    def choose_phase_error(self, predict: Predictor, state: FitState) -> NDArray[Any]:
        """Predictions of all rows that chose a state, port by port, by the phase error that predicts them best.

        Planes that are centimetres off leave phases uncertain, and the expectation of a spectrum is then nearer to what
        is measured than the spectrum of any phases (`Graph.observation`). Other observations have no such expectation.
        """
        plan, rows, reach = self.plan, self._held_out(False), self.reach(False, state.reach_m)
        best = self._predicted(predict, rows, reach)
        if plan.graph.scene is None or not plan.task.averages_phases:
            return best
        observed = self._observed(rows)
        best_scores = np.ravel(plan.task.training_score(best, observed))
        for phase_error in PHASE_ERRORS:
            predict.phase_error = phase_error
            predicted = self._predicted(predict, rows, reach)
            scores = np.ravel(plan.task.training_score(predicted, observed))
            # Scores are taken to rise to one maximum, as each try costs a prediction of all held-out rows.
            if not improves(scores, best_scores, plan.task.higher_is_better):
                break
            state.phase_error, best, best_scores = phase_error, predicted, scores
        predict.phase_error = state.phase_error
        return best

    def held_out_observations(self, state: FitState) -> HeldOutObservations | None:
        """Predictions of held-out rows by the state that was chosen on them; None: none was chosen in groups."""
        plan = self.plan
        if not plan.chooses_beside_paths or not len(state.held_out):
            return None
        rows = self._held_out(False)
        receiver = [np.full(len(port_rows), port // plan.graph.carriers) for port, port_rows in enumerate(rows)]
        return HeldOutObservations(np.concatenate(receiver), np.concatenate(rows), state.held_out)
