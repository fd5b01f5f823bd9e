"""The training loop."""

from __future__ import annotations

import resource
import sys
import time
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
from ..field import InitialGaussians
from ..field.density import adapt, reset_opacity
from ..graph.graph import LEVEL, SHARE, Field, Graph
from ..graph.settings import TRACED_NAMES
from ..measure.observations import check_observations
from ..splat.tiles import perception_plane
from ..tasks import task_of
from ..tasks.conditions import placed_receivers
from .config import PATHS_ALONE, TrainConfig
from .fields import make_field
from .predictor import Predictor
from .start import initial_gaussians
from .state import FitState
from .step import (
    Loss,
    TrainingData,
    Trouble,
    device_pose,
    evaluated,
    make_step,
    no_trouble,
    watched_groups,
)
from .targets import form_of, plan_rows, targets_of

AT_ONCE = 64
"""Observations of a receiver by which its level starts."""


class NumericsError(RuntimeError):
    """A loss, gradient, parameter or moment was not finite; says at which step, and which of them."""

    exit_status = 1


@dataclass(frozen=True)
class Progress:
    """What a listener hears at each log line.

    Attributes:
        step: steps taken.
        seconds: training time so far, over all sittings.
        loss: mean over the steps since the last line.
        validation_score: median on the validation rows, where it was just computed.
        held_out: whether the validation rows are still kept out of training.
        gaussians: their number.
        left_s: estimated seconds to the end.
        label: of the score.
    """

    step: int
    seconds: float
    loss: float
    validation_score: float | None
    held_out: bool
    gaussians: int
    left_s: float
    label: str = "SSIM"


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def check_rows(split: Split, record: Record, source: str) -> None:
    """Refuse a split with rows that the record has not; ``source`` says where the split comes from.

    Raises:
        InputError: such a row.
    """
    rows = np.concatenate([split.train, split.validation, split.test])
    bad = rows[(rows < 0) | (rows >= len(record))]
    if len(bad):
        raise InputError(f"{source}: row {bad[0]}, but {record.name} has rows 0 to {len(record) - 1}; use other rows")


class Trainer:
    """Fits one field to the training rows of one split.

    Args:
        record: of any task that a receiver model reports.
        split: which rows train and which choose.
        config: settings.
        field: a model of your own in place of the one that ``config.model`` names.
        initial: starting values in place of those that ``config.initial`` describes.
        state: of a fit that was stopped, to go on from.
        loss: in place of the task's: ``loss(prediction, truth, batch, *shape)`` of flat Dr.Jit arrays in the
            receiver's unit, NaN in the truth where nothing was received.
        scene: from `wrf_mi.trace.open_scene`, at the record's carrier: its paths are trained together with the
            Gaussians. None: Gaussians alone.

    Raises:
        InputError: settings or data that cannot be trained on.
        BackendError: a deterministic fit in a process that computes on a GPU already.
    """

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
        check_observations(record, split, complete=self.task.image)
        known = split.all_train
        config = config.resolved(record.tx_pos_m[known], scene is not None and self.task.image)
        self.record, self.split, self.config = record, split, config
        self.targets = targets_of(record, known, scene is not None)
        form = form_of(record, config, self.targets, known, scene is not None)
        receivers = placed_receivers(record, by_uplink=bool(form.features))
        self.graph = Graph(
            field or (None if config.model == PATHS_ALONE else make_field(config, form.components, form.features)),
            receivers,
            form,
            scene,
            config.traced,
            record.tx_antenna,
            config.evaluation,
        )
        self._shape = self.targets.truth.shape[2:]
        self._loss = loss or partial(self.task.loss, structural_weight=config.structural_weight)
        self.schedule = plan_rows(config, self.targets, split)
        if config.deterministic:
            # Sums over threads, and on a GPU, add in the order in which parts finish.
            init("llvm", threads=1)
        # Slots of the traced sides: all rows that train or choose.
        self._known = known
        self.graph.check(record.tx_pos_m)
        turned = record.tx_heading_rad[known] if form.headings and record.tx_heading_rad is not None else None
        self._sides = [self.graph.trace(record.tx_pos_m[known], r, turned) for r in range(len(receivers))]
        self._poses = [device_pose(r) for r in receivers]
        self._plane = perception_plane(*form.size, mi.Float)
        self._data = TrainingData(
            to_tensor(self.targets.condition), to_float(self.targets.truth), to_float(1 / self.targets.unit)
        )
        if state is None:
            self.graph.check_polarization(record.tx_pos_m[known])
            state = FitState(self._start(initial))
        self.state = state
        if state.chosen:
            self.schedule, _ = self.schedule.after(state.chosen)
        self.record_functions()
        self.seconds = 0.0

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
        """Forget recorded kernels: the number of Gaussians stands in them as a constant."""
        self._steps: dict[Any, Callable[..., Any]] = {}
        self._predictor: Predictor | None = None

    def _start(self, initial: InitialGaussians | None) -> dict[str, NDArray[np.float32]]:
        """Starting values: Gaussians, gains and levels with which each side reports what was observed, on average."""
        rng, own = np.random.default_rng([self.config.seed, 0]), self.config.initial
        values: dict[str, NDArray[np.float32]] = {}
        if self.graph.field is not None:
            seen = replace(self.record, receivers=self.graph.receivers)
            drawn = initial or initial_gaussians(own, seen, self.split.train, rng, self.graph.sphere)
            values = self.graph.field.init(drawn, rng)
        values |= self.graph.parameters(self._sides)
        for r, side in enumerate(self._sides):
            if side is not None and side.gain_name in values:
                values |= self.graph.match_gain(r, side, {}, self.targets.truth[r, self._known])
        if LEVEL in values:
            values[LEVEL][0] = [self._level(values, r) for r in range(len(self.record.receivers))]
        return values

    def _level(self, values: Mapping[str, NDArray[np.float32]], receiver: int) -> float:
        """Level at which Gaussians alone report what a receiver observed, or far below what its paths bring."""
        params = {name: to_tensor(value) for name, value in values.items()}
        if (side := self._sides[receiver]) is not None:
            return self.graph.power_level(side, params) + float(np.log(SHARE))
        rows = self.targets.received(receiver, self._known)[:AT_ONCE]
        alone, own = self.graph.report(receiver, None), self.targets.condition[:, rows]
        found = evaluated(alone, params, own, receiver, self._poses[receiver], self._plane).numpy().astype(float)
        observed = self.targets.truth[receiver, rows].astype(float)
        return self.graph.models[receiver].missing_gain(found.reshape(observed.shape), observed)

    def _step_of(self, receiver: int) -> Callable[..., Any]:
        """The recorded step of a receiver; without paths one serves all, else it is anew after a search for paths."""
        side = self._sides[receiver]
        if side is not None:
            side.refresh({name: self.state.adam[name] for name in self.state.adam})
        key = None if side is None and not self.graph.arrays(receiver, None) else (receiver, side and side.searches)
        if key not in self._steps:
            self._steps = {k: v for k, v in self._steps.items() if k is None or k[0] != receiver}
            report = self.graph.report(receiver, side)
            state = None if key is None else partial(self.graph.arrays, receiver, side)
            if state is not None:
                # What is made from NumPy's memory at first use must be there before a recording.
                params = {name: self.state.adam[name] for name in self.state.adam}
                first = self.targets.condition[:, self.targets.conditions(self._known[:1])]
                evaluated(report, params, first, receiver, self._poses[receiver], self._plane)
            ends = self._loss, self._shape, state, self.graph.evaluation
            self._steps[key] = make_step(report, self._rates(), *ends)
        return self._steps[key]

    def _rates(self) -> dict[str, float]:
        o = self.config.optimiser
        own = {
            "position": o.position,
            "log_scale": o.scale,
            "rotation": o.rotation,
            "opacity": o.opacity,
            "signal": o.signal,
            "image": 0.0,
            LEVEL: o.level,
        }
        traced = self.graph.traced
        return {
            name: traced.rate(name) if name.startswith(TRACED_NAMES) else own.get(name, o.network)
            for name in self.state.adam
        }

    def predictor(self) -> Predictor:
        """Predictions with the running mean of the parameters as it is now."""
        if self._predictor is None:
            params, own = self.state.mean_params(), self.graph
            self._predictor = Predictor(own.field, params, own.receivers, *own.form.size, self.config.skip, graph=own)
        else:
            self._predictor.update(self.state.mean)
        return self._predictor

    def validate(self) -> float:
        """Median score on the validation rows, all receivers pooled; NaN without such rows."""
        rows, record = self.split.validation, self.record
        if len(rows) == 0:
            return float("nan")
        predict = self.predictor()
        scores = [
            self.task.training_score(predict.of_rows(record, rows, r), record.observation[r, rows])
            for r in range(len(record.receivers))
        ]
        return float(np.nanmedian(np.concatenate([score.ravel() for score in scores])))

    def run(
        self,
        listen: Callable[[Progress], None] = lambda progress: None,
        save: Callable[[], None] = lambda: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Train from the current step to the last.

        Args:
            listen: hears of progress every ``log_every`` steps and at the end.
            save: called for a checkpoint, every ``checkpoint_every`` steps, when stopped and at the end.
            stop: asked after each step; True ends the run there.

        Returns:
            Whether the last step was reached.

        Raises:
            NumericsError: a loss or gradient that is not finite, raised right after that step, which was not taken:
                parameters are as before it. Or parameters or moments that are not, found before a score or checkpoint.
        """
        config, state, schedule = self.config, self.state, self.schedule
        start, before = time.perf_counter(), self.seconds
        losses, trouble = dr.zeros(mi.Float), no_trouble(state.adam)
        since = taken = 0
        while state.step < config.steps and not (taken and stop()):
            t = state.step
            receiver = int(schedule.receiver[t])
            rows = schedule.rows[t]
            state.mean, trouble, report = self._step_of(receiver)(
                state.adam,
                state.mean,
                self._data,
                mi.UInt32(rows.tolist()),
                mi.UInt32(np.searchsorted(self._known, rows // self.targets.per_row).tolist()),
                dr.opaque(mi.UInt32, receiver),
                self._poses[receiver],
                self._plane,
                dr.opaque(mi.Float, float(schedule.factor[t])),
                dr.opaque(mi.Float, float(schedule.decay[t])),
                dr.opaque(mi.UInt32, t + 1),
                trouble,
            )
            losses += report.loss
            state.urge += report.urge
            dr.eval(losses, state.urge)
            state.step, state.urge_steps, since, taken = t + 1, state.urge_steps + 1, since + 1, taken + 1
            if trouble.step[0]:  # one number, but reading it waits for the step
                self._require_finite(trouble)
            self.seconds = before + time.perf_counter() - start
            last = state.step == config.steps
            if state.step in schedule.density:
                self._adapt()
            choosing = config.patience > 0 and state.step <= schedule.joined and not state.chosen
            scored = state.step % config.validate_every == 0 or last or (choosing and state.step == schedule.joined)
            if state.step % config.log_every == 0 or scored:
                self._require_finite(trouble)
                score = self.validate() if scored else None
                self.seconds = before + time.perf_counter() - start
                left = (self.seconds - before) / taken * (config.steps - state.step)
                held_out = state.step <= schedule.joined
                told = (
                    state.step,
                    self.seconds,
                    losses[0] / since,
                    score,
                    held_out,
                    state.gaussians,
                    left,
                    self.task.label,
                )
                listen(Progress(*told))
                losses, since = dr.zeros(mi.Float), 0
                if score is not None and choosing and self._chosen(score):
                    state, schedule = self.state, self.schedule
            if state.step % config.checkpoint_every == 0 and not last:
                self._require_finite(trouble)
                save()
        dr.sync_thread()
        self.seconds = before + time.perf_counter() - start
        self._require_finite(trouble)
        save()
        return state.step == config.steps

    def _chosen(self, score: float) -> bool:
        """Keep the best moment; once no better one is waited for, go on from it. Whether the fit did."""
        state = self.state
        state.keep_best(score if self.task.higher_is_better else -score)
        if state.best is None or (state.waited < self.config.patience and state.step < self.schedule.joined):
            return False
        self.state = state.go_back()
        self.state.chosen = self.state.step
        self.schedule, self.state.step = self.schedule.after(self.state.chosen)
        self.record_functions()
        return True

    def _adapt(self) -> None:
        d, state = self.config.density, self.state
        names = self.field.per_gaussian
        params = {name: values for name, values in state.params().items() if name in names}
        receivers = np.stack([r.position_m for r in self.record.receivers])
        distance = np.linalg.norm(params["position"].T[:, None].astype(float) - receivers, axis=2).min(axis=1)
        # Its own generator for each round: a resumed run draws what an uninterrupted one would.
        rng = np.random.default_rng([self.config.seed, 2, state.step])
        change = adapt(
            params,
            state.urge.numpy() / max(1, state.urge_steps),
            distance,
            rng,
            d.grow,
            max(d.most, self.config.initial.gaussians),
            float(np.radians(d.split_deg)),
            d.least_opacity,
        )
        state.change_density(change)
        self.record_functions()
        rounds = sorted(self.schedule.density)
        if d.reset_every and "opacity" in names and (rounds.index(state.step) + 1) % d.reset_every == 0:
            state.set_param("opacity", reset_opacity(change.parameters["opacity"], d.reset_opacity))

    def _require_finite(self, trouble: Trouble) -> None:
        """Raise `NumericsError` where a step was troubled or a parameter is not finite."""
        step = int(trouble.step[0])
        # A gradient of 1e20 is finite and its square is not: Adam would never move that parameter again.
        groups = (self.state.params(), *self.state.moments()[:2])
        bad = {name for group in groups for name, values in group.items() if not np.isfinite(values).all()}
        if bad:
            where = f"step {step or self.state.step}: parameters or their moments not finite: {', '.join(sorted(bad))}"
            raise NumericsError(f"{where}; go on from the last checkpoint with lower learning rates")
        if step:
            names = ["loss", *watched_groups(self.state.adam)]
            found = ", ".join(n for n, broken in zip(names, trouble.groups.numpy(), strict=True) if broken)
            where = f"step {step}: not finite: {found}"
            raise NumericsError(f"{where}; the parameters are those before it; lower the learning rates")


def final_params(arrays: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """The parameters to predict with, from a checkpoint's arrays."""
    return {key.removeprefix("mean/"): values for key, values in arrays.items() if key.startswith("mean/")}
