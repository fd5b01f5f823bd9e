"""Runs of any model, from a data set to scores in a run folder: the functions behind the command and the Python API."""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from ..backend import init
from ..core import AntennaOptions, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.locks import alone_in_process, locked_folder
from ..datasets.observations import (
    warn_of_left_out,
    warn_of_one_place,
)
from ..estimators.receiver_places import placed_problem, write_places
from ..models import Problem, Session
from ..parallel import Scheduler
from ..scene.correction_data import read_correction_data
from ..stages.engine import FOLDER as OPTIONS
from ..synthetic import load_record
from ..training.checkpoint import CHECKPOINT, checkpoint_seconds
from ..training.session import Interrupted, OnProgress, quiet
from .applications import APPLICATIONS
from .evaluate import FittedPart, score_part, score_run
from .folder import (
    FITTED,
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
from .plan import least_rows, plan_run
from .predict_to_file import predict_to_file
from .run import Run, load_fitted, open_run

if TYPE_CHECKING:
    import xarray

logger = logging.getLogger(__name__)


@alone_in_process()
def train(
    data: str | Path | Record | xarray.Dataset,
    model: str = "hybrid",
    scene: str | Path | Any | None = None,
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
    place = getattr(scene, "folder", scene)
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
    APPLICATIONS["warn"](problem.record)
    warn_of_left_out(problem.record, config.left_out, least_rows(problem.record, request))
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
    run = Run(folder, problem.record, owner=scene)
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
    session = Session(run.folder, run.folder, on_progress, stop, show_progress=progress)
    with locked_folder(run.folder), _noting_resumption(run.folder):
        _complete(run.folder, run.config, run.problem, session)
    return open_run(folder, record)


def _complete(folder: Path, config: RunConfig, problem: Problem, session: Session) -> None:
    """Fit every part that is not fitted yet, and score the run."""
    folders = run_parts(folder)
    splits = [load_rows(part, problem.record) for part in folders]
    if not all((part / FITTED).exists() for part in folders):
        placed = placed_problem(problem, splits[0], config.entry, session.progress)
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
                placed = placed_problem(problem.seen(rows), rows, config.entry, of_part.progress)
                fitted = config.entry.fit(placed, rows, of_part)
            write_places(part, placed.record)
            spent = fitted.train_seconds
            write_fitted(part, fitted.arrays(), before + time.perf_counter() - start if spent is None else spent)
            for done in session.discarded:
                shutil.rmtree(done, ignore_errors=True)
            session.discarded.clear()
            del fitted  # what is scored is the stored one, beside which this would be in memory a second time
        (part / CHECKPOINT).unlink(missing_ok=True)  # also of a process that was killed before
        shutil.rmtree(part / OPTIONS, ignore_errors=True)
        parts.append(FittedPart(part, rows, *load_fitted(config, problem, part)))
        if len(rows.test):
            scores.append(score_part(folder, config, problem, parts[-1]))
    score_run(folder, config, parts, scores)


def evaluate_run(
    folder: str | Path, split: str | None = None, operator: bool = True, record: Record | None = None
) -> dict[str, Any]:
    """Scores of the run in a folder; arguments, result and errors of `Run` and `Run.score`."""
    return open_run(folder, record, operator).score(split)


__all__ = ["Interrupted", "Run", "evaluate_run", "open_run", "plan_run", "predict_to_file", "resume", "train"]
