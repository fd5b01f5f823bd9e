"""MRI: signal strengths by the log-distance path-loss law.

P(d) = T - 10 gamma log10(d), with the power T at one metre and the exponent gamma fitted by least squares to the rows
that were received; d is the distance between transmitter and receiver. Each receiver has its T and gamma, as in Shin et
al.; one whose rows are all at one distance takes the gamma of all receivers together. ``shared=true`` fits both for all
receivers together, as the code of NeRF2's authors does.

Source: Shin, Chon, Kim and Cha, "MRI: Model-based radio interpolation for indoor war-walking", IEEE Transactions on
Mobile Computing 14, 1231 (2015); Rappaport, "Wireless Communications" (2002), section 4.9.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..model import Problem
from .by_receiver import ByReceiverModel, ReceiverRows, Single
from .path_loss import Trend, fit_path_loss, shows_exponent


@dataclass(frozen=True)
class MriSettings:
    """Settings of MRI.

    Attributes:
        shared: whether all receivers share a power at one metre and an exponent; receivers that were not trained on
            take that law in any case.
    """

    shared: bool = False


@dataclass(frozen=True)
class PathLoss(Single):
    """The fitted law of one receiver."""

    receiver_m: FloatArray  # position of the receiver [3], metres
    law: FloatArray  # power at one metre in dBm, and minus the exponent, [2]

    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> NDArray[Any]:
        """Power in dBm, [m] float32, at transmitter positions [m, 3]."""
        return (Trend(self.receiver_m)(tx_pos) @ self.law).astype(np.float32)


def _shared_law(record: Record, rows: IntArray) -> FloatArray:
    """Power at one metre and slope that fit some rows of all receivers together."""
    columns = np.stack([Trend(receiver.position_m)(record.tx_pos_m[rows]) for receiver in record.receivers])
    return _law(columns, record.observation[:, rows])


def _law(columns: FloatArray, observed: NDArray[Any]) -> FloatArray:
    if not shows_exponent(columns, observed):
        count = np.count_nonzero(np.isfinite(observed))
        raise InputError(f"mri: {count} rows at one distance; an exponent shows at two or more")
    return fit_path_loss(columns, observed)


class Mri(ByReceiverModel):
    """The log-distance law of each receiver."""

    name, settings = "mri", MriSettings
    source = "Shin et al., 'MRI: model-based radio interpolation for indoor war-walking' (2015): log-distance path loss"
    summary = "log-distance path loss of each receiver"
    tasks = ("rssi",)
    new_receivers = True

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """The law is of the distance from them."""
        return True

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """``shared`` for a single receiver."""
        return {"shared": "there is one receiver"} if len(problem.record.receivers) == 1 else {}

    def fit_single(self, rows: ReceiverRows) -> PathLoss:
        """The law of a receiver, or that of all receivers."""
        record, train, observed = rows.problem.record, rows.split.all_train, rows.observation
        receiver_m = rows.receiver.position_m
        columns = Trend(receiver_m)(rows.tx_pos_m)
        if rows.problem.settings.shared or np.isnan(observed).all():  # a receiver that is held out has no rows
            return PathLoss(receiver_m, _shared_law(record, train))
        # Where all positions coincide, the shared law has no slope either, and `_law` says so.
        if np.ptp(rows.tx_pos_m, axis=0).any() and not shows_exponent(columns, observed):
            # Rows at a single distance state a level but no exponent, which is that of all receivers.
            return PathLoss(receiver_m, fit_path_loss(columns, observed, -_shared_law(record, train)[1]))
        return PathLoss(receiver_m, _law(columns, observed))


MODEL = Mri()
