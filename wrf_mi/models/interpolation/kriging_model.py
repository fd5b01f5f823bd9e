"""Kriging as a baseline: which trend and covariance serve which task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Receiver, Record, Split
from ...core.angles import FloatArray
from ...tasks import task_of
from ...training.session import FitSession
from ..method import Method
from .by_receiver import ByReceiver, fit_each, load_each
from .kriging import KrigedMean, Kriging, Trend, constant, log_distance

NAME = "kriging"
CONSTANT, LOG_DISTANCE = "constant", "log-distance"
TREND = "trend"
"""Key of the arrays that names the trend."""


@dataclass(frozen=True)
class KrigingSettings:
    """Settings of kriging. Lengths and noise that are null are those of the greatest likelihood of the training rows.

    Attributes:
        length_m: correlation length, metres, or null.
        noise: variance of the noise as a share of the field's, or null.
        heading_length: correlation length over headings, in chords of the unit circle, or null.
        kernel: exponential, matern32 or gaussian.
        trend: constant, log-distance, or null: log-distance for signal strengths, else constant.
        trend_fit: gls (jointly with the field) or ols (before it), or null: ols for log-distance, else gls.
        heading: whether headings count, where the data have them and hold signal strengths.
        likelihood_rows: so many rows at most enter the likelihood.
    """

    length_m: float | None = None
    noise: float | None = None
    heading_length: float | None = None
    kernel: str = "exponential"
    trend: str | None = None
    trend_fit: str | None = None
    heading: bool = True
    likelihood_rows: int = 1000


@dataclass(frozen=True)
class Kriged:
    """One receiver's field.

    Attributes:
        mean: what predicts.
        trend: name of its trend.
    """

    mean: KrigedMean
    trend: str

    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> NDArray[Any]:
        """Observations [m, ...] at positions [m, 3]."""
        return self.mean.predict(tx_pos, tx_heading_rad)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        return {TREND: np.asarray(self.trend), **self.mean.arrays()}


def fit(record: Record, split: Split, settings: KrigingSettings, seed: int, session: FitSession) -> ByReceiver:
    """Krige what each receiver received.

    Raises:
        InputError: settings out of range, a length over headings where the data have none, positions that are not
            known, or too few rows.
    """
    if settings.heading_length is not None and record.tx_heading_rad is None:
        raise InputError(f"{record.name}: has no headings for kriging's heading_length; leave the setting away")
    name = settings.trend or (LOG_DISTANCE if task_of(record).in_decibel else CONSTANT)
    how = settings.trend_fit or ("ols" if name == LOG_DISTANCE else "gls")
    if name not in (CONSTANT, LOG_DISTANCE):
        raise InputError(f"kriging: trend {name!r}; choose {CONSTANT} or {LOG_DISTANCE}")

    def one(receiver: Receiver, tx_pos: FloatArray, observed: NDArray[Any], heading: FloatArray | None) -> Kriged:
        model = Kriging(
            settings.length_m,
            settings.noise,
            settings.heading_length,
            settings.kernel,
            _trend(name, receiver),
            cast(Literal["gls", "ols"], how),
            settings.likelihood_rows,
            seed,
        )
        return Kriged(model.fit(tx_pos, observed, heading).mean, name)

    return fit_each(NAME, record, split, session.report, one, settings.heading and task_of(record).in_decibel)


def _trend(name: str, receiver: Receiver) -> Trend:
    return log_distance(receiver.position_m) if name == LOG_DISTANCE else constant


def load(arrays: dict[str, NDArray[Any]], record: Record) -> ByReceiver:
    """What `ByReceiver.arrays` returned, at the record's receivers."""

    def one(receiver: Receiver, kept: dict[str, NDArray[Any]]) -> Kriged:
        name = str(kept[TREND])
        return Kriged(KrigedMean.from_arrays(kept, _trend(name, receiver)), name)

    return load_each(NAME, arrays, record, one)


METHOD = Method(
    NAME,
    None,
    KrigingSettings,
    fit,
    load,
    "Rasmussen and Williams, 'Gaussian Processes for Machine Learning' (2006), sections 2.2, 2.7 and 5.4",
    several_carriers=True,
)
