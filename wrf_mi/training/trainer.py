"""Training of Gaussians, of the paths of a scene, or of both; choice of state, stages and reach by held-out rows."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..backend import init
from ..core import Record, Split
from ..core.types import IntArray
from ..gaussians import InitialGaussians
from ..gaussians.initial import adapt, reset_opacity
from ..graph.graph import Field, Graph
from ..tasks import Loss
from ..tracing.options import DISC, FACTOR
from ..tracing.paths.traced_field import TracedField
from .adam import NonFiniteReport
from .by_distance import Reach, choose_reach
from .config import TrainConfig
from .evaluator import Request
from .fit_plan import SURFACES, FitPlan, check_params
from .initial import starting_values
from .loop import OF_FIT, FitState, TrainingLoop
from .predictor import Predictor
from .selection import improves
from .step import Steps

PHASE_ERRORS = (0.5, 1.0, 1.5)  # phase errors that are tried, rad: beyond, a reflection knows nothing of its phase


@dataclass(frozen=True)
class HeldOutReports:
    """Reports of training rows that a fit had not seen when it chose its state."""

    receiver: IntArray  # number of the receiver of each [q]
    row: IntArray  # row of the record [q]
    report: NDArray[Any]  # reports [q, ...] as observations
    score: Mapping[str, float]  # best mean score of these rows by the stages' names


class StageSelection:
    """Scores and reports of a fit's held-out rows; ``sides`` are the traced sides of the ports, None without a scene.

    Attributes:
        scores: scores of the held-out rows at the last validation, port by port.
    """

    def __init__(self, plan: FitPlan, sides: Sequence[TracedField | None]) -> None:
        self.plan, self._sides, self.scores = plan, sides, np.zeros(0)
        self._higher = plan.task.higher_is_better

    def reach(self, chosen: bool, length_m: float) -> Reach | None:
        """Reach around the rows that train before or after a state is ``chosen``; None: Gaussians count everywhere."""
        plan = self.plan
        if not plan.graph.corrects:
            return None
        # Once a state is chosen, the held-out rows train, too, unless they stay out to the end.
        joined = chosen and plan.schedule.joined < plan.config.steps
        rows = plan.split.all_train if joined else plan.choosing.train
        positions_m = [plan.record.tx_pos_m[plan.targets.received(port, rows)] for port in range(plan.targets.ports)]
        receivers = range(len(plan.record.receivers))
        return Reach(tuple(np.concatenate([positions_m[port] for port in plan.ports(r)]) for r in receivers), length_m)

    def score(self, predict: Predictor, state: FitState) -> float:
        """Median of `scores` by a state, all receivers pooled; NaN without held-out rows.

        Where Gaussians correct paths, it chooses the reach of the state.
        """
        plan, rows = self.plan, self._held_out(bool(state.chosen))
        if plan.graph.corrects:
            each = [self._corrected_scores(predict, state, rows)]
        elif plan.graph.scene is not None:
            each = [self._scores(predict, port, port_rows) for port, port_rows in enumerate(rows) if len(port_rows)]
        else:
            record, score, validation = plan.record, plan.task.training_score, self._split(state.chosen).validation
            receivers = range(len(record.receivers)) if len(validation) else ()
            reports = [predict.of_rows(record, validation, r) for r in receivers]
            each = [np.ravel(score(reports[r], record.observation[r, validation])) for r in receivers]
        self.scores = np.concatenate([np.zeros(0), *each])
        return float(np.nanmedian(self.scores)) if len(self.scores) else float("nan")

    def _split(self, chosen: bool | int) -> Split:
        """Split whose validation rows are scored before or after a state is ``chosen``."""
        return self.plan.split if chosen else self.plan.choosing

    def _held_out(self, chosen: bool) -> list[IntArray]:
        """Conditions of each port that are held out before or after a state is ``chosen``."""
        split = self._split(chosen)
        return [self.plan.targets.received(port, split.validation) for port in range(self.plan.targets.ports)]

    def facts(self, chosen: bool) -> dict[str, Any]:
        """Fields of `Progress` on the rows of `scores`, before or after a state is ``chosen``."""
        plan, split = self.plan, self._split(chosen)
        record, test = plan.record, plan.split.test
        facts: dict[str, Any] = {"validation_rows": len(split.validation)}
        if not record.has_positions or not len(split.validation):
            return facts
        trained = cKDTree(record.tx_pos_m[split.train])
        by_port = plan.graph.corrects or plan.graph.scene is not None  # the order of `score`
        scored = self._held_out(chosen) if by_port else [split.validation] * len(record.receivers)
        away_m = trained.query(record.tx_pos_m[np.concatenate(scored)])[0]
        facts["validation_m"] = float(np.median(away_m))
        if not len(test):
            return facts
        # Validation rows are compared with test rows as they are predicted: by a field that all of these rows trained.
        known = split.all_train if plan.schedule.joined < plan.config.steps else split.train
        facts["test_m"] = float(np.median(cKDTree(record.tx_pos_m[known]).query(record.tx_pos_m[test])[0]))
        far = (away_m >= facts["test_m"]) & np.isfinite(self.scores)
        if not far.any():
            return facts
        rows = len(np.unique(np.concatenate(scored)[far]))
        return facts | {"far_score": float(np.median(self.scores[far])), "far_rows": rows}

    def _reports(self, predict: Predictor, port: int, rows: IntArray, weight: Any = None) -> NDArray[Any]:
        """Reports of known rows of a port, whose paths need no search; ``weight`` is that of the Gaussians [rows]."""
        # Sides hold all training rows, held-out ones too: scores need no further search for paths.
        slots = np.searchsorted(self.plan.known[port], rows)
        return predict.of_side(Request(self.plan.record.tx_pos_m[rows], port, self._sides[port], slots, weight))

    def _observed(self, port: int, rows: IntArray) -> NDArray[Any]:
        return np.asarray(self.plan.record.observation[port // self.plan.graph.carriers, rows])

    def _scores(self, predict: Predictor, port: int, rows: IntArray, weight: Any = None) -> NDArray[np.float64]:
        reports = self._reports(predict, port, rows, weight)
        return np.ravel(self.plan.task.training_score(reports, self._observed(port, rows)))

    def _corrected_scores(self, predict: Predictor, state: FitState, rows: list[IntArray]) -> NDArray[np.float64]:
        """Scores of held-out rows where Gaussians correct paths; the best reach is used until one is chosen."""
        plan, reach = self.plan, self.reach(bool(state.chosen), state.reach_m)
        assert reach is not None
        reach = reach.of_ports(plan.graph.carriers)
        positions_m = [plan.record.tx_pos_m[port_rows] for port_rows in rows]
        lengths = [reach.length_m]
        if plan.in_groups and not state.chosen:
            # Before the last stage the field has not been trained.
            trained = plan.schedule.stage(state.step - 1) == len(plan.schedule.stages)
            lengths = reach.lengths(positions_m) if trained else [0.0]
        # The state keeps the reach with which it is scored, so that the best state has the best reach.
        state.reach_m, scores = choose_reach(
            reach, lengths, positions_m, lambda port, w: self._scores(predict, port, rows[port], w), self._higher
        )
        return scores

    def stage_score(self, state: FitState) -> float:
        """Mean of `scores`, which decides beside paths; the worst one where a state is no better than stages before."""
        # A mean has less variance than a median. The best mean score of the present stage is noted in the state.
        plan, score = self.plan, float(np.nanmean(self.scores))
        if not len(state.stage_scores):
            state.stage_scores = np.full(len(plan.stages), np.nan)
        # A score right at the end of a stage is that of its last state.
        stage, better = plan.schedule.stage(state.step - 1), np.fmax if self._higher else np.fmin
        state.stage_scores[stage] = better(state.stage_scores[stage], score)
        # A stage's first gain over the stages before may be chance: by less than its standard error it does not count.
        if len(state.baseline) and not improves(self.scores, state.baseline, self._higher):
            score = -np.inf if self._higher else np.inf
        if (score if self._higher else -score) > state.best_score:
            state.best_scores = self.scores
        if state.step in plan.schedule.stages:
            state.baseline = state.best_scores
        return score

    def choose_phase_error(self, predict: Predictor, state: FitState) -> NDArray[Any]:
        """Reports of all rows on which a state was chosen, port by port, by the phase error that predicts them best.

        Planes that are centimetres off leave phases uncertain, and the expectation of a spectrum is then nearer to what
        is measured than the spectrum of any phases (`Graph.report`). Other reports have no such expectation.
        """
        plan, rows = self.plan, self._held_out(False)
        best = self._held_out_reports(predict, state, rows)
        if plan.graph.scene is None or not plan.task.image:
            return best
        observed = np.concatenate([self._observed(port, port_rows) for port, port_rows in enumerate(rows)])
        before = np.ravel(plan.task.training_score(best, observed))
        for phase_error in PHASE_ERRORS:
            predict.phase_error = phase_error
            reports = self._held_out_reports(predict, state, rows)
            scores = np.ravel(plan.task.training_score(reports, observed))
            # Scores are taken to rise to one maximum, as each try costs a prediction of all held-out rows.
            if not improves(scores, before, self._higher):
                break
            state.phase_error, best, before = phase_error, reports, scores
        predict.phase_error = state.phase_error
        return best

    def _held_out_reports(self, predict: Predictor, state: FitState, rows: list[IntArray]) -> NDArray[Any]:
        reach, reports = self.reach(False, state.reach_m), list[NDArray[Any]]()
        for port, port_rows in enumerate(rows):
            receiver = port // self.plan.graph.carriers
            weight = None if reach is None else reach.weight(self.plan.record.tx_pos_m[port_rows], receiver)
            reports.append(self._reports(predict, port, port_rows, weight))
        return np.concatenate(reports)

    def reports(self, state: FitState) -> HeldOutReports | None:
        """Reports of held-out rows by the state that was chosen on them; None: none was chosen in groups."""
        plan = self.plan
        if not plan.in_groups or plan.graph.scene is None or not len(state.held_out):
            return None
        rows = self._held_out(False)
        receiver = [np.full(len(port_rows), port // plan.graph.carriers) for port, port_rows in enumerate(rows)]
        best = {name: float(score) for name, score in zip(plan.stages, state.stage_scores, strict=True)}
        return HeldOutReports(np.concatenate(receiver), np.concatenate(rows), state.held_out, best)


logger = logging.getLogger(__name__)


class Trainer(TrainingLoop):
    """Fits one field to the training rows of one split.

    Args:
        record: measurements of any task that a receiver model reports.
        split: rows for training and for the choice of settings.
        config: settings.
        field: field that replaces the one of ``config.model``.
        initial: starting values that replace those of ``config.initial``.
        state: state of a stopped fit, to resume from.
        loss: ``loss(prediction, truth, batch, *shape)`` of flat Dr.Jit arrays in the receiver's unit, NaN in the truth
            where nothing was received; None: that of the plan.
        scene: scene of `wrf_mi.tracing.open_scene` at the record's carrier, whose paths are trained together with the
            Gaussians. None: Gaussians alone.
        plan: plan of the fit, of the arguments above; None: it is made of them.

    Attributes:
        plan: data, graph, stages and schedule of the fit.
        sides: traced side of each port; None without a scene.
        selection: choice of states and stages by held-out rows.
        steps: recorded optimiser steps.

    Raises:
        InputError: unsuitable settings or data.
        BackendError: a deterministic fit in a process that already computes on a GPU.
    """

    config: TrainConfig

    def __init__(
        self,
        record: Record,
        split: Split,
        config: TrainConfig,
        *,
        field: Field | None = None,
        initial: InitialGaussians | None = None,
        state: FitState | None = None,
        loss: Loss | None = None,
        scene: Any | None = None,
        plan: FitPlan | None = None,
    ) -> None:
        plan = self.plan = plan or FitPlan(record, split, config, field, scene)
        self.config, self.schedule = plan.config, plan.schedule
        self.label, self.higher_is_better = plan.task.label, plan.task.higher_is_better
        if config.deterministic:
            # Sums over threads, and on a GPU, add in the order in which parts finish.
            init("llvm", threads=1)
        # Traced once: the positions of training rows do not change, only what the paths meet.
        self.sides = plan.traced()
        self.selection = StageSelection(plan, self.sides)
        self.steps = Steps(plan, self.sides, loss or plan.loss)
        self._predictor: Predictor | None = None
        if state is None:
            plan.graph.check_polarization(record.tx_pos_m[split.all_train])
            state = FitState(starting_values(plan, self.sides, self.steps.places, initial))
            state.surface = bool(plan.graph.surface) and not self.schedule.stages
            if plan.unjudged:
                logger.warning("%d training rows do not suffice to choose a reach: no Gaussians", len(split.train))
                state.reach_m = 0.0
        else:
            check_params(plan.graph.field, state.params(), "checkpoint.npz")
            plan.graph.cover(self.sides, state.params())
        self.state = state
        # A resumed fit whose state was chosen has the shortened schedule that followed.
        if state.chosen:
            self.schedule, _ = self.schedule.after(state.chosen)
        self._restore_paths()

    @contextmanager
    def at_best(self) -> Iterator[None]:
        """The best state so far in place of the present one, where stages are chosen and none is yet."""
        present = self.state
        if not self.plan.chooses_stages or present.chosen or present.best is None:
            yield
            return
        self.state, self._predictor = present.go_back(), None
        self.state.held_out = self.selection.choose_phase_error(self.predictor(), self.state)
        try:
            yield
        finally:
            self.state, self._predictor = present, None

    def go_on_from(self, params: Mapping[str, NDArray[np.float32]], chosen: FitState) -> None:
        """Train what is left after a state was chosen by a fit to some of the rows, with parameters of that state.

        Those of another shape in this scene keep their starting values, but for Gaussians on surfaces, which have
        places of their own.
        """
        start = self.state.params()
        same = {name: values for name, values in params.items() if name in start and values.shape == start[name].shape}
        discs = {name: values for name, values in params.items() if name in (DISC, FACTOR)}
        self.state = FitState(start | same | discs, self.state.adam.beta_1)
        for name in ("chosen", "reach_m", "surface", "phase_error", *OF_FIT):
            setattr(self.state, name, getattr(chosen, name))
        self.plan.graph.cover(self.sides, self.state.params())
        self.schedule, self.state.step = self.schedule.after(chosen.chosen)

    @property
    def graph(self) -> Graph:
        """Gaussians, paths and receivers."""
        return self.plan.graph

    @property
    def field(self) -> Field:
        """The Gaussians of the graph (ValueError: it has none)."""
        if self.graph.field is None:
            raise ValueError("paths are trained alone: there are no Gaussians")
        return self.graph.field

    def record_functions(self) -> None:
        """Discard recorded kernels: the number of Gaussians is a constant in them."""
        self.steps.recorded = {}
        self._predictor = None

    def _restore_paths(self) -> None:
        # A receiver that training moves is searched from its position at the last search.
        sides = [side for side in self.sides if side is not None]
        if sides and not len(self.state.searched_m):
            self.state.searched_m = np.stack([side.searched_at_m for side in sides])
        for side, searched_m in zip(sides, self.state.searched_m, strict=True):
            if not np.array_equal(side.searched_at_m, searched_m):
                side.search(searched_m)

    def predictor(self) -> Predictor:
        """Predictions with the current running mean of the parameters."""
        if self._predictor is None:
            self._predictor = Predictor(self.graph, self.state.mean_params())
        else:
            self._predictor.update(self.state.mean)
        self._predictor.reach, self._predictor.phase_error = self.reach(), self.state.phase_error
        return self._predictor

    def reach(self) -> Reach | None:
        """Reach around the rows that train now; None: the Gaussians are used everywhere."""
        return self.selection.reach(bool(self.state.chosen), self.state.reach_m)

    def begin(self) -> None:
        """Score the state that a fit beside paths starts from."""
        if self.plan.chooses_stages and not self.state.step and self.state.best is None:
            self.validate()
            # Trained parameters of paths may fit few rows and be wrong elsewhere: better stated ones stay.
            if len(scores := self.selection.scores):
                self.state.keep_best(float(np.nanmean(scores)) * (1 if self.higher_is_better else -1))
                self.state.best_scores = scores

    def validate(self) -> float:
        """Median score on the validation rows, all receivers pooled; NaN without such rows."""
        return self.selection.score(self.predictor(), self.state)

    def validation_facts(self) -> dict[str, Any]:
        """Number and distance of the rows that were scored, and the score of those as far as test rows."""
        return self.selection.facts(bool(self.state.chosen))

    def choose(self, score: float) -> bool:
        """Early stopping (`TrainingLoop`), beside paths by `StageSelection.stage_score` and in the last stage alone."""
        if self.plan.in_groups and len(self.selection.scores):
            score = self.selection.stage_score(self.state)
        # A stage may end without a gain and the next one still have some: patience counts in the last stage alone.
        if self.schedule.stage(self.state.step) < len(self.schedule.stages):
            self.state.waited = -1
        if not super().choose(score):
            return False
        self._restore_paths()
        if self.plan.chooses_stages:
            self.state.held_out = self.selection.choose_phase_error(self.predictor(), self.state)
        if self.state.reach_m == 0 and self.graph.scene is None:
            logger.warning("at no distance from training rows do the Gaussians predict held-out rows better than zero")
            self.state.step = self.config.steps  # further steps would train what is not used
        return True

    def take_step(self, trouble: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """One optimiser step (`TrainingLoop`)."""
        if self.state.step in self.schedule.stages and not self.state.chosen:
            # Go on from the best state so far; Gaussians on surfaces are trained from the second stage on.
            self.state = self.state.next_stage()
            begun = self.plan.stages[self.schedule.stage(self.state.step)]
            if begun == SURFACES and self.graph.surface and not self.plan.unjudged:
                self.state.surface = True
            self._restore_paths()
            self.record_functions()
        return self.steps.take(self.state, self.schedule, trouble)

    def adapt(self) -> None:
        """One round of density control."""
        density, state, names = self.config.density, self.state, self.field.per_gaussian
        params = {name: values for name, values in state.params().items() if name in names}
        receivers = np.stack([r.position_m for r in self.plan.record.receivers])
        # Of the nearest receiver, which sees the Gaussian largest.
        distance = np.linalg.norm(params["position"].T[:, None].astype(float) - receivers, axis=2).min(axis=1)
        # A generator for each round: a resumed run draws the same numbers.
        rng = np.random.default_rng([self.config.seed, 2, state.step])
        gradient = state.view_gradient_norm.numpy() / max(1, state.view_gradient_steps)
        # A field that starts with more Gaussians than the limit keeps them, and does not grow.
        most = max(density.max_gaussians, self.config.initial.gaussians)
        change = adapt(params, gradient, distance, rng, density.growth_fraction, most)
        state.change_density(change)
        self.record_functions()
        rounds, every = sorted(self.schedule.density), density.reset_every
        if every and "opacity" in names and (rounds.index(state.step) + 1) % every == 0:
            state.set_param("opacity", reset_opacity(change.parameters["opacity"]))
