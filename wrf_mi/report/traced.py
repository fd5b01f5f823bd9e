"""The ray-tracing baseline as a run: paths, fitted offsets, scores, in the run folder of a learned model.

config.yaml      data set, split, seed, versions, scene and what is traced
split.npz        rows that fitted and rows that score (in ``fold0``, ... for several splits)
paths.npz        every path, to be used again for other materials (`wrf_mi.trace.load_trace`, ``recompute``)
metrics.json, predictions.npz
convergence.json where settings were chosen by convergence: target and estimated error, dB, and all that was tried
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ..core import AntennaOptions, InputError, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.files import write_atomically
from ..core.types import IntArray
from ..fit.folder import CONFIG, SPLIT, check_new, load_rows, part_folders, stated_config, stored_parts, versions
from ..fit.trainer import peak_memory_mb
from ..measure import make_splits, save_split
from ..measure.observations import check_observations
from ..parallel import Scheduler, row_parts
from ..receive.instruments import Instrument
from ..tasks import instrument_of, task_of
from ..trace import TraceOptions, TraceResult, load_record, load_trace, save_trace
from ..trace.calibrate import CalibrationOptions, calibrate
from ..trace.calibration import Calibration, calibrated_rssi, load_calibration, save_calibration
from ..trace.offsets import fit_offsets
from ..trace.polarization import warn_of_cross_polarization
from ..trace.result import join_traces
from ..trace.solve import TARGETS_AT_ONCE
from ..trace.target import CHOSEN_KINDS, choose_options
from ..trace.tracer import RayTracer
from .evaluate import evaluate, milliseconds_per_sample, pool, stored_metrics, write_results
from .run_folder import stated_model

MODEL = "ray-tracing"
PATHS, CALIBRATION, CONVERGENCE = "paths.npz", "calibration.json", "convergence.json"
TIMED = 3
"""Single samples that are timed: in a furnished scene with transmission one may take seconds."""
TRACED_AT_LEAST, SPECULAR_AT_LEAST = 16, 1024
"""Positions of one part at least, for a scheduler: candidates of fewer are made no faster. Where rays go out from the
receivers alone, a part of any size costs as much as a few hundred positions, and the parts for a worker may be two."""
UNUSED_HEADING = "its model does not know how the transmitter is turned; leave heading_rad away"
"""What is wrong with headings for a model that does not use them."""
CALIBRATIONS = {"patterns": CalibrationOptions(materials=False), "all": CalibrationOptions()}
"""What can be fitted beside offsets."""


@dataclass(frozen=True)
class TraceConfig:
    """What ``config.yaml`` says of a traced run.

    Attributes:
        dataset: name or folder that was loaded.
        scene: name, scene folder, Mitsuba XML or mesh.
        material: of a bare mesh, or None.
        split: its name.
        n_train: number or fraction of training rows; None: all.
        seed: of the split.
        options: what is traced.
        calibration: what is fitted to the training rows beside offsets, a key of `CALIBRATIONS`; None: nothing.
        antennas: stated in place of the data's.
    """

    dataset: str
    scene: str
    material: str | None
    split: str
    n_train: float | None
    seed: int
    options: TraceOptions
    calibration: str | None = None
    antennas: AntennaOptions = AS_STATED

    def record(self) -> Record:
        """The data set, with the antennas that were stated.

        Raises:
            InputError: it cannot be read.
        """
        return self.antennas.of(load_record(self.dataset))


def is_traced(folder: Path) -> bool:
    """Whether a folder is a run of the ray tracer."""
    return stated_model(folder) == MODEL


def read_trace_config(folder: Path) -> TraceConfig:
    """Read ``config.yaml`` of a traced run.

    Raises:
        InputError: missing, not YAML, or not of a traced run.
    """
    names = ("dataset", "scene", "material", "split", "n_train", "seed", "calibration")
    with stated_config(folder, "trace") as content:
        options, antennas = TraceOptions(**content["options"]), AntennaOptions(**content["antennas"])
        return TraceConfig(**{name: content[name] for name in names}, options=options, antennas=antennas)


def trace_run(
    scene: str | Path,
    dataset: str | Path | Record,
    out: str | Path,
    options: TraceOptions | None = None,
    *,
    material: str | None = None,
    split: str = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    calibration: str | None = None,
    antennas: AntennaOptions = AS_STATED,
    target_error_db: float | None = None,
    kinds: Sequence[str] = CHOSEN_KINDS,
    progress: bool = False,
    scheduler: Scheduler | None = None,
) -> Path:
    """Trace a scene for every row of a data set and score it as a learned model is scored.

    Nothing is fitted, but for signal strengths one offset per receiver on the training rows
    (`wrf_mi.trace.offsets`), because their scale is not calibrated; or all that `wrf_mi.trace.calibrate` fits.

    Args:
        scene: name, scene folder, Mitsuba XML or mesh.
        dataset: name, folder, or a record that was loaded.
        out: run folder to make; must not exist or be empty.
        options: what is traced; None: the defaults.
        material: of a bare mesh.
        split: name of a split; ``blocked`` scores every fold in turn and pools.
        n_train: number or fraction of the training rows to use; None: all.
        seed: of the split. The rays have theirs in ``options``.
        calibration: what to fit to the training rows by gradients, beside offsets: ``"patterns"`` of the antennas,
            or ``"all"``, materials too (a step takes fifty times as long). Signal strengths alone.
        antennas: patterns and polarisations in place of what the data state.
        target_error_db: error of received power, and of spectra where they are the task, dB, for which depth, rays and
            further kinds of path are chosen by convergence on a sample of the transmitters (`wrf_mi.trace.target`);
            None: ``options`` as they are.
            ``convergence.json`` states what was tried.
        kinds: that may then be switched on.
        progress: show a progress bar on standard error.
        scheduler: what traces parts of the rows; None: this process. Its workers must see the scene under the same
            name. What comes of it is the same.

    Returns:
        The run folder.

    Raises:
        InputError: data, scene, settings or folder that cannot be used, with nothing left behind.
    """
    folder = Path(out)
    check_new(folder)
    record = dataset if isinstance(dataset, Record) else load_record(str(dataset), progress=progress)
    source = record.source or record.name if isinstance(dataset, Record) else str(dataset)
    record = antennas.of(record)
    splits = make_splits(record, split, seed, n_train)
    if calibration is not None and calibration not in CALIBRATIONS:
        raise InputError(f"calibration {calibration!r}: unknown; choose from {', '.join(CALIBRATIONS)}")
    task = task_of(record)
    if calibration is not None and not task.in_decibel:
        raise InputError(f"{record.name}: holds {record.task}; only signal strengths (rssi) can be calibrated with")
    for rows in splits:
        check_observations(record, rows)
    given = options or TraceOptions()
    config = TraceConfig(source, str(scene), material, split, n_train, seed, given, calibration, antennas)
    tracer = RayTracer(scene, instrument_of(record), config.options, material)
    choice = None
    if target_error_db is not None:
        here = record.tx_pos_m, record.receivers
        spectra = tracer.instrument.observe if task.image else None
        choice = choose_options(tracer.scene, *here, target_error_db, tracer.options, kinds, spectra, record.tx_antenna)
        config = replace(config, options=choice.options)
        tracer = RayTracer(scene, instrument_of(record), config.options, material)

    start = time.perf_counter()
    traced = _trace(tracer, record.tx_pos_m, config, progress, scheduler)
    seconds = time.perf_counter() - start
    warn_of_cross_polarization(traced, tracer.scene)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        save_trace(folder / PATHS, traced)
        if choice is not None:
            write_atomically(folder / CONVERGENCE, json.dumps(choice.plain(), indent=1) + "\n")
        start = time.perf_counter()
        for part, rows in part_folders(folder, splits):
            part.mkdir(exist_ok=True)
            save_split(part / SPLIT, rows)
            if calibration is not None:
                wanted = CALIBRATIONS[calibration]
                fitted = calibrate(traced, tracer.scene, record, rows.all_train, wanted, progress)
                save_calibration(part / CALIBRATION, fitted)
        spent = {"trace_seconds": seconds, "train_seconds": time.perf_counter() - start if calibration else 0.0}
        metrics, arrays = _score(folder, record, splits, tracer, traced)
    except InputError:
        shutil.rmtree(folder)  # it was new or empty
        raise
    # Only now: a trace is not gone on with, so what is left of one that was stopped must not look like a run.
    write_atomically(folder / CONFIG, _config_text(config))
    write_results(folder, _header(config, traced) | spent | metrics, arrays)
    return folder


def _trace(
    tracer: RayTracer, tx_pos_m: FloatArray, config: TraceConfig, progress: bool, scheduler: Scheduler | None
) -> TraceResult:
    """Paths of all positions; each part with the number of rays that all of them settle on."""
    if scheduler is None:
        return tracer.trace(tx_pos_m, progress)
    rays = tracer.rays(tx_pos_m)
    least = TRACED_AT_LEAST
    if not tracer.options.sampled:
        least = max(least, min(SPECULAR_AT_LEAST, -(-len(tx_pos_m) // (2 * scheduler.workers))))
    parts = row_parts(len(tx_pos_m), scheduler.workers, least, TARGETS_AT_ONCE)
    opener = partial(RayTracer, config.scene, tracer.instrument, replace(tracer.options, rays=rays), config.material)
    given = [(tx_pos_m[part], part.start) for part in parts]
    sizes = [len(positions) for positions, _ in given]
    found = scheduler.map(_trace_part, given, opener, what="tracing", sizes=sizes)
    return replace(join_traces(found), options=tracer.options)


def _trace_part(tracer: RayTracer, part: tuple[FloatArray, int]) -> TraceResult:
    return tracer.trace(part[0], first_row=part[1])


def evaluate_traced(folder: Path, split: str | None = None) -> dict[str, Any]:
    """Score a traced run again from its saved paths, without tracing.

    Args:
        folder: the run; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: score on the test rows of another split instead; nothing is written.

    Returns:
        The metrics.

    Raises:
        InputError: not a traced run, or files in it that are missing or damaged.
    """
    config = read_trace_config(folder)
    record = config.record()
    traced = load_trace(folder / PATHS)
    tracer = _tracer_of(config, traced, instrument_of(record))
    if split is None:
        splits = [load_rows(part, record) for part in stored_parts(folder)]
    elif config.calibration is not None:
        raise InputError(f"{folder}: calibrated on the training rows of {config.split}; leave --split away")
    else:
        splits = make_splits(record, split, config.seed)
        config = replace(config, split=split)
    metrics, arrays = _score(folder if split is None else None, record, splits, tracer, traced)
    known = stored_metrics(folder)
    stored = {key: known[key] for key in ("trace_seconds", "train_seconds") if key in known}
    merged = _header(config, traced) | stored | metrics
    if split is None:
        write_results(folder, merged, arrays)
    return merged


class TracedRun:
    """A traced run, ready to predict.

    Attributes:
        names: of the receivers.
        uses_heading: whether predictions depend on the transmitter's heading: a calibrated pattern of the transmitter,
            fitted to rows with headings, turns with it.
    """

    def __init__(self, folder: Path) -> None:
        """Open a run with one split.

        Raises:
            InputError: not a traced run, or one over several splits whose offsets differ.
        """
        config = read_trace_config(folder)
        self._folder, self.uses_heading = folder, False
        self._record = record = config.record()
        self._instrument = instrument = instrument_of(record)
        traced = load_trace(folder / PATHS)
        self._tracer = _tracer_of(config, traced, instrument)
        self.names = tuple(receiver.name for receiver in instrument.receivers)
        self._calibration: Calibration | None = None
        self._offsets: Callable[[FloatArray], FloatArray] | None = None
        if not task_of(record).in_decibel:
            return
        if not (folder / SPLIT).exists():
            raise InputError(f"{folder}: offsets for each block; trace with --split official to predict")
        self._rows = load_rows(folder, record)
        if config.calibration is not None:
            self._calibration = load_calibration(folder / CALIBRATION)
            self.uses_heading = record.tx_heading_rad is not None and self._calibration.tx_pattern_db.size > 0
            return
        known = self._rows.all_train
        self._offsets = fit_offsets(instrument.observe(traced.paths)[:, known], record.observation[:, known])

    def predict(
        self, tx_pos_m: FloatArray, tx_heading_rad: FloatArray | None = None, first_row: int = 0
    ) -> NDArray[Any]:
        """What the receivers report of new transmitter positions.

        Args:
            tx_pos_m: positions [m, 3], metres.
            tx_heading_rad: yaw of the transmitter's body [m], radians, if and only if ``uses_heading``.
            first_row: what errors call the first of them.

        Returns:
            Observations [n_rx, m, ...].

        Raises:
            InputError: a position inside a solid object, headings missing or of another shape, or headings for a run
                that does not use them.
        """
        self._check_heading(len(tx_pos_m), tx_heading_rad)
        new = self._tracer.trace(tx_pos_m, first_row=first_row)
        if self._calibration is not None:
            values = calibrated_rssi(self._calibration, new, self._tracer.scene, tx_heading_rad)
            return _with_floor(values, self._record, self._rows)
        observed = self._instrument.observe(new.paths)
        return observed if self._offsets is None else self._offsets(observed)

    def _check_heading(self, count: int, tx_heading_rad: FloatArray | None) -> None:
        if not self.uses_heading:
            if tx_heading_rad is not None:
                raise InputError(f"{self._folder}: {UNUSED_HEADING}")
        elif tx_heading_rad is None:
            text = "calibrated with the transmitter's headings; give heading_rad, or trace without --calibrate"
            raise InputError(f"{self._folder}: {text}")
        elif tx_heading_rad.shape != (count,) or not np.isfinite(tx_heading_rad).all():
            text = f"{count} positions and headings {tx_heading_rad.shape}; give one finite heading for each"
            raise InputError(f"{self._folder}: {text}")


def _tracer_of(config: TraceConfig, traced: TraceResult, instrument: Instrument) -> RayTracer:
    """The tracer of a run, with the number of rays that the run settled on, not one that new positions would."""
    return RayTracer(config.scene, instrument, replace(config.options, rays=traced.rays), config.material)


def _score(
    folder: Path | None, record: Record, splits: list[Split], tracer: RayTracer, traced: TraceResult
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Scores over all splits; with the calibrations that lie in ``folder``, if there are any."""
    observed = tracer.instrument.observe(traced.paths)
    parts = []
    for k, rows in enumerate(splits):
        place = folder if folder is None or len(splits) == 1 else folder / f"fold{k}"
        values = observed
        if place is not None and (place / CALIBRATION).exists():
            calibration = load_calibration(place / CALIBRATION)
            values = calibrated_rssi(calibration, traced, tracer.scene, record.tx_heading_rad)
            values = _with_floor(values, record, rows)
        elif task_of(record).in_decibel:
            known = rows.all_train
            values = fit_offsets(observed[:, known], record.observation[:, known])(observed)
        parts.append(evaluate(record, rows, partial(_reported, values)))
    metrics, arrays = parts[0] if len(parts) == 1 else pool(parts)
    # The rows above are read from one trace of all; a single sample is traced by itself.
    single = milliseconds_per_sample(lambda rows, _: tracer(record.tx_pos_m[rows]), splits[0].test, TIMED)
    return metrics | {"ms_per_sample": single, "peak_memory_mb": peak_memory_mb()}, arrays


def _reported(values: NDArray[Any], rows: IntArray, receiver: int) -> NDArray[Any]:
    return values[receiver, rows]


def _with_floor(values: FloatArray, record: Record, rows: Split) -> FloatArray:
    """Strengths [n_rx, n] with the weakest that each receiver reported in place of what no path reaches."""
    floor = np.nanmin(record.observation[:, rows.all_train], axis=1)
    return np.where(np.isnan(values), floor[:, None], values)


def _header(config: TraceConfig, traced: TraceResult) -> dict[str, Any]:
    known = {"dataset": config.dataset, "scene": config.scene, "split": config.split, "seed": config.seed}
    known |= {"calibration": config.calibration}
    return {"model": MODEL, **known, "train_seconds": 0.0, "paths": len(traced.paths), "rays": traced.rays}


def _config_text(config: TraceConfig) -> str:
    content = {"model": MODEL, **{k: v for k, v in asdict(config).items() if k != "options"}}
    return yaml.safe_dump(content | {"versions": versions(), "options": asdict(config.options)}, sort_keys=False)
