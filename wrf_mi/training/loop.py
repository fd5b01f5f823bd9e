"""The training loop of every model that is trained by gradients (Gaussians, paths, networks), and its state."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import NDArray

from ..backend.device import to_float, to_tensor
from ..core.array_files import keyed, under
from ..core.files import listed
from ..core.stored import Arrays
from ..gaussians.initial import DensityChange
from .adam import NonFiniteReport, NumericsError, Schedule, watched_groups
from .config import LoopConfig

VIEW_GRADIENT = ("view_gradient_norm", "view_gradient_steps")
OF_FIT = ("best_scores", "held_out")  # belong to a fit, not to one of its states
KEPT = ("step", "chosen", *VIEW_GRADIENT, "reach_m", "searched_m", "phase_error", *OF_FIT)
"""Attributes that a checkpoint stores under their names."""


class FitState:
    """Parameters under optimisation, from starting values; ``momentum``: Adam's decay of the first moment."""

    def __init__(self, params: Mapping[str, NDArray[np.float32]], momentum: float = 0.9) -> None:
        self.adam = Adam(lr=0.0, beta_1=momentum)  # owns the current parameters
        self.adam.update({name: to_tensor(values) for name, values in params.items()})
        # Running mean of the parameters, used for evaluation.
        self.mean = {name: to_tensor(values) for name, values in params.items()}
        self.step = 0  # steps taken
        self.chosen = 0  # step from which the fit went on (`LoopConfig.patience`); 0: none was chosen
        self.reach_m = float(np.inf)  # reach of the Gaussians around training transmitters (`Reach`)
        self.searched_m = np.zeros((0, 3))  # position of each receiver at the last search for paths; empty: no scene
        self.phase_error = 0.0  # standard deviation of a reflection's phase in predictions, rad, once chosen
        self.best_scores = np.zeros(0)  # scores of the held-out rows by the best state
        self.held_out = np.zeros(0)  # predictions of the held-out rows by the chosen state
        self.best: Arrays | None = None  # arrays of the state with the best validation score
        self.best_score = -np.inf  # its score, the higher the better; kept once the fit went on from it
        self.waited = 0  # number of scores since then
        self._reset_view_gradient()

    @property
    def gaussians(self) -> int:
        """Number of Gaussians; 0 where paths are trained alone."""
        return int(self.adam["position"].shape[1]) if "position" in self.adam else 0

    def _reset_view_gradient(self) -> None:
        # Sum since the last round of density control of each Gaussian's directional gradient, [n], and its steps.
        self.view_gradient_norm, self.view_gradient_steps = dr.zeros(mi.Float, max(self.gaussians, 1)), 0
        dr.make_opaque(self.view_gradient_norm)  # a literal would be recorded as a constant

    def params(self) -> Arrays:
        """Current parameters."""
        return {name: dr.detach(self.adam[name]).numpy().copy() for name in self.adam}

    def mean_params(self) -> Arrays:
        """Running mean of the parameters."""
        return {name: self.mean[name].numpy().copy() for name in self.mean}

    def moments(self) -> tuple[Arrays, Arrays, int]:
        """Adam's first and second moments in the parameters' shapes, and its step count."""
        first, second, count = {}, {}, 0
        for name, (value, _, _, (t, m, v, _)) in self.adam.state.items():
            first[name], second[name] = (a.numpy().copy().reshape(value.shape) for a in (m, v))
            count = int(t[0])
        return first, second, count

    def _set_moments(self, first: Arrays, second: Arrays, count: int) -> None:
        # The step count is opaque: as a number it would be a constant of recorded kernels.
        for name, (value, promoted, rate, _) in list(self.adam.state.items()):
            moments = (to_float(first[name]), to_float(second[name]))
            self.adam.state[name] = (value, promoted, rate, (dr.opaque(mi.UInt32, count), *moments, None))

    def change_density(self, change: DensityChange) -> None:
        """Replace the set of Gaussians; fresh Gaussians start without momentum, new values without a past mean."""
        # Dr.Jit's Adam has no rows to add or drop: moments are taken out, changed in NumPy and put back.
        first, second, count = self.moments()
        before, mean = self.params(), self.mean_params()
        for name, values in change.parameters.items():
            fresh = np.broadcast_to(change.fresh, values.shape)
            first[name] = np.where(fresh, 0, first[name][:, change.source]).astype(np.float32)
            second[name] = np.where(fresh, 0, second[name][:, change.source]).astype(np.float32)
            # The original of a clone has a new opacity, for which the old mean does not hold.
            new = fresh | (values != before[name][:, change.source])
            mean[name] = np.where(new, values, mean[name][:, change.source]).astype(np.float32)
            self.adam[name] = to_tensor(values)
        self.mean = {name: to_tensor(values) for name, values in mean.items()}
        self._set_moments(first, second, count)
        self._reset_view_gradient()

    def set_param(self, name: str, values: NDArray[np.float32]) -> None:
        """Set one parameter and reset its momentum (opacity reset)."""
        first, second, count = self.moments()
        self.adam[name] = to_tensor(values)
        nothing = {name: np.zeros_like(values)}
        self._set_moments(first | nothing, second | nothing, count)

    def keep_best(self, score: float) -> None:
        """Keep the state if its score is the best so far."""
        self.waited += 1
        if score > self.best_score:
            self.best, self.best_score, self.waited = self._now(), score, 0

    def go_back(self) -> FitState:
        """The best state, with its score."""
        if self.best is None:
            return self
        of_fit = {name: np.asarray(getattr(self, name)) for name in OF_FIT}
        return FitState.from_arrays(self.best | of_fit | {"best_score": np.asarray(self.best_score)}, self.adam.beta_1)

    def restarted(self) -> FitState:
        """The start of another training, with the scores of this state."""
        # Moments of this training would push the first steps of the other one where the loss of this one fell.
        params = self.params()
        state, nothing = FitState(params, self.adam.beta_1), {name: np.zeros_like(v) for name, v in params.items()}
        state.mean = {name: to_tensor(values) for name, values in self.mean_params().items()}
        state.reach_m, state.searched_m, state.best_scores = self.reach_m, self.searched_m, self.best_scores
        state._set_moments(nothing, nothing, 0)
        return state

    def arrays(self) -> Arrays:
        """All arrays, for a checkpoint."""
        best = {"best_score": np.asarray(self.best_score), "waited": np.asarray(self.waited)}
        return self._now() | best | keyed("best/", self.best or {})

    def _now(self) -> Arrays:
        """All arrays without the best state."""
        first, second, count = self.moments()
        groups = {"param": self.params(), "mean": self.mean_params(), "first": first, "second": second}
        flat: Arrays = {}
        for group, arrays in groups.items():
            flat |= keyed(f"{group}/", arrays)
        attributes = {name: np.array(getattr(self, name)) for name in KEPT}
        return flat | attributes | {"adam_step": np.asarray(count)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], momentum: float = 0.9) -> FitState:
        """State from the arrays of a checkpoint, with Adam's decay of the first moment."""
        state = cls(under("param/", arrays), momentum)
        state.mean = {name: to_tensor(values) for name, values in under("mean/", arrays).items()}
        state._set_moments(under("first/", arrays), under("second/", arrays), int(arrays["adam_step"]))
        for name in KEPT:
            setattr(state, name, np.array(arrays[name]) if np.ndim(arrays[name]) else arrays[name].item())
        state.view_gradient_norm = to_float(arrays["view_gradient_norm"])
        state.best = under("best/", arrays) or None
        state.best_score, state.waited = float(arrays["best_score"]), int(arrays.get("waited", 0))
        return state


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
    validation_rows: int = 0  # number of rows that are scored; 0: not stated
    # Median distance in metres of these from the nearest row that trains now, and of the test rows from the nearest row
    # that trains at all; None: unknown. Scores of rows near training rows say nothing of test rows far from any.
    validation_m: float | None = None
    test_m: float | None = None
    far_score: float | None = None  # median over those at least as far as half of the test rows; None: there are none
    far_rows: int = 0  # number of these


class TrainingLoop(ABC):
    """Steps of Adam, with validation, early stopping, progress and checkpoints."""

    config: LoopConfig  # settings of the loop
    schedule: Schedule  # rows and learning rates of each step
    state: FitState  # state between two steps
    until_chosen: bool = False  # whether steps end once a state is chosen, before the validation rows train
    seconds: float = 0.0  # training time so far, resumed runs included
    _origin_s: float  # reading of the clock at which ``seconds`` would have been 0
    label: str  # name of the validation score
    higher_is_better: bool  # direction of the validation score

    @abstractmethod
    def take_step(self, non_finite: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """Take the step after ``state.step`` steps; returns the loss before it and the report after it."""

    @abstractmethod
    def validate(self) -> float:
        """Score of the running mean of the parameters on the validation rows; NaN without such rows."""

    def validation_facts(self) -> dict[str, Any]:
        """Fields of `Progress` on the rows that `validate` scored last; empty where they are not known."""
        return {}

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
        """Train from the current step to the last, or until a state is chosen; whether that was reached.

        Args:
            on_progress: called every ``log_every`` steps and at the end.
            save: writes a checkpoint; called every ``checkpoint_every`` steps, when stopped and at the end.
            stop: stop condition, called after each step but the last.

        Raises:
            NumericsError: a loss or gradient is not finite, raised right after that step, which leaves the parameters
                unchanged; or parameters or moments are not finite, found before a score or checkpoint.
        """
        self.begin()
        self._origin_s = time.perf_counter() - self.seconds
        non_finite = self._run_session(on_progress, save, stop)
        dr.sync_thread()
        self.seconds = time.perf_counter() - self._origin_s
        self._require_finite(non_finite)
        save()
        return self._is_over

    @property
    def _is_over(self) -> bool:
        step = self.state.step
        ends = self.until_chosen and (self.state.chosen > 0 or step >= self.schedule.joined)
        return step == self.config.steps or ends

    def _run_session(
        self, on_progress: Callable[[Progress], None], save: Callable[[], None], stop: Callable[[], bool]
    ) -> NonFiniteReport:
        """Steps to the last or until stopped (`run`); returns the report after them."""
        config, before_s, non_finite = self.config, self.seconds, NonFiniteReport.none(self.state.adam)
        losses, logged, steps = dr.zeros(mi.Float), 0, 0  # steps since the last line of the log, and in this sitting
        while not self._is_over and not (steps and stop()):
            losses, non_finite = self._next(losses, non_finite)
            logged, steps, last = logged + 1, steps + 1, self.state.step == config.steps
            self.seconds = time.perf_counter() - self._origin_s
            scored, choosing = self._due()
            if scored or self.state.step % config.log_every == 0:
                self._require_finite(non_finite)
                progress = self._progress(losses[0] / logged, steps, before_s, scored)
                on_progress(progress)
                losses, logged = dr.zeros(mi.Float), 0
                if choosing and progress.validation_score is not None:
                    self.choose(progress.validation_score)
            if self.state.step % config.checkpoint_every == 0 and not last:
                self._require_finite(non_finite)
                save()
        return non_finite

    def _next(self, losses: Any, non_finite: NonFiniteReport) -> tuple[Any, NonFiniteReport]:
        """Take a step, and a round of density control where one is due; returns the sum of losses and the report."""
        loss, non_finite = self.take_step(non_finite)
        # Summed on the device: a loss that is read waits for its step, and the next one could not be queued.
        losses += loss
        dr.eval(losses)
        self.state.step += 1
        if non_finite.step[0]:  # one number, but reading it waits for the step
            self._require_finite(non_finite)
        if self.state.step in self.schedule.density:
            self.adapt()
        return losses, non_finite

    def _due(self) -> tuple[bool, bool]:
        """Whether the state is scored at this step, and whether its score may choose it."""
        step, joined = self.state.step, self.schedule.joined
        choosing = self.config.patience > 0 and step <= joined and not self.state.chosen
        # The last state before validation rows join counts, too, wherever it falls between two scores.
        at_end = step == self.config.steps or (choosing and step == joined)
        return at_end or step % self.config.validate_every == 0, choosing

    def _progress(self, loss: float, steps: int, before_s: float, scored: bool) -> Progress:
        """Progress with the mean loss since the last line, after so many steps in a sitting that began at a time."""
        state, score = self.state, self.validate() if scored else None
        self.seconds = time.perf_counter() - self._origin_s
        left_s = (self.seconds - before_s) / steps * (self.config.steps - state.step)
        of_state = state.step <= self.schedule.joined, state.gaussians
        facts = {} if score is None else self.validation_facts()
        return Progress(state.step, self.seconds, loss, score, *of_state, left_s, self.label, **facts)

    def choose(self, score: float) -> bool:
        """Keep the best state; without improvement for ``patience`` scores go on from it. True: the fit went back."""
        state = self.state
        state.keep_best(score if self.higher_is_better else -score)
        if state.best is None or (state.waited < self.config.patience and state.step < self.schedule.joined):
            return False
        self.choose_best()
        return True

    def choose_best(self) -> None:
        """Go on from the best state: steps that follow train on the validation rows, too."""
        # As many as led to the best state, in proportion.
        self.state = self.state.go_back()
        self.state.chosen = max(self.state.step, 1)  # 0 means that none is
        self.schedule, self.state.step = self.schedule.after(self.state.chosen)
        self.record_functions()

    def _require_finite(self, non_finite: NonFiniteReport) -> None:
        """Raise `NumericsError` after a step without finite values, or with parameters that are not finite."""
        step = int(non_finite.step[0])
        # A gradient of 1e20 is finite and its square is not: Adam would never move that parameter again.
        groups = (self.state.params(), *self.state.moments()[:2])
        bad = {name for group in groups for name, values in group.items() if not np.isfinite(values).all()}
        if bad:
            where = f"step {step or self.state.step}: parameters or their moments not finite: {listed(sorted(bad))}"
            raise NumericsError(f"{where}; go on from the last checkpoint with lower learning rates")
        if step:
            names = np.array(["loss", *watched_groups(self.state.adam)])[non_finite.groups.numpy() > 0]
            where = f"step {step}: not finite: {listed(names)}"
            raise NumericsError(f"{where}; the parameters are those before it; lower the learning rates")
