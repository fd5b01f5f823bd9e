"""The model ``ray-tracing``: paths of a scene, optionally calibrated on the training rows.

paths.npz         in the run folder: every path, to be used again for other materials (`wrf_mi.tracing.load_trace`)
corrected/        where planes or materials were calibrated: the corrected scene, a folder that plain Sionna RT opens
convergence.json  where settings were chosen by convergence: target and estimated error, dB, and all tried settings

For signal strengths an offset per receiver (`wrf_mi.tracing.tracer`) is fitted to the training rows. With
``calibration``, parameters of the scene are trained for every task, by the graph of `wrf_mi.graph.graph` without
Gaussians.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.carriers import carriers_text
from ..core.files import readable, write_atomically
from ..core.settings import settings_from, with_settings
from ..core.stored import NOT_STORED, from_arrays
from ..core.types import IntArray
from ..datasets.observations import place_of
from ..parallel import row_parts
from ..receivers.instruments import Instrument
from ..receivers.registry import GAPS
from ..receivers.spreads import PathStatistics
from ..tasks import instrument_of
from ..tracing import TraceOptions, TraceResult, load_trace, save_trace
from ..tracing.convergence import CHOSEN_KINDS, choose_options
from ..tracing.options import without_effect
from ..tracing.paths.corrected_scene import check_materials, write_corrected_scene
from ..tracing.paths.result import join_traces
from ..tracing.paths.solve import PAIRS_TOGETHER
from ..tracing.tracer import Offsets, RayTracer, fit_offsets, warn_of_cross_polarization
from ..training.config import LoopOptions, calibration_config
from .gaussian.model import WRF_GS_PLUS, FittedField
from .model import Arrays, Decomposition, Fitted, Inputs, Model, Problem, Session

logger = logging.getLogger(__name__)

NAME = "ray-tracing"
PATHS, CONVERGENCE, CORRECTED = "paths.npz", "convergence.json", "corrected"
WITHOUT_PATH = 0.05  # share of measured values without a path from which on walls that nothing passes are suspected
TRACED_AT_LEAST, SPECULAR_AT_LEAST = 16, 1024
"""Fewest positions of a scheduler's part: candidates of fewer are not made faster. Where rays start at the receivers
alone, a part of any size costs as much as a few hundred positions."""


@dataclass(frozen=True)
class TracingSettings(LoopOptions, TraceOptions):  # type: ignore[misc]  # its fields are made from others
    """Settings of tracing and calibration, and with ``calibration`` of the training loop."""

    #: parameters that are trained on the training rows, separated by commas: any of ``gain`` (of each receiver),
    #: ``materials``, ``planes``, ``patterns`` (of the antennas), ``pose`` (of the receivers) and ``surface`` (Gaussians
    #: on surfaces, `wrf_mi.tracing.paths.surface_gaussians`); null: none
    calibration: str | None = None
    #: error of received power, and of spectra where they are the task, dB, for which depth, rays and further kinds of
    #: path are chosen by convergence on a sample of the transmitters (`wrf_mi.tracing.convergence`); null: none are
    #: chosen
    target_error_db: float | None = None
    target_kinds: str = ",".join(CHOSEN_KINDS)  #: kinds of path that may then be switched on, separated by commas

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.calibration is None and (chosen := self.chosen()):
            raise InputError(f"setting {chosen[0]}: of a training, and nothing is calibrated; set calibration, too")
        if self.calibration is not None:
            with_settings(calibration_config(self.calibration.split(",")), self.chosen())
            if self.target_error_db is not None:
                raise InputError("target_error_db chooses what is traced without calibration; omit one of the two")
        if unknown := [kind for kind in self.target_kinds.split(",") if kind and kind not in CHOSEN_KINDS]:
            raise InputError(f"target_kinds {unknown[0]!r}: choose from {', '.join(CHOSEN_KINDS)}")


@dataclass(eq=False)
class FittedTracing(Fitted):
    """A traced scene with offsets that were fitted to training rows."""

    problem: Problem = field(metadata=NOT_STORED)
    file: Path | None = field(metadata=NOT_STORED)  # stored paths of the record's rows; None: of an edited scene
    rays: int  # number of rays
    paths: int  # number of paths
    trace_seconds: float
    paths_without_gain: int  # number of paths that are left out
    offsets: Offsets | None = None  # of signal strengths

    def __post_init__(self) -> None:
        self._last: tuple[Inputs, NDArray[Any], list[PathStatistics], set[int]] | None = None
        self._of_rows: tuple[IntArray, NDArray[Any]] | None = None

    @cached_property
    def _tracer(self) -> RayTracer:
        problem = self.problem
        assert problem.scene is not None
        options = replace(problem.settings.options, rays=self.rays)
        return RayTracer(problem.scene, _instrument(problem.record), options, problem.material)

    @cached_property
    def _stored(self) -> TraceResult:
        assert self.file is not None
        return _stored_trace(self.file, self.problem.record)

    def _observed(self, traced: TraceResult) -> NDArray[Any]:
        observed = self._tracer.observe(traced)
        return observed if self.offsets is None else self.offsets(observed)

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction | None:
        """Predictions from the stored paths, which an edited scene has not."""
        if self.file is None:
            return None
        # Receivers are predicted in turn.
        if self._of_rows is None or not np.array_equal(self._of_rows[0], rows):
            self._of_rows = rows, self._observed(self._stored.of_transmitters(rows))
        return Prediction(self._of_rows[1][receiver])

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Predictions of a receiver (InputError: inside a solid); all receivers are traced together."""
        return self.decompose(inputs, receiver).prediction

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Predictions of a receiver with statistics of its paths (`predict`)."""
        # Receivers are predicted in turn; the same receiver again is traced anew, so that predictions can be timed.
        last, compared = self._last, ("tx_pos_m", "carriers_hz")
        same = last and all(np.array_equal(getattr(last[0], name), getattr(inputs, name)) for name in compared)
        if self._last is None or not same or receiver in self._last[3]:
            traced = self._tracer.trace(inputs.tx_pos_m, False, inputs.first_row, inputs.carriers_hz)
            statistics = [PathStatistics.of_receiver(traced.paths, index) for index in range(traced.paths.n_rx)]
            self._last = inputs, self._observed(traced), statistics, set()
        self._last[3].add(receiver)
        return Decomposition(Prediction(self._last[1][receiver]), paths=self._last[2][receiver])

    def in_scene(self, scene: str) -> FittedTracing:
        """Paths of an edited scene, with the offsets of strengths."""
        return replace(self, problem=replace(self.problem, scene=scene, material=None), file=None)

    def facts(self) -> dict[str, Any]:
        """Duration of tracing, numbers of paths, of those left out without a gain if there are any, and of rays."""
        lost = {"paths_without_gain": self.paths_without_gain} if self.paths_without_gain else {}
        return {"trace_seconds": self.trace_seconds, "paths": self.paths, **lost, "rays": self.rays}


def _instrument(record: Record) -> Instrument:
    """The instrument behind a record, where rows have several carriers at the first row's."""
    carriers = record.carriers_hz
    return instrument_of(record if carriers is None else record.at_carrier(carriers[0]))


class FittedCalibration(FittedField):
    """Traced paths whose materials, planes, antennas or poses were trained."""

    def facts(self) -> dict[str, Any]:
        """Steps, and the trained parameters."""
        return super().facts() | {"calibration": self.problem.settings.calibration}


def _graph_problem(problem: Problem) -> Problem:
    """The problem of the training loop, with settings of paths alone."""
    settings: TracingSettings = problem.settings
    assert settings.calibration is not None
    options = settings.options
    sampled = options.diffraction or options.scattering
    refusals = (
        (sampled, "diffraction and scattering have no derivative here; trace without them"),
        (not options.line_of_sight, "paths without line-of-sight cannot be chosen there; omit it"),
        (options.seed != TraceOptions().seed, f"seed={options.seed} cannot be chosen there; omit it"),
        (options.phase_error, f"phase_error={options.phase_error:g} belongs to a trace; omit it"),
    )
    for is_stated, text in refusals:
        if is_stated:
            raise InputError(f"calibration: {text}")
    reflections = options.depth if options.reflections is None else options.reflections
    overrides = [
        f"seed={problem.seed}",
        f"traced.depth={options.depth}",
        f"traced.reflections={reflections if options.reflection else 0}",
        f"traced.transmission={str(options.transmission).lower()}",
        *([] if options.rays == "auto" else [f"traced.rays={options.rays}"]),
        *settings.chosen(),
    ]
    config = with_settings(
        calibration_config(settings.calibration.split(","), problem.record.task.settings_of_paths), overrides
    )
    return replace(problem, settings=config.resolved(problem.record.tx_pos_m[:1]))


def _changes_scene(problem: Problem) -> bool:
    groups = set((problem.settings.calibration or "").split(","))
    return bool({"planes", "materials"} & groups) and "surface" not in groups  # a scene's folder holds no Gaussians


def _stored_trace(path: Path, record: Record) -> TraceResult:
    """The run's trace at the receivers of a record: a fold leaves out those with too few training rows."""
    traced, names = load_trace(path), {receiver.name for receiver in record.receivers}
    return traced.of_receivers(
        np.array([k for k, receiver in enumerate(traced.receivers) if receiver.name in names], np.int64)
    )


def _warn_of_walls(traced_dbm: NDArray[Any], measured_dbm: NDArray[Any]) -> None:
    """Say that waves pass walls where many measured values have no path without."""
    share = (~np.isfinite(traced_dbm))[np.isfinite(measured_dbm)].mean() if np.isfinite(measured_dbm).any() else 0.0
    if share > WITHOUT_PATH:
        remedy = "waves pass walls with --set transmission=true (wrf-mi trace: --paths with transmission)"
        text = f"no path arrives where %.0f %% of the training values were measured; {remedy}"
        logger.warning(text, 100 * share)


def _trace(tracer: RayTracer, problem: Problem, session: Session) -> TraceResult:
    """Paths of all positions; every part has the number of rays of all positions."""
    record, scheduler = problem.record, session.scheduler
    tx_pos_m, carriers = record.tx_pos_m, record.carriers_hz
    if scheduler is None:
        return tracer.trace(tx_pos_m, session.show_progress, carriers_hz=carriers)
    assert problem.scene is not None
    rays, least = tracer.rays(tx_pos_m), TRACED_AT_LEAST
    if not tracer.options.sampled:
        least = max(least, min(SPECULAR_AT_LEAST, -(-len(tx_pos_m) // (2 * scheduler.workers))))
    parts = row_parts(len(tx_pos_m), scheduler.workers, least, PAIRS_TOGETHER)
    rows_of = [(tx_pos_m[part], part.start, None if carriers is None else carriers[part]) for part in parts]
    sizes = [len(positions) for positions, *_ in rows_of]
    options = replace(tracer.options, rays=rays)
    opener = partial(RayTracer, problem.scene, tracer.instrument, options, problem.material)
    traces = scheduler.map(_trace_part, rows_of, opener, what="tracing", sizes=sizes)
    return replace(join_traces(traces), options=tracer.options)


def _trace_part(tracer: RayTracer, part: tuple[FloatArray, int, FloatArray | None]) -> TraceResult:
    return tracer.trace(part[0], False, *part[1:])


def _paths_folder(record: Record, session: Session) -> Path:
    """Folder of stored paths, which folds share unless each estimates positions of receivers."""
    estimated = any(receiver.position_std_m is not None for receiver in record.receivers)
    return session.folder if estimated else session.run


def _trace_of_fit(tracer: RayTracer, problem: Problem, session: Session) -> TraceResult:
    """Stored paths of all rows, else new ones, which are stored (Interrupted: stopped after them)."""
    path = _paths_folder(problem.record, session) / PATHS
    traced = _stored_trace(path, problem.record) if path.exists() else None
    if traced is None or len(traced.receivers) < len(problem.record.receivers):  # of a fold that left some out
        traced = _trace(tracer, problem, session)
        warn_of_cross_polarization(traced, tracer.scene)
        save_trace(path, traced)
        if session.stop():
            raise session.interrupted("after tracing")
    return traced


class RayTracing(Model):
    """Paths of a scene, optionally calibrated on the training rows."""

    name, source, settings = NAME, "Hoydis et al., 'Sionna RT' (2023)", TracingSettings
    summary, scene_summary = "Sionna RT in the scene", ""
    scene = "required"
    several_carriers, new_receivers = True, True
    gaps = GAPS

    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Train the calibrated parameters; or trace all rows, unless a fold has, and fit offsets of strengths."""
        if problem.settings.calibration is not None:
            graph = WRF_GS_PLUS.fit(_graph_problem(problem), split, session)
            if _changes_scene(problem):
                scene = graph.predictor.graph.scene
                write_corrected_scene(session.folder / CORRECTED, scene, graph.params, replace=True)
            calibrated = self.load(graph.arrays(), problem, session.folder)
            calibrated.train_seconds = graph.train_seconds
            return calibrated
        record, start = problem.record, time.perf_counter()
        path = _paths_folder(record, session) / PATHS
        assert problem.scene is not None
        settings: TracingSettings = problem.settings
        tracer = RayTracer(problem.scene, _instrument(record), settings.options, problem.material)
        stored = path.exists()
        traced = _trace_of_fit(tracer, problem, session)
        seconds = time.perf_counter() - start
        offsets = None
        if record.task.has_offsets:
            training_rows = split.all_train
            traced_observation = tracer.observe(traced)[:, training_rows]
            if not settings.transmission:
                _warn_of_walls(traced_observation, record.observation[:, training_rows])
            try:
                offsets = fit_offsets(traced_observation, record.observation[:, training_rows])
            except InputError:  # a resumed fit would be refused for the same paths: no progress
                if not stored:  # else fitted folds have them
                    path.unlink()
                raise
        fitted = FittedTracing(problem, path, traced.rays, len(traced.paths), seconds, traced.lost, offsets)
        fitted.train_seconds = 0.0
        return fitted

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The model that a fit's arrays describe; stored paths lie in the run folder, above the folds."""
        if problem.settings.calibration is not None:
            return from_arrays(FittedCalibration, arrays, problem=problem, folder=folder)
        paths = folder / PATHS
        paths = paths if paths.exists() else folder.parent / PATHS
        return from_arrays(FittedTracing, arrays, problem=problem, file=paths)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse a scene that cannot be opened at every carrier, and settings that cannot be calibrated or chosen."""
        settings, carriers = problem.settings, problem.record.carriers_hz
        if carriers is not None:
            if settings.target_error_db is not None:
                text = "target_error_db serves one carrier; omit it"
                raise InputError(f"{place_of(problem.record)}: {carriers_text(carriers)}; {text}")
            for carrier_hz in np.unique(carriers):
                problem.open_scene(float(carrier_hz))
        for receiver in problem.record.receivers:
            if receiver.frequency_hz is not None:
                problem.open_scene(receiver.frequency_hz)
        if problem.settings.calibration is not None:
            WRF_GS_PLUS.check(_graph_problem(problem), splits)
            if _changes_scene(problem):
                check_materials(problem.opened_scene)
        assert problem.opened_scene is not None

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of paths that are not traced, of convergence without a target, and of a trace beside calibration."""
        s, record = problem.settings, problem.record
        unused = without_effect(s.options)
        if not record.task.averages_phases:
            unused["phase_error"] = f"spectra alone are expectations, and {record.name} holds {record.task}"
        # The seed is also that of the split, which draws rows unless all official ones are used.
        if record.official is None or any(set(split.all_train) != set(record.official[0]) for split in splits):
            unused.pop("seed", None)
        if s.target_error_db is None:
            unused["target_kinds"] = "target_error_db is not set"
        else:
            unused.pop("scattering_coefficient", None)
            unused |= dict.fromkeys(("depth", "rays"), "target_error_db chooses it")
        if s.calibration is not None:
            unused["phase_error"] = "it belongs to a trace, and calibration trains paths"
            if s.rays == "auto":
                unused["rays"] = "calibration has a fixed number of rays; give it"
        return unused

    def prepare(self, problem: Problem, splits: Sequence[Split], session: Session) -> TracingSettings:
        """Settings, with those that are chosen by convergence; ``convergence.json`` lists all tried settings."""
        settings: TracingSettings = problem.settings
        path = session.run / CONVERGENCE
        if settings.target_error_db is None:
            return settings
        if not path.exists():
            record, instrument = problem.record, instrument_of(problem.record)
            choice = choose_options(
                problem.opened_scene,
                record.tx_pos_m,
                record.receivers,
                settings.target_error_db,
                settings.options,
                kinds=settings.target_kinds.split(","),
                spectra=instrument.observe if record.task.image else None,
                tx_antenna=record.tx_antenna,
            )
            write_atomically(path, json.dumps(choice.plain(), indent=1) + "\n")
        with readable(path, f"{path}: missing; trace anew", "trace anew"):
            chosen = settings_from(TraceOptions, json.loads(path.read_text())["options"], str(path))
            return replace(settings, **vars(chosen))


MODEL = RayTracing()
