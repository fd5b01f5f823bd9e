"""Methods that fit each receiver separately from positions and headings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Prediction, Receiver, Record, Split
from ...core.angles import FloatArray
from ...core.carriers import by_carrier, carriers_text
from ...core.types import IntArray
from ...datasets.observations import LEAST_ROWS, rows_received
from ...training.session import OnProgress
from ..model import Fitted, Inputs, Model, Problem, Session, known_positions


class Single(ABC):
    """The model of one receiver; its subclasses are dataclasses, which `wrf_mi.core.stored` stores."""

    @abstractmethod
    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> NDArray[Any]:
        """Observations [m, ...] at positions [m, 3]."""


class Probabilistic(Single):
    """The model of one receiver that states standard deviations."""

    @abstractmethod
    def prediction(self, tx_pos: FloatArray) -> Prediction:
        """Observations [m, ...] at positions [m, 3], and their standard deviations."""

    @abstractmethod
    def facts(self) -> dict[str, Any]:
        """Fitted parameters and choices as plain numbers and strings."""


@dataclass(frozen=True)
class ReceiverRows:
    """Training rows of one receiver, and what they belong to."""

    problem: Problem
    split: Split
    receiver: Receiver
    tx_pos_m: FloatArray  # positions [n, 3], metres
    observation: NDArray[Any]  # observations [n, ...]; NaN where nothing was received
    tx_heading_rad: FloatArray | None  # headings [n], or None to leave them out
    on_progress: OnProgress


def finite_positions(inputs: Inputs, name: str) -> FloatArray:
    """Positions of the rows to predict [m, 3], metres.

    Raises:
        InputError: unknown positions, from which the model ``name`` predicts.
    """
    if not np.isfinite(inputs.tx_pos_m).all():
        raise InputError(f"{name}: predicts from positions; give finite x, y, z in metres for every row")
    return inputs.tx_pos_m


def observed_rows(
    tx_pos: ArrayLike, observation: ArrayLike, tx_heading_rad: ArrayLike | None = None
) -> tuple[FloatArray, NDArray[Any], FloatArray | None]:
    """Positions [n, 3], observations [n, ...] and headings [n] of the rows without NaN.

    Raises:
        InputError: no rows, none that was received, or different numbers of them.
    """
    positions, values = np.atleast_2d(np.asarray(tx_pos, float)), np.asarray(observation)
    heading = None if tx_heading_rad is None else np.asarray(tx_heading_rad, float)
    if not (0 < len(positions) == len(values)) or (heading is not None and heading.shape != (len(values),)):
        counts = f"{len(positions)} positions and {len(values)} observations"
        raise InputError(f"{counts}: give one (and one heading, if any) per row, at least one")
    received = ~np.isnan(values).reshape(len(values), -1).any(axis=1)
    if not received.any():
        raise InputError(f"{len(values)} training rows: none of them was received; use another split")
    return positions[received], values[received], None if heading is None else heading[received]


@dataclass(frozen=True)
class ByReceiver(Fitted):
    """A model for each receiver, and for each carrier where the rows have several."""

    name: str  # name of the method, for errors
    # Models of the receivers in turn, and so for each carrier; None: too few rows at that carrier
    models: list[Single | None]
    heading: bool  # whether the models use headings
    carriers_hz: FloatArray | None = None

    @property
    def states_std(self) -> bool:
        """Whether predictions have standard deviations: those of all receivers, or none."""
        return self.carriers_hz is None and all(isinstance(model, Probabilistic) for model in self.models)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of a receiver, [m, ...], with standard deviations where `states_std`.

        At a carrier without a model of the receiver they are linear in the logarithm of the frequency between the two
        next carriers with one, and beyond all of them those of the nearest.

        Raises:
            InputError: positions, headings or carriers that are not known.
        """
        return self._predict(inputs, receiver, std=True)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, without the time that standard deviations take."""
        return self._predict(inputs, receiver, std=False).mean

    def _predict(self, inputs: Inputs, receiver: int, std: bool) -> Prediction:
        tx_pos_m = finite_positions(inputs, self.name)
        if self.heading and inputs.tx_heading_rad is None:
            raise InputError(
                f"{self.name}: fitted with the transmitter's headings; give heading_rad, or train with heading=false"
            )
        heading = inputs.tx_heading_rad if self.heading else None
        if self.carriers_hz is None:
            (model,) = self._of(receiver).values()
            if std and self.states_std:
                assert isinstance(model, Probabilistic)
                return model.prediction(tx_pos_m)
            return Prediction(model.predict(tx_pos_m, heading))
        if inputs.carriers_hz is None:
            carriers = carriers_text(self.carriers_hz)
            raise InputError(f"{self.name}: trained at {carriers}; give the carrier of every row")
        models = self._of(receiver)
        fitted, known_log = list(models.values()), np.log(self.carriers_hz[list(models)])

        def of_carrier(carrier_hz: float, rows: IntArray) -> NDArray[Any]:
            # Over log f, in which free-space path loss is linear; `interp` holds the outermost models beyond them.
            place = np.interp(np.log(carrier_hz), known_log, np.arange(len(known_log)))
            turned = None if heading is None else heading[rows]

            def at(number: int) -> NDArray[Any]:
                return np.asarray(fitted[number].predict(tx_pos_m[rows], turned))

            below, share = int(place), place % 1
            # At a carrier with a model no second one is evaluated, and none may exist above the last.
            return at(below) if share == 0 else (1 - share) * at(below) + share * at(below + 1)

        return Prediction(by_carrier(inputs.carriers_hz, of_carrier))

    def _of(self, receiver: int) -> dict[int, Single]:
        """Models of a receiver by the number of the carrier."""
        carriers = 1 if self.carriers_hz is None else len(self.carriers_hz)
        # Models run through the receivers of the first carrier, then of the next.
        models = enumerate(self.models[receiver :: len(self.models) // carriers])
        return {number: model for number, model in models if model is not None}

    @property
    def depends_on_heading(self) -> bool:
        """Whether the models use headings."""
        return self.heading

    def facts(self) -> dict[str, Any]:
        """Fitted parameters and choices of each receiver, where its model states them."""
        if not self.states_std:
            return {}
        return {"fitted": [model.facts() for model in self.models if isinstance(model, Probabilistic)]}


class ByReceiverModel(Model):
    """A method that fits every receiver by itself to all training rows, those of each carrier by themselves."""

    uplink = "optional"
    several_carriers, headings = True, True
    fitted: type[ByReceiver] = ByReceiver  #: class of its fitted models

    @abstractmethod
    def fit_single(self, rows: ReceiverRows) -> Single:
        """The model of one receiver.

        Raises:
            InputError: rows that it cannot be fitted to.
        """

    def takes_headings(self, record: Record, settings: Any) -> bool:
        """Whether headings count where the record has them."""
        return False

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Most interpolate over the transmitter's positions, whatever the receiver's."""
        return False

    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Models of all receivers, and of all carriers.

        Raises:
            InputError: unknown positions, or rows that the model of a receiver cannot be fitted to.
        """
        record, rows = problem.record, split.all_train
        known_positions(record, rows, self.name)
        headings = record.tx_heading_rad if self.takes_headings(record, problem.settings) else None
        carriers, parts = None, [rows]
        if record.carriers_hz is not None:
            carriers_hz = record.carriers_hz[rows]
            carriers = np.unique(carriers_hz)
            parts = [rows[carriers_hz == carrier_hz] for carrier_hz in carriers]
        counts = np.stack([rows_received(record, part) for part in parts])
        # A receiver with few rows at one carrier is interpolated between its other carriers.
        enough = counts >= np.minimum(counts.max(axis=0), LEAST_ROWS)
        models: list[Single | None] = []
        for part, has_rows in zip(parts, enough, strict=True):
            turned = None if headings is None else headings[part]
            for receiver, observed, fits in zip(record.receivers, record.observation, has_rows, strict=True):
                if not fits:
                    models.append(None)
                    continue
                done, name = len(models), receiver.name

                def progress(
                    stage: str, share: float, _: object = None, /, *, done: int = done, name: str = name
                ) -> None:
                    session.progress(f"{name}: {stage}", (done + share) / enough.size)

                rows_of = ReceiverRows(
                    problem, split, receiver, record.tx_pos_m[part], observed[part], turned, progress
                )
                try:
                    models.append(self.fit_single(rows_of))
                except InputError as error:
                    raise InputError(f"{record.name}, receiver {name}: {error}") from None
                session.progress(f"{self.name}: receivers", len(models) / enough.size)
        return self.fitted(self.name, models, headings is not None, carriers)
