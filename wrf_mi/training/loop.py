"""The training loop of every model that is trained by gradients: Gaussians, paths of a scene, both, and networks."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .adam import NonFiniteReport, NumericsError, Schedule, watched_groups
from .config import LoopConfig
from .state import FitState


@dataclass(frozen=True)
class Progress:
    """Progress at a log line."""

    step: int  # steps taken
    seconds: float  # training time so far, resumed runs included
    loss: float  # mean over the steps since the last line
    validation_score: float | None  # median on the validation rows, where it was just computed
    held_out: bool  # whether the validation rows are still kept out of training
    gaussians: int  # number of Gaussians; 0 without a field
    left_s: float  # estimated seconds to the end
    label: str = "SSIM"  # name of the score


class TrainingLoop(ABC):
    """Steps of Adam, with validation, early stopping, progress and checkpoints."""

    config: LoopConfig  # settings of the loop
    schedule: Schedule  # rows and learning rates of each step
    state: FitState  # state between two steps
    seconds: float = 0.0  # training time so far, resumed runs included
    label: str  # name of the validation score
    higher_is_better: bool  # direction of the validation score

    @abstractmethod
    def take_step(self, trouble: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """Take the step after ``state.step`` steps; returns the loss before it and the report after it."""

    @abstractmethod
    def validate(self) -> float:
        """Score of the running mean of the parameters on the validation rows; NaN without such rows."""

    @abstractmethod
    def record_functions(self) -> None:
        """Discard recorded kernels, which are valid for the former state only."""

    def begin(self) -> None:  # noqa: B027 - most fits have nothing to prepare
        """Prepare the first or the next sitting, before its first step."""

    def adapt(self) -> None:
        """Run a round of density control, after a step of ``schedule.density``."""
        raise NotImplementedError("no density control without Gaussians")

    def run(
        self,
        on_progress: Callable[[Progress], None] = lambda progress: None,
        save: Callable[[], None] = lambda: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Train from the current step to the last.

        Args:
            on_progress: called every ``log_every`` steps and at the end.
            save: writes a checkpoint; called every ``checkpoint_every`` steps, when stopped and at the end.
            stop: stop condition, called after each step.

        Returns:
            Whether the last step was reached.

        Raises:
            NumericsError: a loss or gradient is not finite, raised right after that step, which leaves the parameters
                unchanged; or parameters or moments are not finite, found before a score or checkpoint.
        """
        self.begin()
        config, state, schedule = self.config, self.state, self.schedule
        start, before = time.perf_counter(), self.seconds
        losses, trouble = dr.zeros(mi.Float), NonFiniteReport.none(state.adam)
        logged = steps = 0  # steps since the last line of the log, and in this sitting
        while state.step < config.steps and not (steps and stop()):
            loss, trouble = self.take_step(trouble)
            # Summed on the device: a loss that is read waits for its step, and the next one could not be queued.
            losses += loss
            dr.eval(losses)
            state = self.state
            state.step, logged, steps = state.step + 1, logged + 1, steps + 1
            if trouble.step[0]:  # one number, but reading it waits for the step
                self._require_finite(trouble)
            self.seconds = before + time.perf_counter() - start
            last = state.step == config.steps
            if state.step in schedule.density:
                self.adapt()
            # No state of the first stage is chosen before its end: paths converge within it, and a score costs a
            # prediction of all held-out rows.
            judged = state.step >= min(schedule.stages, default=0)
            choosing = config.patience > 0 and judged and state.step <= schedule.joined and not state.chosen
            scored = (state.step % config.validate_every == 0 and judged) or last
            # The last state of a stage counts, too, wherever its end falls between two scores.
            scored = scored or (choosing and state.step in (*schedule.stages, schedule.joined))
            if state.step % config.log_every == 0 or scored:
                self._require_finite(trouble)
                score = self.validate() if scored else None
                self.seconds = before + time.perf_counter() - start
                left = (self.seconds - before) / steps * (config.steps - state.step)
                held_out = state.step <= schedule.joined
                loss = losses[0] / logged
                on_progress(
                    Progress(state.step, self.seconds, loss, score, held_out, state.gaussians, left, self.label)
                )
                losses, logged = dr.zeros(mi.Float), 0
                if score is not None and choosing and self.choose(score):
                    state, schedule = self.state, self.schedule
            if state.step % config.checkpoint_every == 0 and not last:
                self._require_finite(trouble)
                save()
        dr.sync_thread()
        self.seconds = before + time.perf_counter() - start
        self._require_finite(trouble)
        save()
        return state.step == config.steps

    def choose(self, score: float) -> bool:
        """Keep the best state; without improvement for ``patience`` scores go on from it. True: the fit went back."""
        state = self.state
        state.keep_best(score if self.higher_is_better else -score)
        if state.best is None or (state.waited < self.config.patience and state.step < self.schedule.joined):
            return False
        # The steps that follow train on the validation rows, too, as many as led to the best state, in proportion.
        self.state = state.go_back()
        self.state.chosen = max(self.state.step, 1)  # 0 means that none is
        self.schedule, self.state.step = self.schedule.after(self.state.chosen)
        self.record_functions()
        return True

    def _require_finite(self, trouble: NonFiniteReport) -> None:
        """Raise `NumericsError` after a step without finite values, or with parameters that are not finite."""
        step = int(trouble.step[0])
        # A gradient of 1e20 is finite and its square is not: Adam would never move that parameter again.
        groups = (self.state.params(), *self.state.moments()[:2])
        bad = {name for group in groups for name, values in group.items() if not np.isfinite(values).all()}
        if bad:
            where = f"step {step or self.state.step}: parameters or their moments not finite: {', '.join(sorted(bad))}"
            raise NumericsError(f"{where}; go on from the last checkpoint with lower learning rates")
        if step:
            names = ["loss", *watched_groups(self.state.adam)]
            broken = ", ".join(n for n, flag in zip(names, trouble.groups.numpy(), strict=True) if flag)
            where = f"step {step}: not finite: {broken}"
            raise NumericsError(f"{where}; the parameters are those before it; lower the learning rates")
