"""Data, graph and schedule of a fit, known before its first step."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import InputError, Record, Split
from ..datasets.observations import check_observations
from ..graph.graph import Field, Graph
from ..tasks import task_of
from ..tasks.conditions import placed_receivers
from ..tracing.paths.traced_field import TracedField
from .config import TrainConfig
from .fields import check_memory, field_of
from .schedule import Schedule, density_rounds, plan
from .selection import hold_out_groups
from .targets import form_of, targets_of

CALIBRATION, SURFACES, FIELD = "calibration", "surfaces", "field"
"""Stages of a training: parameters of paths; Gaussians on surfaces with them; and the field's Gaussians, too."""


def check_rows(split: Split, record: Record, source: str) -> None:
    """Refuse a split with rows beyond the record's; ``source`` names the split, for the message.

    Raises:
        InputError: such a row.
    """
    rows = np.concatenate([split.train, split.validation, split.test])
    bad = rows[(rows < 0) | (rows >= len(record))]
    if len(bad):
        raise InputError(f"{source}: row {bad[0]}, but {record.name} has rows 0 to {len(record) - 1}; use other rows")


class FitPlan:
    """Data, graph and schedule of a fit, a function of its arguments, those of `wrf_mi.training.trainer.Trainer`.

    Attributes:
        record, split: data.
        task: task of the record.
        config: settings with number of steps and scale of transmitters.
        targets: conditions and observations.
        graph: Gaussians, paths and receivers.
        stages: names of the stages in their order.
        in_groups: whether the state is chosen on rows held out in groups, far from the training rows too.
        choosing: split of these rows; ``split`` itself where there are none.
        unjudged: whether the training rows do not suffice for such groups.
        schedule: rows and learning rates of each step.
        known: slots of the traced sides by port: conditions that train or choose at its carrier.

    Raises:
        InputError: unsuitable settings or data.
    """

    def __init__(
        self, record: Record, split: Split, config: TrainConfig, field: Field | None = None, scene: Any | None = None
    ) -> None:
        check_rows(split, record, f"split {split.name}")
        self.task = task_of(record)
        check_observations(record, split, complete=self.task.image)
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
        self.stages = self._stage_names()
        # What corrects paths is chosen also on rows far from the training rows: near them, Gaussians that interpolate
        # always gain, whatever they do elsewhere.
        wanted = (self.graph.corrects or len(self.stages) > 1) and config.patience > 0
        wanted &= config.holdout_steps_fraction > 0
        self.choosing = hold_out_groups(split, record.tx_pos_m) if wanted else split
        self.in_groups = wanted and (self.choosing is not split or self.graph.corrects)
        self.unjudged = self.in_groups and self.choosing is split
        # Without rows to choose by, Gaussians are not used at all (`Trainer`): paths alone are the safe answer.
        self.schedule = self._planned()
        # Sides are traced for all training rows at once, validation rows included, and addressed by these slots.
        self.known = [self.targets.at(port, rows) for port in range(self.targets.ports)]

    @property
    def chooses_stages(self) -> bool:
        """Whether stages beside paths are chosen by groups of rows that are held out."""
        return self.in_groups and self.graph.scene is not None

    def traced(self) -> list[TracedField | None]:
        """Traced side of the training rows at each port; None without a scene.

        Raises:
            InputError: a transmitter or receiver inside a solid.
        """
        record, rows, form = self.record, self.split.all_train, self.graph.form
        self.graph.check(record.tx_pos_m)
        headings = record.tx_heading_rad if form.headings else None
        carriers = None if form.carriers_hz is None else record.carriers_hz
        heading, carrier = (None if part is None else part[rows] for part in (headings, carriers))
        receivers = range(len(record.receivers))
        return [side for r in receivers for side in self.graph.trace(record.tx_pos_m[rows], r, heading, carrier)]

    def _stage_names(self) -> tuple[str, ...]:
        """Stages in their order: paths, Gaussians on surfaces, those of the field if there is one."""
        if self.graph.scene is None:
            return (FIELD,)
        traced = self.config.traced
        more = (SURFACES,) * (traced.surface > 0) + (FIELD,) * (self.graph.field is not None)
        return (CALIBRATION, *more) if traced.alone else (more or (CALIBRATION,))[-1:]

    def _planned(self) -> Schedule:
        """The schedule, in which each port learns from its receiver's observations."""
        config, targets = self.config, self.targets
        everything, train = (
            [targets.received(port, rows) for port in range(targets.ports)]
            for rows in (self.choosing.all_train, self.choosing.train)
        )
        # A receiver without training rows learns from its validation rows.
        train = [rows if len(rows) else every for rows, every in zip(train, everything, strict=True)]
        alone, end = config.traced.alone, config.holdout_steps_fraction
        # Each stage but the last has an equal share of the steps.
        first = tuple(round(k * alone * config.steps) for k in range(1, len(self.stages)))
        if first and config.patience and 0 < end * config.steps <= first[-1]:
            share = f"{alone} of the steps" + (", twice," if len(first) > 1 else "")
            text = f"{share} are not less than holdout_steps_fraction, {end}"
            raise InputError(f"setting traced.alone: {text}, by whose rows Gaussians are chosen; choose less")
        density = density_rounds(config.density, config.steps, first[-1] if first else 0)
        return plan(config, train, everything, np.random.default_rng([config.seed, 1]), density, first)

    def ports(self, receiver: int) -> range:
        """Ports of a receiver."""
        return range(receiver * self.graph.carriers, (receiver + 1) * self.graph.carriers)
