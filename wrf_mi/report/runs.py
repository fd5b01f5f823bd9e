"""Whole runs, from a data set to scores in a run folder: what the command and the Python API call."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..baselines.method import Inputs
from ..core import AntennaOptions, InputError, Receiver, Record, Split
from ..core.antenna import AS_STATED
from ..core.types import IntArray
from ..fit.config import TrainConfig, default_config
from ..fit.folder import (
    RunConfig,
    append_log,
    check_new,
    load_predictor,
    load_rows,
    read_checkpoint,
    read_config,
    resume_run,
    start_run,
    write_checkpoint,
    write_config,
)
from ..fit.predictor import Predictor
from ..fit.trainer import Progress, Trainer, check_rows, peak_memory_mb
from ..measure import make_splits
from ..measure.observations import check_observations
from ..parallel import Scheduler, row_parts
from ..tasks import task_of
from ..trace import load_record
from .baseline_run import evaluate_baseline, is_baseline, open_baseline
from .evaluate import Predict, evaluate, pool, stored_metrics, write_results
from .hybrid_run import evaluate_hybrid, is_hybrid, open_hybrid, predict_with
from .prediction_file import check_prediction_file, write_prediction_file
from .run_folder import CONFIG, METRICS
from .traced import UNUSED_HEADING, TracedRun, evaluate_traced, is_traced

Listen = Callable[[str, int, Progress], None]
"""Hears of progress: name of the fold ("" where there is one split), steps in all, and the progress."""

Estimates = tuple[NDArray[Any], NDArray[Any] | None, tuple[str, ...]]
"""Observations [n_rx, m, ...], their standard deviations where the model states them, and the receivers' names."""

FOLDS = "fold*"
PREDICTED_AT_ONCE = 256
"""Positions of one part at most, for a scheduler: 33 MB of spectra of 90 x 360 for each receiver."""


class Interrupted(Exception):
    """A run was stopped between two steps; its checkpoint is written."""

    exit_status = 130


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
        folder: where everything lies.
    """

    folder: Path

    def __post_init__(self) -> None:
        """Take the folder's name as text, too."""
        object.__setattr__(self, "folder", Path(self.folder))

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of ``metrics.json``."""
        return json.loads((self.folder / METRICS).read_text())

    def predictor(self, operator: bool = True) -> Predictor:
        """The trained field: ``predictor()(tx_pos_m)`` gives spectra [m, H, W].

        Args:
            operator: predict by operator where the field allows it.

        Raises:
            InputError: a run over all blocks has one field a fold, in its subfolders.
        """
        if is_blocked(self.folder):
            raise InputError(f"{self.folder}: one field for each block; choose one, e.g. {self.folder / 'fold0'}")
        return load_predictor(self.folder, operator)


def is_blocked(folder: Path) -> bool:
    """Whether a run folder holds one run for each of several folds."""
    return not (folder / "split.npz").exists() and any(folder.glob(FOLDS))


def train(
    dataset: str | Path | Record,
    out: str | Path,
    config: TrainConfig | None = None,
    split: str | Split = "official",
    n_train: int | float | None = None,
    listen: Listen = lambda fold, steps, progress: None,
    stop: Callable[[], bool] = lambda: False,
    *,
    scene: str | Path | None = None,
    material: str | None = None,
    antennas: AntennaOptions = AS_STATED,
) -> Run:
    """Fit a field, alone or together with the paths of a scene, and score it.

    Args:
        dataset: name, folder, or a record that was loaded.
        out: run folder to make; must not exist or be empty.
        config: settings; None: the defaults.
        split: name of a split (``blocked`` fits every fold in turn and pools the scores), or rows of your own.
        n_train: number or fraction of the training rows to use; None: all.
        listen: hears of progress.
        stop: asked after each step; True stops the run at a checkpoint.
        scene: name, scene folder, Mitsuba XML or mesh: its paths are trained together with the Gaussians.
        material: of a bare mesh.
        antennas: patterns and polarisations in place of what the data state; with a scene.

    Raises:
        InputError: data, settings, scene or folder that cannot be used.
        Interrupted: ``stop`` ended the run; go on with `resume`.
    """
    record = dataset if isinstance(dataset, Record) else load_record(str(dataset))
    source = record.source or record.name if isinstance(dataset, Record) else str(dataset)
    settings, folder = config or default_config(record.task), Path(out)
    if scene is None and (material is not None or antennas):
        raise InputError("a material and antennas belong to a scene that is traced; give it, or leave them away")
    record = antennas.of(record)
    if isinstance(split, Split):
        splits, name = [split], split.name
    else:
        splits, name = make_splits(record, split, settings.seed, n_train), split
    for rows in splits:
        check_rows(rows, record, f"split {rows.name}")
        check_observations(record, rows, complete=task_of(record).image)
    known = np.concatenate([rows.all_train for rows in splits])
    settings = settings.resolved(record.tx_pos_m[known], scene is not None and task_of(record).image)
    run = RunConfig(source, name, n_train, settings, None if scene is None else str(scene), material, antennas)
    if len(splits) == 1:
        _fit(start_run(folder, record, splits[0], run), folder, run, "", listen, stop)
        return Run(folder)
    check_new(folder)
    # What cannot be trained is refused here, before anything is written.
    start_run(folder / "fold0", record, splits[0], replace(run, split=splits[0].name))
    write_config(folder, run)
    return _fit_folds(folder, record, splits, run, listen, stop)


def resume(
    folder: str | Path, listen: Listen = lambda fold, steps, progress: None, stop: Callable[[], bool] = lambda: False
) -> Run:
    """Go on with a run that was stopped, from its last checkpoint to the end; a finished one is only scored again.

    Raises:
        InputError: not a run folder.
        Interrupted: ``stop`` ended the run once more.
    """
    path = Path(folder)
    run = read_config(path)
    record = run.antennas.of(load_record(run.dataset))
    if (path / "split.npz").exists():
        _fit(resume_run(path, record), path, run, "", listen, stop)
        return Run(path)
    splits = make_splits(record, run.split, run.settings.seed, run.n_train)
    return _fit_folds(path, record, splits, run, listen, stop)


def _fit_folds(
    folder: Path, record: Record, splits: list[Split], run: RunConfig, listen: Listen, stop: Callable[[], bool]
) -> Run:
    parts, seconds = [], 0.0
    for k, split in enumerate(splits):
        part, own = folder / f"fold{k}", replace(run, split=split.name)
        trainer = resume_run(part, record) if (part / "split.npz").exists() else start_run(part, record, split, own)
        parts.append(_fit(trainer, part, own, part.name, listen, stop))
        seconds += trainer.seconds
    metrics, arrays = pool(parts)
    write_results(folder, _header(run, seconds) | metrics, arrays)
    return Run(folder)


def _fit(
    trainer: Trainer, folder: Path, run: RunConfig, fold: str, listen: Listen, stop: Callable[[], bool]
) -> tuple[dict[str, Any], dict[str, Any]]:
    def heard(progress: Progress) -> None:
        append_log(folder, progress)
        listen(fold, run.settings.steps, progress)

    if not trainer.run(heard, lambda: write_checkpoint(folder, trainer), stop):
        top = folder.parent if fold else folder
        raise Interrupted(
            f"stopped after step {trainer.state.step} of {run.settings.steps}; go on with: wrf-mi train --resume {top}"
        )
    # As the run will be opened: where there is an operator it is built and stored here.
    metrics, arrays = evaluate(trainer.record, trainer.split, of_rows(trainer.record, load_predictor(folder)))
    metrics = _header(run, trainer.seconds) | {"gaussians": trainer.state.gaussians} | metrics
    write_results(folder, metrics, arrays)
    return metrics, arrays


def of_rows(record: Record, predictor: Predictor) -> Predict:
    """A predictor from transmitter positions as a method on a record's rows."""

    def predict(rows: IntArray, receiver: int) -> NDArray[Any]:
        return predictor.of_rows(record, rows, receiver)

    return predict


def _header(run: RunConfig, seconds: float) -> dict[str, Any]:
    return {
        "model": run.settings.model,
        "dataset": run.dataset,
        "split": run.split,
        "seed": run.settings.seed,
        "steps": run.settings.steps,
        **({} if run.scene is None else {"scene": run.scene}),
        "train_seconds": seconds,
        "peak_memory_mb": peak_memory_mb(),
    }


def evaluate_run(folder: str | Path, split: str | None = None, operator: bool = True) -> dict[str, Any]:
    """Score a run again.

    Args:
        folder: run folder; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: score on the test rows of another split instead, without those the run was trained on;
            nothing is written.
        operator: a learned field alone predicts by operator where it can.

    Returns:
        The metrics.

    Raises:
        InputError: not a run folder, one that was stopped, or no row of ``split`` is left that the run has not seen.
    """
    path = Path(folder)
    if is_traced(path):
        return evaluate_traced(path, split)
    if is_hybrid(path):
        return evaluate_hybrid(path, split)
    if is_baseline(path):
        return evaluate_baseline(path, split)
    run = read_config(path)
    record = load_record(run.dataset)
    if is_blocked(path):
        if split is not None:
            raise InputError(f"{path}: every row is held out in one of its folds; leave --split away")
        parts, done = [], {"train_seconds": 0.0}
        for k in range(len(make_splits(record, run.split, run.settings.seed, run.n_train))):
            part = path / f"fold{k}"
            done["train_seconds"] += _finished(part, run)["train_seconds"]
            parts.append(evaluate(record, load_rows(part, record), of_rows(record, load_predictor(part, operator))))
        metrics, arrays = pool(parts)
    else:
        done = _finished(path, run)
        rows = load_rows(path, record)
        if split is not None:
            asked = np.unique(np.concatenate([s.test for s in make_splits(record, split, run.settings.seed)]))
            unseen = np.setdiff1d(asked, rows.all_train)
            if len(unseen) == 0:
                raise InputError(f"{path}: trained on all test rows of split {split}; nothing is left to score")
            rows, run = replace(rows, test=unseen), replace(run, split=f"{split} (rows unseen by {run.split})")
        metrics, arrays = evaluate(record, rows, of_rows(record, load_predictor(path, operator)))
    merged = _header(run, 0.0) | stored_metrics(path) | done | metrics | {"split": run.split}
    if split is None:
        write_results(path, merged, arrays)
    return merged


def _finished(folder: Path, run: RunConfig) -> dict[str, Any]:
    """What the checkpoint of a finished run knows of its training."""
    arrays = read_checkpoint(folder)
    if int(arrays["step"]) < run.settings.steps:
        where = f"{folder}: stopped after step {int(arrays['step'])} of {run.settings.steps}"
        raise InputError(f"{where}; finish it with train --resume")
    return {"train_seconds": float(arrays["seconds"]), "gaussians": arrays["mean/position"].shape[1]}


def predict_to_file(
    folder: str | Path,
    tx_pos_m: np.ndarray,
    out: str | Path,
    tx_heading_rad: np.ndarray | None = None,
    scheduler: Scheduler | None = None,
    operator: bool = True,
    uplink: NDArray[Any] | None = None,
) -> dict[str, tuple[int, ...]]:
    """What a run's model predicts at new transmitter positions, as an ``.npz`` or ``.csv`` file.

    Args:
        folder: run folder with one field.
        tx_pos_m: positions [m, 3], metres; NaN where they are not known.
        out: file to write. ``.npz``: keys ``row`` (0..m-1), ``prediction`` ([m, H, W] for one receiver, else
            [n_rx, m, H, W]), ``tx_pos`` [m, 3] and ``receiver_name``, as in ``predictions.npz``, and of a hybrid
            ``std``. ``.csv``, signal strengths alone: see `wrf_mi.report.prediction_file.write_prediction_file`.
        tx_heading_rad: yaw of the transmitter's body [m], radians; only a hybrid, calibrated ray tracing and baselines
            for signal strengths use it.
        scheduler: what computes parts of the positions; None: this process. Its workers must see the run folder, and
            the data set and scene of a traced or hybrid run, under the same names.
        operator: a learned field alone predicts by operator where it can.
        uplink: uplink channels [m, antennas, subcarriers], for a baseline that predicts from them.

    Returns:
        Shape of each array that ``.npz`` has.

    Raises:
        InputError: a run over several blocks, positions that are not known, headings or an uplink for a model
            without, no headings for a model that needs them, or a file name with another suffix or of a form that
            does not hold what the run predicts.
    """
    path, asked = Path(folder), Inputs(np.asarray(tx_pos_m, float), tx_heading_rad, uplink)
    check_prediction_file(Path(out), path)
    if not is_baseline(path):
        if tx_heading_rad is not None and not is_hybrid(path) and not is_traced(path):
            raise InputError(f"{path}: {UNUSED_HEADING}")
        if uplink is not None:
            raise InputError(f"{path}: its model does not predict from the uplink; leave uplink away")
    parts: list[Estimates]
    if scheduler is None or not len(asked):
        parts = [open_run(path, operator)(asked, 0)]
    else:
        rows = row_parts(len(asked), scheduler.workers, most=PREDICTED_AT_ONCE)
        given = [(asked.rows(r), r.start) for r in rows]
        sizes = [len(one[0]) for one in given]
        parts = scheduler.map(_predict_part, given, partial(open_run, path, operator), what="predicting", sizes=sizes)
    means, stds, names = zip(*parts, strict=True)
    arrays: dict[str, Any] = {
        "row": np.arange(len(asked)),
        "prediction": np.concatenate(means, axis=1),
        "tx_pos": asked.tx_pos_m,
        "receiver_name": np.asarray(names[0]),
    }
    if stds[0] is not None:
        arrays["std"] = np.concatenate(stds, axis=1).astype(np.float32)
    written = write_prediction_file(Path(out), arrays, tx_heading_rad)
    return {key: value.shape for key, value in written.items()}


def open_run(folder: Path, operator: bool = True) -> Callable[[Inputs, int], Estimates]:
    """The model of a run: a function of what is known of rows, and of the row that the first one is.

    Raises:
        InputError: not a finished run, or one over several blocks.
    """
    if is_hybrid(folder):
        model = open_hybrid(folder)
        return lambda asked, first: predict_with(model, asked.tx_pos_m, asked.tx_heading_rad)
    if is_traced(folder):
        traced = TracedRun(folder)
        return lambda asked, first: (
            traced.predict(asked.tx_pos_m, asked.tx_heading_rad, first),
            None,
            traced.names,
        )
    if is_baseline(folder):
        baseline = open_baseline(folder)
        return lambda asked, first: _of_receivers(partial(baseline.predict_inputs, asked), baseline.receivers)
    predictor = Run(folder).predictor(operator)
    return lambda asked, first: _of_receivers(partial(predictor, asked.tx_pos_m), predictor.receivers)


def _of_receivers(predict: Callable[[int], NDArray[Any]], receivers: Sequence[Receiver]) -> Estimates:
    every = np.stack([predict(index) for index in range(len(receivers))])
    return every, None, tuple(receiver.name for receiver in receivers)


def _predict_part(model: Callable[[Inputs, int], Estimates], part: tuple[Inputs, int]) -> Estimates:
    return model(*part)


__all__ = ["CONFIG", "Interrupted", "Run", "evaluate_run", "predict_to_file", "resume", "train"]
