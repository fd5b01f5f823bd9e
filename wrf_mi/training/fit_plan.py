"""Data, field, graph and schedule of a fit, known before its first step.

A *condition* is the input of a field: a row's transmitter position, or the uplink channel of one antenna of a row.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..datasets.observations import check_observations, check_rows
from ..graph.graph import Field, Graph
from ..receivers.registry import AUTO, ObservationSpec, receiver_model
from ..tasks import Loss, known_loss
from ..tasks.conditions import normalised_uplink, outputs_of, placed_receivers
from ..tracing.paths.traced_field import TracedField
from .adam import Schedule, density_rounds, plan
from .config import TrainConfig
from .fields import check_memory, field_of
from .selection import hold_out_far, hold_out_groups


@dataclass(frozen=True)
class Targets:
    """Conditions and observations of a record."""

    condition: FloatArray  # positions [3, c] in metres or features [features, c]
    truth: NDArray[np.float32]  # float32 [n_rx, c, *shape of a report], NaN where nothing was received
    unit: FloatArray  # unit of each receiver's differences in the loss, [n_rx]
    per_row: int = 1  # number of consecutive conditions of a row
    weight: FloatArray | None = None  # factor of each observation's difference in the loss [n_rx, c]; None: 1
    carriers_hz: FloatArray | None = None  # carriers of the training rows, ascending; None: rows have a single carrier
    carrier: IntArray | None = None  # number of each condition's carrier [c], -1 for carriers without training rows

    @property
    def ports(self) -> int:
        """Number of receivers times that of carriers."""
        return len(self.truth) * self.carriers

    @property
    def carriers(self) -> int:
        """Number of carriers of the training rows."""
        return 1 if self.carriers_hz is None else len(self.carriers_hz)

    def at(self, port: int, conditions: IntArray) -> IntArray:
        """Those of some conditions that have a port's carrier."""
        return conditions if self.carrier is None else conditions[self.carrier[conditions] == port % self.carriers]

    def conditions(self, rows: IntArray) -> IntArray:
        """Numbers of the conditions of rows."""
        return np.asarray((rows[:, None] * self.per_row + np.arange(self.per_row)).ravel())

    def received(self, port: int, rows: IntArray) -> IntArray:
        """Conditions of those rows that a port's receiver observed at its carrier."""
        chosen = self.at(port, self.conditions(rows))
        return np.asarray(chosen[self._complete[port // self.carriers, chosen]])

    @cached_property
    def _complete(self) -> NDArray[np.bool_]:
        """Whether each receiver observed each condition [n_rx, c]; of images it takes long, and is asked for often."""
        return np.asarray(np.isfinite(self.truth).all(axis=tuple(range(2, self.truth.ndim))))


def targets_of(record: Record, rows: IntArray, with_scene: bool = False) -> Targets:
    """Conditions and observations of a record; units are measured on training rows.

    An uplink is the condition where there is one, except beside paths of a scene, which are traced from positions.

    Raises:
        InputError: an unknown position, or an uplink without a signal or with a different number of antennas.
    """
    task, observed = record.task, np.asarray(record.observation)
    if record.uplink is None or with_scene:
        if not np.isfinite(record.tx_pos_m[rows]).all():
            row = int(rows[~np.isfinite(record.tx_pos_m[rows]).all(axis=1)][0])
            raise InputError(f"{record.name} has no position in row {row}; choose a model that needs none")
        units = np.array([task.unit(values[rows]) for values in observed])
        weight = _weights(record, rows)
        targets = Targets(np.ascontiguousarray(record.tx_pos_m.T, float), _real(observed), units, weight=weight)
        if record.carriers_hz is None:
            return targets
        carriers = np.unique(record.carriers_hz[rows])
        number = np.where(np.isin(record.carriers_hz, carriers), np.searchsorted(carriers, record.carriers_hz), -1)
        return replace(targets, carriers_hz=carriers, carrier=number)
    outputs = outputs_of(record)
    features, divisor = normalised_uplink(record.uplink)
    # Divided as the uplink is: path loss and the radios' phases are equal in both links and need not be learned.
    channels = observed[0].reshape(len(record), outputs.antennas, -1) / divisor[..., None]
    truth = _real(channels.reshape(1, -1, outputs.count).astype(np.complex64))
    received = Targets(np.zeros((0, 0)), truth, np.ones(1), outputs.antennas).received(0, rows)
    # Root mean square of the complex numbers, whose two parts have half of the mean square each.
    unit = float(np.sqrt(2 * np.mean(np.square(truth[0, received], dtype=float)))) or 1.0
    return Targets(np.asarray(features.T, float), truth, np.array([unit]), outputs.antennas)


def _weights(record: Record, rows: IntArray) -> FloatArray | None:
    # Inverse standard deviation of the noise, 1 in other rows: differences become standardised residuals, an absolute
    # error is weighted by 1 / std, a squared one by 1 / variance.
    precision = record.precision(rows)
    if precision is None:
        return None
    weight, inverse = np.ones(record.observation.shape[:2]), np.sqrt(precision)
    # A mean of 1, so that learning rates and losses compare with those of unweighted rows.
    weight[:, rows] = inverse / inverse[np.isfinite(record.observation[:, rows])].mean()
    return weight


def _real(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Complex values with a last axis of real and imaginary part."""
    if not np.iscomplexobj(values):
        return np.ascontiguousarray(values, np.float32)
    single = np.ascontiguousarray(values, np.complex64)
    return single.view(np.float32).reshape(*single.shape, 2)


def _receiver_of(record: Record, config: TrainConfig, with_scene: bool) -> str:
    """Name of the receiver model that reports a record (InputError: none, or one that it does not suit)."""
    task = record.task
    default = task.receiver_with_scene if with_scene else task.receiver
    if not default:
        raise InputError(f"{record.name}: no receiver model reports {task.name}; choose another model")
    name = default if config.receiver == AUTO else config.receiver
    receiver_model(name, task.name)
    arrays = len(task.outputs(record.observation.shape[2:])) > 1
    if with_scene and arrays and any(receiver.array_m is None for receiver in record.receivers):
        raise InputError(f"{record.name}: antennas' positions unknown; state base_station in base-station.yml")
    return name


def form_of(record: Record, config: TrainConfig, targets: Targets, rows: IntArray, with_scene: bool) -> ObservationSpec:
    """Form of a record's observations, whose basis is computed from training ``rows`` (InputError: unsuitable)."""
    task, name = record.task, _receiver_of(record, config, with_scene)
    shape = record.observation.shape[2:]
    height, width = task.image_size(shape) or (config.view.height, config.view.columns)
    outputs = task.outputs(shape)
    basis = _basis(targets, rows, config.view.components) if outputs else None
    features = 0 if record.uplink is None or with_scene else len(targets.condition)
    headings = with_scene and config.traced.pattern_degree > 0 and record.tx_heading_rad is not None
    floor_db = task.floor_db(record.observation[:, rows]) if with_scene else np.nan
    size, carriers_hz = (height, width), targets.carriers_hz
    return ObservationSpec(name, size, record.frequencies_hz, outputs, basis, features, headings, floor_db, carriers_hz)


def _basis(targets: Targets, rows: IntArray, most: int) -> NDArray[np.complex128]:
    """Principal components [components, outputs] of the training rows' channels, without subtraction of the mean."""
    # Receivers have equal weight, as scores are relative.
    power: NDArray[np.complex128] | float = 0.0
    for receiver in range(len(targets.truth)):
        pairs = targets.truth[receiver, targets.received(receiver, rows)].astype(float)
        channels = (pairs[..., 0] + 1j * pairs[..., 1]).reshape(len(pairs), -1)
        power = power + channels.conj().T @ channels / (np.square(np.abs(channels)).sum() or 1.0)
    _, vectors = np.linalg.eigh(power)
    # Rows v^H: a channel h has coefficients h v and is their sum with v^H.
    return np.ascontiguousarray(vectors[:, ::-1][:, :most].conj().T)


PATHS, SURFACES, FIELD = "paths", "surfaces", "field"
"""Parameters that a training adds to those before: of paths, of Gaussians on surfaces, and of the field's Gaussians."""


class FitPlan:
    """Data, graph and schedule of a fit, a function of its arguments, those of `wrf_mi.training.trainer.Trainer`.

    With ``held_out``, the validation rows of the split are those that choose the state; else some are chosen.

    Beside the paths of a scene, parameters are trained in a curriculum of trainings, each of which goes on from the one
    before (`part`).

    Attributes:
        config: settings with number of steps and scale of transmitters.
        curriculum: parameters that each training adds (`PATHS`, `SURFACES`, `FIELD`), in their order.
        number: number of the training that this plan is for.
        loop: its settings: steps, share of them in which validation rows are held out, and steps between two scores.
        schedule: rows and learning rates of its steps.
        chooses: whether the state is chosen on rows far from the training rows, too, which are held out in groups.
        choosing: split of these rows, or, where Gaussians alone train, of validation rows as far from training rows as
            test rows (`hold_out_far`); ``split`` itself where there are none.
        unjudged: whether the training rows do not suffice for such groups.
        loss: loss of a batch.
        known: slots of the traced sides by port: conditions that train or choose at its carrier.

    Raises:
        InputError: unsuitable settings or data.
    """

    def __init__(
        self,
        record: Record,
        split: Split,
        config: TrainConfig,
        field: Field | None = None,
        scene: Any | None = None,
        held_out: bool = False,
    ) -> None:
        check_rows(split, record, f"split {split.name}")
        self.task, name = record.task, config.loss.name
        self.loss: Loss = known_loss(name) if name else partial(self.task.loss, ssim_weight=config.loss.ssim_weight)
        check_observations(record, split, complete=self.task.complete)
        rows = split.all_train
        config = config.resolved(record.tx_pos_m[rows])
        self.record, self.split, self.config = record, split, config
        self.targets = targets_of(record, rows, scene is not None)
        form = form_of(record, config, self.targets, rows, scene is not None)
        field = field or field_of(config, form)
        if field is not None:
            check_memory(config, field)
        receivers = placed_receivers(record, by_uplink=bool(form.features))
        self.graph = Graph(field, receivers, form, scene, config.traced, record.tx_antenna, config.evaluation)
        self.curriculum = self._curriculum()
        # What corrects paths is chosen also on rows far from the training rows: near them, Gaussians that interpolate
        # always gain, whatever they do elsewhere.
        chosen = config.patience > 0 and config.holdout_steps_fraction > 0
        wanted = chosen and (self.graph.corrects or len(self.curriculum) > 1)
        self.choosing = hold_out_groups(split, record.tx_pos_m) if wanted and not held_out else split
        # Rows for a score alone: they choose no state, and are trained on in the end.
        shown = not config.patience and 0 < config.holdout_steps_fraction < 1
        if self.graph.scene is None and record.has_positions and shown:
            self.choosing = self._with_far_rows()
        self.chooses = wanted and (held_out or self.choosing is not split or self.graph.corrects)
        # Without rows to choose by, Gaussians are not used at all (`Trainer`): paths alone are the safe answer.
        self.unjudged = self.chooses and self.choosing is split and not held_out
        self._take(0)
        # Sides are traced for all training rows at once, validation rows included, and addressed by these slots.
        self.known = [self.targets.at(port, rows) for port in range(self.targets.ports)]

    def part(self, number: int) -> FitPlan:
        """The plan of another training of the curriculum, of the same graph."""
        plan = copy(self)
        plan._take(number)
        return plan

    def _take(self, number: int) -> None:
        self.number = number
        self.loop = self._loop()
        self.schedule = self._planned()

    @property
    def trains(self) -> str:
        """Parameters that the training adds."""
        return self.curriculum[self.number]

    @property
    def trains_surfaces(self) -> bool:
        """Whether Gaussians on surfaces are trained."""
        return bool(self.graph.surface) and self.trains != PATHS and not self.unjudged

    @property
    def chooses_beside_paths(self) -> bool:
        """Whether the state is chosen by groups of rows that are held out, beside the paths of a scene."""
        return self.chooses and self.graph.scene is not None

    def traced(self) -> list[TracedField | None]:
        """Traced side of the training rows at each port, None without a scene (InputError: positions in a solid)."""
        record, rows, form = self.record, self.split.all_train, self.graph.form
        self.graph.check(record.tx_pos_m)
        headings = record.tx_heading_rad if form.headings else None
        carriers = None if form.carriers_hz is None else record.carriers_hz
        heading, carrier = (None if part is None else part[rows] for part in (headings, carriers))
        receivers = range(len(record.receivers))
        return [side for r in receivers for side in self.graph.trace(record.tx_pos_m[rows], r, heading, carrier)]

    def _curriculum(self) -> tuple[str, ...]:
        if self.graph.scene is None:
            return (FIELD,)
        traced = self.config.traced
        every = (PATHS, *(SURFACES,) * (traced.surface > 0), *(FIELD,) * (self.graph.field is not None))
        return every if traced.alone else every[-1:]

    def _with_far_rows(self) -> Split:
        """The split of `hold_out_far`; the fit's own where a receiver would be left with less than a batch."""
        # Scores of rows near training rows say nothing of test rows that are far from them.
        far = hold_out_far(self.split, self.record.tx_pos_m)
        ports = range(self.targets.ports)
        least, least_far = (min(len(self.targets.received(p, part.train)) for p in ports) for part in (self.split, far))
        # Batches of all receivers are as large as that of the one with the fewest rows.
        return far if least_far >= min(self.config.batch, least) else self.split

    def _planned(self) -> Schedule:
        config, targets = self.loop, self.targets
        parts, ports = (self.choosing.all_train, self.choosing.train), range(targets.ports)
        everything, train = ([targets.received(port, rows) for port in ports] for rows in parts)
        # A receiver without training rows learns from its validation rows.
        train = [rows if len(rows) else every for rows, every in zip(train, everything, strict=True)]
        density = density_rounds(config.density, config.steps) if self.trains == FIELD else frozenset[int]()
        rng, is_last = np.random.default_rng([config.seed, 1, self.number]), self.number == len(self.curriculum) - 1
        # The next training goes on from parameters that have converged.
        return plan(config, train, everything, rng, density, falls_by_choice=not is_last)

    def _loop(self) -> TrainConfig:
        """Settings of the training: all but the last have ``traced.alone`` of the steps (InputError: beyond the
        hold-out).
        """
        config, last = self.config, len(self.curriculum) - 1
        if not last:
            return config
        alone, holdout = config.traced.alone, config.holdout_steps_fraction
        begin, end = (round(number * alone * config.steps) for number in (self.number, self.number + 1))
        if config.patience and 0 < holdout * config.steps <= round(last * alone * config.steps):
            share = f"{alone} of the steps" + (", twice," if last > 1 else "")
            text = f"{share} are not less than holdout_steps_fraction, {holdout}"
            raise InputError(f"setting traced.alone: {text}, by whose rows Gaussians are chosen; choose less")
        if self.number == last:
            steps, held_out = max(config.steps - begin, 1), max(round(holdout * config.steps) - begin, 0)
        elif self.chooses:  # validation rows join a training that is chosen, for as large a share of its steps
            held_out = max(end - begin, 1)
            steps = round(held_out / holdout)
        else:
            steps = max(end - begin, 1)
            held_out = steps * (holdout > 0)
        # Paths converge within their steps, and a score costs a prediction of all held-out rows.
        every = config.validate_every if self.number else max(held_out, 1)
        return replace(config, steps=steps, holdout_steps_fraction=held_out / steps, validate_every=every)

    def ports(self, receiver: int) -> range:
        """Ports of a receiver."""
        return range(receiver * self.graph.carriers, (receiver + 1) * self.graph.carriers)
