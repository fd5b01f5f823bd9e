"""Runs of every model, from a data set to scores in a run folder: what the command and the Python API call."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from ..backend import init
from ..core import AntennaOptions, InputError, Record, Split
from ..core.antenna import AS_STATED
from ..core.settings import with_settings
from ..datasets import make_splits
from ..datasets.observations import check_observations, place_of
from ..models import MODELS, Model, Problem, Session, known_model
from ..models.checks import check_record
from ..parallel import Scheduler
from ..synthetic import load_record
from ..training.checkpoint import CHECKPOINT
from ..training.session import Interrupted, OnProgress, quiet
from ..training.trainer import check_rows
from .folder import FITTED, RunConfig, check_new, load_rows, run_parts, start_run, write_configs, write_fitted
from .run import Run, load_part, open_run, predict_to_file
from .scoring import score_other, score_part, score_run

Settings = Iterable[str] | object
"""``key=value`` of the model's settings, or all of them as its dataclass."""


def _settings_of(model: Model, settings: Settings, given: dict[str, Any]) -> Any:
    """All settings of a model; ``given`` are arguments of `train` that may be settings, too."""
    kind: Any = model.settings
    own = {name: value for name, value in given.items() if name in model.given and value is not None}
    if is_dataclass(settings) and not isinstance(settings, type):
        if not issubclass(kind, type(settings)):
            raise InputError(f"settings of {model.name}: {type(settings).__name__}; give {kind.__name__}")
        found: Any = kind(**{one.name: getattr(settings, one.name) for one in fields(settings)})
    else:
        assert isinstance(settings, Iterable)
        found = with_settings(kind(**own), [*model.defaults, *settings])
    if "model" in model.given and found.model != model.name:
        raise InputError(f"setting model: {found.model}, where the model is {model.name}; choose it with --model")
    return found


def plan_run(
    dataset: str | Path | Record,
    model: str = "wrf-gs+",
    *,
    scene: str | Path | None = None,
    material: str | None = None,
    antennas: AntennaOptions = AS_STATED,
    receiver: str | None = None,
    evaluation: str | None = None,
    split: str | Split = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    settings: Settings = (),
    deterministic: bool = False,
    progress: bool = False,
) -> tuple[Problem, RunConfig, list[Split]]:
    """What `train` would fit. Nothing is written.

    Raises:
        InputError: as `train`.
    """
    entry, place = known_model(model), None if scene is None else str(scene)
    record = dataset if isinstance(dataset, Record) else load_record(str(dataset), progress=progress)
    check_record(entry, record, (other for other in MODELS.values() if other.scene != "required"))
    chosen = entry.serving(record.task, scene is not None)
    if evaluation is not None and "evaluation" not in chosen.given:
        raise InputError(f"--evaluation belongs to Gaussians (wrf-gs, wrf-gs+, factorised), not to {model}")
    if receiver is not None and "receiver" not in chosen.given:
        raise InputError(f"--receiver belongs to fields of spectra (wrf-gs, wrf-gs+, factorised), not to {model}")
    _check_place(chosen, record, place, material, antennas)
    given = {"model": model, "seed": seed, "deterministic": deterministic, "receiver": receiver}
    given["evaluation"] = evaluation
    own = _settings_of(chosen, settings, given)
    if "seed" in chosen.given:
        seed, deterministic = own.seed, own.deterministic
    if n_train == 0 and chosen.scene_alone and scene is None:
        raise InputError("--n-train 0: nothing to predict from; give training rows or a scene")
    use_rows = not (n_train == 0 and chosen.scene_alone)
    # Without training rows the split keeps them for the references beside the model, which need some.
    splits = [split] if isinstance(split, Split) else make_splits(record, split, seed, n_train if use_rows else None)
    for rows in splits:
        check_rows(rows, record, f"split {rows.name}")
        check_observations(record, rows, complete=chosen.complete)
    problem = Problem(record, own, seed, place, material, antennas, use_rows)
    if chosen.check is not None:
        chosen.check(problem, splits)
    source = (record.source or record.name) if isinstance(dataset, Record) else str(dataset)
    name = split.name if isinstance(split, Split) else split
    ends = seed, place, material, antennas, deterministic, own
    return problem, RunConfig(model, source, record.task, name, n_train, *ends), splits


def _check_place(
    model: Model, record: Record, scene: str | None, material: str | None, antennas: AntennaOptions
) -> None:
    if scene is None:
        if model.scene == "required":
            raise InputError(f"{model.name} needs a scene; give --scene SCENE")
        if material is not None or antennas:
            raise InputError("--material and antenna options belong to a scene that is traced; give --scene")
    elif model.scene == "none":
        raise InputError(f"{model.name} on {place_of(record)}: takes no scene; leave --scene away")
    elif antennas and not model.uses_antennas:
        raise InputError(f"{model.name} on {record.name}: takes no antenna options: its channels are of isotropic ones")


def train(
    dataset: str | Path | Record,
    out: str | Path,
    model: str = "wrf-gs+",
    *,
    scene: str | Path | None = None,
    material: str | None = None,
    antennas: AntennaOptions = AS_STATED,
    receiver: str | None = None,
    evaluation: str | None = None,
    split: str | Split = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    settings: Settings = (),
    deterministic: bool = False,
    on_progress: OnProgress = quiet,
    stop: Callable[[], bool] = lambda: False,
    scheduler: Scheduler | None = None,
    progress: bool = False,
) -> Run:
    """Fit a model to a data set and score it.

    Args:
        dataset: name, folder, or a record that was loaded.
        out: run folder to make; must not exist or be empty.
        model: its name, a key of `wrf_mi.models.MODELS`.
        scene: name, scene folder, Mitsuba XML or mesh that is traced, too; for models that take one.
        material: of a bare mesh.
        antennas: patterns and polarisations in place of what the data state; with a scene.
        receiver: ``"pixel"``, ``"array"`` or ``"auto"``, of models that have a choice.
        evaluation: of Gaussians, ``"splatted"`` or ``"traced"`` (`wrf_mi.graph.evaluations`).
        split: name of a split (``blocked`` fits every fold in turn and pools the scores), or rows of your own.
        n_train: number or fraction of the training rows to use; None: all; 0: none, where a scene alone predicts.
        seed: of split and fit.
        settings: ``key=value`` of the model, or all settings as its dataclass; seed and determinism in it count.
        deterministic: on one thread of the CPU, so bit-identical from run to run.
        on_progress: progress callback: stage, fraction done, and loss, score and time where steps are taken.
        stop: asked wherever nothing would be lost; True ends the run, to be gone on with by `resume`.
        scheduler: computes parts of the work of models that have some (ray tracing); None: this process. Its workers
            must see the scene under the same name. What comes of it is the same.
        progress: show bars on standard error where the tracer takes time.

    Raises:
        InputError: data, scene, settings or folder that cannot be used, with nothing left behind.
        Interrupted: ``stop`` ended the run; go on with `resume`.
        BackendError: a deterministic fit in a process that computes on a GPU already.
    """
    folder = Path(out)
    check_new(folder)
    if deterministic:  # before anything is read: whatever reads a data set may choose the GPU
        init("llvm", threads=1)
    place: dict[str, Any] = {"scene": scene, "material": material, "antennas": antennas, "receiver": receiver}
    rows: dict[str, Any] = {"split": split, "n_train": n_train, "seed": seed, "evaluation": evaluation}
    own: dict[str, Any] = {"settings": settings, "deterministic": deterministic, "progress": progress}
    problem, config, splits = plan_run(dataset, model, **place, **rows, **own)
    if config.deterministic:
        init("llvm", threads=1)
    start_run(folder, config, splits)
    try:
        _complete(folder, config, problem, Session(folder, folder, on_progress, stop, scheduler, progress))
    except InputError:
        if not any(True for name in (FITTED, CHECKPOINT) for _ in folder.rglob(name)):
            shutil.rmtree(folder)
        raise
    return Run(folder, problem.record)


def resume(
    folder: str | Path,
    on_progress: OnProgress = quiet,
    stop: Callable[[], bool] = lambda: False,
    scheduler: Scheduler | None = None,
    progress: bool = False,
    record: Record | None = None,
) -> Run:
    """Go on with a run that was stopped; what is fitted is only scored again. Arguments: see `train` and `open_run`.

    Raises:
        InputError: not a run folder, or one of version 0.1.
        Interrupted: ``stop`` ended the run once more.
        BackendError: as `train`.
    """
    run = open_run(folder, record)
    if run.config.deterministic:
        init("llvm", threads=1)
    session = Session(run.folder, run.folder, on_progress, stop, scheduler, progress)
    _complete(run.folder, run.config, run.problem, session)
    return open_run(folder, record)


def _complete(folder: Path, config: RunConfig, problem: Problem, session: Session) -> None:
    """Fit every part that is not fitted yet, and score the run."""
    parts = run_parts(folder)
    splits = [load_rows(part, problem.record) for part in parts]
    if config.entry.prepare is not None and not all((part / FITTED).exists() for part in parts):
        problem.settings = config.entry.prepare(problem, splits, session)
        if problem.settings != config.settings:
            config = replace(config, settings=problem.settings)
            write_configs(folder, config, splits)
    done, scored = [], []
    for part, rows in zip(parts, splits, strict=True):
        if not (part / FITTED).exists():
            start = time.perf_counter()
            # Matrices of a few hundred rows: with a pool of threads BLAS spends its time waiting for other processes.
            with threadpool_limits(1, "blas"):
                fitted = config.entry.fit(problem, rows, replace(session, folder=part))
            spent = fitted.train_seconds
            write_fitted(part, fitted.arrays(), time.perf_counter() - start if spent is None else spent)
            (part / CHECKPOINT).unlink(missing_ok=True)
        done.append(load_part(config, problem, part))
        scored.append(score_part(folder, part, config, problem, rows, done[-1]))
    score_run(folder, config, done, scored)


def evaluate_run(folder: str | Path, split: str | None = None, operator: bool = True) -> dict[str, Any]:
    """Score a run again.

    Args:
        folder: run folder; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: score on the test rows of another split instead, without those the run was trained on;
            nothing is written.
        operator: learned fields predict by operator where they can.

    Returns:
        The metrics.

    Raises:
        InputError: not a run folder, one that was stopped, or no row of ``split`` is left that the run has not seen.
    """
    run = open_run(folder, operator=operator)
    parts = run_parts(run.folder)
    if split is not None and parts != [run.folder]:
        raise InputError(f"{run.folder}: every row is held out in one of its folds; leave --split away")
    done = [load_part(run.config, run.problem, part) for part in parts]
    splits = [load_rows(part, run.problem.record) for part in parts]
    if split is not None:
        return score_other(run.folder, run.config, run.problem, splits[0], done[0], split)
    each = zip(parts, splits, done, strict=True)
    scored = [score_part(run.folder, part, run.config, run.problem, rows, own) for part, rows, own in each]
    return score_run(run.folder, run.config, done, scored)


__all__ = ["Interrupted", "Run", "evaluate_run", "open_run", "plan_run", "predict_to_file", "resume", "train"]
