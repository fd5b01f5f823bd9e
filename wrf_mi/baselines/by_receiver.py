"""Baselines that know positions and headings, and fit each receiver by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver, Record, Split
from ..core.angles import FloatArray
from .method import Inputs, Listen

HEADING = "heading"
"""Key of the arrays that says whether headings were used."""


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
    """One model for each receiver.

    Args:
        name: of the method, for errors.
        models: of the receivers in turn.
        heading: whether they were given headings.
    """

    def __init__(self, name: str, models: Sequence[Single], heading: bool) -> None:
        self.name, self.models, self.heading = name, tuple(models), heading

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """What a receiver observes, [m, ...].

        Raises:
            InputError: positions that are not known, or no headings for a model that was given some.
        """
        if not np.isfinite(inputs.tx_pos_m).all():
            raise InputError(f"{self.name}: predicts from positions; give finite x, y, z in metres for every row")
        if not self.heading:
            return self.models[receiver].predict(inputs.tx_pos_m)
        if inputs.tx_heading_rad is None:
            raise InputError(
                f"{self.name}: fitted with the transmitter's headings; give heading_rad, or train with heading=false"
            )
        return self.models[receiver].predict(inputs.tx_pos_m, inputs.tx_heading_rad)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        arrays = {f"{r}/{key}": value for r, one in enumerate(self.models) for key, value in one.arrays().items()}
        return {HEADING: np.asarray(self.heading), **arrays}


def fit_each(
    name: str, record: Record, split: Split, listen: Listen, fit: FitSingle, heading: bool = False
) -> ByReceiver:
    """Fit every receiver to all training rows.

    Args:
        name: of the method.
        record: its rows' positions must be known.
        split: rows.
        listen: hears of each receiver.
        fit: of one receiver.
        heading: use headings where the record has them.

    Raises:
        InputError: positions that are not known, or what ``fit`` raises, with the receiver's name.
    """
    rows = split.all_train
    if not np.isfinite(record.tx_pos_m[rows]).all():
        raise InputError(f"{record.name}: positions are not known, from which {name} predicts; choose another model")
    turned = record.tx_heading_rad[rows] if heading and record.tx_heading_rad is not None else None
    models = []
    for index, (receiver, observed) in enumerate(zip(record.receivers, record.observation, strict=True)):
        try:
            models.append(fit(receiver, record.tx_pos_m[rows], observed[rows], turned))
        except InputError as error:
            raise InputError(f"{record.name}, receiver {receiver.name}: {error}") from None
        # Only now: what is refused at once is refused without a word of progress.
        listen(f"{name}: receivers", (index + 1) / len(record.receivers))
    return ByReceiver(name, models, turned is not None)


def load_each(
    name: str,
    arrays: dict[str, NDArray[Any]],
    record: Record,
    load: Callable[[Receiver, dict[str, NDArray[Any]]], Single],
) -> ByReceiver:
    """What `ByReceiver.arrays` returned; ``load`` makes one receiver's model."""
    models = []
    for index, receiver in enumerate(record.receivers):
        own = f"{index}/"
        kept = {key.removeprefix(own): value for key, value in arrays.items() if key.startswith(own)}
        models.append(load(receiver, kept))
    return ByReceiver(name, models, bool(arrays[HEADING]))
