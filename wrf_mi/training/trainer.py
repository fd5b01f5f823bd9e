"""Training of Gaussians, of the paths of a scene, or of both."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend import init
from ..backend.device import to_float, to_tensor
from ..core import Record, Split
from ..gaussians import InitialGaussians
from ..gaussians.density import adapt, reset_opacity
from ..graph.graph import LEVEL, SHARE, Field
from ..graph.settings import TRACED_NAMES
from .adam import NonFiniteReport
from .config import TrainConfig
from .fields import check_params
from .fit_plan import FIELD, SURFACES, FitPlan
from .initial import initial_gaussians
from .judging import HeldOutReports, Judge
from .loop import TrainingLoop
from .predictor import Predictor
from .reach import Reach
from .state import FitState
from .step import Loss, TrainingData, evaluated, make_step, places_of

logger = logging.getLogger(__name__)

CHUNK_SIZE = 64
"""Observations of a receiver from which its starting level is estimated."""


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
            where nothing was received; None: the task's loss.
        scene: scene of `wrf_mi.tracing.open_scene` at the record's carrier, whose paths are trained together with the
            Gaussians. None: Gaussians alone.

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
    ) -> None:
        plan = self.plan = FitPlan(record, split, config, field, scene)
        self.record, self.split, self.task, self.config = record, split, plan.task, plan.config
        self.graph, self.targets, self.schedule = plan.graph, plan.targets, plan.schedule
        self.label, self.higher_is_better = plan.task.label, plan.task.higher_is_better
        self._loss = loss or partial(plan.task.loss, ssim_weight=config.loss.ssim_weight)
        if config.deterministic:
            # Sums over threads, and on a GPU, add in the order in which parts finish.
            init("llvm", threads=1)
        rows, form = split.all_train, plan.graph.form
        self.graph.check(record.tx_pos_m)
        turned = record.tx_heading_rad if form.headings else None
        carriers = None if form.carriers_hz is None else record.carriers_hz
        heading, carrier = (None if part is None else part[rows] for part in (turned, carriers))
        receivers = range(len(record.receivers))
        sides = [self.graph.trace(record.tx_pos_m[rows], r, heading, carrier) for r in receivers]
        self._sides = [side for of_receiver in sides for side in of_receiver]
        self._judge, self._places = Judge(plan, self._sides), places_of(self.graph)
        self._data = TrainingData(
            to_tensor(self.targets.condition),
            to_float(self.targets.truth),
            to_float(1 / self.targets.unit),
            None if self.targets.weight is None else to_float(self.targets.weight),
        )
        if state is None:
            self.graph.check_polarization(record.tx_pos_m[rows])
            state = FitState(self._start(initial))
            state.surface = bool(self.graph.surface) and not self.schedule.stages
            if plan.unjudged:
                logger.warning("%d training rows do not suffice to choose a reach: no Gaussians", len(split.train))
                state.reach_m = 0.0
        else:
            check_params(self.graph.field, state.params(), "checkpoint.npz")
            self.graph.cover(self._sides, state.params())
        self.state = state
        if state.chosen:
            self.schedule, _ = self.schedule.after(state.chosen)
        self._restore_paths()
        self.record_functions()

    @property
    def field(self) -> Field:
        """The Gaussians of the graph.

        Raises:
            ValueError: it has none.
        """
        if self.graph.field is None:
            raise ValueError("paths are trained alone: there are no Gaussians")
        return self.graph.field

    def record_functions(self) -> None:
        """Discard recorded kernels: the number of Gaussians is a constant in them."""
        self._steps: dict[Any, Callable[..., Any]] = {}
        self._predictor: Predictor | None = None

    def _restore_paths(self) -> None:
        """Restore the paths of the state: a receiver that training moves is searched from its position at the last
        search.
        """
        sides = [side for side in self._sides if side is not None]
        if sides and not len(self.state.searched_m):
            self.state.searched_m = np.stack([side.searched_at_m for side in sides])
        for side, searched_m in zip(sides, self.state.searched_m, strict=True):
            if not np.array_equal(side.searched_at_m, searched_m):
                side.search(searched_m)

    def _start(self, initial: InitialGaussians | None) -> dict[str, NDArray[np.float32]]:
        """Starting values: Gaussians, and gains and levels that match the observations on average."""
        rng = np.random.default_rng([self.config.seed, 0])
        values: dict[str, NDArray[np.float32]] = {}
        if self.graph.field is not None:
            placed = replace(self.record, receivers=self.graph.receivers)
            start = initial or initial_gaussians(self.config.initial, placed, self.split.train, rng, self.graph.sphere)
            values = self.graph.field.init(start, rng)
        values |= self.graph.parameters(self._sides) | self.graph.cover(self._sides)
        gains: dict[str, list[NDArray[np.float32]]] = {}
        for port, side in enumerate(self._sides):
            if side is not None and side.gain_name in values and len(side):
                observed = self.targets.truth[port // self.graph.carriers, self.plan.known[port]]
                gains.setdefault(side.gain_name, []).append(self.graph.match_gain(port, side, observed))
        values |= {name: np.mean(of_ports, axis=0, dtype=np.float32) for name, of_ports in gains.items()}
        if LEVEL in values:
            values[LEVEL][0] = [self._level(values, self.plan.ports(r)[0]) for r in range(len(self.record.receivers))]
        return values

    def _level(self, values: Mapping[str, NDArray[np.float32]], port: int) -> float:
        """Level at which Gaussians match a receiver's observations, or far below its paths' power, by one port."""
        params = {name: to_tensor(value) for name, value in values.items()}
        if (side := self._sides[port]) is not None:
            return self.graph.power_level(side, params) + float(np.log(SHARE))
        rows = self.targets.received(port, self.plan.known[port])[:CHUNK_SIZE]
        report, condition = self.graph.report(port, None), self.targets.condition[:, rows]
        reported = evaluated(report, params, condition, self._places[port]).numpy()
        observed = self.targets.truth[port // self.graph.carriers, rows].astype(float)
        return self.graph.models[port].missing_gain(reported.astype(float).reshape(observed.shape), observed)

    def _step_of(self, port: int) -> Callable[..., Any]:
        """Recorded step of a port; without paths one serves all, else each search for paths needs another."""
        side = self._sides[port]
        state = self.state
        if side is not None and side.refresh({name: state.adam[name] for name in state.adam}):
            state.searched_m[port] = side.searched_at_m
        learned = side is None or (self.plan.stages[self._stage] == FIELD and not (state.chosen and state.reach_m == 0))
        arrays = self.graph.arrays(port, side)
        key = None if side is None and not arrays else (port, side and side.searches, learned, state.surface)
        if key not in self._steps:
            self._steps = {k: v for k, v in self._steps.items() if k is None or k[0] != port}
            report = self.graph.report(port, side, learned, surface=state.surface)
            read = None if key is None else partial(self.graph.arrays, port, side)
            if read is not None:
                # Arrays that are made from NumPy's memory at first use must exist before a recording.
                params = {name: self.state.adam[name] for name in self.state.adam}
                first = self.targets.condition[:, self.targets.conditions(self.plan.known[port][:1])]
                evaluated(report, params, first, self._places[port])
            shape = self.targets.truth.shape[2:]
            self._steps[key] = make_step(report, self._rates(), self._loss, shape, read, self.graph.evaluation)
        return self._steps[key]

    @property
    def _stage(self) -> int:
        """Stage of the schedule to which the next step belongs, or the chosen state."""
        return self.schedule.stage(self.state.chosen - 1 if self.state.chosen else self.state.step)

    def _begin_stage(self) -> None:
        """Go on from the best state so far; Gaussians on surfaces are trained from the second stage on."""
        self.state = self.state.next_stage()
        if self.plan.stages[self._stage] == SURFACES and self.graph.surface and not self.plan.unjudged:
            self.state.surface = True
        self._restore_paths()
        self.record_functions()

    def _rates(self) -> dict[str, float]:
        o, traced = self.config.optimiser, self.graph.traced
        rates = {name: getattr(o, name) for name in ("position", "rotation", "opacity", "signal")}
        rates |= {"log_scale": o.scale, "image": 0.0, LEVEL: o.level}
        return {
            name: traced.rate(name) if name.startswith(TRACED_NAMES) else rates.get(name, o.network)
            for name in self.state.adam
        }

    def predictor(self) -> Predictor:
        """Predictions with the current running mean of the parameters."""
        if self._predictor is None:
            params, graph = self.state.mean_params(), self.graph
            size = graph.form.size
            self._predictor = Predictor(graph.field, params, graph.receivers, *size, graph=graph)
        else:
            self._predictor.update(self.state.mean)
        self._predictor.reach, self._predictor.phase_error = self.reach(), self.state.phase_error
        return self._predictor

    def reach(self) -> Reach | None:
        """Reach around the rows that train now; None: the Gaussians are used everywhere."""
        return self._judge.reach(bool(self.state.chosen), self.state.reach_m)

    def held_out_reports(self) -> HeldOutReports | None:
        """Reports of held-out rows by the state that was chosen on them; None: none was chosen in groups."""
        return self._judge.summary(self.state)

    def begin(self) -> None:
        """Judge the state that a fit beside paths starts from.

        Parameters of paths may fit few rows and be wrong elsewhere: the stated ones are kept where they score better.
        """
        plan, state = self.plan, self.state
        if plan.in_groups and plan.graph.scene is not None and not state.step and state.best is None:
            self.validate()
            if len(self._judge.scores):
                score = float(np.nanmean(self._judge.scores))
                state.keep_best(score if self.higher_is_better else -score)
                state.best_scores = self._judge.scores

    def validate(self) -> float:
        """Median score on the validation rows, all receivers pooled; NaN without such rows."""
        return self._judge.score(self.predictor(), self.state)

    def choose(self, score: float) -> bool:
        """Early stopping (`TrainingLoop`); beside paths by `Judge.stage_score`, and only the last stage ends early."""
        if self.plan.in_groups and len(self._judge.scores):
            score = self._judge.stage_score(self.state)
        if self.schedule.stage(self.state.step) < len(self.schedule.stages):
            self.state.waited = -1
        if not super().choose(score):
            return False
        self._restore_paths()
        if self.plan.in_groups and self.graph.scene is not None:
            self.state.held_out = self._judge.choose_phase_error(self.predictor(), self.state)
        if self.state.reach_m == 0 and self.graph.scene is None:
            logger.warning("at no distance from training rows do the Gaussians predict held-out rows better than zero")
            self.state.step = self.config.steps
        return True

    def take_step(self, trouble: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """One optimiser step (`TrainingLoop`)."""
        schedule, t = self.schedule, self.state.step
        port, rows = int(schedule.receiver[t]), schedule.rows[t]
        if t in schedule.stages and not self.state.chosen:
            self._begin_stage()
        state = self.state
        slots = mi.UInt32(np.searchsorted(self.plan.known[port], rows // self.targets.per_row).tolist())
        state.mean, trouble, loss, view_gradient_norm = self._step_of(port)(
            state.adam,
            state.mean,
            self._data,
            mi.UInt32(rows.tolist()),
            self._places[port].batch(None, slots),
            dr.opaque(mi.Float, float(schedule.factor[t])),
            dr.opaque(mi.Float, float(schedule.decay[t])),
            dr.opaque(mi.UInt32, t + 1),
            trouble,
        )
        state.view_gradient_norm += view_gradient_norm
        state.view_gradient_steps += 1
        dr.schedule(state.view_gradient_norm)  # evaluated together with the loop's sum of losses
        return loss, trouble

    def adapt(self) -> None:
        """One round of density control."""
        d, state = self.config.density, self.state
        names = self.field.per_gaussian
        params = {name: values for name, values in state.params().items() if name in names}
        receivers = np.stack([r.position_m for r in self.record.receivers])
        distance = np.linalg.norm(params["position"].T[:, None].astype(float) - receivers, axis=2).min(axis=1)
        # A generator for each round: a resumed run draws the same numbers.
        rng = np.random.default_rng([self.config.seed, 2, state.step])
        change = adapt(
            params,
            state.view_gradient_norm.numpy() / max(1, state.view_gradient_steps),
            distance,
            rng,
            d.growth_fraction,
            max(d.max_gaussians, self.config.initial.gaussians),
            float(np.radians(d.split_deg)),
            d.least_opacity,
        )
        state.change_density(change)
        self.record_functions()
        rounds = sorted(self.schedule.density)
        if d.reset_every and "opacity" in names and (rounds.index(state.step) + 1) % d.reset_every == 0:
            state.set_param("opacity", reset_opacity(change.parameters["opacity"], d.reset_opacity))
