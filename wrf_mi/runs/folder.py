"""Run folder of any model.

    config.yaml      format, model, data set and its task, split, seed, scene, all settings, and versions
    split.npz        rows for training, validation and test
    model.npz        fitted model: arrays, with the format and the training time
    metrics.json     scores
    predictions.npz  predictions of the test rows, with their truth

With several splits ``fold0``, ... are each such a folder, and their parent pools the scores; with the split ``none``
the parent holds the model of all rows, too. A model may write further files: ``checkpoint.npz`` until its training has
ended, ``log.jsonl``, ``paths.npz`` of the ray tracer, ``operator0.npz``. Files are written atomically.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..backend import init
from ..core import AntennaOptions, InputError, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.array_files import stored_arrays, write_arrays
from ..core.files import LEFTOVER, readable, write_atomically
from ..core.locks import LOCK, locked_folder
from ..core.settings import settings_from
from ..core.yaml_files import read_yaml
from ..datasets import load_split, save_split
from ..datasets.folder_files import shown
from ..datasets.observations import check_rows, count_not_finite
from ..estimators.few_rows import with_few_rows
from ..estimators.model import Arrays
from ..models import Model, known_model
from ..tasks import TASKS
from ..version import __version__

FORMAT = 5  # version of ``config.yaml`` and ``model.npz``
CONFIG, SPLIT, FITTED, METRICS, PREDICTIONS = "config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"
PLACE = "working_directory"  # key of the folder in which the paths of ``config.yaml`` were stated
VERSION, SECONDS = "run/format", "run/train_seconds"  # keys of ``model.npz`` beside the model's arrays


Settings = Iterable[str] | Mapping[str, Any] | object  # settings by name, ``key=value``, or the model's dataclass
GIVEN = ("model", "seed", "deterministic", "receiver", "evaluation")  # arguments of `train` that may be settings, too


@dataclass(frozen=True)
class RunRequest:
    """What is fitted to a data set: arguments of `wrf_mi.train`, which describes them."""

    model: str = "hybrid"
    scene: str | Path | None = None
    material: str | None = None
    antennas: AntennaOptions = AS_STATED
    receiver: str | None = None
    evaluation: str | None = None
    split: str | Split | None = None
    n_train: int | float | None = None
    seed: int = 0
    settings: Settings = ()
    deterministic: bool = False
    intervals: bool = False
    min_rows: int | None = None
    preset: str | None = None
    loss: str | None = None
    wanted: str | Path | FloatArray | None = None


@dataclass(frozen=True)
class RunConfig:
    """Content of ``config.yaml``: the arguments of `wrf_mi.train`, and what follows from them."""

    model: str
    dataset: str
    task: str  # task of the data set
    split: str  # name of the split; that of a fold is, e.g., ``blocked:2``
    n_train: int | float | None
    seed: int
    scene: str | None
    material: str | None
    antennas: AntennaOptions
    deterministic: bool
    intervals: bool
    settings: Any  # all settings of the model
    # training rows of the receivers that are left out for having too few, by name
    left_out: Mapping[str, int] = field(default_factory=dict)
    # names of the settings that were stated; None: a run of an earlier version, or settings as a dataclass
    stated: tuple[str, ...] | None = None

    @cached_property
    def entry(self) -> Model:
        """Registry entry of the model; `InputError`: no model of that name."""
        entry = with_few_rows(known_model(self.model).serving(self.task, self.scene is not None), self.task)
        if not self.intervals:
            return entry
        from ..stages.mixture import WithIntervals  # stages bring corrections of scenes, which take long to import

        return WithIntervals(entry)


def package_versions() -> dict[str, str]:
    """Versions of this package, of the numerical packages below it, and of Python."""
    packages = ("mitsuba", "drjit", "sionna-rt", "numpy", "scipy", "scikit-image", "scikit-learn")
    below = {name: importlib.metadata.version(name) for name in packages}
    return {"wrf-mi": __version__, **below, "python": platform.python_version()}


def versions() -> dict[str, str]:
    """Versions of packages, backend and device."""
    backend = init()
    name = f"{backend.name} {backend.llvm_version or ''}".strip()
    return {**package_versions(), "backend": name, "device": backend.device}


def read_config(folder: Path) -> RunConfig:
    """Read ``config.yaml``; `InputError` where it is missing, not YAML, of another format or has unknown settings."""
    path = folder / CONFIG
    missing = f"{folder}: no {CONFIG}, so not a run folder; give one made by train or trace"
    with readable(path, missing, "restore it"):
        if not path.exists():
            raise InputError(missing)
        content = read_yaml(path)
        if not content:
            raise InputError(f"{path}: not readable (no settings in it); restore it")
        check_format(folder)
        needed = ("model", "dataset", "task", "split", "n_train", "seed", "scene", "material", "antennas")
        entries = {name: content[name] for name in needed}
        entries |= {name: content.get(name) or False for name in ("deterministic", "intervals")}
        entries |= {"left_out": content.get("left_out") or {}, "stated": content.get("stated")}
        entries |= {name: _from_here(entries[name], content.get(PLACE)) for name in ("dataset", "scene")}
        config = settings_from(RunConfig, {**entries, "settings": None}, str(path))
        if config.task not in TASKS or config.seed < 0:
            raise InputError(f"{path}: task {shown(config.task)} with seed {config.seed}: not known; restore it")
        kind: Any = config.entry.settings
        return replace(config, settings=settings_from(kind, content["settings"], str(path)))


def _from_here(stated_path: Any, place: Any) -> Any:
    """A path that was stated in a folder, as it is called here: a run is opened from anywhere, also from a copy."""
    if not isinstance(stated_path, str) or not isinstance(place, str) or Path(place) == Path.cwd():
        return stated_path
    joined = Path(place, stated_path)
    return str(joined) if joined.exists() else stated_path


def known_config(folder: Path) -> RunConfig | None:
    """Content of ``config.yaml``; None where there is none, or for a model or settings that this version lacks."""
    try:
        return read_config(folder)
    except InputError:
        return None


def stored_versions(folder: Path) -> dict[str, str]:
    """Versions of packages, backend and device with which a run was made; empty where they are not stored."""
    try:
        content = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
        return {str(name): str(value) for name, value in content["versions"].items()}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return {}


def check_format(folder: Path) -> None:
    """Refuse a run of another format by `InputError`; an unreadable configuration passes."""
    content: dict[Any, Any] = {}
    with suppress(InputError):
        content = read_yaml(folder / CONFIG)
    if content and (stored_format := content.get("format")) != FORMAT:
        text = f"format {stored_format or 'not stated'}, this version reads {FORMAT}"
        raise InputError(f"{folder / CONFIG}: {text}; train it anew, or use the version that wrote it")


def check_new(folder: Path, replace: bool = False) -> None:
    """Refuse (`InputError`) a file, or a folder with files that a new run may not take the place of.

    It may take that of a run which was killed before its configuration was written, and with ``replace`` of any run.
    """
    if not folder.exists() or (folder.is_dir() and (not any(folder.iterdir()) or _is_begun(folder))):
        return
    if not _is_run(folder):
        only = " and is no run, which --replace would replace" if replace else " and is not empty"
        raise InputError(f"{folder}: exists{only}; choose another --out, or remove it")
    if not replace:
        remedies = "choose another --out, give --replace"
        if not (folder / METRICS).exists():
            remedies += f", or go on with train --resume {folder}"
        raise InputError(f"{folder}: exists and is not empty; {remedies}")


def _is_run(folder: Path) -> bool:
    """Whether a folder has the configuration of a run, of this or another version."""
    with suppress(InputError):
        return {"format", "model", "dataset"} <= read_yaml(folder / CONFIG).keys()
    return False


@contextmanager
def new_run_folder(folder: Path, replace: bool = False) -> Iterator[None]:
    """A block that alone writes a new run into a folder, which `InputError` removes where nothing was fitted.

    The run that it replaces is set aside until the block ends, and comes back where nothing is left of the new one.

    Raises:
        InputError: as of `check_new`, or another process writes into the folder.
    """
    check_new(folder, replace)
    before = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    if _is_run(folder):
        with locked_folder(folder):  # refused while another process writes
            pass
        os.replace(folder, before)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked_folder(folder):
            _clear_begun(folder)
            try:
                yield
            except InputError:
                if not has_progress(folder):
                    shutil.rmtree(folder)
                raise
    finally:
        if before.exists() and not folder.exists():
            os.replace(before, folder)
        shutil.rmtree(before, ignore_errors=True)


def _is_begun(folder: Path) -> bool:
    """Whether a run was killed here before it could be resumed: a lock and splits, but no configuration."""
    if not (folder / LOCK).is_file() or (folder / CONFIG).exists():
        return False
    return not has_progress(folder)


def has_progress(folder: Path) -> bool:
    """Whether a run folder has files that a fit has written, beyond those of its beginning."""
    files = (path.name for path in folder.rglob("*") if not path.is_dir())
    return not all(name in (LOCK, SPLIT, CONFIG) or LEFTOVER.fullmatch(name) for name in files)


def _clear_begun(folder: Path) -> None:
    """Remove what a killed run left in a folder that is locked now; `InputError` as of `check_new`."""
    check_new(folder)
    for path in [path for path in folder.iterdir() if path.name != LOCK]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def start_run(folder: Path, config: RunConfig, splits: Sequence[Split]) -> None:
    """Make the folders of a run and of its folds."""
    for part, rows in _folders(folder, splits):
        part.mkdir(parents=True, exist_ok=True)
        save_split(part / SPLIT, rows)
    write_configs(folder, config, splits)


def write_configs(folder: Path, config: RunConfig, splits: Sequence[Split]) -> None:
    """Write ``config.yaml`` of a run and of its folds."""
    of_folds = [(part, replace(config, split=rows.name)) for part, rows in _folders(folder, splits) if part != folder]
    for part, part_config in [*of_folds, (folder, config)]:  # last: a folder with a configuration has all its splits
        content = {"format": FORMAT, **asdict(part_config), PLACE: str(Path.cwd()), "versions": versions()}
        plain = json.loads(json.dumps(content))  # YAML has no tuples
        write_atomically(part / CONFIG, yaml.safe_dump(plain, sort_keys=False))


def _folders(folder: Path, splits: Sequence[Split]) -> list[tuple[Path, Split]]:
    """Folder of each split: one alone, or without test rows, in the run folder, others in ``fold0``, ..."""
    alone = len(splits) == 1
    return [(folder if alone or not len(rows.test) else folder / f"fold{k}", rows) for k, rows in enumerate(splits)]


def run_parts(folder: Path) -> list[Path]:
    """Folders of a run that hold a split: those of its folds, and the run folder unless it only pools their scores."""
    folds = sorted(folder.glob(f"fold*/{SPLIT}"), key=lambda path: (len(path.parent.name), path.parent.name))
    return [path.parent for path in folds] + ([folder] if (folder / SPLIT).exists() else [])


def is_finished(folder: Path) -> bool:
    """Whether a run has its metrics; what a process left there that was killed after them is removed."""
    finished = (folder / METRICS).exists()
    if finished and (folder / LOCK).exists():
        with suppress(InputError), locked_folder(folder):  # refused while another process writes
            pass
    return finished


def load_rows(folder: Path, record: Record) -> Split:
    """Read the split of a run; `InputError` where it is missing, damaged, or has rows that the record lacks."""
    split = load_split(folder / SPLIT)
    check_rows(split, record, str(folder / SPLIT))
    return split


def write_fitted(folder: Path, arrays: Arrays, seconds: float) -> Path:
    """Write ``model.npz``, with a checksum."""
    return write_arrays(folder / FITTED, {VERSION: FORMAT, SECONDS: seconds, **arrays}, compressed=True, checksum=True)


def read_fitted(folder: Path, entry: Model) -> tuple[Arrays, float]:
    """Arrays of ``model.npz`` of a model, and the training time in seconds.

    `InputError`: missing, damaged, of another format, or NaN or infinity where the model has no `Model.gaps`.
    """
    path = folder / FITTED
    missing = f"{path}: missing, the fit was stopped; finish it with train --resume"
    with readable(path, missing, "train the run anew"):
        arrays = stored_arrays(path)
        version, seconds = int(arrays.pop(VERSION)), float(arrays.pop(SECONDS))
    if version != FORMAT:
        raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
    for name, values in arrays.items():
        numbers = values.dtype.kind in "fc" and name.rpartition("/")[2] not in entry.gaps
        if numbers and not np.isfinite(values).all():
            raise InputError(f"{path}: array {name}: {count_not_finite(values)}; train the run anew")
    return arrays, seconds
