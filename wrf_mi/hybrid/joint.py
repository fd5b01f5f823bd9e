"""One fit of both sides: one graph, one loss, one optimiser."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from numpy.typing import ArrayLike, NDArray

from ..backend.device import on_device, to_tensor
from ..core import Receiver
from ..core.angles import FloatArray
from ..core.receivers import receiver_index
from ..field import InitialGaussians
from ..field.recorded import Recorded
from ..loss.known import absolute_error as known_error
from ..splat.tiles import perception_plane
from .combine import ArrayReceiver, CsiReceiver, PixelReceiver
from .learned import Field, learned_field
from .materials import physical
from .pose import pose_parameters, receiver_pose
from .traced import TracedField

Model = PixelReceiver | CsiReceiver
Loss = Callable[..., Any]
"""``loss(prediction, truth, batch, *shape)`` of flat arrays, a Dr.Jit float of one value; `spectrum_loss` is one.

It is recorded once and replayed: what it makes of NumPy arrays it makes before, and what it counts in Python stays as
it is.
"""

FIELD = "field."
MATCHING = 3
"""Passes of `JointFit.match_gain`: in the first, magnitudes may be below the receiver's floor."""
RATES: Mapping[str, float] = {
    "material.*": 0.05,
    "plane.shift": 0.002,
    "plane.tilt": 0.001,
    "receiver.*.gain": 0.02,
    "receiver.*.pattern": 0.01,
    "pattern.*": 0.01,
    "field.position": 0.005,
    "field.log_scale": 0.005,
    "field.rotation": 0.002,
    "field.opacity": 0.02,
    "field.signal": 0.01,
    "field.*": 0.001,
}
"""Learning rates by pattern of names; the first that fits counts. A pose is held unless a rate is given for it."""


def absolute_error(prediction: Any, truth: Any, batch: int, *shape: int) -> Any:
    """Mean absolute difference over what was received (truth not NaN)."""
    return known_error(prediction, truth)


@dataclass(frozen=True)
class View:
    """One receiver of a joint fit.

    Attributes:
        receiver: stated pose.
        model: how it reports.
        observation: [n, *shape of a report], NaN where nothing was received; complex for a CSI receiver.
        traced: the traced side to this receiver, or None.
    """

    receiver: Receiver
    model: Model
    observation: NDArray[Any]
    traced: TracedField | None = None


class JointFit:
    """Materials, antennas, poses and Gaussians fitted together by Adam, each parameter at its own rate.

    Args:
        tx_pos_m: transmitters [n, 3], world frame, metres.
        views: one for each receiver; they share materials, patterns and the learned field.
        field: the learned side, or None for the traced one alone.
        initial: starting Gaussians; needed with a field.
        rates: learning rates by pattern of names (`fnmatch`), before those of `RATES`; 0 holds a parameter.
        loss: see `Loss`.
        batch: transmitters of a step; None: all.
        seed: of the field's starting values and of the batches.

    Attributes:
        adam: Dr.Jit's optimiser, which owns the parameters; ``fixed`` are those at rate 0.
        losses: of each step so far, before the step.

    Raises:
        ValueError: shapes that do not belong together, nothing to fit, or a rate's pattern that fits no parameter.
    """

    def __init__(
        self,
        tx_pos_m: ArrayLike,
        views: Sequence[View],
        field: Field | None = None,
        initial: InitialGaussians | None = None,
        *,
        rates: Mapping[str, float] | None = None,
        loss: Loss = absolute_error,
        batch: int | None = None,
        seed: int = 0,
    ) -> None:
        self.tx_pos_m: FloatArray = np.atleast_2d(np.asarray(tx_pos_m, float))
        self.views, self.field, self._loss = tuple(views), field, loss
        for view in self.views:
            _check(view, self.tx_pos_m)
        if not self.views or (field is None and any(view.traced is None for view in self.views)):
            raise ValueError("JointFit: no view, or one with neither a traced nor a learned side")
        if field is not None and initial is None:
            raise ValueError("JointFit: a learned field needs initial Gaussians")
        self._rng = np.random.default_rng([seed, 1])
        values: dict[str, NDArray[np.float32]] = {}
        for view in self.views:
            values |= pose_parameters(view.receiver) if view.traced is None else view.traced.parameters()
        if field is not None and initial is not None:
            start = field.init(initial, np.random.default_rng([seed, 0]))
            values |= {FIELD + name: value for name, value in start.items()}
        self.rates = _rates(values, rates or {})
        self.adam = Adam(lr=0.0)
        self.adam.update({name: to_tensor(value) for name, value in values.items() if self.rates[name] > 0})
        self.fixed = {name: to_tensor(value) for name, value in values.items() if self.rates[name] == 0}
        self.batch = len(self.tx_pos_m) if batch is None else min(batch, len(self.tx_pos_m))
        self.losses: list[float] = []
        self._truth = [_flat(view.observation) for view in self.views]
        self._order = np.zeros(0, int)
        self._steps: dict[int, tuple[Any, Recorded]] = {}

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters by name, as Dr.Jit tensors; those that are fitted carry gradients."""
        return {**self.fixed, **dict(self.adam.items())}

    @property
    def recordings(self) -> int:
        """How often the present steps were traced: once or twice for each view; a search for paths begins anew."""
        return sum(step.n_recordings for _, step in self._steps.values())

    def values(self) -> dict[str, NDArray[np.float32]]:
        """All parameters by name, as NumPy arrays."""
        return {name: dr.detach(value).numpy().copy() for name, value in self.parameters.items()}

    def set_values(self, values: Mapping[str, ArrayLike]) -> None:
        """Set parameters by name, from `values` of a fit of the same form; Adam forgets its moments of those.

        Raises:
            ValueError: a name or shape that this fit has not.
        """
        present = self.parameters
        for name, value in values.items():
            if name not in present or np.shape(value) != present[name].shape:
                raise ValueError(f"set_values: {name} {np.shape(value)} is not a parameter of this fit")
        for name, value in values.items():
            if name in self.adam:
                self.adam[name] = to_tensor(value)
            else:
                self.fixed[name] = to_tensor(value)

    def match_gain(self) -> None:
        """Set each instrument's gain so that the traced side alone reports what was observed, on average.

        The mean over all rows: of magnitudes, of dB, of powers of complex channels; for spectra that the instrument
        scales to 0..1, so that unscaled ones peak at 1.
        """
        for view in self.views:
            if view.traced is None:
                continue
            name = view.traced.gain_name
            for _ in range(MATCHING):
                change = np.array([missing_gain(view, view.traced, self.parameters), 0], np.float32)
                self.set_values({name: self.values()[name] + change})

    def materials(self) -> dict[str, float]:
        """Relative permittivities and conductivities (S/m), by parameter name."""
        return physical(self.values())

    def step(self, factor: float = 1.0) -> float:
        """One step on the next batch, receivers in turn.

        Args:
            factor: multiplies all learning rates.

        Returns:
            The loss before the step.

        Raises:
            FloatingPointError: the loss or a gradient is not finite; the parameters are as before.
        """
        number = len(self.losses) % len(self.views)
        view, rows = self.views[number], self._next_rows()
        if view.traced is not None:
            view.traced.refresh(self.parameters)
        positions, device_rows = self._on_device(self.tx_pos_m[rows]), on_device(rows, mi.UInt32)
        take = self._recorded_step(number, positions, device_rows)
        share = dr.opaque(mi.Float, float(factor))
        loss, finite = take(self.adam, self.fixed, self._truth[number], positions, device_rows, share)
        if not finite[0]:
            raise FloatingPointError(f"step {len(self.losses)}: loss or gradient not finite; lower the learning rates")
        self.losses.append(float(loss[0]))
        return self.losses[-1]

    def _recorded_step(self, number: int, positions: Any, rows: Any) -> Callable[..., Any]:
        """The step of one view, recorded: anew after a search for paths, whose number and places stand in it."""
        view = self.views[number]
        key = (self._loss, 0 if view.traced is None else view.traced.searches)
        if number in self._steps and self._steps[number][0] == key:
            return self._steps[number][1]
        with dr.suspend_grad():
            # What is made from NumPy's memory at first use must be there before a recording begins.
            dr.eval(self._report(view, self.parameters, rows, positions, view.traced))
        loss_of, rates = self._loss, self.rates

        def read() -> list[Any]:
            plane = perception_plane(view.model.height, view.model.width, mi.Float)
            traced = [] if view.traced is None else view.traced.arrays
            return [plane, view.model.arrays(mi.Float), traced]

        def step(adam: Adam, fixed: Any, truth: Any, positions: Any, rows: Any, factor: Any) -> tuple[Any, Any]:
            # A rate of its own for each parameter: Adam multiplies a shared array in place, once a parameter.
            adam.set_learning_rate({name: factor * rates[name] for name in adam})
            parameters = {**fixed, **dict(adam.items())}
            batch = dr.width(rows)
            prediction = self._report(view, parameters, rows, positions, view.traced)
            loss = loss_of(prediction, _rows_of(truth, rows, len(self.tx_pos_m)), batch, *view.model.shape)
            dr.backward(loss)
            health = dr.detach(loss)
            for name in adam:
                health = health + dr.sum(dr.abs(dr.grad(parameters[name]).array))
            finite = dr.isfinite(health)
            adam.step(eval=False, active=finite)
            loss = dr.detach(loss)
            dr.eval(adam, loss, finite)
            return loss, finite

        self._steps[number] = key, Recorded(step, read)
        return self._steps[number][1]

    def run(self, steps: int, final_factor: float = 1.0, listen: Callable[[int, float], None] | None = None) -> float:
        """Take steps; learning rates fall geometrically to ``final_factor`` of theirs.

        Args:
            steps: how many.
            final_factor: of the learning rates at the end.
            listen: hears of each step's number and loss.

        Returns:
            Mean loss of the last tenth of the steps.

        Raises:
            FloatingPointError: see `step`.
        """
        for i in range(steps):
            loss = self.step(final_factor ** (i / max(steps - 1, 1)))
            if listen is not None:
                listen(len(self.losses), loss)
        last = self.losses[len(self.losses) - max(steps // 10, 1) :]
        return float(np.mean(last)) if steps else float("nan")

    def predict(self, tx_pos_m: ArrayLike | None = None, view: int | str = 0) -> NDArray[np.float64]:
        """What a receiver reports, [n, *shape], with the present parameters.

        Args:
            tx_pos_m: transmitters [n, 3], metres; None: those of the fit.
            view: name of the receiver, or its number from 0.

        Raises:
            InputError: no such receiver.
        """
        own, parameters = self._view(view), self.parameters
        positions = self.tx_pos_m if tx_pos_m is None else np.atleast_2d(np.asarray(tx_pos_m, float))
        traced = own.traced
        with dr.suspend_grad():
            if traced is not None:
                traced = traced if tx_pos_m is None else traced.at(positions)
                traced.refresh(parameters)
            rows = on_device(np.arange(len(positions)), mi.UInt32)
            report = self._report(own, parameters, rows, self._on_device(positions), traced)
            return np.asarray(report.numpy(), float).reshape(len(positions), *own.model.shape)

    def learned(self, tx_pos_m: ArrayLike | None = None, view: int | str = 0) -> NDArray[np.complex128]:
        """The learned signal R on the receiver's directions, [n, directions] (see `learned_field`).

        Raises:
            InputError: no such receiver.
            ValueError: no learned side.
        """
        own = self._view(view)
        positions = self.tx_pos_m if tx_pos_m is None else np.atleast_2d(np.asarray(tx_pos_m, float))
        with dr.suspend_grad():
            signal = self._learned(own, self.parameters, self._on_device(positions))
        if signal is None:
            raise ValueError("learned: this fit has no learned side")
        return (signal[0].numpy() + 1j * signal[1].numpy().astype(float)).reshape(len(positions), -1)

    def _view(self, view: int | str) -> View:
        return self.views[receiver_index([one.receiver for one in self.views], view)]

    @staticmethod
    def _on_device(tx_pos_m: FloatArray) -> Any:
        """Positions [n, 3] as the tensor [3, n] that fields take."""
        return to_tensor(np.ascontiguousarray(tx_pos_m.T))

    def _learned(self, view: View, parameters: Mapping[str, Any], positions: Any) -> Any:
        if self.field is None:
            return None
        own = {name.removeprefix(FIELD): value for name, value in parameters.items() if name.startswith(FIELD)}
        gaussians = self.field.gaussians(own, positions)
        plane = perception_plane(view.model.height, view.model.width, mi.Float)
        return learned_field(gaussians, receiver_pose(view.receiver, parameters, mi.Float), plane, view.model.sphere)

    def _report(
        self, view: View, parameters: Mapping[str, Any], rows: Any, positions: Any, traced: TracedField | None
    ) -> Any:
        paths = None if traced is None else traced(parameters, rows)
        return view.model(paths, self._learned(view, parameters, positions))

    def _next_rows(self) -> NDArray[np.int64]:
        """The next batch: every row once before any comes again."""
        if self.batch == len(self.tx_pos_m):
            return np.arange(self.batch)
        if len(self._order) < self.batch:
            self._order = np.concatenate([self._order, self._rng.permutation(len(self.tx_pos_m))])
        rows, self._order = self._order[: self.batch], self._order[self.batch :]
        return rows


def _rows_of(values: Any, rows: Any, count: int) -> Any:
    """Some of ``count`` equal parts of a flat array, behind each other."""
    size = dr.width(values) // count
    lane = dr.arange(mi.UInt32, dr.width(rows) * size)
    row = dr.gather(mi.UInt32, rows, lane // size)
    return dr.gather(type(values), values, row * size + lane % size)


def _check(view: View, tx_pos_m: FloatArray) -> None:
    given, asked = np.shape(view.observation), (len(tx_pos_m), *view.model.shape)
    complex_given = np.iscomplexobj(view.observation)
    if (*given, 2) != asked if complex_given else given != asked:
        raise ValueError(f"JointFit: observation of {view.receiver.name} has shape {given}, the model reports {asked}")
    if view.traced is not None and not np.array_equal(view.traced.tx_pos_m, tx_pos_m):
        raise ValueError(f"JointFit: the traced side of {view.receiver.name} has other transmitters than the fit")


def missing_gain(view: View, traced: TracedField, parameters: Mapping[str, Any]) -> float:
    """Logarithm of the amplitude that the traced side lacks."""
    model = view.model
    alone = model.unscaled if isinstance(model, ArrayReceiver) else model
    with dr.suspend_grad():
        report = alone(traced(parameters), None).numpy()
    return model.missing_gain(report, np.asarray(_pairs(view.observation), float))


def _rates(values: Mapping[str, Any], asked: Mapping[str, float]) -> dict[str, float]:
    """Rate of each parameter by the first pattern that fits, those asked for before `RATES`; else 0."""
    idle = [pattern for pattern in asked if not any(fnmatchcase(name, pattern) for name in values)]
    if idle:
        raise ValueError(f"JointFit: rate for {', '.join(idle)}, but the parameters are {', '.join(values)}")
    patterns = [*asked.items(), *RATES.items()]
    return {name: next((rate for p, rate in patterns if fnmatchcase(name, p)), 0.0) for name in values}


def _pairs(values: NDArray[Any]) -> NDArray[Any]:
    """Complex values as real and imaginary part in turn."""
    array = np.ascontiguousarray(values)
    return np.stack([array.real, array.imag], axis=-1) if np.iscomplexobj(array) else array


def _flat(values: NDArray[Any]) -> Any:
    """All values in a row on the device; complex ones as real and imaginary part in turn."""
    return to_tensor(_pairs(values)).array
