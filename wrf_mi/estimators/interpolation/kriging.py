"""Kriging: the best linear interpolation of the measurements under a stated covariance.

An observation is a trend, a smooth field of zero mean and noise: y(x) = b(x) . beta + z(x) + e with
Cov(z(x), z(x')) = s^2 c(x, x') and Var(e) = s^2 noise. The covariance is shared by all components of an observation
(pixels, subcarriers), so that one Cholesky factor serves all of them; each component has its variance s^2 and trend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.optimize import minimize

from ...core import InputError, Prediction, Receiver, Record, Split
from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, names_of
from ..model import Problem
from .by_receiver import ByReceiverModel, Probabilistic, ReceiverRows, Single, observed_rows
from .kriging_equations import KrigingSystem, component_root, correlation
from .path_loss import Trend

CONSTANT, LOG_DISTANCE = "constant", "log-distance"
LENGTH_M = (0.01, 100.0)  # or half of the rows' extent
HEADING_LENGTH = (0.1, 100.0)
NOISE = (1e-4, 10.0)
"""Limits of the likelihood's maximum: metres, chords of the unit circle (2 is the opposite heading), shares of the
variance."""
LIKELIHOOD_EVALUATIONS = 200  # Nelder-Mead on three logarithms settles to 0.01 in 60 to 150


UNKNOWN_MEAN = Trend()  # one unknown mean


@dataclass(frozen=True)
class Kriged(Single):
    """A fitted kriging: a trend, and weights of the training rows' correlations."""

    kernel: str  # a key of `wrf_mi.estimators.interpolation.kriging_equations.KERNELS`
    lengths: FloatArray  # correlation length in metres, and over headings where there are any
    positions_m: FloatArray  # positions of the rows [n, 3]
    circle: FloatArray | None  # cosine and sine of their headings [n, 2], or None
    coefficients: NDArray[np.inexact]  # coefficients of the trend's columns for each component [p, q]
    weights: NDArray[np.inexact]  # weights of the rows for each component [n, q]
    like: NDArray[np.inexact]  # empty array of the shape and type of observations, [0, ...]
    trend: Trend
    noise: float = 0.0  # variance of the noise as a share of the field's

    def predict(self, tx_pos: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> NDArray[np.inexact]:
        """Interpolate at positions [m, 3], metres: [m, ...], in the observations' unit and type.

        Raises:
            InputError: headings that the fit did not have, or the other way round.
        """
        if (tx_heading_rad is None) != (self.circle is None):
            had = "no headings" if self.circle is None else "headings"
            raise InputError(f"kriging: fitted with {had}; predict with the same")
        positions = np.atleast_2d(np.asarray(tx_pos, float))
        turned = None if tx_heading_rad is None else _circle(tx_heading_rad)
        requested = _coordinates(positions, turned, self.lengths)
        cross = correlation(requested, _coordinates(self.positions_m, self.circle, self.lengths), self.kernel)
        mean = self.trend(positions) @ self.coefficients + cross @ self.weights
        return mean.astype(self.like.dtype).reshape(len(mean), *self.like.shape[1:])


@dataclass(frozen=True, kw_only=True)
class UncertainKriged(Kriged, Probabilistic):
    """Kriging over positions, with a trend by generalised least squares, that states standard deviations."""

    scale: FloatArray  # standard deviation of the field of each component [q]

    @classmethod
    def of(cls, kriged: Kriged, observed: NDArray[Any]) -> UncertainKriged:
        """The kriging of rows [n, ...], with the variance of greatest restricted likelihood."""
        values = observed.reshape(len(observed), -1)
        free = len(values) - kriged.coefficients.shape[0]
        # y^H Q y / free, Q being the precision free of the trend, whose product with y the weights are. A single row
        # says nothing about the spread: it may be as great as what it observed.
        square = np.einsum("nq,nq->q", values.conj(), kriged.weights if free else values).real / max(free, 1)
        return cls(**vars(kriged), scale=np.sqrt(np.maximum(square, 0)))

    @cached_property
    def _system(self) -> KrigingSystem:
        rows = self.positions_m / self.lengths[0]
        return KrigingSystem(correlation(rows, rows, self.kernel), self.noise, self.trend(self.positions_m))

    def left_out(self) -> NDArray[Any]:
        """Errors of the rows, each predicted from all others, [n, q] (Dubrule, 1983)."""
        return np.asarray(self.weights / np.diag(self._system.precision)[:, None])

    def prediction(self, tx_pos: FloatArray) -> Prediction:
        """Observations, and standard deviations of these and of their mean, at positions [m, 3], metres."""
        mean, length_m = self.predict(tx_pos), self.lengths[0]
        cross = correlation(tx_pos / length_m, self.positions_m / length_m, self.kernel)
        of_mean = self._system.variance(1.0, cross, self.trend(tx_pos))
        std, std_mean = (
            (np.sqrt(variance)[:, None] * self.scale).reshape(mean.shape)
            for variance in (of_mean + self.noise, of_mean)
        )
        return Prediction(mean, std, std_mean=std_mean)

    def facts(self) -> dict[str, Any]:
        """Form, correlation length and noise."""
        return {"parts": "generic", "length_m": float(self.lengths[0]), "noise": self.noise}


@dataclass(frozen=True)
class CovarianceSettings(CheckedSettings):
    """Settings of kriging's covariance; null: of the greatest restricted likelihood of the training rows.

    Attributes:
        length_m: correlation length, metres, or null.
        noise: variance of the noise as a share of the field's, or null.
        heading_length: correlation length over headings, in chords of the unit circle, or null; unused without.
        kernel: exponential, matern32 or gaussian, see `wrf_mi.estimators.interpolation.kriging_equations.KERNELS`.
        likelihood_rows: most rows of the likelihood, drawn with the seed; the prediction uses all.
    """

    length_m: Annotated[float | None, Field(gt=0, description="more than 0")] = None
    noise: float | None = None
    heading_length: Annotated[float | None, Field(gt=0, description="more than 0")] = None
    kernel: Literal["exponential", "matern32", "gaussian"] = "exponential"
    likelihood_rows: Annotated[int, Field(ge=2, description="2 or more")] = 1000


@dataclass(frozen=True)
class Kriging(CovarianceSettings):
    """Kriging of real or complex observations over positions and, if given, headings.

    c is a kernel of sqrt(|x - x'|^2 / length^2 + |(cos, sin) - (cos, sin)'|^2 / heading_length^2). The likelihood that
    chooses has the variance at its best value.

    Attributes:
        trend: columns of the trend; one unknown mean by default.
        trend_fit: ``gls``, jointly with the field (universal kriging); ``ols``, by least squares before it (regression
            kriging), in which every row weighs the same.
        seed: seed of the rows of the likelihood.
    """

    trend: Trend = UNKNOWN_MEAN
    trend_fit: Literal["gls", "ols"] = "gls"
    seed: int = 0

    def fit(self, tx_pos: ArrayLike, observation: ArrayLike, tx_heading_rad: ArrayLike | None = None) -> Kriged:
        """Choose lengths and noise that are None, and factor the covariance of the rows that were observed.

        Positions [n, 3] are in metres; real or complex observations [n, ...] are NaN where nothing was received; None
        leaves headings [n] out.

        Raises:
            InputError: no rows, none that was observed, different numbers of them, fewer than the trend has columns,
                or rows that coincide while the noise is zero.
        """
        positions, values, heading = observed_rows(tx_pos, observation, tx_heading_rad)
        like = np.empty((0, *values.shape[1:]), np.result_type(values, np.float32))
        y = values.reshape(len(values), -1)
        circle = None if heading is None else _circle(heading)
        columns = self.trend(positions)
        if len(y) < columns.shape[1]:
            text = f"kriging: training rows received: {len(y)}; its trend needs {columns.shape[1]}"
            raise InputError(f"{text}, so give more rows or a constant trend")
        field, ordinary = y, None
        if self.trend_fit == "ols":
            # Regression kriging: the field is the residual of the least-squares trend, known from here on.
            ordinary = np.linalg.lstsq(columns, y, rcond=None)[0]
            field, columns = y - columns @ ordinary, columns[:, :0]
        lengths, noise = self._choose(field, columns, positions, circle)
        try:
            system = self._factored(_coordinates(positions, circle, lengths), noise, columns)
        except LinAlgError:
            raise InputError("kriging: rows coincide and the noise is zero; give noise above 0") from None
        beta, weights = system.regression(field)
        coefficients = beta if ordinary is None else ordinary
        return Kriged(self.kernel, lengths, positions, circle, coefficients, weights, like, self.trend, noise)

    def _factored(self, coordinates: FloatArray, noise: float, columns: FloatArray) -> KrigingSystem:
        return KrigingSystem(correlation(coordinates, coordinates, self.kernel), noise, columns)

    def _choose(
        self, field: NDArray[np.inexact], columns: FloatArray, positions_m: FloatArray, circle: FloatArray | None
    ) -> tuple[FloatArray, float]:
        """Lengths and noise: as given, or of the greatest likelihood."""
        rows = np.arange(len(field))
        if len(rows) > self.likelihood_rows:
            rows = np.sort(np.random.default_rng(self.seed).permutation(rows)[: self.likelihood_rows])
        positions_m, circle, columns = positions_m[rows], None if circle is None else circle[rows], columns[rows]
        extent = float(np.linalg.norm(np.ptp(positions_m, axis=0)))
        longest = LENGTH_M[0], max(LENGTH_M[1], extent / 2)
        # Stated value or None, limits, and first value of the search.
        table = [
            (self.length_m, longest, float(np.clip(extent / 10, *longest))),
            (self.heading_length, HEADING_LENGTH, 1.0),
            (self.noise, NOISE, 0.1),
        ]
        hyperparameters, limits, first = zip(*(table if circle is not None else [table[0], table[2]]), strict=True)
        free = np.array([value is None for value in hyperparameters])
        value = np.array([0.0 if v is None else v for v in hyperparameters])
        if not free.any():
            return value[:-1], float(value[-1])
        root = component_root(field[rows])
        if not root.any() and not columns.shape[1]:
            # The trend that was fitted before passes through every row, as through any two: there is no field, whose
            # correlations would count.
            value[free] = np.array(first)[free]
            return value[:-1], float(value[-1])
        if not root.any():
            raise InputError("kriging: all observations are zero; give length and noise instead of None")

        def objective(logarithm: FloatArray) -> float:
            # Minus the logarithm of the restricted likelihood, the variance at its best, per component.
            value[free] = np.exp(logarithm)
            try:
                system = self._factored(_coordinates(positions_m, circle, value[:-1]), float(value[-1]), columns)
            except LinAlgError:  # singular to rounding, as a smooth kernel is at great lengths: the search turns back
                return np.inf
            return system.restricted_cost(root, np.finfo(float).tiny) / 2

        # Over logarithms, as lengths and noise are scales.
        start = np.log(first)[free]
        simplex = np.concatenate([start[None], start + np.eye(len(start))])
        best = minimize(
            objective,
            start,
            method="Nelder-Mead",
            bounds=np.log(limits)[free],
            options={"initial_simplex": simplex, "maxfev": LIKELIHOOD_EVALUATIONS, "xatol": 0.01, "fatol": 0.01},
        )
        value[free] = np.exp(best.x)
        return value[:-1], float(value[-1])


def _coordinates(positions_m: FloatArray, circle: FloatArray | None, lengths: FloatArray) -> FloatArray:
    """Positions and headings in correlation lengths."""
    scaled = positions_m / lengths[0]
    return scaled if circle is None else np.concatenate([scaled, circle / lengths[1]], axis=1)


def _circle(heading_rad: ArrayLike) -> FloatArray:
    heading = np.asarray(heading_rad, float)
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


@dataclass(frozen=True)
class KrigingSettings(CovarianceSettings):
    """Settings of kriging.

    Attributes:
        trend: constant, log-distance, or null: log-distance for signal strengths, else constant.
        trend_fit: gls (jointly with the field) or ols (before it), or null: ols for log-distance, else gls.
        generic: whether the observations themselves are kriged, each receiver alone, whatever they are; so they are,
            too, where a covariance or a trend is stated.
        heading: whether headings count, where the data have them and hold signal strengths.
    """

    trend: str | None = None
    trend_fit: str | None = None
    generic: bool = False
    heading: bool = True


GENERIC_ONLY = names_of(KrigingSettings) - {"generic", "heading"}
"""Settings that only generic kriging has."""


def asks_generic(problem: Problem) -> bool:
    """Whether `KrigingSettings.generic` is set, or settings are stated that only generic kriging has."""
    return problem.settings.generic or bool(GENERIC_ONLY & problem.stated_settings)


class GenericKriging(ByReceiverModel):
    """Kriging of any observations, each receiver by itself."""

    name, summary = "kriging", "kriging (Gaussian process)"
    source = "Rasmussen and Williams, 'Gaussian Processes for Machine Learning' (2006), sections 2.2, 2.7 and 5.4"
    settings: type = KrigingSettings

    def takes_headings(self, record: Record, settings: KrigingSettings) -> bool:
        """Whether the settings let headings count, which matter to strengths alone."""
        return settings.heading and record.task.follows_heading

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Whether its trend is a law of distance."""
        return _trend_name(problem) == LOG_DISTANCE

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of headings that do not count, and a choice of rows for a likelihood without free parameters."""
        s, record, unused = problem.settings, problem.record, dict[str, str]()
        turns = record.tx_heading_rad is not None and self.takes_headings(record, replace(s, heading=True))
        if not turns:
            why = "the data have no headings" if record.tx_heading_rad is None else "they count for strengths alone"
            unused |= dict.fromkeys(("heading", "heading_length"), why)
        elif not s.heading:
            unused["heading_length"] = "heading=false"
        if None not in (s.length_m, s.noise, *([s.heading_length] if turns and s.heading else [])):
            unused["likelihood_rows"] = "lengths and noise are stated"
        if "generic" in problem.stated_settings and not s.generic:
            unused |= dict.fromkeys(GENERIC_ONLY, "generic=false")
        return unused

    def fit_single(self, rows: ReceiverRows) -> Single:
        """Kriging of the observations themselves, see `kriged`."""
        return kriged(rows)


def _trend_name(problem: Problem) -> str:
    return problem.settings.trend or (LOG_DISTANCE if problem.record.task.shares_law else CONSTANT)


def _trend(name: str, receiver: Receiver) -> Trend:
    return Trend(receiver.position_m if name == LOG_DISTANCE else None)


def kriged(rows: ReceiverRows) -> Kriged:
    """Kriging of the observations of one receiver.

    Raises:
        InputError: settings that do not fit the data, or as `Kriging.fit`.
    """
    s, record = rows.problem.settings, rows.problem.record
    if s.heading_length is not None and record.tx_heading_rad is None:
        raise InputError(f"{record.name}: has no headings for kriging's heading_length; omit the setting")
    name = _trend_name(rows.problem)
    if name not in (CONSTANT, LOG_DISTANCE):
        raise InputError(f"kriging: trend {name!r}; choose {CONSTANT} or {LOG_DISTANCE}")
    # The law of distance is that of the whole room: each row weighs the same in it, however dense the rows around it.
    how: Any = s.trend_fit or ("ols" if name == LOG_DISTANCE else "gls")
    arguments = s.length_m, s.noise, s.heading_length, s.kernel, s.likelihood_rows
    kriging = Kriging(*arguments, _trend(name, rows.receiver), how, rows.problem.seed)
    return kriging.fit(rows.tx_pos_m, rows.observation, rows.tx_heading_rad)
