"""Fit what a room's ray tracing cannot know to measured signal strengths, by gradients through Sionna RT's fields."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from ..core import InputError, Record
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..measure.splits import position_folds
from ..receive.graph import path_power, power_sum_db
from ..tasks import task_of
from .buffer import to_buffer
from .calibration import Calibration, calibrated_rssi, harmonics, in_body, with_materials
from .fields import field_of
from .result import TraceResult
from .surfaces import Surfaces, scene_surfaces

logger = logging.getLogger(__name__)

LEAST_SUSCEPTIBILITY, LEAST_CONDUCTIVITY = 1e-3, 1e-6
"""A permittivity of 1, or a conductivity of 0, starts this much above: its logarithm has no slope there."""
KNEE_DB = 1.0
"""Errors well above count by their size, below by their square: scores are absolute errors, and these have no kink."""

DECIBELS = 4.0
"""Patterns and offsets, in dB, take steps so much longer than logarithms of constants do."""


@dataclass(frozen=True)
class CalibrationOptions:
    """What is fitted and how.

    Attributes:
        materials: permittivity and conductivity of every material that a path meets.
        tx_degree: of the transmitter's pattern in its body's frame; 0: none.
        rx_degree: of each receiver's pattern; 0: none.
        steps: of Adam.
        learning_rate: of Adam.
        batch: training rows a step.
        weakest_db: paths so much below their pair's power, with the scene's first materials, are left out of the fit.
        shrink: weight of the mean square of the patterns' coefficients (dB^2) in the loss (dB).
        seed: of the order of rows.
    """

    materials: bool = True
    tx_degree: int = 3
    rx_degree: int = 2
    steps: int = 200
    learning_rate: float = 0.03
    batch: int = 500
    weakest_db: float = 20.0
    shrink: float = 1e-2
    seed: int = 0


DEFAULTS = CalibrationOptions()
OFFSETS_ALONE = CalibrationOptions(materials=False, tx_degree=0, rx_degree=0, steps=0)
"""One offset per receiver: the honest figure of an uncalibrated tracer."""


def calibrate(
    trace: TraceResult,
    scene: Any,
    record: Record,
    rows: IntArray,
    options: CalibrationOptions = DEFAULTS,
    progress: bool = False,
) -> Calibration:
    """Fit to some rows of a record; see `wrf_mi.trace.calibration` for the model.

    Starts from the scene's materials, flat patterns and offsets that make the median error zero. The scene
    keeps its own materials.

    Args:
        trace: paths from all of the record's positions to its receivers; transmitter i is row i.
        scene: they are of.
        record: with ``task="rssi"``.
        rows: to fit to, shape [k].
        options: what is fitted.
        progress: show a progress bar on standard error.

    Raises:
        InputError: not signal strengths, paths of other positions, or a receiver without a row to fit to.
    """
    if not task_of(record).in_decibel:
        raise InputError(f"{record.name}: holds {record.task}; calibration needs signal strengths (rssi)")
    if trace.paths.n_tx != len(record) or trace.paths.n_rx != len(record.receivers):
        raise InputError(f"{record.name}: paths of {trace.paths.n_tx} positions for {len(record)} rows; trace it anew")
    return _Fit(trace, scene, record, np.asarray(rows), options).run(progress)


def choose_calibration(
    trace: TraceResult,
    scene: Any,
    record: Record,
    rows: IntArray,
    candidates: Sequence[CalibrationOptions],
    folds: int = 5,
    progress: bool = False,
) -> tuple[CalibrationOptions, list[float]]:
    """The options with the least median absolute error on rows held out by place.

    Neighbouring rows are alike, so a random draw would choose what fits best rather than what predicts: each fold is
    a cluster of the rows' positions.

    Args:
        trace: see `calibrate`.
        scene: see `calibrate`.
        record: see `calibrate`.
        rows: to choose on, shape [k].
        candidates: at least one.
        folds: how many of the five clusters are held out in turn.
        progress: show progress bars on standard error.

    Returns:
        The best options and each candidate's error in dB.
    """
    own = replace(record, tx_pos_m=record.tx_pos_m[rows], observation=record.observation[:, rows], folds=None)
    place = position_folds(own)
    errors = []
    for options in candidates:
        misses = []
        for fold in range(folds):
            fitted = calibrate(trace, scene, record, rows[place != fold], options, progress)
            misses.append(absolute_error_db(fitted, trace, scene, record, rows[place == fold]).ravel())
        errors.append(float(np.nanmedian(np.concatenate(misses))))
        logger.info("%.3f dB on held-out places: %s", errors[-1], options)
    return candidates[int(np.argmin(errors))], errors


def absolute_error_db(
    calibration: Calibration, trace: TraceResult, scene: Any, record: Record, rows: IntArray
) -> FloatArray:
    """Absolute errors [n_rx, k] in dB on some rows, NaN where nothing was received or no path arrives."""
    own = trace.select(np.isin(trace.paths.tx, rows))
    return np.abs(calibrated_rssi(calibration, own, scene, record.tx_heading_rad) - record.observation)[:, rows]


@dataclass(frozen=True)
class _Batch:
    """Paths of some rows on the device; q pairs of receiver and row, p paths.

    Attributes:
        buffer: Sionna RT's.
        power: of each path with the materials of the trace.
        pair, rx: of each path.
        tx_harmonics, rx_harmonics: lists of arrays [p].
        measured: dBm of each pair; 0 where there is none.
        counts: 1 for a pair that counts, 0 for others; shape [q].
        pair_rx: receiver of each pair.
    """

    buffer: Any
    power: Any
    pair: Any
    rx: Any
    tx_harmonics: list[Any]
    rx_harmonics: list[Any]
    measured: Any
    counts: Any
    pair_rx: Any


class _Fit:
    """One fit: batches, parameters, steps."""

    def __init__(
        self, trace: TraceResult, scene: Any, record: Record, rows: IntArray, options: CalibrationOptions
    ) -> None:
        self.trace, self.scene, self.options = trace, scene, options
        self.n_rx = trace.paths.n_rx
        heading = np.zeros(len(record)) if record.tx_heading_rad is None else record.tx_heading_rad
        power = np.abs(trace.paths.gain) ** 2
        pair = trace.paths.rx * len(record) + trace.paths.tx
        total = np.bincount(pair, power, minlength=self.n_rx * len(record))
        observed = np.asarray(record.observation, float)
        with np.errstate(divide="ignore"):
            traced = 10 * np.log10(total).reshape(self.n_rx, -1)
        known = np.isfinite(observed) & np.isfinite(traced)
        for receiver, row_known in zip(record.receivers, known[:, rows], strict=True):
            if not row_known.any():
                raise InputError(f"{receiver.name}: no row to calibrate with is both received and reached by a path")
        self.first_offset = np.array(
            [np.median((observed - traced)[k, rows][known[k, rows]]) for k in range(self.n_rx)]
        )
        self.materials = self._met() if options.materials else ()
        strong = power > total[pair] * 10 ** (-options.weakest_db / 10)
        surfaces = scene_surfaces(scene)
        order = np.random.default_rng(options.seed).permutation(rows)
        self.batches = []
        parts = np.array_split(order, -(-len(order) // options.batch)) if options.steps else []
        for part in parts:
            own = np.sort(part)
            chosen = trace.select(strong & np.isin(trace.paths.tx, own))
            self.batches.append(self._batch(chosen, surfaces, own, observed, known, heading))

    def _met(self) -> tuple[str, ...]:
        """Materials, of those that have constants, of the objects that a path meets."""
        objects = np.unique(self.trace.paths.objects)
        names = {self.scene.objects[self.trace.paths.object_names[k]].radio_material.name for k in objects if k >= 0}
        return tuple(n for n, m in self.scene.radio_materials.items() if n in names and hasattr(m, "conductivity"))

    def _batch(
        self,
        trace: TraceResult,
        surfaces: Surfaces,
        rows: IntArray,
        observed: FloatArray,
        known: NDArray[np.bool_],
        heading: FloatArray,
    ) -> _Batch:
        from ..backend.device import to_float, to_uint

        paths, options = trace.paths, self.options
        place = np.searchsorted(rows, paths.tx)
        leaving = harmonics(in_body(paths.departure, heading[paths.tx]), options.tx_degree)
        return _Batch(
            buffer=to_buffer(trace.legs(surfaces), surfaces, valid=True),
            power=to_float(np.abs(paths.gain) ** 2),
            pair=to_uint(paths.rx * len(rows) + place),
            rx=to_uint(paths.rx),
            tx_harmonics=[to_float(values) for values in leaving],
            rx_harmonics=[to_float(values) for values in harmonics(paths.arrival, options.rx_degree)],
            measured=to_float(np.where(known, observed, 0)[:, rows]),
            counts=to_float(known[:, rows]),
            pair_rx=to_uint(np.repeat(np.arange(self.n_rx), len(rows))),
        )

    def run(self, progress: bool) -> Calibration:
        """Adam from the scene's materials and flat patterns."""
        import drjit as dr
        import mitsuba as mi
        from drjit.opt import Adam

        from ..backend.device import to_float

        options = self.options
        adam = Adam(lr=options.learning_rate)
        adam["offset"] = to_float(self.first_offset)
        if options.tx_degree:
            adam["tx"] = dr.zeros(mi.Float, (options.tx_degree + 1) ** 2 - 1)
        if options.rx_degree:
            adam["rx"] = dr.zeros(mi.Float, ((options.rx_degree + 1) ** 2 - 1) * self.n_rx)
        for name in self.materials:
            material = self.scene.radio_materials[name]
            susceptibility = float(np.ravel(material.relative_permittivity)[0]) - 1
            adam[f"permittivity {name}"] = mi.Float(math.log(max(susceptibility, LEAST_SUSCEPTIBILITY)))
            conductivity = float(np.ravel(material.conductivity)[0])
            adam[f"conductivity {name}"] = mi.Float(math.log(max(conductivity, LEAST_CONDUCTIVITY)))
        adam.set_learning_rate(
            {name: options.learning_rate * DECIBELS for name in ("offset", "tx", "rx") if name in adam}
        )
        bar = Progress(console=Console(stderr=True), transient=True, disable=not progress)
        with bar:
            task = bar.add_task("calibrating", total=options.steps)
            for step in range(options.steps):
                # Until the backward pass is over: it calls the materials again.
                with with_materials(self.scene, self._constants(adam)):
                    dr.backward(self._loss(self.batches[step % len(self.batches)], adam))
                adam.step()
                bar.advance(task)
        return self._fitted({name: np.asarray(dr.detach(adam[name]), float) for name in adam})

    def _constants(self, values: Any) -> dict[str, tuple[Any, Any]]:
        import drjit as dr

        return {
            name: (1 + dr.exp(values[f"permittivity {name}"]), dr.exp(values[f"conductivity {name}"]))
            for name in self.materials
        }

    def _loss(self, batch: _Batch, values: Any) -> Any:
        """Mean error in dB, smooth at zero, plus what shrinks the patterns."""
        import drjit as dr
        import mitsuba as mi

        power = batch.power
        if self.materials:
            field = field_of(self.scene, batch.buffer, self.trace.ends(), self.trace.rays, loop_mode="evaluated")
            power = path_power(field)
        decibel, shrink = dr.zeros(mi.Float, dr.width(batch.pair)), mi.Float(0)
        for k, harmonic in enumerate(batch.tx_harmonics):
            decibel += dr.gather(mi.Float, values["tx"], mi.UInt32(k)) * harmonic
        count = len(batch.rx_harmonics)
        for k, harmonic in enumerate(batch.rx_harmonics):
            decibel += dr.gather(mi.Float, values["rx"], batch.rx * count + k) * harmonic
        for name in ("tx", "rx"):
            if name in values:
                shrink += dr.mean(dr.square(values[name]))
        power = power * dr.exp(decibel * (np.log(10) / 10))
        rssi = power_sum_db(power, batch.pair, dr.width(batch.measured))
        rssi += dr.gather(mi.Float, values["offset"], batch.pair_rx)
        miss = (rssi - batch.measured) / KNEE_DB
        error = dr.sum(batch.counts * (dr.sqrt(dr.square(miss) + 1) - 1)) * (KNEE_DB / dr.sum(batch.counts))
        return error + self.options.shrink * shrink

    def _fitted(self, values: dict[str, FloatArray]) -> Calibration:
        none = np.zeros(0)
        return Calibration(
            offset_db=values["offset"],
            tx_pattern_db=values.get("tx", none),
            rx_pattern_db=values.get("rx", none).reshape(self.n_rx, -1),
            materials={
                name: (
                    1 + float(np.exp(values[f"permittivity {name}"][0])),
                    float(np.exp(values[f"conductivity {name}"][0])),
                )
                for name in self.materials
            },
        )
