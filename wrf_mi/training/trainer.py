"""Training of Gaussians, of the paths of a scene, or of both; held-out rows choose state and reach."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backend import init
from ..core import Record, Split
from ..gaussians import InitialGaussians
from ..gaussians.attributes import grown_attributes
from ..gaussians.initial import adapt, reset_opacity
from ..graph.graph import Field, Graph
from ..tasks import Loss
from ..tracing.options import DISC, FACTOR
from .adam import NonFiniteReport
from .by_distance import Reach
from .config import TrainConfig
from .fields import check_params
from .fit_plan import FitPlan
from .initial import starting_values
from .loop import OF_FIT, FitState, TrainingLoop
from .predictor import Predictor
from .step import Steps
from .validation import Validation

logger = logging.getLogger(__name__)


class Trainer(TrainingLoop):
    """Fits one field to the training rows of one split.

    Args:
        record: measurements of any task that a receiver model observes.
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
        before: training of the curriculum from whose state this one starts; None: from starting values.

    Attributes:
        plan: data, graph and schedule of the fit.
        validation: scores of held-out rows.
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
        before: Trainer | None = None,
    ) -> None:
        plan = self.plan = plan or FitPlan(record, split, config, field, scene)
        config = self.config = plan.loop
        self.schedule = plan.schedule
        self.label, self.higher_is_better = plan.task.label, plan.task.higher_is_better
        if config.deterministic:
            # Sums over threads, and on a GPU, add in the order in which parts finish.
            init("llvm", threads=1)
        self.validation, self.steps = Validation(plan), Steps(plan, loss or plan.loss)
        self._predictor: Predictor | None = None
        if state is None and before is not None:
            state, self.seconds = before.state.restarted(), before.seconds
        elif state is None:
            state = FitState(starting_values(plan, initial))
            plan.graph.check_polarization(record.tx_pos_m[split.all_train])
            if plan.unjudged:
                logger.warning("%d training rows do not suffice to choose a reach: no Gaussians", len(split.train))
                state.reach_m = 0.0
        else:
            check_params(plan.graph.field, state.params(), "checkpoint.npz")
            plan.graph.add_surface_gaussians(plan.traced_fields, state.params())
        self.state = state
        # A resumed fit whose state was chosen has the shortened schedule that followed.
        if state.chosen:
            self.schedule, _ = self.schedule.after(state.chosen)
        self._restore_paths()

    def go_on_from(self, before: Trainer, params: Mapping[str, NDArray[np.float32]]) -> None:
        """Train what is left after a fit to some of the rows has chosen a state, with parameters of that state.

        Parameters of paths change as much from what this scene states as they did there. Those of another shape here
        keep their starting values, but for Gaussians on surfaces, which have places of their own.
        """
        start, chosen = self.state.params(), before.state
        parameters, parameters_before = (
            trainer.graph.parameters(trainer.plan.traced_fields) for trainer in (self, before)
        )
        fitted = {name: v for name, v in params.items() if name in start and v.shape == start[name].shape}
        for name, values in parameters.items():
            if name in fitted and name in parameters_before and parameters_before[name].shape == values.shape:
                fitted[name] = values + (fitted[name] - parameters_before[name])
        discs = {name: values for name, values in params.items() if name in (DISC, FACTOR)}
        self.state = FitState(start | fitted | discs, self.state.adam.beta_1)
        for name in ("chosen", "reach_m", "phase_error", *OF_FIT):
            setattr(self.state, name, getattr(chosen, name))
        self.graph.add_surface_gaussians(self.plan.traced_fields, self.state.params())
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
        traced_fields = [field for field in self.plan.traced_fields if field is not None]
        if traced_fields and not len(self.state.searched_m):
            self.state.searched_m = np.stack([field.searched_at_m for field in traced_fields])
        for traced_field, searched_m in zip(traced_fields, self.state.searched_m, strict=True):
            if not np.array_equal(traced_field.searched_at_m, searched_m):
                traced_field.search(searched_m)

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
        return self.validation.reach(bool(self.state.chosen), self.state.reach_m)

    def begin(self) -> None:
        """Score the state that a training beside paths starts from."""
        state = self.state
        if self.plan.chooses_beside_paths and not state.step and state.best is None:
            if not len(state.best_scores):  # those of the training before
                self.validate()
                state.best_scores = self.validation.scores
            # Trained parameters of paths may fit few rows and be wrong elsewhere: better stated ones stay.
            if len(state.best_scores):
                state.keep_best(float(np.nanmean(state.best_scores)) * (1 if self.higher_is_better else -1))

    def validate(self) -> float:
        """Median score on the validation rows, all receivers pooled; NaN without such rows."""
        return self.validation.score(self.predictor(), self.state)

    def validation_facts(self) -> dict[str, Any]:
        """Number and distance of the rows that were scored, and the score of those as far as test rows."""
        return self.validation.facts(bool(self.state.chosen))

    def choose(self, score: float) -> bool:
        """Early stopping (`TrainingLoop`)."""
        score = self.validation.choosing_score(score)
        if (score if self.higher_is_better else -score) > self.state.best_score:
            self.state.best_scores = self.validation.scores
        if not super().choose(score):
            return False
        if self.state.reach_m == 0 and self.graph.scene is None:
            logger.warning("at no distance from training rows do the Gaussians predict held-out rows better than zero")
            self.state.step = self.config.steps  # further steps would train what is not used
        return True

    def choose_best(self) -> None:
        """Go on from the best state (`TrainingLoop`), with the phase error that predicts held-out rows best."""
        super().choose_best()
        self._restore_paths()
        if self.plan.chooses_beside_paths:
            self.state.held_out = self.validation.choose_phase_error(self.predictor(), self.state)

    def take_step(self, non_finite: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """One optimiser step (`TrainingLoop`)."""
        return self.steps.take(self.state, self.schedule, non_finite)

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
        change.parameters.update(grown_attributes(self.field, params, change.source))
        state.change_density(change)
        self.record_functions()
        rounds, every = sorted(self.schedule.density), density.reset_every
        if every and "opacity" in names and (rounds.index(state.step) + 1) % every == 0:
            state.set_param("opacity", reset_opacity(change.parameters["opacity"]))
