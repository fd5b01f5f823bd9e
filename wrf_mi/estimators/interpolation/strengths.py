"""Kriging of received signal strengths: path loss or traced power, patterns and shadowing, pooled over receivers.

Expected is free space, or the local mean of traced power (`wrf_mi.tracing.power_map`); measurements correct it. Common
terms are in `strength_terms`; hyperparameters and the calibration of predictions come from held-out stretches of the
training rows (`strength_fit`). Terms that all receivers share serve receivers without rows.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Prediction, Record
from ...core.angles import FloatArray
from ...core.array_files import under
from ...core.settings import changed
from ...core.stored import from_arrays, to_arrays
from ...core.types import IntArray
from ...datasets.observations import FEW_ROWS, trained_runs
from ...parallel.threads import one_blas_thread
from ...tasks import require
from ...training.session import OnProgress, quiet
from ..model import Arrays, Fitted, Inputs
from .by_receiver import finite_positions
from .run_offsets import RunOffsets
from .strength_fit import (
    PriorMean,
    StrengthPosterior,
    by_likelihood,
    by_search,
    held_out,
    likely_deviations,
    widening,
)
from .strength_settings import (
    BY_SEARCH,
    DEFAULT,
    DEFAULT_SETTINGS,
    LIKELIHOOD,
    NONE,
    RECEIVER_SD_DB,
    STOP_M,
    STOP_RAD,
    STOP_ROWS,
    TREES,
    StrengthSettings,
)
from .strength_terms import Hyperparameters, Measured, Poses, Stops, run_numbers, stop_numbers, stops_of
from .strength_trees import TREES as TREES_OF_ALL
from .strength_trees import TREES_OF_FOLD

if TYPE_CHECKING:
    from ...tracing.power_map import Traced, Tracer

HEADINGS = 8  # headings over which the prediction is averaged where the heading is unknown
CHUNK = 1024  # transmitters predicted together, which bounds the memory of their covariances with the rows
MOST_COVARIANCES = 1e8
"""Covariances between stops, of all receivers: factors of 0.8 GB, 30 s at four; with more, stops are thinned."""
ROBUST_ROUNDS = 2  # rounds of weights for Student-t noise, by the residuals of the one before
LEAST_HEARD = 4  # receivers with more than a few rows that tell how well the others are predicted from them
NO_SHADOW_DB = 1e-3  # standard deviation of shadowing where there is none: it has to be above zero
OFFSET_SD_DB = 10.0  # standard deviation of the common offset of all receivers about the transmit power a priori
EXPONENT_SD = (1.0, 0.3)
"""Standard deviations of the exponent of distance about free space's: common, and of each receiver."""
TRACED_SD = (0.5, 0.2)  # standard deviations, common and of each receiver, of the factor of the traced decibels about 1
BODY_PATTERN_DB = (
    1.0,
    0.2,
)  # standard deviations, common and of each receiver, of the first harmonic of the transmitter's pattern
RECEIVER_PATTERN_DB = 2.0  # standard deviation of the first harmonic of each receiver's pattern
MAP, EXACT = "map/", "exact_dbm"
"""Prefix of the arrays of a local mean, and array of powers traced at the stops, NaN without a path."""


@dataclass(eq=False, repr=False)
class Strengths(Fitted):
    """Fitted signal strengths; made by `fit_strengths`."""

    field: StrengthPosterior
    widen: FloatArray  # factor of each receiver's standard deviations [n_rx]
    fit_facts: dict[str, float]  # numbers of the fit for `facts`
    shadowing: str = DEFAULT  # where hyperparameters come from, see `StrengthSettings`
    options: Sequence[Mapping[str, Any]] = ()  # reports of what held-out rows chose from
    offsets: RunOffsets | None = None  # of the runs of the measurement; None: they have none

    def __post_init__(self) -> None:
        """Headings count where the training rows had them."""
        self.uses_heading, traced = self.field.headings, self.field.prior.traced
        self.traces = traced is not None and traced.exact
        self.run_sd_db = None if self.offsets is None else self.offsets.sd_db

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Signal strengths in dBm with standard deviations of a reading and of the local mean power, see `Fitted`.

        Raises:
            InputError: positions that are not known.
        """
        position_m = finite_positions(inputs, "kriging")
        mean, std, std_mean = np.empty((3, len(position_m)))
        noise = self.field.noise * self.widen[receiver] ** 2
        chunks = self._chunks(position_m, inputs)
        with one_blas_thread():
            predicted = iter(self.field.predict([each for _, poses in chunks for each in poses], receiver))
        for rows, poses in chunks:
            means, variances = zip(*islice(predicted, len(poses)), strict=True)
            # Of unknown headings: variance within each, and between their means.
            variance = np.mean(variances, axis=0) * self.widen[receiver] ** 2 + np.var(means, axis=0)
            mean[rows] = np.mean(means, axis=0)
            std[rows], std_mean[rows] = np.sqrt(variance + noise), np.sqrt(variance)
        if self.offsets is not None:
            offset_db, variance = self.offsets.of(inputs.runs, len(mean))
            mean += offset_db
            variance = variance * self.widen[receiver] ** 2
            std, std_mean = np.sqrt(std**2 + variance), np.sqrt(std_mean**2 + variance)
        return Prediction(mean, std, std_mean=std_mean)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict` in a fraction of its time: variances take the most of that."""
        position_m = finite_positions(inputs, "kriging")
        mean = np.empty(len(position_m))
        for rows, poses in self._chunks(position_m, inputs):
            mean[rows] = np.mean([self.field.mean(each, receiver) for each in poses], axis=0)
        return mean if self.offsets is None else mean + self.offsets.of(inputs.runs, len(mean))[0]

    def tracing_once(self) -> Strengths:
        """The model about a traced mean that keeps powers, see `Fitted`; itself about any other mean."""
        traced = self.field.prior.traced
        if traced is None or not traced.exact:
            return self
        field = copy(self.field)
        field.prior = replace(field.prior, traced=traced.keeping())
        return replace(self, field=field)

    def refit(self, record: Record, rows: IntArray) -> Strengths:
        """The posterior given some rows, see `Fitted`; factors of deviations are those of held-out stretches of all."""
        field = self.tracing_once().field
        stops = _stops(_without_offsets(_measured(record, rows, field.headings), record, self.offsets))
        with one_blas_thread():
            posterior = StrengthPosterior(
                field.prior, field.hyperparameters, stops, field.rounds, field.spread, field.trees
            )
        return replace(self, field=posterior)

    def _chunks(self, position_m: FloatArray, inputs: Inputs) -> list[tuple[IntArray, list[Poses]]]:
        """Numbers of the rows in chunks, and poses that predictions are averaged over.

        These are at the stated headings, or at `HEADINGS` where headings count and are unknown.
        """
        heading_rad = inputs.tx_heading_rad
        turns: list[FloatArray | None] = [np.asarray(heading_rad, float) if self.uses_heading else None]
        if self.uses_heading and heading_rad is None:
            turns = [np.full(len(position_m), turn) for turn in 2 * np.pi * np.arange(HEADINGS) / HEADINGS]
        every = [Poses(position_m, turn) for turn in turns]
        chunks = np.split(np.arange(len(position_m)), np.arange(CHUNK, len(position_m), CHUNK))
        return [(rows, [poses.take(rows) for poses in every]) for rows in chunks]

    def arrays(self) -> Arrays:
        """Fields, the traced mean, and of an exact one the powers at the stops."""
        arrays, traced = to_arrays(self), self.field.prior.traced
        if traced is not None:
            arrays |= to_arrays(traced.local if traced.exact else traced, MAP)
            if traced.exact:
                arrays[EXACT] = traced.traced_dbm(self.field.stops.poses.position_m)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Arrays, trace: Tracer | None = None) -> Strengths:
        """The model that `arrays` stored; ``trace`` of `wrf_mi.tracing.power_map.TracedPower`, if that is its mean."""
        traced: Traced | None = None
        if under(MAP, arrays):
            from ...tracing.power_map import PowerMap, TracedPower  # the tracer is imported where there is a scene

            traced = from_arrays(PowerMap, arrays, MAP)
            if EXACT in arrays:
                assert trace is not None
                positions_m, power_dbm = arrays["field/stops/poses/position_m"], arrays[EXACT].T
                power_of_position = dict(zip(map(np.ndarray.tobytes, positions_m), power_dbm, strict=True))
                traced = TracedPower(traced, trace, np.arange(power_dbm.shape[1]), power_of_position, keeps=False)
        return from_arrays(cls, arrays, traced=traced)

    def facts(self) -> dict[str, Any]:
        """Hyperparameters, calibration, and error on held-out rows."""
        fitted = {
            "stops": len(self.field.stops.poses),
            "traced": self.field.prior.traced is not None,
            "headings": self.field.headings,
            "transmit_dbm": self.field.prior.transmit_dbm,
            "shadowing": self.shadowing,
            **asdict(self.field.hyperparameters),
            **({} if self.offsets is None else {"run_sd_db": self.offsets.sd_db}),
            "widen": [float(factor) for factor in self.widen],
            "noise_of_reading_db": [float(np.sqrt(self.field.noise) * factor) for factor in self.widen],
            **self.fit_facts,
        }
        return {"fitted": fitted} | ({"options": list(self.options)} if self.options else {})


def fit_strengths(
    record: Record,
    rows: IntArray,
    power_map: Traced | None = None,
    settings: StrengthSettings = DEFAULT_SETTINGS,
    on_progress: OnProgress = quiet,
    stated: Collection[str] | None = None,
    calibrate: bool = True,
    runs: bool = False,
) -> Strengths:
    """Fit signal strengths to some rows of a record; nothing is drawn, so there is no seed.

    Args:
        record: signal strengths with a single, known carrier.
        rows: numbers of training rows, in the order of time (`wrf_mi.estimators.interpolation.stretches.folds`).
        power_map: traced power, a local mean or at positions themselves; None: free space is expected.
        settings: settings; hyperparameters whose origin they leave open are the default ones.
        on_progress: progress callback.
        stated: names of the hyperparameters that hold, whatever the likelihood of the others; None: those that differ
            from their defaults.
        calibrate: whether deviations come from held-out stretches, see `calibrated`.
        runs: whether runs of the measurement have offsets.

    Raises:
        InputError: a record of another task or without its carrier, or neither rows nor a map.
    """
    require(record, "rssi", why="these strengths are in dBm")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown; state it in the data")
    measured, offsets = _measured(record, rows, settings.heading), None
    if runs:
        offsets = RunOffsets.fit(_stops(measured), trained_runs(record, measured.rows).tolist())
        measured = _without_offsets(measured, record, offsets)
    if not len(measured.rows) and power_map is None:
        raise InputError(f"{record.name}: neither a training row that was received nor a scene; give one of them")
    prior = _prior(record, measured, power_map, settings)
    hyperparameters, stated = settings.hyperparameters, changed(settings) if stated is None else stated
    shadowing = settings.shadowing or DEFAULT
    if len(measured.rows) > 1 and shadowing == LIKELIHOOD:
        prior, hyperparameters = by_likelihood(prior, _stops(measured), hyperparameters, stated)
    elif len(measured.rows) > 1 and shadowing == BY_SEARCH:
        on_progress("strengths: search", 0.0)
        hyperparameters = by_search(prior, measured, _stops, hyperparameters, stated)
    elif shadowing in (TREES, NONE):
        # What shadowing is left in the mean terms' residuals is noise to these.
        h = hyperparameters
        drift_db = float(np.linalg.norm([h.drift_db, h.shadow_db, h.body_db]))
        hyperparameters = replace(h, drift_db=drift_db, shadow_db=NO_SHADOW_DB, body_db=0.0)
    trees = TREES_OF_ALL * (shadowing == TREES)
    field = StrengthPosterior(prior, hyperparameters, _stops(measured), ROBUST_ROUNDS, trees=trees)
    strengths = Strengths(
        field, np.ones(len(measured.value_dbm)), {"rows": float(len(measured.rows))}, shadowing, offsets=offsets
    )
    return calibrated(strengths, record, rows, on_progress, stated) if calibrate else strengths


def calibrated(
    strengths: Strengths,
    record: Record,
    rows: IntArray,
    on_progress: OnProgress = quiet,
    stated: Collection[str] = (),
    new_runs: bool = False,
) -> Strengths:
    """The fit to some rows with deviations by stretches that are held out.

    Deviations of hyperparameters that are not ``stated`` are by likelihood. With ``new_runs``, rows of other runs than
    the record's are predicted, and so runs are held out in place of stretches.
    """
    field, facts = strengths.field, dict(strengths.fit_facts)
    measured = _measured(record, rows, field.headings)
    if len(measured.rows) < 2:
        return strengths
    # Rows of a run that is held out have an offset that nobody knows.
    calibration_data = measured if new_runs else _without_offsets(measured, record, strengths.offsets)
    values, variance = calibration_data.value_dbm, strengths.offsets.sd_db**2 if new_runs and strengths.offsets else 0.0
    on_progress("strengths: all rows", 0.8)
    spread = _deviations(strengths, stated)
    field = field.with_spread(spread)
    on_progress("strengths: held-out rows", 0.9)
    # Without weights of Student-t noise, which are by the residuals of all rows: outliers would be known.
    plain = StrengthPosterior(field.prior, field.hyperparameters, field.stops, 0, spread, field.trees, field.forest)
    by_fold = partial(held_out, plain, measured, _stop_of_rows(field.stops, measured), new_runs, trees=TREES_OF_FOLD)
    mean, std = by_fold()
    residual = values - mean
    widen = widening(residual, np.sqrt(std**2 + variance))
    few = np.isfinite(values).sum(axis=1) < FEW_ROWS
    if few.any() and len(few) - few.sum() >= LEAST_HEARD:
        # At receivers without rows nearby errors are those of the common terms, as at others that are left out.
        mean, std = by_fold(unheard=True)
        widen[few] = np.maximum(widen, widening(values - mean, np.sqrt(std**2 + variance)))[few]
    if np.isfinite(residual).any():
        facts["held_out_db"] = float(np.nanmedian(np.abs(residual)))
    on_progress("strengths: held-out rows", 1.0)
    return replace(strengths, field=field, widen=widen, fit_facts=facts)


def _deviations(strengths: Strengths, fixed: Collection[str]) -> Hyperparameters | None:
    """Hyperparameters of the deviations, see `likely_deviations`; None: those of the means."""
    field, shadowing = strengths.field, strengths.shadowing
    h, likely = field.hyperparameters, partial(likely_deviations, field.prior, field.stops)
    if shadowing == LIKELIHOOD:  # whose hyperparameters are those of a likelihood already
        return None
    if shadowing == TREES:
        # The noise about the shadowing, which the spread of the trees stands for.
        noise = likely(Hyperparameters(lever_m=h.lever_m), fixed)
        return replace(h, drift_db=noise.drift_db, noise_db=noise.noise_db)
    return likely(h, {*fixed, "shadow_db"} if shadowing == NONE else fixed)


def _without_offsets(measured: Measured, record: Record, offsets: RunOffsets | None) -> Measured:
    """Rows of a record without the offsets of their runs."""
    if offsets is None or record.runs is None:
        return measured
    offset_db, _ = offsets.of(record.runs[measured.rows], len(measured.rows))
    return replace(measured, value_dbm=measured.value_dbm - offset_db)


def _measured(record: Record, rows: IntArray, headings: bool) -> Measured:
    """Those of some rows of a record that a receiver received, with their runs, with or without headings."""
    rows = np.unique(np.asarray(rows, np.int64))
    values = np.asarray(record.observation[:, rows], float)
    received = np.isfinite(values).any(axis=0)
    rows, values = rows[received], values[:, received]
    heading = record.tx_heading_rad if headings else None
    heading = None if heading is None else np.asarray(heading[rows], float)
    run = None if record.runs is None else run_numbers(record.runs[rows], trained_runs(record, rows).tolist())
    poses = Poses(record.tx_pos_m[rows].astype(float), heading, run)
    return Measured(poses, values, rows, record.precision(rows))


def _stops(measured: Measured) -> Stops:
    stops = stops_of(measured, STOP_M, STOP_RAD, STOP_ROWS)
    # Of each receiver the stops that it received count: the hundreds of a building hear a few per cent of them.
    covariances = np.square(np.isfinite(stops.value_dbm).sum(axis=1, dtype=float)).sum()
    return stops.thinned(int(len(stops.poses) * min(1.0, np.sqrt(MOST_COVARIANCES / max(covariances, 1.0)))))


def _stop_of_rows(stops: Stops, measured: Measured) -> IntArray:
    """Number of the stop of each row [n] among some that may be thinned out, -1 for none."""
    number = stop_numbers(measured, STOP_M, STOP_RAD, STOP_ROWS)
    middle = (np.bincount(number, measured.rows) / np.bincount(number))[number]
    place = np.minimum(np.searchsorted(stops.row, middle), len(stops.row) - 1)
    return np.where(stops.row[place] == middle, place, -1)


def _prior(record: Record, measured: Measured, power_map: Traced | None, settings: StrengthSettings) -> PriorMean:
    """Expected signal strength before the fit."""
    assert record.frequencies_hz is not None
    receivers_m = np.stack([receiver.position_m for receiver in record.receivers]).astype(float)
    traced_sd = np.multiply(TRACED_SD, power_map is not None)
    sd = np.array([(OFFSET_SD_DB, RECEIVER_SD_DB), EXPONENT_SD, traced_sd, BODY_PATTERN_DB])
    of_receivers = record.receiver_carriers_hz
    carrier_hz = np.mean(record.frequencies_hz, keepdims=True) if of_receivers is None else of_receivers
    at_0_dbm = PriorMean(receivers_m, 0.0, carrier_hz, power_map, sd, RECEIVER_PATTERN_DB)
    transmit_dbm = settings.transmit_dbm
    if transmit_dbm is None:
        transmit_dbm = _transmit_dbm(at_0_dbm, measured)
    return replace(at_0_dbm, transmit_dbm=transmit_dbm)


def _transmit_dbm(at_0_dbm: PriorMean, measured: Measured) -> float:
    """Median level of the data above what is expected for 0 dBm; 0 dBm without data.

    Strengths may be of any transmit power, and in any unit of decibels. A prior about 0 dBm would bend the law of
    distance to them where rows are few: 0.4 dB with 5 rows that are 40 dB lower (flat-ble, 2026-11-27), while the level
    of 5 rows is as good a prior as 0 dBm where that is right. A median, as fades reach deep.
    """
    excess = [
        measured.value_dbm[receiver] - at_0_dbm.columns(measured.poses, receiver)[0]
        for receiver in range(len(measured.value_dbm))
    ]
    finite_excess = np.concatenate(excess)[np.isfinite(np.concatenate(excess))]
    return float(np.median(finite_excess)) if len(finite_excess) else 0.0
