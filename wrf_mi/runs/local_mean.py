"""Scores of local mean powers: averages over some wavelengths, in which small-scale fading is smoothed."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree

from ..core import InputError, Record
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import TASKS
from ..tasks.scores import abs_error_db, decibels, signed_errors_db, summary
from .results import read_run
from .run import open_run


@dataclass(frozen=True)
class LocalMean:
    """Scores of local mean powers of the test rows of a run.

    Attributes:
        wavelengths: diameter of the window in wavelengths.
        diameter_m: diameter in metres, at the smallest and at the largest wavelength.
        count: number of local means: of each receiver, of test rows with another one in their window.
        rows: median number of rows in these windows; 0 where ``count`` is 0.
        score: median, mean, 10th and 90th percentile of the absolute errors of the local means, and bias, standard
            deviation and RMSE of their errors, dB; empty where ``count`` is 0.
        single: the same of these rows without averaging.
    """

    wavelengths: float
    diameter_m: tuple[float, float]
    count: int = 0
    rows: float = 0.0
    score: dict[str, float] = field(default_factory=dict)
    single: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        """The scores in a line or two."""
        shown = dict.fromkeys(f"{metres:.2g}" for metres in self.diameter_m)
        what = f"local mean power over {self.wavelengths:g} wavelengths ({' to '.join(shown)} m)"
        if not self.count:
            return f"{what}: no test row has another one in its window; choose more wavelengths"
        errors = (
            "median absolute error {median:.3f} dB, bias {bias:+.2f}, standard deviation {std:.2f}, RMSE {rmse:.3f}"
        )
        counts = f"{self.count} test values, median {self.rows:g} rows in a window"
        return f"{what}: {errors.format(**self.score)}\n  {counts}; without averaging {errors.format(**self.single)}"


def local_mean_scores(folder: str | Path, wavelengths: float) -> LocalMean:
    """Scores of the local mean powers of a run's test rows, those of all its folds.

    Around each test row, the received powers of the test rows of the same receiver and carrier within a sphere, whose
    diameter is so many wavelengths, are averaged in milliwatts and converted to dBm: the measured ones, and the
    predicted ones of the same rows (`local_mean_dbm`). Rows without another one in their window are left out.

    Raises:
        InputError: not a finished run of signal strengths, unknown positions or carriers, or no positive number.
    """
    if not 0 < wavelengths < np.inf:
        raise InputError(f"local mean over {wavelengths:g} wavelengths: choose a positive number, such as 10")
    results, record = read_run(folder), open_run(folder).problem.record
    if not TASKS[results.task].in_decibel:
        raise InputError(f"{folder}: holds {results.task}; a local mean power is of signal strengths")
    if not np.isfinite(results.tx_pos_m).all():
        raise InputError(f"{folder}: positions of test rows are not known, so no rows are within wavelengths")
    diameter_m = wavelengths * speed_of_light / _carriers_hz(record, results.row)
    pairs, single, counts = list[FloatArray](), list[FloatArray](), list[IntArray]()
    for powers_dbm, of_rows_m in zip(np.stack([results.prediction, results.truth], axis=1), diameter_m, strict=True):
        received = np.isfinite(powers_dbm).all(axis=0)
        for window_m in np.unique(of_rows_m):
            rows = np.flatnonzero(received & (of_rows_m == window_m))
            mean_dbm, count = local_mean_dbm(powers_dbm[:, rows], results.tx_pos_m[rows], float(window_m))
            pairs.append(mean_dbm[:, count > 1])
            single.append(powers_dbm[:, rows[count > 1]])
            counts.append(count[count > 1])
    count, window = np.concatenate(counts), (float(diameter_m.min()), float(diameter_m.max()))
    if not len(count):
        return LocalMean(wavelengths, window)
    powers_dbm = (np.concatenate(values, axis=1) for values in (pairs, single))
    scores = (summary(abs_error_db(*pair)) | signed_errors_db(*pair) for pair in powers_dbm)
    return LocalMean(wavelengths, window, len(count), float(np.median(count)), *scores)


def local_mean_dbm(power_dbm: FloatArray, position_m: FloatArray, diameter_m: float) -> tuple[FloatArray, IntArray]:
    """Local mean power around each position, and the number of rows that it averages.

    Args:
        power_dbm: received powers [..., n], dBm, finite.
        position_m: positions [n, 3], metres.
        diameter_m: diameter of the sphere around a position whose rows are averaged in milliwatts, metres.

    Returns:
        Local mean powers [..., n], dBm, and numbers of rows [n], at least 1.

    Source: Lee, "Estimate of local average power of a mobile radio signal" (1985), IEEE Transactions on Vehicular
    Technology 34(1).

    >>> power_dbm, x_m = np.array([-60.0, -70.0, -50.0]), np.array([0.0, 1.0, 9.0])
    >>> mean_dbm, count = local_mean_dbm(power_dbm, np.stack([x_m, x_m, x_m], axis=1), 4.0)
    >>> mean_dbm.round(2).tolist(), count.tolist()
    ([-62.6, -62.6, -50.0], [2, 2, 1])
    """
    power_mw = 10 ** (np.asarray(power_dbm, float) / 10)
    near = cKDTree(position_m).query_ball_point(position_m, diameter_m / 2)
    mean_mw = np.empty(power_mw.shape)
    for row, rows in enumerate(near):
        mean_mw[..., row] = power_mw[..., rows].mean(axis=-1)
    return decibels(mean_mw), np.array([len(rows) for rows in near], np.int64)


def _carriers_hz(record: Record, rows: IntArray) -> FloatArray:
    """Carriers of receivers and rows [n_rx, m], Hz (InputError: unknown)."""
    shape = len(record.receivers), len(rows)
    if record.carriers_hz is not None:
        return np.broadcast_to(record.carriers_hz[rows], shape)
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown; state {record.task.carrier_stated_in}")
    carriers_hz = [receiver.frequency_hz or float(record.frequencies_hz[0]) for receiver in record.receivers]
    return np.broadcast_to(np.array(carriers_hz)[:, None], shape)
