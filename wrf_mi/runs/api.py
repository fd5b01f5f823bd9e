"""Runs of any model, from a data set to scores in a run folder: the functions behind the command and the Python API."""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from ..backend import init
from ..checking import warn_of_suspicions
from ..core import AntennaOptions, InputError, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.locks import alone_in_process, locked_folder
from ..core.settings import names_of, setting_texts, stated_values
from ..datasets import make_splits
from ..datasets.folder_files import read_positions
from ..datasets.observations import (
    LEAST_ROWS,
    check_observations,
    fitted_receivers,
    place_of,
    warn_of_left_out,
    warn_of_one_place,
)
from ..datasets.splits import NONE, default_split, splits_below
from ..models import MODELS, Model, Problem, Session, known_model
from ..models.checks import check_held_receivers, check_record, check_stated
from ..models.model import default_settings
from ..models.receiver_places import check_placeable, placed_problem, tell_places, write_places
from ..parallel import Scheduler
from ..scene.correction_data import read_correction_data
from ..synthetic import load_record
from ..tasks import TASKS, task_of
from ..training.checkpoint import CHECKPOINT, checkpoint_seconds
from ..training.fit_plan import check_rows
from ..training.session import Interrupted, OnProgress, quiet
from .evaluate import FittedPart, score_other, score_part, score_run
from .folder import (
    FITTED,
    GIVEN,
    RunConfig,
    RunRequest,
    Settings,
    check_new,
    has_progress,
    load_rows,
    new_run_folder,
    run_parts,
    start_run,
    write_configs,
    write_fitted,
)
from .run import Run, load_fitted, open_run, predict_to_file
from .scenes import Scene

if TYPE_CHECKING:
    import xarray

logger = logging.getLogger(__name__)

LOSS = "loss"  # setting of fields of Gaussians that names their loss


def plan_run(
    dataset: str | Path | Record, request: RunRequest, progress: bool = False, on_progress: OnProgress = quiet
) -> tuple[Problem, RunConfig, list[Split]]:
    """Problem, configuration and splits of a run; errors as those of `train`. Nothing is written."""
    scene = None if request.scene is None else str(request.scene)
    record = dataset if isinstance(dataset, Record) else load_record(str(dataset), progress=progress)
    model = _serving_model(record, request)
    _check_scene(model, record, scene, request)
    settings, stated = _settings_of(model, request)
    seed, deterministic = request.seed, request.deterministic
    if "seed" in model.train_arguments:
        seed, deterministic = settings.seed, settings.deterministic
    split = _split_of(record, request)
    record, splits, left_out = _split_rows(record, split, seed, request.n_train, _least_rows(record, request))
    if request.wanted is not None:
        wanted_m = _wanted_m(record, request.wanted)
        splits = [replace(rows, wanted_m=wanted_m) for rows in splits]
    for rows in splits:
        check_held_receivers(record, rows, model, MODELS.values())
        check_observations(record, rows, model.complete, may_be_silent=TASKS[record.task].in_decibel)
    problem = Problem(record, settings, seed, scene, request.material, request.antennas, stated=stated)
    check_placeable(problem, splits)
    source = (record.source or record.name) if isinstance(dataset, Record) else str(dataset)
    name = split.name if isinstance(split, Split) else split
    options = (seed, scene, request.material, request.antennas, deterministic, request.intervals, settings, left_out)
    names = None if stated is None else tuple(sorted(stated))
    config = RunConfig(request.model, source, record.task, name, request.n_train, *options, names)
    placed = placed_problem(problem.seen(splits[-1]), splits[-1], config.entry, on_progress)
    config.entry.check(placed, splits)
    check_stated(config.entry, placed, splits)
    tell_places(placed)
    return problem, config, splits


def _wanted_m(record: Record, wanted: str | Path | FloatArray) -> FloatArray:
    """Positions where predictions are wanted; `InputError`: none, or a task whose hold-out does not depend on them."""
    if not task_of(record).in_decibel:
        raise InputError(f"--for: {record.name} holds {record.task}; positions shape the hold-out of rssi; omit it")
    positions_m = np.asarray(read_positions(Path(wanted)).positions_m if isinstance(wanted, str | Path) else wanted)
    if positions_m.ndim != 2 or positions_m.shape[1] != 3 or not np.isfinite(positions_m).all() or not len(positions_m):
        raise InputError(f"--for: positions {positions_m.shape}; give finite x, y, z in metres in each row")
    return positions_m.astype(float)


def _serving_model(record: Record, request: RunRequest) -> Model:
    """Registry entry that serves a record; `InputError`: none does, or arguments belong to other models."""
    entry = known_model(request.model)
    check_record(entry, record, (other for other in MODELS.values() if other.scene != "required"))
    model = entry.serving(record.task, request.scene is not None)
    for name, option, data in (("evaluation", "", "Gaussians"), ("receiver", "-model", "fields of spectra")):
        if getattr(request, name) is not None and name not in model.train_arguments:
            able = ", ".join(other.name for other in MODELS.values() if name in other.train_arguments)
            raise InputError(f"--{name}{option} belongs to {data} ({able}), not to {request.model}")
    return model


def _split_of(record: Record, request: RunRequest) -> str | Split:
    """Stated split, else the official one, or `NONE` with a warning."""
    if request.split is not None:
        return request.split
    split = default_split(record)
    if split == NONE:
        text = "%s: no official split, so --split none: scores are of folds held out in space, the model of all rows"
        logger.warning(text, place_of(record))
    return split


def _settings_of(model: Model, request: RunRequest) -> tuple[Any, frozenset[str] | None]:
    """Settings, and the names of those that are stated; None: those of a dataclass that differ from its defaults."""
    kind: Any = model.settings
    stated, names = request.settings, None
    if is_dataclass(stated) and not isinstance(stated, type):
        if request.preset is not None:
            raise InputError(f"preset {request.preset}: the settings state all values; give one of both")
        if request.loss is not None:
            raise InputError(f"loss {request.loss}: the settings state all values; state it as loss.name there")
        if not issubclass(kind, type(stated)):
            raise InputError(f"settings of {model.name}: {type(stated).__name__}; give {kind.__name__}")
        settings: Any = kind(**{field.name: getattr(stated, field.name) for field in fields(stated)})
    else:
        assert isinstance(stated, Iterable)
        texts = [*(setting_texts(stated) if isinstance(stated, Mapping) else stated), *_loss_text(model, request.loss)]
        preset, given = _preset(model, request.preset), {name: getattr(request, name) for name in GIVEN}
        settings = default_settings(model, [*preset, *texts], given)
        names = frozenset(stated_values(settings, texts))
        if preset and stated_values(settings, preset).keys() <= names:
            raise InputError(f"preset {request.preset}: the settings state all that it does; omit one of them")
        for name in names.intersection(model.train_arguments) - {"model"}:
            value = getattr(settings, name)
            if given[name] not in (None, type(value)(), value):
                raise InputError(f"setting {name}: {value}, where the argument is {given[name]}; give one of both")
    if "model" in model.train_arguments and settings.model != model.name:
        raise InputError(f"setting model: {settings.model}, where the model is {model.name}; choose it with --model")
    return settings, names


def _loss_text(model: Model, name: str | None) -> list[str]:
    """The setting that a loss of a name is."""
    if name is None:
        return []
    if LOSS not in names_of(model.settings):
        able = ", ".join(other.name for other in MODELS.values() if LOSS in names_of(other.settings))
        raise InputError(f"loss {name}: belongs to fields of Gaussians ({able}), not to {model.name}")
    return [f"{LOSS}.name={name}"]


def _preset(model: Model, name: str | None) -> tuple[str, ...]:
    if name is not None and name not in model.presets:
        known = f"has the presets {', '.join(model.presets)}" if model.presets else "has no presets; use --set"
        raise InputError(f"--preset {name}: {model.name} for such data {known}")
    return () if name is None else model.presets[name]


def _least_rows(record: Record, request: RunRequest) -> int:
    """Training rows below which receivers are left out; by default no receiver of signal strengths is."""
    if request.min_rows is None:
        return 0 if TASKS[record.task].in_decibel else LEAST_ROWS
    if request.min_rows < 0:
        raise InputError(f"min_rows {request.min_rows}: give a number of training rows, 0 or more")
    return request.min_rows


def _split_rows(
    record: Record, split: str | Split, seed: int, n_train: int | float | None, least: int
) -> tuple[Record, list[Split], dict[str, int]]:
    """Record without receivers that have too few training rows, its splits, and those receivers' numbers of rows."""
    left_out: dict[str, int] = {}
    if isinstance(split, Split):
        check_rows(split, record, f"split {split.name}")
    # Receivers are held out of those that have enough rows in the split of rows that lies below.
    below = () if isinstance(split, Split) else splits_below(record, split)
    for rule in (*below, split):
        while True:
            splits = [rule] if isinstance(rule, Split) else make_splits(record, rule, seed, n_train)
            numbers, scarce = fitted_receivers(record, splits, least)
            if not scarce:
                break
            # Rows that only these receivers received are in no split any more, and a seeded draw from fewer rows may
            # leave another receiver without: so again, until none is left out. Each turn leaves out one at least.
            left_out |= scarce
            record = record.at_receivers(numbers)
            rule = rule.at_receivers(numbers) if isinstance(rule, Split) else rule
    return record, splits, left_out


def _check_scene(model: Model, record: Record, scene: str | None, request: RunRequest) -> None:
    if scene is None:
        if model.scene == "required":
            raise InputError(f"{model.name} needs a scene; give --scene SCENE, or choose kriging, which takes none")
        if request.material is not None or request.antennas:
            raise InputError("--material and antenna options belong to a scene that is traced; give --scene")
    elif model.scene == "none":
        raise InputError(f"{model.name} on {place_of(record)}: takes no scene; omit --scene")
    elif request.antennas and not model.uses_antennas:
        raise InputError(f"{model.name} on {record.name}: takes no antenna options: its channels are of isotropic ones")


@alone_in_process()
def train(
    data: str | Path | Record | xarray.Dataset,
    model: str = "hybrid",
    scene: str | Path | Scene | None = None,
    *,
    out: str | Path | None = None,
    overwrite: bool = False,
    preset: str | None = None,
    material: str | None = None,
    antennas: AntennaOptions = AS_STATED,
    receiver: str | None = None,
    evaluation: str | None = None,
    loss: str | None = None,
    split: str | Split | None = None,
    wanted: str | Path | FloatArray | None = None,
    n_train: int | float | None = None,
    seed: int = 0,
    settings: Settings = (),
    deterministic: bool = False,
    intervals: bool = False,
    min_rows: int | None = None,
    on_progress: OnProgress = quiet,
    stop: Callable[[], bool] = lambda: False,
    scheduler: Scheduler | None = None,
    progress: bool = False,
) -> Run:
    """Fit a model to a data set and score it.

    Args:
        data: name or folder of a data set, a loaded record, or an `xarray.Dataset` (`wrf_mi.core.Record.to_xarray`).
        model: name of the model, a key of `wrf_mi.models.MODELS`.
        scene: scene, or name, scene folder, Mitsuba XML or mesh to trace, for models that take one.
        out: run folder to make; must not exist or be empty. None: a temporary one, removed with the run.
        overwrite: ``out`` may be that of a run, which is replaced.
        preset: settings by a name of `wrf_mi.models.Model.presets`, such as ``"fast"``; ``settings`` are beside them.
        material: radio material of a bare mesh.
        antennas: patterns and polarisations that override the data set; with a scene.
        receiver: ``"pixel"``, ``"array"`` or ``"auto"``, for models that have a choice.
        evaluation: evaluation of Gaussians, ``"splatted"`` or ``"traced"`` (`wrf_mi.graph.evaluations`).
        loss: name of a loss of the training (`wrf_mi.tasks.LOSSES`), for fields of Gaussians; None: the task's.
        split: name of a split (``blocked`` fits every fold in turn and pools the scores; ``none`` then fits all rows),
            or the rows themselves; None: ``official``, or ``none`` where the data have no split.
        wanted: positions where predictions are wanted, [k, 3] in metres or a CSV file with the columns x, y, z: the
            training rows that are held out for the choices of a fit to signal strengths are as far from the others as
            these are from the training rows. None: as the test rows of the split.
        n_train: number or fraction of the training rows to use; None: all.
        seed: seed of split and fit.
        settings: settings of the model: values by name, nested or dotted, ``key=value`` texts, or its dataclass, whose
            seed and determinism then count.
        deterministic: fit on one thread of the CPU, bit-identical from run to run.
        intervals: calibrate the standard deviations of predictions on training rows that are held out in space; the
            model is fitted once more.
        min_rows: receivers with fewer training rows are left out; None: of signal strengths none is left out, those
            with few rows being predicted from the others; of other data those with fewer than 2.
        on_progress: progress callback: stage, fraction done, and loss, score and time where steps are taken.
        stop: called wherever nothing would be lost; True ends the run, and `resume` continues it.
        scheduler: computes parts of the work of models that have some (ray tracing), with the same result; None: this
            process. Its workers must see the scene under the same name.
        progress: show bars on standard error where the tracer takes time.

    Returns:
        The run, with its scores in ``metrics``.

    Raises:
        InputError: data, scene, settings or folder that cannot be used; what a fit has stored before it stays, and a
            note says how to go on; without it nothing is left on the disk.
        Interrupted: ``stop`` ended the run; continue with `resume`.
        BackendError: a deterministic fit in a process that computes on a GPU already.

    >>> run = train("laboratory", "idw", n_train=20)
    >>> run.metrics["n_train"]
    20
    """
    if out is not None:
        check_new(Path(out), overwrite)
    if deterministic:  # before anything is read: reading a data set may choose the GPU
        init("llvm", threads=1)
    place = scene.folder if isinstance(scene, Scene) else scene
    what = RunRequest(model, place, material, antennas, receiver, evaluation, split, n_train, seed, settings)
    request = replace(
        what,
        deterministic=deterministic,
        intervals=intervals,
        min_rows=min_rows,
        preset=preset,
        loss=loss,
        wanted=wanted,
    )
    data = data if isinstance(data, str | Path | Record) else load_record(data)
    problem, config, splits = plan_run(data, request, progress, on_progress)
    warn_of_suspicions(problem.record)
    warn_of_left_out(problem.record, config.left_out, _least_rows(problem.record, request))
    warn_of_one_place(problem.record, splits)
    _warn_of_known_rows(problem, splits)
    if config.deterministic:
        init("llvm", threads=1)
    folder = Path(tempfile.mkdtemp(prefix="wrf-mi-") if out is None else out)
    with new_run_folder(folder, overwrite):
        start_run(folder, config, splits)
        session = Session(folder, folder, on_progress, stop, scheduler, progress)
        with _noting_resumption(folder):
            _complete(folder, config, problem, session)
    run = Run(folder, problem.record, kept=scene)
    if out is None:
        weakref.finalize(run, shutil.rmtree, folder, ignore_errors=True)
    return run


@contextmanager
def _noting_resumption(folder: Path) -> Iterator[None]:
    """Note at an error of the block, whatever it is, how to go on from what a fit has stored in its run folder."""
    try:
        yield
    except Interrupted:  # it says so
        raise
    except BaseException as error:
        if has_progress(folder):
            error.add_note(f"what was fitted is kept; go on with: wrf-mi train --resume {folder}")
        raise


def _warn_of_known_rows(problem: Problem, splits: Sequence[Split]) -> None:
    """Warn of a scene that was corrected by rows that the run is to be tested on."""
    data = read_correction_data(problem.scene)
    if data is None:
        return
    # Of receivers that are held out, the correction knew the others.
    tested = np.unique([row for split in splits if not split.held_receivers for row in split.test]).astype(np.int64)
    count = int(data.knows(problem.record.name, tested).sum())
    if count:
        text = "%s was corrected by %d of the %d test rows: scores are too good; correct it by the training rows"
        logger.warning(text, problem.scene, count, len(tested))


@alone_in_process()
def resume(
    folder: str | Path,
    on_progress: OnProgress = quiet,
    stop: Callable[[], bool] = lambda: False,
    progress: bool = False,
    record: Record | None = None,
) -> Run:
    """Continue a stopped run; fitted parts are only scored again. Arguments as those of `train` and `open_run`.

    Raises:
        InputError: not a run folder, or one that another process writes into.
        Interrupted: ``stop`` ended the run once more.
        BackendError: as `train`.

    >>> run = train("laboratory", "idw", n_train=20)
    >>> (run.folder / "model.npz").unlink()  # as if stopped
    >>> resume(run.folder).metrics["n_train"]
    20
    """
    run = open_run(folder, record)
    if run.config.deterministic:
        init("llvm", threads=1)
    session = Session(run.folder, run.folder, on_progress, stop, progress=progress)
    with locked_folder(run.folder), _noting_resumption(run.folder):
        _complete(run.folder, run.config, run.problem, session)
    return open_run(folder, record)


def _complete(folder: Path, config: RunConfig, problem: Problem, session: Session) -> None:
    """Fit every part that is not fitted yet, and score the run."""
    folders = run_parts(folder)
    splits = [load_rows(part, problem.record) for part in folders]
    if not all((part / FITTED).exists() for part in folders):
        placed = placed_problem(problem, splits[0], config.entry, session.report)
        problem.settings = config.entry.prepare(placed, splits, session)
        if problem.settings != config.settings:
            config = replace(config, settings=problem.settings)
            write_configs(folder, config, splits)
    parts, scores = [], []
    for part, rows in zip(folders, splits, strict=True):
        if not (part / FITTED).exists():
            before, start = checkpoint_seconds(part), time.perf_counter()
            # Matrices of a few hundred rows: threads of BLAS would mostly wait for each other.
            with threadpool_limits(1, "blas"):
                of_part = session.of_part(part, folders)
                placed = placed_problem(problem.seen(rows), rows, config.entry, of_part.report)
                fitted = config.entry.fit(placed, rows, of_part)
            write_places(part, placed.record)
            spent = fitted.train_seconds
            write_fitted(part, fitted.arrays(), before + time.perf_counter() - start if spent is None else spent)
            for done in session.discarded:
                shutil.rmtree(done, ignore_errors=True)
            session.discarded.clear()
            del fitted  # what is scored is the stored one, beside which this would be in memory a second time
        (part / CHECKPOINT).unlink(missing_ok=True)  # also of a process that was killed before
        parts.append(FittedPart(part, rows, *load_fitted(config, problem, part)))
        if len(rows.test):
            scores.append(score_part(folder, config, problem, parts[-1]))
    score_run(folder, config, parts, scores)


@alone_in_process()
def evaluate_run(
    folder: str | Path, split: str | None = None, operator: bool = True, record: Record | None = None
) -> dict[str, Any]:
    """Score a run again.

    Args:
        folder: run folder; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: name of another split, whose test rows are scored except those used in training; nothing is written.
        operator: learned fields predict by operator where they can.
        record: data that the model was fitted to; None: the data set that the folder names.

    Returns:
        The metrics.

    Raises:
        InputError: not a run folder, a stopped run, or no row of ``split`` that was not used in training.
    """
    run = open_run(folder, record, operator)
    config, problem, folders = run.config, run.problem, run_parts(run.folder)
    if split is not None and folders != [run.folder]:
        raise InputError(f"{run.folder}: every row is held out in one of its folds; omit --split")
    parts = [FittedPart(part, load_rows(part, problem.record), *load_fitted(config, problem, part)) for part in folders]
    if split is not None:
        return score_other(config, problem, parts[0], split)
    scores = [score_part(run.folder, config, problem, part) for part in parts if len(part.split.test)]
    return score_run(run.folder, config, parts, scores)


__all__ = ["Interrupted", "Run", "evaluate_run", "open_run", "plan_run", "predict_to_file", "resume", "train"]
