"""Differentiable graph of traced paths, Gaussians (splatted or traced) and receivers, which observe both components.

    tx position or uplink ─► Gaussians ─ splat or trace ─► L(u) ─┐
                                                                 ├─► receiver model ─► spectrum, dBm, channel
    tx position ─► chains of planes ─► T ────────────────────────┘

A *port* is a receiver at a carrier: rows of several carriers have as many ports of each receiver, which share its
parameters; other data have one.

Every argument that training changes is a parameter by name: those of the field (`wrf_mi.gaussians`), ``level``, the
logarithm of the unit in which each receiver sees the learned component, and of the traced component ``material.*``,
``receiver.*``, ``pattern.*`` (`wrf_mi.tracing.paths.traced_field.TracedField`) and ``surface.*``
(`wrf_mi.tracing.paths.surface_gaussians`). Without a scene Sionna RT is not imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.device import to_uint
from ..backend.vectors import Complex, Pose
from ..core import Antenna, InputError, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..gaussians import Factorised, WithAttributes, WrfGs, WrfGsPlus
from ..gaussians.parameters import by_component, gaussians_in_parts
from ..gaussians.tiles import TiledPlane
from ..receivers.device_paths import TracedPaths, draws_on_device, expected_observation, spread
from ..receivers.registry import RECEIVERS, ObservationSpec
from ..tracing.options import FACTOR
from ..tracing.paths.instrument_parameters import receiver_pose
from ..tracing.paths.solve import Prepared
from ..tracing.paths.surface_gaussians import Interactions, SurfaceGaussians
from ..tracing.paths.traced_field import TracedField, TracedOptions, trace_fields
from ..tracing.tracer import check_polarization
from .evaluations import Evaluation, evaluation_named
from .settings import DEFAULT, SPLATTED, TracedConfig

Field = WrfGs | WrfGsPlus | Factorised | WithAttributes
LEVEL = "level"  # parameter [1, n_rx] of the learned component: logarithm of each receiver's unit of amplitude
SHARE = 0.1  # initial learned amplitude relative to the amplitude of the paths
MATCHING = 3  # passes of `Graph.match_gain`: in the first, magnitudes may be below the receiver's floor
MATCHED = 256  # most transmitters whose observations it compares


@dataclass
class Batch:
    """A batch of transmitters and their receiver, on the device."""

    condition: Any  # positions [3, batch], metres, or features [features, batch] in their place
    slots: Any  # rows of the traced field [batch]
    receiver: Any  # number of the receiver, from 0
    pose: Pose  # pose of the receiver
    plane: TiledPlane  # directions of the learned signal
    weight: Any | None = None  # factor of the learned signal [batch], 0 to 1; None: 1
    carrier: Any | None = None  # logarithm of the carrier over the middle one; None: rows have a single carrier
    signal: Complex | None = None  # learned signal without its unit (`Graph.learned`); None: it is evaluated

    @property
    def inputs(self) -> Any:
        """Conditions [3 or features, batch] with the carrier, if rows have several, as the last row."""
        if self.carrier is None:
            return self.condition
        values, (count, width) = self.condition.array, self.condition.shape
        joint = dr.concat([values, dr.repeat(type(values)(self.carrier), width)])
        return type(self.condition)(joint, (count + 1, width))


Component = Literal["traced", "learned"]  # component that is observed without the other
ObservationFunction = Callable[[Mapping[str, Any], Batch], Any]  # ``observe(params, batch)``: flat, differentiable


class Graph:
    """Gaussians, the traced paths of a scene, and receivers.

    Args:
        field: field of Gaussians; None: only traced paths.
        receivers: poses, antennas and arrays.
        form: form of the observations.
        scene: scene from `wrf_mi.tracing.open_scene`, at `ObservationSpec.carrier_hz`; None: only Gaussians.
        traced: options of tracing, and learning rates.
        tx_antenna: antenna of the transmitters.
        evaluation: evaluation of the Gaussians, a key of `wrf_mi.graph.evaluations.EVALUATIONS`.

    Raises:
        InputError: a receiver model or a scene without the array or carrier it needs, or nothing to evaluate.
    """

    def __init__(
        self,
        field: Field | None,
        receivers: Sequence[Receiver],
        form: ObservationSpec,
        scene: Any | None = None,
        traced: TracedConfig = DEFAULT,
        tx_antenna: Antenna = ANTENNA,
        evaluation: str = SPLATTED,
    ) -> None:
        self.kind = RECEIVERS[form.receiver]
        self._check_data(form, receivers, scene is not None)
        if scene is not None and form.features:
            raise InputError("paths are traced from positions, not from an uplink; omit the scene")
        if field is None and scene is None:
            raise InputError("neither Gaussians nor a scene: there is nothing to evaluate; give one")
        self.field, self.receivers, self.scene, self.traced = field, tuple(receivers), scene, traced
        self.tx_antenna = tx_antenna
        self.surface: SurfaceGaussians | None = None  # on the scene's surfaces, changing its paths (`cover`)
        self.evaluation: Evaluation = evaluation_named(evaluation)(scene, traced)
        self._stated_hz = form.carrier_hz
        self._take(form)

    def _check_data(self, form: ObservationSpec, receivers: Sequence[Receiver], with_scene: bool) -> None:
        # Phases of an array need its elements and a wavelength; paths need a carrier in any case.
        array = self.kind.needs_array and any(receiver.array_m is None for receiver in receivers)
        carrier = (self.kind.needs_carrier or with_scene) and np.isnan(form.carrier_hz)
        if array or carrier:
            what = "a scene" if with_scene else f"setting receiver: {form.receiver}"
            needed = "the antenna array and the carrier" if self.kind.needs_array else "the carrier"
            raise InputError(f"{what} needs {needed}; state array and frequency_hz in the data")

    def at_carrier(self, carrier_hz: float) -> Graph:
        """The same graph for rows of another carrier."""
        graph = copy(self)
        graph._take(replace(self.form, carriers_hz=np.array([carrier_hz])))
        return graph

    def _take(self, form: ObservationSpec) -> None:
        """Take a form, with the receiver model of each port, receiver by receiver."""
        forms = form.of_ports
        self.form, self.carriers = form, len(forms)
        self.models = tuple(self.kind.of(of_port, receiver) for receiver in self.receivers for of_port in forms)

    def log_carrier(self, number: int) -> float | None:
        """Logarithm of a port's carrier over the middle one of training; None: rows have a single carrier."""
        if self.form.carriers_hz is None:
            return None
        return float(np.log(self.form.carriers_hz[number % self.carriers] / self._stated_hz))

    @property
    def sphere(self) -> bool:
        """Whether receivers cover the full sphere instead of the upper hemisphere."""
        return self.models[0].sphere

    @property
    def moves(self) -> bool:
        """Whether poses of receivers are trained."""
        return self.scene is not None and (self.traced.position > 0 or self.traced.turn > 0)

    @property
    def corrects(self) -> bool:
        """Whether the Gaussians correct an observation without them: paths, or a channel of zero."""
        is_channel = self.kind.complex_valued and not self.form.features
        return self.field is not None and (self.scene is not None or is_channel)

    @cached_property
    def _prepared(self) -> Prepared:
        return Prepared(self.scene)

    def check(self, tx_pos_m: FloatArray) -> None:
        """Refuse transmitters [n, 3] and receivers in solids (`InputError`), warn of those near surfaces."""
        if self.scene is not None:
            self._prepared.check(tx_pos_m, self.receivers)

    def check_polarization(self, tx_pos_m: FloatArray) -> None:
        """Warn of receivers polarised orthogonally to the waves of transmitters [n, 3]."""
        if self.scene is not None:
            check_polarization(self.scene, tx_pos_m, self.receivers, self.tx_antenna)

    def trace(
        self,
        tx_pos_m: ArrayLike,
        receiver: int,
        tx_heading_rad: ArrayLike | None = None,
        carriers_hz: FloatArray | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> Sequence[TracedField | None]:
        """The traced fields of a receiver, one for each carrier of the transmitters, from one search for paths.

        Transmitters [n, 3] are in the world frame, metres; ``tx_heading_rad`` is the yaw of each one's frame [n] (None:
        0), ``carriers_hz`` its carrier [n], of training or not (None: all have that of the scene). With ``params``,
        values by name, paths are those that `TracedField.refresh` finds; None: stated values.

        They are in ascending order of carriers, each of the transmitters at its carrier; without a scene None.
        """
        if self.scene is None:
            return [None] * (1 if carriers_hz is None else len(np.unique(carriers_hz)))
        t = self.traced
        options = TracedOptions(t.options, t.pattern_degree, self.tx_antenna, t.materials, t.moves_planes, t.faint)
        at = self.receivers[receiver], options, self._prepared
        traced_fields = trace_fields(tx_pos_m, *at, tx_heading_rad, carriers_hz, parameters=params)
        if self.surface:
            for traced_field in traced_fields:
                traced_field.attach(self.surface)
        return traced_fields

    def add_surface_gaussians(
        self, traced_fields: Sequence[TracedField | None], fitted: Mapping[str, NDArray[Any]] | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Put Gaussians on the surfaces that paths of traced fields meet, if the settings train them.

        ``traced_fields`` are those of the training transmitters, later ones get the same Gaussians; ``fitted`` are
        parameters of a fit with such Gaussians, which replace new ones. Returns starting values of their parameters.
        """
        spacing_m, present = self.traced.surface_spacing, [traced for traced in traced_fields if traced is not None]
        if fitted is not None:
            self.surface = SurfaceGaussians.of(fitted, spacing_m)
        elif self.traced.surface > 0 and present:
            joint = Interactions(*map(np.concatenate, zip(*(traced.interactions for traced in present), strict=True)))
            self.surface = SurfaceGaussians.covering(joint, spacing_m)
        if not self.surface:
            return {}
        for traced in present:
            traced.attach(self.surface)
        return self.surface.parameters()

    def parameters(self, traced_fields: Sequence[TracedField | None]) -> dict[str, NDArray[np.float32]]:
        """Starting values of the trained parameters beside the field's, by name, from the traced fields of all ports.

        `InputError` without Gaussians for a receiver that no path reaches.
        """
        values: dict[str, NDArray[np.float32]] = {}
        for traced_field in traced_fields:
            if traced_field is not None:
                if self.field is None and not traced_field.exists.any():
                    name = traced_field.receiver.name
                    raise InputError(f"{name}: no training row is reached by a path; trace more kinds of path")
                values |= {name: v for name, v in traced_field.parameters().items() if self.traced.rate(name) > 0}
        if self.field is not None and self.kind.levels:
            values[LEVEL] = np.zeros((1, len(self.receivers)), np.float32)
        return values

    def learned(self, number: int, params: Mapping[str, Any], batch: Batch, chunked: bool = False) -> Complex:
        """Signal (re, im) of the Gaussians, [batch * components * directions], at a port, without the `unit`."""
        assert self.field is not None
        evaluate = partial(gaussians_in_parts, self.field) if chunked else self.field.gaussians
        gaussians = by_component(evaluate(params, batch.inputs), self.form.components)
        pose = batch.pose
        if self.moves:
            pose = receiver_pose(self.receivers[number // self.carriers], params, mi.Float)
        return self.evaluation(gaussians, pose, batch.plane, self.sphere, params)

    def unit(self, params: Mapping[str, Any], batch: Batch, paths: TracedPaths | None = None) -> Any | None:
        """Factor of the learned signal of each transmitter: the receiver's unit and the batch's weights; None: 1."""
        # Where observations have a unit, it is exp(``level``), and with paths at least a share of their amplitude: the
        # error of a mesh scales with its paths, near and far.
        if LEVEL not in params:
            return batch.weight
        kind = type(params[LEVEL].array)
        unit = dr.exp(dr.gather(kind, params[LEVEL].array, batch.receiver))
        if paths is not None:
            # A root of squares keeps both derivatives, where a maximum would leave ``level`` without one.
            unit = dr.sqrt(SHARE**2 * kind(paths.power) + unit * unit)
        return unit if batch.weight is None else unit * batch.weight

    def observation(
        self,
        number: int,
        traced_field: TracedField | None,
        learned: bool = True,
        chunked: bool = False,
        surface: bool = True,
        component: Component | None = None,
        phase_error: float = 0.0,
    ) -> ObservationFunction:
        """Observations of a port as a function of parameters, for transmitters of a traced field.

        ``learned`` and ``surface``: with the learned component and the Gaussians on surfaces, where the graph has them;
        ``chunked``: evaluate networks in chunks of Gaussians, without gradients (`gaussians_in_parts`);
        ``component``: the one component that is observed, without an instrument's scaling of each observation, so that
        both compare (the unit of the Gaussians is that beside the paths). With ``phase_error``, the standard deviation
        in rad of the phase that each reflection of a path adds, the observation is the expectation
        (`wrf_mi.receivers.instruments.Instrument`).
        """
        model: Any = self.models[number]
        if component is not None:
            model = model.unscaled

        def observe(params: Mapping[str, Any], batch: Batch) -> Any:
            if not surface:
                params = {name: values for name, values in params.items() if name != FACTOR}
            # The traced component, then the learned one in the receiver's unit.
            paths, signal = None if traced_field is None else traced_field(params, batch.slots), None
            if self.field is not None and learned and component != "traced":
                signal = batch.signal or self.learned(number, params, batch, chunked)
                if (unit := self.unit(params, batch, paths)) is not None:
                    if (count := dr.width(unit)) > 1:
                        unit = spread(unit, dr.width(signal[0]) // count)
                    signal = signal[0] * unit, signal[1] * unit
                if component == "learned":
                    return model(None, signal)
            # Single components are compared with each other: they keep the phases that the paths have.
            if phase_error and traced_field is not None and paths is not None and component is None:
                return expected_observation(model, paths, signal, phase_error * traced_field.bounces_of(batch.slots))
            return model(paths, signal)

        return observe

    def arrays(self, number: int, traced_field: TracedField | None) -> list[Any]:
        """Constants on the device that an observation reads beside its arguments, inputs of a recording."""
        if traced_field is None and self.form.receiver == "pixel":
            return []
        of_traced_field = [] if traced_field is None else [traced_field.arrays, draws_on_device(traced_field.form[0])]
        return [self.models[number].arrays(mi.Float), of_traced_field]

    def power_level(self, traced_field: TracedField, params: Mapping[str, Any]) -> float:
        """Logarithm of the paths' amplitude, by their mean power over all transmitters of a traced field."""
        with dr.suspend_grad():
            re, im = traced_field(params).gain
            power = float(dr.sum(re * re + im * im)[0]) / len(traced_field)
        return float(np.log(power) / 2) if power > 0 else 0.0

    def match_gain(self, number: int, traced_field: TracedField, observed: NDArray[Any]) -> NDArray[np.float32]:
        """Starting gain [2] of a receiver, which matches the mean of a port's traced observations to the measured ones.

        ``observed`` [n, *shape of an observation] are of its transmitters, NaN where nothing was received.
        """
        model = self.models[number]
        unscaled = model.unscaled
        finite_rows = np.flatnonzero(np.isfinite(observed).reshape(len(observed), -1).all(axis=1))
        # Images of thousands of rows would take gigabytes, for a start that training changes anyway.
        rows = finite_rows[:: -(-len(finite_rows) // MATCHED)] if len(finite_rows) else finite_rows
        gain = np.zeros(2, np.float32)
        # Observations are linear in the gain but for floors, which further passes leave behind.
        for _ in range(MATCHING if len(rows) else 0):
            with dr.suspend_grad():
                predicted = unscaled(
                    traced_field({traced_field.gain_name: mi.TensorXf(gain)}, to_uint(rows)), None
                ).numpy()
            predicted = predicted.astype(float).reshape(len(rows), *np.shape(observed)[1:])
            gain[0] += model.missing_gain(predicted, observed[rows])
        return gain
