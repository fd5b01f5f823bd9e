"""Training of Gaussians, of the paths of a scene, or of both."""

from __future__ import annotations

import logging
import resource
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend import init
from ..backend.device import to_float, to_tensor
from ..core import InputError, Record, Split
from ..core.types import IntArray
from ..datasets.observations import check_observations
from ..gaussians import InitialGaussians
from ..gaussians.density import adapt, reset_opacity
from ..gaussians.footprint import Pose
from ..gaussians.tiles import Plane, perception_plane
from ..graph.graph import LEVEL, SHARE, Field, Graph
from ..graph.settings import TRACED_NAMES
from ..tasks import task_of
from ..tasks.conditions import placed_receivers
from .adam import NonFiniteReport
from .config import TrainConfig
from .fields import check_memory, check_params, field_of
from .initial import initial_gaussians
from .loop import TrainingLoop
from .predictor import Predictor
from .reach import Reach, choose_reach, hold_out_groups, improves
from .state import FitState
from .step import Loss, TrainingData, device_pose, evaluated, make_step
from .targets import FIELD, SURFACES, form_of, plan_rows, stage_names, targets_of

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class HeldOutReports:
    """Reports of training rows that a fit had not seen when it chose its state.

    Attributes:
        receiver: number of the receiver of each [q].
        row: row of the record [q].
        report: reports [q, ...] as observations.
        score: best mean score of these rows by the stages' names.
    """

    receiver: IntArray
    row: IntArray
    report: NDArray[Any]
    score: Mapping[str, float]


CHUNK_SIZE = 64
"""Observations of a receiver from which its starting level is estimated."""


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def check_rows(split: Split, record: Record, source: str) -> None:
    """Refuse a split with rows beyond the record's; ``source`` names the split, for the message.

    Raises:
        InputError: such a row.
    """
    rows = np.concatenate([split.train, split.validation, split.test])
    bad = rows[(rows < 0) | (rows >= len(record))]
    if len(bad):
        raise InputError(f"{source}: row {bad[0]}, but {record.name} has rows 0 to {len(record) - 1}; use other rows")


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
        check_rows(split, record, f"split {split.name}")
        self.task = task_of(record)
        self.label, self.higher_is_better = self.task.label, self.task.higher_is_better
        check_observations(record, split, complete=self.task.image)
        known = split.all_train
        config = config.resolved(record.tx_pos_m[known])
        self.record, self.split, self.config = record, split, config
        self.targets = targets_of(record, known, scene is not None)
        form = form_of(record, config, self.targets, known, scene is not None)
        field = field or field_of(config, form)
        if field is not None:
            check_memory(config, field)
        receivers = placed_receivers(record, by_uplink=bool(form.features))
        self.graph = Graph(
            field,
            receivers,
            form,
            scene,
            config.traced,
            record.tx_antenna,
            config.evaluation,
        )
        self._shape = self.targets.truth.shape[2:]
        self._loss = loss or partial(self.task.loss, ssim_weight=config.loss.ssim_weight)
        self.stages = stage_names(config, field is not None, scene is not None)
        # What corrects paths is chosen also on rows far from the training rows.
        self._in_groups = self.graph.corrects or len(self.stages) > 1
        self._in_groups &= config.patience > 0 and config.holdout_steps_fraction > 0
        self.choosing = hold_out_groups(split, record.tx_pos_m) if self._in_groups else split
        self._in_groups &= self.choosing is not split or self.graph.corrects
        self._unjudged = self._in_groups and self.choosing is split
        self.schedule = plan_rows(config, self.targets, self.choosing, self.stages)
        if config.deterministic:
            # Sums over threads, and on a GPU, add in the order in which parts finish.
            init("llvm", threads=1)
        # Slots of the traced sides: all rows that train or choose, at each port those of its carrier.
        self._known = [self.targets.at(port, known) for port in range(self.targets.ports)]
        self.graph.check(record.tx_pos_m)
        turned = record.tx_heading_rad if form.headings else None
        carriers = None if form.carriers_hz is None else record.carriers_hz
        heading, carrier = (None if part is None else part[known] for part in (turned, carriers))
        sides = [self.graph.trace(record.tx_pos_m[known], r, heading, carrier) for r in range(len(receivers))]
        self._sides = [side for of_receiver in sides for side in of_receiver]
        self._poses = [device_pose(receivers[port // self.graph.carriers]) for port in range(self.targets.ports)]
        self._plane = perception_plane(*form.size, mi.Float)
        self._data = TrainingData(
            to_tensor(self.targets.condition),
            to_float(self.targets.truth),
            to_float(1 / self.targets.unit),
            None if self.targets.weight is None else to_float(self.targets.weight),
        )
        if state is None:
            self.graph.check_polarization(record.tx_pos_m[known])
            state = FitState(self._start(initial))
            state.surface = bool(self.graph.surface) and not self.schedule.stages
            if self._unjudged:
                logger.warning("%d training rows do not suffice to choose a reach: no Gaussians", len(split.train))
                state.reach_m = 0.0
        else:
            check_params(self.graph.field, state.params(), "checkpoint.npz")
            self.graph.cover(self._sides, state.params())
        self.state = state
        self._held_scores = np.zeros(0)
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
            seen = replace(self.record, receivers=self.graph.receivers)
            start = initial or initial_gaussians(self.config.initial, seen, self.split.train, rng, self.graph.sphere)
            values = self.graph.field.init(start, rng)
        values |= self.graph.parameters(self._sides) | self.graph.cover(self._sides)
        gains: dict[str, list[NDArray[np.float32]]] = {}
        for port, side in enumerate(self._sides):
            if side is not None and side.gain_name in values and len(side):
                seen = self.targets.truth[port // self.graph.carriers, self._known[port]]
                for name, gain in self.graph.match_gain(port, side, {}, seen).items():
                    gains.setdefault(name, []).append(gain)
        values |= {name: np.mean(found, axis=0, dtype=np.float32) for name, found in gains.items()}
        if LEVEL in values:
            values[LEVEL][0] = [self._level(values, self._ports(r)[0]) for r in range(len(self.record.receivers))]
        return values

    def _level(self, values: Mapping[str, NDArray[np.float32]], port: int) -> float:
        """Level at which Gaussians match a receiver's observations, or far below its paths' power, by one port."""
        params = {name: to_tensor(value) for name, value in values.items()}
        if (side := self._sides[port]) is not None:
            return self.graph.power_level(side, params) + float(np.log(SHARE))
        rows = self.targets.received(port, self._known[port])[:CHUNK_SIZE]
        report, condition = self.graph.report(port, None), self.targets.condition[:, rows]
        where = self._where(port)
        found = evaluated(report, params, condition, *where).numpy()
        observed = self.targets.truth[port // self.graph.carriers, rows].astype(float)
        return self.graph.models[port].missing_gain(found.astype(float).reshape(observed.shape), observed)

    def _where(self, port: int) -> tuple[int, Pose, Plane, float | None]:
        """Number, pose and directions of a port's receiver, and the logarithm of its carrier."""
        receiver = port // self.graph.carriers
        return receiver, self._poses[port], self._plane, self.graph.log_carrier(port)

    def _step_of(self, port: int) -> Callable[..., Any]:
        """Recorded step of a port; without paths one serves all, else each search for paths needs another."""
        side = self._sides[port]
        state = self.state
        if side is not None and side.refresh({name: state.adam[name] for name in state.adam}):
            state.searched_m[port] = side.searched_at_m
        learned = side is None or (self.stages[self._stage] == FIELD and not (state.chosen and state.reach_m == 0))
        arrays = self.graph.arrays(port, side)
        key = None if side is None and not arrays else (port, side and side.searches, learned, state.surface)
        if key not in self._steps:
            self._steps = {k: v for k, v in self._steps.items() if k is None or k[0] != port}
            report = self.graph.report(port, side, learned, surface=state.surface)
            read = None if key is None else partial(self.graph.arrays, port, side)
            if read is not None:
                # Arrays that are made from NumPy's memory at first use must exist before a recording.
                params = {name: self.state.adam[name] for name in self.state.adam}
                first = self.targets.condition[:, self.targets.conditions(self._known[port][:1])]
                evaluated(report, params, first, *self._where(port))
            rest = self._loss, self._shape, read, self.graph.evaluation
            self._steps[key] = make_step(report, self._rates(), *rest)
        return self._steps[key]

    @property
    def _stage(self) -> int:
        """Stage of the schedule to which the next step belongs, or the chosen state."""
        return self.schedule.stage(self.state.chosen - 1 if self.state.chosen else self.state.step)

    def _begin_stage(self) -> None:
        """Go on from the best state so far; Gaussians on surfaces are trained from the second stage on."""
        self.state = self.state.next_stage()
        if self.stages[self._stage] == SURFACES and self.graph.surface and not self._unjudged:
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
        self._predictor.reach = self.reach()
        return self._predictor

    def _ports(self, receiver: int) -> range:
        """Ports of a receiver."""
        return range(receiver * self.graph.carriers, (receiver + 1) * self.graph.carriers)

    def reach(self) -> Reach | None:
        """Reach around the rows that train now; None: the Gaussians are used everywhere."""
        if not self.graph.corrects:
            return None
        joined = self.state.chosen and self.schedule.joined < self.config.steps
        rows = self.split.all_train if joined else self.choosing.train
        known = [self.record.tx_pos_m[self.targets.received(port, rows)] for port in range(self.targets.ports)]
        every = [np.concatenate([known[port] for port in self._ports(r)]) for r in range(len(self.record.receivers))]
        return Reach(tuple(every), self.state.reach_m)

    def _held_out(self) -> list[IntArray]:
        """Conditions of each port that are held out now."""
        chosen = self.choosing if self._in_groups and not self.state.chosen else self.split
        return [self.targets.received(port, chosen.validation) for port in range(self.targets.ports)]

    def _corrected_scores(self) -> NDArray[np.float64]:
        """Scores of held-out rows where Gaussians correct paths; the best reach is used until one is chosen."""
        predict, record, reach, state = self.predictor(), self.record, self.reach(), self.state
        rows, judged = self._held_out(), self._in_groups and not state.chosen
        assert reach is not None
        reach = reach.of_ports(self.graph.carriers)

        def score(port: int, weight: NDArray[np.float32]) -> NDArray[np.float64]:
            return self._traced_scores(predict, port, rows[port], weight)

        held = [record.tx_pos_m[chosen_rows] for chosen_rows in rows]
        lengths = [reach.length_m]
        if judged:
            # Before the last stage the field has not been trained.
            trained = self.schedule.stage(state.step - 1) == len(self.schedule.stages)
            lengths = reach.lengths(held) if trained else [0.0]
        state.reach_m, found = choose_reach(reach, lengths, held, score, self.task.higher_is_better)
        return found

    def _traced(self, predict: Predictor, port: int, rows: IntArray, weight: Any = None) -> NDArray[Any]:
        """Reports of known rows of a port, whose paths need no search; ``weight`` is that of the Gaussians [rows]."""
        slots = np.searchsorted(self._known[port], rows)
        return predict.of_side(self.record.tx_pos_m[rows], port, self._sides[port], slots, weight)

    def _traced_scores(self, predict: Predictor, port: int, rows: IntArray, weight: Any = None) -> NDArray[np.float64]:
        """Scores of `_traced`."""
        found = self._traced(predict, port, rows, weight)
        return self.task.training_score(found, self.record.observation[port // self.graph.carriers, rows])

    def held_out_reports(self) -> HeldOutReports | None:
        """Reports of held-out rows by the state that was chosen on them; None: none was chosen in groups."""
        if not self._in_groups or self.graph.scene is None or not len(self.state.held_out):
            return None
        rows = [self.targets.received(port, self.choosing.validation) for port in range(self.targets.ports)]
        receiver = [np.full(len(some), port // self.graph.carriers) for port, some in enumerate(rows)]
        best = {name: float(score) for name, score in zip(self.stages, self.state.stage_scores, strict=True)}
        return HeldOutReports(np.concatenate(receiver), np.concatenate(rows), self.state.held_out, best)

    def _reports(self) -> NDArray[Any]:
        """Reports of all held-out rows, port by port, by the present state and reach."""
        predict, reach, rows = self.predictor(), self.reach(), self._held_out()
        found = []
        for port, some in enumerate(rows):
            receiver = port // self.graph.carriers
            weight = None if reach is None else reach.weight(self.record.tx_pos_m[some], receiver)
            found.append(self._traced(predict, port, some, weight))
        return np.concatenate(found)

    def begin(self) -> None:
        """Judge the state that a fit beside paths starts from.

        Parameters of paths may fit few rows and be wrong elsewhere: the stated ones are kept where they score better.
        """
        state = self.state
        if self._in_groups and self.graph.scene is not None and not state.step and state.best is None:
            self.validate()
            if len(self._held_scores):
                score = float(np.nanmean(self._held_scores))
                state.keep_best(score if self.higher_is_better else -score)
                state.best_scores = self._held_scores

    def validate(self) -> float:
        """Median score on the validation rows, all receivers pooled; NaN without such rows."""
        if self.graph.corrects:
            self._held_scores = self._corrected_scores()
        elif self.graph.scene is not None:
            predict, known = self.predictor(), self._held_out()
            scores = [
                np.ravel(self._traced_scores(predict, port, some)) for port, some in enumerate(known) if len(some)
            ]
            self._held_scores = np.concatenate([np.zeros(0), *scores])
        else:
            rows, record = self.split.validation, self.record
            if not len(rows):
                return float("nan")
            predict = self.predictor()
            scores = [
                np.ravel(self.task.training_score(predict.of_rows(record, rows, r), record.observation[r, rows]))
                for r in range(len(record.receivers))
            ]
            return float(np.nanmedian(np.concatenate(scores)))
        return float(np.nanmedian(self._held_scores)) if len(self._held_scores) else float("nan")

    def choose(self, score: float) -> bool:
        """Early stopping (`TrainingLoop`).

        Beside paths, means decide, which have less variance than medians. A state of a later stage has to improve on
        the best of the stages before it (`improves`), and only the last stage ends early.
        """
        stages, state = self.schedule.stages, self.state
        if self._in_groups and len(self._held_scores):
            score = float(np.nanmean(self._held_scores))
            self._note_stage(score)
            baseline = state.baseline
            if len(baseline) and not improves(self._held_scores, baseline, self.higher_is_better):
                score = -np.inf if self.higher_is_better else np.inf
            if (score if self.higher_is_better else -score) > state.best_score:
                state.best_scores = self._held_scores
            if state.step in stages:
                state.baseline = state.best_scores
        if self.schedule.stage(state.step) < len(stages):
            state.waited = -1
        chosen = super().choose(score)
        if chosen:
            self._restore_paths()
            if self._in_groups and self.graph.scene is not None:
                self.state.chosen, now = 0, self.state.chosen  # the rows are still held out
                self.state.held_out = self._reports()
                self.state.chosen = now
        if chosen and self.state.reach_m == 0 and self.graph.scene is None:
            logger.warning("at no distance from training rows do the Gaussians predict held-out rows better than zero")
            self.state.step = self.config.steps
        return chosen

    def _note_stage(self, score: float) -> None:
        """Keep the best mean score of the present stage, for the report."""
        if not len(self.state.stage_scores):
            self.state.stage_scores = np.full(len(self.stages), np.nan)
        # A score right at the end of a stage is that of its last state.
        stage, better = self.schedule.stage(self.state.step - 1), np.fmax if self.higher_is_better else np.fmin
        self.state.stage_scores[stage] = better(self.state.stage_scores[stage], score)

    def take_step(self, trouble: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """One optimiser step (`TrainingLoop`)."""
        schedule, t = self.schedule, self.state.step
        port, rows = int(schedule.receiver[t]), schedule.rows[t]
        carrier = self.graph.log_carrier(port)
        if t in schedule.stages and not self.state.chosen:
            self._begin_stage()
        state = self.state
        state.mean, trouble, report = self._step_of(port)(
            state.adam,
            state.mean,
            self._data,
            mi.UInt32(rows.tolist()),
            mi.UInt32(np.searchsorted(self._known[port], rows // self.targets.per_row).tolist()),
            dr.opaque(mi.UInt32, port // self.graph.carriers),
            self._poses[port],
            self._plane,
            None if carrier is None else dr.opaque(mi.Float, carrier),
            dr.opaque(mi.Float, float(schedule.factor[t])),
            dr.opaque(mi.Float, float(schedule.decay[t])),
            dr.opaque(mi.UInt32, t + 1),
            trouble,
        )
        state.view_gradient_norm += report.view_gradient_norm
        state.view_gradient_steps += 1
        dr.schedule(state.view_gradient_norm)  # evaluated together with the loop's sum of losses
        return report.loss, trouble

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
