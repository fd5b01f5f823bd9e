"""Data, field, graph and schedule of a fit, known before its first step."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..core import InputError, Record, Split
from ..core.types import IntArray
from ..datasets.observations import check_observations, check_rows
from ..graph.graph import Field, Graph
from ..tasks import Loss, known_loss
from ..tasks.conditions import placed_receivers
from ..tracing.paths.traced_field import TracedField
from .adam import Schedule, density_rounds, schedule_of
from .config import TrainConfig
from .fields import check_memory, field_of
from .selection import hold_out_far, hold_out_groups
from .targets import form_of, targets_of

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
        selection: split of these rows, or, where Gaussians alone train, of validation rows as far from training rows
            as test rows (`hold_out_far`); ``split`` itself where there are none.
        unjudged: whether the training rows do not suffice for such groups.
        loss: loss of a batch.
        port_rows: rows that train or choose at the carrier of each port, in ascending order.

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
        form = form_of(record, rows, config, self.targets, scene is not None)
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
        self.selection = hold_out_groups(split, record.tx_pos_m) if wanted and not held_out else split
        # Rows for a score alone: they choose no state, and are trained on in the end.
        shown = not config.patience and 0 < config.holdout_steps_fraction < 1
        if self.graph.scene is None and record.has_positions and shown:
            self.selection = self._with_far_rows()
        self.chooses = wanted and (held_out or self.selection is not split or self.graph.corrects)
        # Without rows to choose by, Gaussians are not used at all (`Trainer`): paths alone are the safe answer.
        self.unjudged = self.chooses and self.selection is split and not held_out
        self._take(0)
        self.port_rows = [self.targets.at_carrier(port, rows) for port in range(self.targets.ports)]

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

    @cached_property
    def traced_fields(self) -> Sequence[TracedField | None]:
        """Traced fields of the training rows at each port, None without a scene (InputError: positions in a solid).

        Rows are traced once, validation rows included: their positions do not change, only what the paths meet.
        """
        record, rows, form = self.record, self.split.all_train, self.graph.form
        self.graph.check(record.tx_pos_m)
        headings = record.tx_heading_rad[rows] if form.headings and record.tx_heading_rad is not None else None
        carriers_hz = None if form.carriers_hz is None or record.carriers_hz is None else record.carriers_hz[rows]
        receivers = range(len(record.receivers))
        return [field for r in receivers for field in self.graph.trace(record.tx_pos_m[rows], r, headings, carriers_hz)]

    def slots(self, port: int, conditions: IntArray) -> IntArray:
        """Number of the row of each condition in the traced field of a port."""
        return np.searchsorted(self.port_rows[port], conditions // self.targets.per_row)

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
        least, least_far = (min(map(len, self.targets.received(split.train))) for split in (self.split, far))
        # Batches of all receivers are as large as that of the one with the fewest rows.
        return far if least_far >= min(self.config.batch, least) else self.split

    def _planned(self) -> Schedule:
        config, received = self.loop, self.targets.received
        all_train, train = received(self.selection.all_train), received(self.selection.train)
        # A receiver without training rows learns from its validation rows.
        train = [rows if len(rows) else all_train[port] for port, rows in enumerate(train)]
        density = density_rounds(config.density, config.steps) if self.trains == FIELD else frozenset[int]()
        rng, is_last = np.random.default_rng([config.seed, 1, self.number]), self.number == len(self.curriculum) - 1
        # The next training goes on from parameters that have converged.
        return schedule_of(config, train, all_train, rng, density, falls_by_choice=not is_last)

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
