"""What runs of models that are fitted in one go have in common: the hybrid's and the baselines'.

config.yaml      model, data set, split, seed, settings, versions
split.npz        rows that train and rows that score
<file>.npz       the fitted model, arrays only, with the format's version
metrics.json, predictions.npz

With several splits ``fold0``, ... are each such a folder, and the one above pools their scores.
"""

from __future__ import annotations

import shutil
import time
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ..backend import init
from ..baselines.method import Listen
from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.files import readable, stored_arrays, write_arrays, write_atomically
from ..core.types import IntArray
from ..fit.folder import CONFIG, SPLIT, check_new, load_rows, part_folders, stored_parts, versions
from ..fit.trainer import peak_memory_mb
from ..measure import make_splits, save_split
from ..tasks.scores import inside_interval
from ..trace import load_record
from .evaluate import evaluate, pool, stored_metrics, write_results

VERSION, SECONDS = "run/format", "run/train_seconds"
"""Keys in the file of a fitted model that are not the model's."""


@dataclass(frozen=True)
class FittedConfig:
    """What ``config.yaml`` says of a run, beside what its kind adds.

    Attributes:
        dataset: name or folder that was loaded.
        split: its name.
        n_train: number or fraction of training rows; None: all.
        seed: of split and fit.
        deterministic: fitted on one thread of the CPU, so bit-identical from run to run.
    """

    dataset: str
    split: str
    n_train: float | None
    seed: int
    deterministic: bool = field(default=False, kw_only=True)


Config = TypeVar("Config", bound=FittedConfig)
Model = TypeVar("Model")


class FittedRun(ABC, Generic[Config, Model]):
    """The folder of a run, its configuration and its data.

    Attributes:
        folder: of the run.
        config: what ``config.yaml`` says.
        record: the data.
    """

    file: ClassVar[str]
    """Name of the file of a fitted model."""
    format: ClassVar[int]
    """Version of that file."""

    def __init__(self, folder: Path, config: Config, record: Record) -> None:
        self.folder, self.config, self.record = folder, config, record

    @property
    @abstractmethod
    def model_name(self) -> str:
        """As in ``config.yaml`` and ``metrics.json``."""

    @abstractmethod
    def fit(self, rows: Split, listen: Listen) -> Model:
        """Fit the model to the training rows of a split."""

    @abstractmethod
    def arrays(self, model: Model) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""

    @abstractmethod
    def load(self, arrays: dict[str, NDArray[Any]]) -> Model:
        """The model of these arrays."""

    @abstractmethod
    def predict(self, model: Model, rows: IntArray, receiver: int) -> tuple[NDArray[Any], FloatArray | None]:
        """What a receiver observes in rows [m] of the record, and the standard deviation where the model states it."""

    def facts(self, model: Model) -> dict[str, Any]:
        """What ``metrics.json`` says of the run beside what it says of any."""
        return {}

    def seen(self, rows: Split) -> IntArray:
        """Rows that a fit has used."""
        return rows.all_train

    def train(self, splits: list[Split], listen: Listen) -> Path:
        """Make the folder, fit the model to every split and score it.

        Returns:
            The run folder.

        Raises:
            InputError: a folder that holds something already, or data that the model cannot be fitted to; what cannot
                be fitted leaves nothing behind.
        """
        check_new(self.folder)
        self._start(splits)
        try:
            return self.resume(listen)
        except InputError:
            if not any(self.folder.rglob(self.file)):
                shutil.rmtree(self.folder)
            raise

    def _start(self, splits: list[Split]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for part, rows in part_folders(self.folder, splits):
            part.mkdir(exist_ok=True)
            save_split(part / SPLIT, rows)
            write_atomically(part / CONFIG, self._config_text(rows.name))
        # Last at the top: a folder with a configuration has all its splits.
        write_atomically(self.folder / CONFIG, self._config_text(self.config.split))

    def resume(self, listen: Listen) -> Path:
        """Fit every part that is not fitted yet, and score the run.

        Returns:
            The run folder.

        Raises:
            InputError: data that the model cannot be fitted to.
            BackendError: a deterministic fit in a process that computes on a GPU already.
        """
        if self.config.deterministic:
            init("llvm", threads=1)
        for part in stored_parts(self.folder):
            if not (part / self.file).exists():
                self._fit_part(part, listen)
        self.score()
        return self.folder

    def _fit_part(self, part: Path, listen: Listen) -> None:
        rows = load_rows(part, self.record)
        start = time.perf_counter()
        name = "" if part == self.folder else f"{part.name}: "
        # Matrices of a few hundred rows: with a pool of threads BLAS spends its time waiting for other processes.
        with threadpool_limits(1, "blas"):
            model = self.fit(rows, partial(_named, listen, name))
        arrays = {VERSION: self.format, SECONDS: time.perf_counter() - start, **self.arrays(model)}
        write_arrays(part / self.file, arrays, compressed=True)

    def model_of(self, part: Path) -> tuple[Model, float]:
        """The fitted model of a part, and the seconds that its fit took.

        Raises:
            InputError: missing, damaged, or of another format version.
        """
        path = part / self.file
        missing = f"{path}: missing, the fit was stopped; finish it with train --resume"
        with readable(path, missing, "train the run anew"):
            arrays = stored_arrays(path)
            version, seconds = int(arrays.pop(VERSION)), float(arrays.pop(SECONDS))
            if version == self.format:
                return self.load(arrays), seconds
        raise InputError(f"{path}: format {version}, this version reads {self.format}; use the version that wrote it")

    def the_model(self) -> Model:
        """The model of a run with one split.

        Raises:
            InputError: not a finished run, or one over several splits.
        """
        if not (self.folder / SPLIT).exists():
            raise InputError(f"{self.folder}: one model for each block; choose one, e.g. {self.folder / 'fold0'}")
        return self.model_of(self.folder)[0]

    def score(self) -> dict[str, Any]:
        """Write ``metrics.json`` and ``predictions.npz`` of every part and of the run.

        Returns:
            The metrics of the run.

        Raises:
            InputError: a part that is not fitted.
        """
        parts, seconds, models = [], 0.0, []
        for part in stored_parts(self.folder):
            model, spent = self.model_of(part)
            rows = load_rows(part, self.record)
            models.append(model)
            seconds += spent
            parts.append(self._evaluated(rows, model))
            if part != self.folder:
                write_results(part, self._header(part, rows.name, spent, model) | parts[-1][0], parts[-1][1])
        metrics, arrays = parts[0] if len(parts) == 1 else pool(parts)
        merged = self._header(self.folder, self.config.split, seconds, models[0]) | metrics | _uncertainty(arrays)
        write_results(self.folder, merged, arrays)
        return merged

    def score_on(self, split: str) -> dict[str, Any]:
        """Metrics on those test rows of another split that the run has not seen; nothing is written.

        Raises:
            InputError: not a finished run with one split, or no such row is left.
        """
        if not (self.folder / SPLIT).exists():
            raise InputError(f"{self.folder}: every row is held out in one of its folds; leave --split away")
        rows = load_rows(self.folder, self.record)
        asked = np.unique(np.concatenate([s.test for s in make_splits(self.record, split, self.config.seed)]))
        unseen = np.setdiff1d(asked, self.seen(rows))
        if not len(unseen):
            raise InputError(f"{self.folder}: trained on all test rows of split {split}; nothing is left to score")
        model, seconds = self.model_of(self.folder)
        metrics, _ = self._evaluated(replace(rows, test=unseen), model)
        name = f"{split} (rows unseen by {self.config.split})"
        return self._header(self.folder, name, seconds, model) | metrics

    def _evaluated(self, rows: Split, model: Model) -> tuple[dict[str, Any], dict[str, Any]]:
        stds: dict[int, FloatArray] = {}

        def predict(chosen: IntArray, receiver: int) -> NDArray[Any]:
            mean, std = self.predict(model, chosen, receiver)
            if std is not None and len(chosen) == len(rows.test):  # all at once; single ones are timed
                stds[receiver] = std
            return mean

        metrics, arrays = evaluate(self.record, rows, predict)
        if stds:
            arrays["std"] = np.stack([stds[r] for r in range(len(self.record.receivers))]).astype(np.float32)
        if not len(self.seen(rows)):
            metrics["n_train"] = 0  # the references have theirs
        return metrics | _uncertainty(arrays), arrays

    def _header(self, folder: Path, split: str, seconds: float, model: Model) -> dict[str, Any]:
        known = {"dataset": self.config.dataset, "split": split, "seed": self.config.seed}
        # What the fit needed, where it is known already.
        memory_mb = stored_metrics(folder).get("peak_memory_mb", peak_memory_mb())
        done = {"train_seconds": seconds, "peak_memory_mb": memory_mb}
        return {"model": self.model_name, **known, **done, **self.facts(model)}

    def _config_text(self, split: str) -> str:
        stated = {key: _plain(value) for key, value in asdict(replace(self.config, split=split)).items()}
        content = {"model": self.model_name, **stated, "versions": versions()}
        return yaml.safe_dump(content, sort_keys=False)


def opened(dataset: str | Path | Record) -> tuple[Record, str]:
    """A data set and what a configuration calls it.

    Raises:
        InputError: it cannot be read.
    """
    if isinstance(dataset, Record):
        return dataset, dataset.source or dataset.name
    return load_record(str(dataset)), str(dataset)


def _plain(value: Any) -> Any:
    """What YAML has words for."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def _named(listen: Listen, name: str, what: str, share: float) -> None:
    listen(name + what, share)


def _uncertainty(arrays: dict[str, Any]) -> dict[str, Any]:
    if "std" not in arrays:
        return {}
    return {"inside_90": inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])}
