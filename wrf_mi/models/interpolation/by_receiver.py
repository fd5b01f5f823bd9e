"""Baselines that know positions and headings, and fit each receiver by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Receiver, Record, Split
from ...core.angles import FloatArray
from ...core.carriers import by_carrier, carriers_text
from ...core.types import IntArray
from ...training.session import OnProgress
from ..method import Inputs

HEADING = "heading"
"""Key of the arrays that says whether headings were used."""
CARRIERS = "carriers_hz"
"""Key of the carriers where there are several."""


class Single(Protocol):
    """The model of one receiver."""

    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> NDArray[Any]:
        """Observations [m, ...] at positions [m, 3]."""
        ...

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        ...


FitSingle = Callable[[Receiver, FloatArray, NDArray[Any], "FloatArray | None"], Single]
"""From a receiver, positions [n, 3] in metres, observations [n, ...] and headings [n] to its model."""


class ByReceiver:
    """One model for each receiver, and for each carrier where the rows have several.

    Args:
        name: of the method, for errors.
        models: of the receivers in turn, and so for each carrier.
        heading: whether they were given headings.
        carriers_hz: of the training rows, ascending; None: one that is not told.
    """

    def __init__(
        self, name: str, models: Sequence[Single], heading: bool, carriers_hz: FloatArray | None = None
    ) -> None:
        self.name, self.models, self.heading, self.carriers_hz = name, tuple(models), heading, carriers_hz

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """What a receiver observes, [m, ...].

        Raises:
            InputError: positions that are not known, no headings for a model that was given some, or a carrier without
                training rows.
        """
        if not np.isfinite(inputs.tx_pos_m).all():
            raise InputError(f"{self.name}: predicts from positions; give finite x, y, z in metres for every row")
        if self.heading and inputs.tx_heading_rad is None:
            raise InputError(
                f"{self.name}: fitted with the transmitter's headings; give heading_rad, or train with heading=false"
            )
        heading = inputs.tx_heading_rad if self.heading else None
        if self.carriers_hz is None:
            return self.models[receiver].predict(inputs.tx_pos_m, heading)
        if inputs.carriers_hz is None:
            known = carriers_text(np.asarray(self.carriers_hz))
            raise InputError(f"{self.name}: trained at {known}; give the carrier of every row")
        each = len(self.models) // len(self.carriers_hz)

        def of_carrier(carrier_hz: float, rows: IntArray) -> NDArray[Any]:
            place = np.flatnonzero(self.carriers_hz == carrier_hz)
            if not len(place):
                row, known = inputs.first_row + rows[0] + 1, carriers_text(np.asarray(self.carriers_hz))
                raise InputError(f"{self.name}: row {row}: no training row at {carrier_hz:.10g} Hz; trained on {known}")
            turned = None if heading is None else heading[rows]
            return self.models[place[0] * each + receiver].predict(inputs.tx_pos_m[rows], turned)

        return by_carrier(inputs.carriers_hz, of_carrier)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        arrays = {f"{r}/{key}": value for r, one in enumerate(self.models) for key, value in one.arrays().items()}
        carriers = {} if self.carriers_hz is None else {CARRIERS: self.carriers_hz}
        return {HEADING: np.asarray(self.heading), **carriers, **arrays}


def fit_each(
    name: str, record: Record, split: Split, on_progress: OnProgress, fit: FitSingle, heading: bool = False
) -> ByReceiver:
    """Fit every receiver to all training rows, those of each carrier by themselves.

    Args:
        name: of the method.
        record: its rows' positions must be known.
        split: rows.
        on_progress: hears of each receiver.
        fit: of one receiver.
        heading: use headings where the record has them.

    Raises:
        InputError: positions that are not known, or what ``fit`` raises, with the receiver's name.
    """
    rows = split.all_train
    if not np.isfinite(record.tx_pos_m[rows]).all():
        raise InputError(f"{record.name}: positions are not known, from which {name} predicts; choose another model")
    turned, stated = record.tx_heading_rad if heading else None, record.carriers_hz
    carriers = None if stated is None else np.unique(stated[rows])
    parts = [rows] if stated is None or carriers is None else [rows[stated[rows] == one] for one in carriers]
    models: list[Single] = []
    for own in parts:
        for receiver, observed in zip(record.receivers, record.observation, strict=True):
            try:
                models.append(
                    fit(receiver, record.tx_pos_m[own], observed[own], None if turned is None else turned[own])
                )
            except InputError as error:
                raise InputError(f"{record.name}, receiver {receiver.name}: {error}") from None
            # Only now: what is refused at once is refused without a word of progress.
            on_progress(f"{name}: receivers", len(models) / (len(parts) * len(record.receivers)))
    return ByReceiver(name, models, turned is not None, carriers)


def load_each(
    name: str,
    arrays: dict[str, NDArray[Any]],
    record: Record,
    load: Callable[[Receiver, dict[str, NDArray[Any]]], Single],
) -> ByReceiver:
    """What `ByReceiver.arrays` returned; ``load`` makes one receiver's model."""
    models, carriers = [], arrays.get(CARRIERS)
    for index, receiver in enumerate(record.receivers * (1 if carriers is None else len(carriers))):
        own = f"{index}/"
        kept = {key.removeprefix(own): value for key, value in arrays.items() if key.startswith(own)}
        models.append(load(receiver, kept))
    return ByReceiver(name, models, bool(arrays[HEADING]), carriers)
