"""MRI: signal strengths by the log-distance path-loss law.

P(d) = T - 10 gamma log10(d), with the power T at one metre and the exponent gamma fitted by least squares to the rows
that were received; d is the distance between transmitter and receiver. That is what of Shin et al.'s system for
smartphones (which also tracks the user and finds the access points) is compared with in NeRF2 and WRF-GS+. The code of
NeRF2's authors fits one T and gamma for all receivers together; here each receiver has its own, as Shin et al. fit each
access point, and ``shared=true`` fits one.

Source: Shin, Chon, Kim and Cha, "MRI: Model-based radio interpolation for indoor war-walking", IEEE Transactions on
Mobile Computing 14, 1231 (2015); Rappaport, "Wireless Communications" (2002), section 4.9.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Receiver, Record, Split
from ...core.angles import FloatArray
from ...training.session import FitSession
from ..method import Method
from .by_receiver import ByReceiver, fit_each, load_each
from .kriging import log_distance

NAME = "mri"


@dataclass(frozen=True)
class MriSettings:
    """Settings of MRI.

    Attributes:
        shared: one power at a metre and one exponent for all receivers.
    """

    shared: bool = False


@dataclass(frozen=True)
class PathLoss:
    """The fitted law of one receiver.

    Attributes:
        receiver_m: its position [3], metres.
        law: power at one metre in dBm, and minus the exponent, [2].
    """

    receiver_m: FloatArray
    law: FloatArray

    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> NDArray[Any]:
        """Power in dBm, [m] float32, at transmitter positions [m, 3]."""
        return (log_distance(self.receiver_m)(tx_pos) @ self.law).astype(np.float32)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The law."""
        return {"law": self.law}


def fit(record: Record, split: Split, settings: MriSettings, seed: int, session: FitSession) -> ByReceiver:
    """Fit the law to the training rows that were received.

    Raises:
        InputError: rows at a single distance, or none that was received.
    """
    rows = split.all_train
    everyone = _law(*_pairs(record, rows)) if settings.shared else None

    def one(receiver: Receiver, tx_pos: FloatArray, observed: NDArray[Any], heading: FloatArray | None) -> PathLoss:
        if everyone is not None:
            return PathLoss(receiver.position_m, everyone)
        known = ~np.isnan(observed)
        return PathLoss(receiver.position_m, _law(log_distance(receiver.position_m)(tx_pos[known]), observed[known]))

    return fit_each(NAME, record, split, session.report, one)


def _pairs(record: Record, rows: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    columns = np.stack([log_distance(receiver.position_m)(record.tx_pos_m[rows]) for receiver in record.receivers])
    observed = np.asarray(record.observation[:, rows], float)
    known = ~np.isnan(observed)
    return columns[known], observed[known]


def _law(columns: FloatArray, observed: NDArray[Any]) -> FloatArray:
    if len(observed) < 2 or not np.ptp(columns[:, 1]) > 0:
        raise InputError(f"mri: {len(observed)} rows at one distance; an exponent shows at two or more")
    law: FloatArray = np.linalg.lstsq(columns, np.asarray(observed, float), rcond=None)[0]
    return law


def load(arrays: dict[str, NDArray[Any]], record: Record) -> ByReceiver:
    """What `ByReceiver.arrays` returned, at the record's receivers."""
    return load_each(NAME, arrays, record, lambda receiver, kept: PathLoss(receiver.position_m, kept["law"]))


METHOD = Method(
    NAME,
    ("rssi",),
    MriSettings,
    fit,
    load,
    "Shin et al., 'MRI: model-based radio interpolation for indoor war-walking' (2015): log-distance path loss",
    several_carriers=True,
)
