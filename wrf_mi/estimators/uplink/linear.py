"""Linear map from uplink to downlink: the linear minimum-mean-square-error estimator, learned by ridge regression.

Each antenna's downlink y [g] is its uplink x [f] times a complex matrix [f, g] that all antennas share. The matrix
minimises the squared error over the training rows plus a penalty on its squared entries, by the normal equations.
Without the penalty, and with means in place of sums, it is the estimator of Kay (below), E[x^H x]^-1 E[x^H y] for rows
x and y. It has no offset: the phase of a radio is arbitrary, so that means are zero. Chosen here:

- An antenna's squared error counts in units of its row's downlink energy, as the score (CEA) does.
- The penalty of `PENALTIES`, in units of the mean energy of an uplink coefficient, has the best median CEA of the
  validation rows, or without these of every fifth training row. Then all training rows are fitted with it.

Source: Kay, "Fundamentals of statistical signal processing: estimation theory" (1993), chapter 12; Hoerl and Kennard,
"Ridge regression: biased estimation for nonorthogonal problems", Technometrics 12, 55 (1970).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ...core import InputError, Prediction, Record, Split
from ...core.settings import CheckedSettings
from ...core.types import IntArray
from ...training.session import FitSession, OnProgress
from ..model import Fitted, Inputs, Problem, slices
from .uplink_waves import UplinkModel, relative_error

PENALTIES = tuple(float(10.0**half) for half in np.arange(-10, 1.25, 0.5))
"""Penalties to choose from: from the resolution of float64 in normal equations to a map of nearly zero."""
JUDGES = 5  # without validation rows, every so-many-th training row chooses the penalty
CHUNK_SIZE = 256  # rows whose products are added together: bounds the memory beside the data


@dataclass(frozen=True)
class LinearSettings(CheckedSettings):
    """Settings of the linear map."""

    #: in units of the mean energy of an uplink coefficient; None: chosen on validation rows
    penalty: Annotated[float | None, Field(gt=0, description="more than 0")] = None


@dataclass(frozen=True)
class LinearMap(Fitted):
    """A fitted map from uplink to downlink coefficients, ``matrix`` [f, g], and the penalty of its fit."""

    matrix: NDArray[np.complex128]
    antennas: int
    penalty: float

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``."""
        return Prediction((np.asarray(inputs.uplink, complex) @ self.matrix).astype(np.complex64))


def ridge(record: Record, rows: IntArray) -> Callable[[float], NDArray[np.complex128]]:
    """The map [f, g] of some rows (InputError: rows without downlink energy) by penalty in units of mean eigenvalue."""
    assert record.uplink is not None
    up, down = record.uplink.shape[2], record.observation.shape[3]
    # Normal equations: sums over rows and antennas of weighted products.
    left, right = np.zeros((up, up), complex), np.zeros((up, down), complex)
    for part in slices(len(rows), CHUNK_SIZE):
        chunk = rows[part]
        x, y = record.uplink[chunk].astype(complex), record.observation[0, chunk].astype(complex)
        energy = np.square(np.abs(y)).sum(axis=(1, 2))
        # A row without energy has no relative error.
        scale = np.where(energy > 0, 1 / np.sqrt(np.where(energy > 0, energy, 1)), 0)[:, None, None]
        x, y = (x * scale).reshape(-1, up), (y * scale).reshape(-1, down)
        left += x.conj().T @ x
        right += x.conj().T @ y
    if not np.trace(left).real > 0:
        raise InputError(f"{record.name}: no training row's downlink has any energy; use other rows")
    values, vectors = np.linalg.eigh(left)

    def matrix(penalty: float) -> NDArray[np.complex128]:
        # Ridge regression by eigenvectors: each penalty costs one product. Rounding leaves values below 0.
        damped = np.maximum(values, 0) + penalty * values.mean()
        return np.asarray(vectors @ ((vectors.conj().T @ right) / damped[:, None]))

    return matrix


def choose(record: Record, train: IntArray, judges: IntArray, on_progress: OnProgress) -> float:
    """The penalty of the best median relative error of the rows that judge, from a fit to the others."""
    assert record.uplink is not None
    matrix = ridge(record, train)
    uplink = record.uplink[judges].astype(complex)
    truth = record.observation[0, judges].reshape(len(judges), -1)
    errors = []
    for number, penalty in enumerate(PENALTIES):
        predicted = (uplink @ matrix(penalty)).reshape(len(judges), -1)
        errors.append(float(np.median(relative_error(predicted, truth))))
        on_progress("linear: choosing the penalty", (number + 1) / (len(PENALTIES) + 1))
    return PENALTIES[int(np.argmin(errors))]


class LinearModel(UplinkModel):
    """The linear estimator."""

    name, settings, fitted = "linear", LinearSettings, LinearMap
    source = "Kay, Fundamentals of statistical signal processing: estimation theory (1993), chapter 12"
    summary = "linear map from uplink to downlink"

    def fit(self, problem: Problem, split: Split, session: FitSession) -> LinearMap:
        """Choose the penalty, then fit the map to all training rows."""
        record, settings = problem.record, problem.settings
        train, validation = self.known_rows(record, split)
        all_train = np.concatenate([train, validation])
        if not len(validation):
            picked = np.arange(len(train)) % JUDGES == 0
            train, validation = train[~picked], train[picked]
        penalty = settings.penalty or choose(record, train, validation, session.progress)
        matrix = ridge(record, all_train)(penalty)
        session.progress(f"linear: penalty {penalty:.2g}", 1.0)
        return LinearMap(matrix, record.observation.shape[2], penalty)


MODEL = LinearModel()
