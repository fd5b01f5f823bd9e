"""Position of a transmitter from what the receivers of a run received.

The posterior over candidate positions inside the area is the likelihood of the observation under the run's predictions
(`wrf_mi.apps.maps.locate_likelihood`), times a density around the estimate of nearest neighbours
(`wrf_mi.apps.maps.locate_neighbours`) where held-out rows gain by it, as they choose the form of the likelihood and the
mass of regions (`wrf_mi.apps.maps.locate_calibration`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError
from ...core.angles import FloatArray
from ...datasets.labelled import of_receivers
from ...models import Session
from ...runs.folder import load_rows
from ...runs.run import Run, open_run
from ...tasks.scores import LEVEL
from ...training.session import Interrupted, OnProgress, quiet
from .grid import Candidates, candidates_of
from .locate_calibration import Calibration, calibration_of, headings_of, predict_candidates
from .locate_likelihood import region_of


@dataclass(frozen=True)
class LocatedPositions:
    """Positions of m transmitters.

    Attributes:
        tx_pos_m: estimates [m, 3], metres: of the least expected distance; at the candidates' height.
        radius_m: radius of the circle around each that holds the true position with the probability ``level`` [m],
            metres.
        area_m2: area of each highest-density region [m], square metres.
        probability: probabilities of the candidates [m, p].
        region: candidates in each highest-density region [m, p].
        neighbours_m: positions by k nearest neighbours [m, 3], metres; None without training rows.
        level: share of true positions that regions hold.
        masses: sum of the candidates' probabilities in a region and in a circle with that share.
        candidates: candidate positions.
        calibration: form of the likelihood, with held-out error and coverage.
        at_border: whether each estimate lies at the border of the candidates' area [m]: it may lie beyond.
        rows_outside: number of training rows that were measured outside of that area.
    """

    tx_pos_m: FloatArray
    radius_m: FloatArray
    area_m2: FloatArray
    probability: NDArray[np.float32]
    region: NDArray[np.bool_]
    neighbours_m: FloatArray | None
    level: float
    masses: tuple[float, float]
    candidates: Candidates
    calibration: Calibration
    at_border: NDArray[np.bool_]
    rows_outside: int

    def __len__(self) -> int:
        """Number of transmitters."""
        return len(self.tx_pos_m)

    def error_m(self, true_m: FloatArray) -> FloatArray:
        """Distances [m] in the plan from true positions [m, 2 or more], metres."""
        return np.asarray(np.linalg.norm(self.tx_pos_m[:, :2] - true_m[:, :2], axis=1))

    def neighbours_error_m(self, true_m: FloatArray) -> FloatArray | None:
        """Distances [m] of nearest neighbours from true positions; None without training rows."""
        near_m = self.neighbours_m
        return None if near_m is None else np.asarray(np.linalg.norm(near_m[:, :2] - true_m[:, :2], axis=1))

    def covers(self, true_m: FloatArray) -> NDArray[np.bool_]:
        """Whether each region holds the candidate nearest to the true position [m]."""
        return np.asarray(self.region[np.arange(len(self)), self.candidates.nearest(true_m)])


def located_run(run: str | Path | Run) -> Run:
    """The run of a folder, checked to be one that positions can be found with.

    `InputError`: not a finished run of a model of powers in decibels at one carrier for receivers that it was trained
    on, or a run of several folds.
    """
    opened = open_run(run) if not isinstance(run, Run) else run
    record = opened.problem.record
    task = record.task
    if not task.in_decibel or task.axes:
        text = f"predicts {task.name}; positions are found from powers in decibels"
        raise InputError(f"{opened.folder}: {text}; give a run on signal strengths")
    if record.carriers_hz is not None:
        raise InputError(f"{opened.folder}: its data have several carriers; give a run on data of one carrier")
    if opened.scene is not None:
        raise InputError(f"{opened.folder}: rows of the scene of the fit calibrate positions; omit the edited scene")
    _ = opened.of_any_device.fitted
    if load_rows(opened.folder, record).held_receivers:
        raise InputError(f"{opened.folder}: its split holds receivers out; give a run trained on all receivers")
    return opened


def locate(
    run: str | Path | Run,
    observed_dbm: ArrayLike,
    *,
    step_m: float | None = None,
    height_m: float | None = None,
    level: float = LEVEL,
    offset_db: float | None = None,
    on_progress: OnProgress = quiet,
    stop: Callable[[], bool] = lambda: False,
) -> LocatedPositions:
    """Positions of transmitters from the signal strengths that the receivers of a run received.

    The first call for a run fits its model to parts of the training rows, up to five times, to choose the form of the
    likelihood; the choice is kept in the run folder.

    Args:
        run: folder of a finished run on signal strengths, or the run; its model states standard deviations.
        observed_dbm: signal strengths [n_rx, m] in dBm, receivers in the order of ``run.receivers``; NaN where nothing
            was received; or an `xarray.DataArray` (row, receiver) with the names of receivers.
        step_m: distance between candidate positions, metres; None: 0.25 m, more for large areas.
        height_m: height of the transmitters; None: the median of the training rows.
        level: probability with which regions hold the true position.
        offset_db: standard deviation of an unknown offset of the transmitter's power from that of the training rows'
            transmitter; None: as chosen by held-out rows, or that of the device of ``run.own``.
        on_progress: progress callback.
        stop: stop condition, called wherever nothing would be lost.

    Raises:
        InputError: a run of another task or without standard deviations, observations of another shape, a transmitter
            that no receiver received, or no candidate position.
        Interrupted: ``stop`` ended the choice of the likelihood; the next call goes on.

    >>> import shutil, tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import wrf_mi
    >>> from wrf_mi.datasets import write_ble_folder
    >>> rng = np.random.default_rng(0)
    >>> corners_m = np.array([[0, 0, 2], [6, 0, 2], [0, 6, 2.0]])
    >>> receivers = [wrf_mi.Receiver(f"anchor{k}", p, np.array([0.0, 0, 0, 1])) for k, p in enumerate(corners_m)]
    >>> tx_pos_m = np.column_stack([rng.uniform(0.5, 5.5, (60, 2)), np.ones(60)])
    >>> distance_m = np.linalg.norm(tx_pos_m - corners_m[:, None], axis=2)
    >>> rssi_dbm = -40 - 20 * np.log10(distance_m) + rng.normal(0, 1, (3, 60))
    >>> known = {"frequencies_hz": np.array([2.44e9]), "official": (np.arange(50), np.arange(50, 60))}
    >>> record = wrf_mi.Record("made-up", "rssi", tx_pos_m, tuple(receivers), rssi_dbm, **known)
    >>> folder = Path(tempfile.mkdtemp())
    >>> data = write_ble_folder(folder / "data", record)
    >>> run = wrf_mi.train(data, "kriging", out=folder / "run")
    >>> found = run.locate(rssi_dbm[:, 50:], level=0.9)
    >>> bool(np.median(found.error_m(tx_pos_m[50:])) < 1)
    True
    >>> shutil.rmtree(folder)
    """
    run = located_run(run)
    record, observed = run.problem.record, np.asarray(of_receivers(observed_dbm, run.receivers), float)
    _check(run, observed, level, offset_db)
    if run.own is not None:  # what the mean device would have received
        device, run = run.device, run.of_any_device
        observed = observed - device.mean_db
        offset_db = device.std_db if offset_db is None else offset_db
    candidates = candidates_of(run, step_m, height_m)
    session = Session(run.folder, run.folder, on_progress, stop)
    try:
        fitted = run.fitted.tracing_once()
        progress = partial(session.progress, f"predicting {len(candidates.positions_m)} candidates")
        predicted = predict_candidates(fitted, np.arange(len(observed)), headings_of(run), candidates, progress)
        calibration = calibration_of(run, fitted, candidates, session)
    except InputError as error:
        raise InputError(f"{run.folder}: {error}") from None
    except Interrupted:
        raise Interrupted("stopped; finished folds are kept, and the same command goes on") from None
    likelihood = calibration.likelihood
    if offset_db is not None:
        likelihood = replace(likelihood, offset_db=offset_db)
    m, p = observed.shape[1], len(candidates.positions_m)
    estimate, radius = np.full((m, 3), candidates.grid.height_m), np.empty(m)
    at_border = np.empty(m, bool)
    probability, inside = np.empty((m, p), np.float32), np.empty((m, p), bool)
    near, rows = calibration.neighbours, load_rows(run.folder, record).all_train
    near_m = None if near is None else near.locate(record, rows, observed)
    masses = calibration.masses(level)
    if likelihood != calibration.likelihood:  # held-out rows do not tell of the offset of another transmitter
        masses = max(masses[0], level), max(masses[1], level)
    for number, strengths in enumerate(observed.T):
        if stop():
            raise Interrupted(f"stopped after {number} of {m} positions; nothing is written")
        neighbours_m = None if near_m is None else near_m[number]
        probabilities = calibration.probabilities(likelihood.log(strengths, *predicted), neighbours_m, candidates)
        best, radius[number], inside[number] = region_of(probabilities, candidates.distance_m, *masses)
        probability[number] = probabilities
        estimate[number, :2], at_border[number] = candidates.positions_m[best, :2], candidates.at_border[best]
        session.progress("locating", (number + 1) / m)
    area = inside.sum(axis=1) * candidates.cell_m2
    of_regions = estimate, radius, area, probability, inside, near_m, level, masses, candidates, calibration
    return LocatedPositions(*of_regions, at_border, int(candidates.outside(record.tx_pos_m[rows]).sum()))


def _check(run: Run, observed_dbm: FloatArray, level: float, offset_db: float | None) -> None:
    count = len(run.problem.record.receivers)
    if observed_dbm.ndim != 2 or len(observed_dbm) != count:
        text = f"observations of shape {list(observed_dbm.shape)}; give strengths [{count}, m] in dBm"
        raise InputError(f"{run.folder}: {text}, one row for each receiver")
    silent = np.flatnonzero(~np.isfinite(observed_dbm).any(axis=0))
    if len(silent):
        raise InputError(f"{run.folder}: no receiver received transmitter {silent[0]}; leave it out")
    if not 0 < level < 1:
        raise InputError(f"level {level:g}: give a probability between 0 and 1, such as 0.9")
    if offset_db is not None and not (np.isfinite(offset_db) and offset_db >= 0):
        raise InputError(f"offset {offset_db:g} dB: give a standard deviation of 0 or more")
