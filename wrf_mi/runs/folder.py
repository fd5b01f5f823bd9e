"""The run folder of every model.

    config.yaml      format, model, data set and its task, split, seed, scene, settings, resolved, and versions
    split.npz        rows that train, choose and score
    model.npz        the fitted model: arrays only, with the format and the seconds that its fit took
    metrics.json     scores
    predictions.npz  predictions of the test rows, with their truth

With several splits ``fold0``, ... are each such a folder, and the one above pools their scores. A model may leave
further files: ``checkpoint.npz`` until its training has ended, ``log.jsonl``, ``paths.npz`` of the ray tracer,
``operator0.npz``. Every file appears whole or not at all.
"""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from .. import __version__
from ..backend import init
from ..core import AntennaOptions, InputError, Record, Split
from ..core.files import readable, stored_arrays, write_arrays, write_atomically
from ..core.settings import settings_from
from ..datasets import load_split, save_split
from ..models import Model, known_model
from ..models.model import Arrays
from ..training.trainer import check_rows

FORMAT = 2
"""Version of ``config.yaml`` and ``model.npz``."""
CONFIG, SPLIT, FITTED, METRICS, PREDICTIONS = "config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"
OLD = ("hybrid.npz", "fitted.npz")
"""Files that version 0.1 wrote."""
VERSION, SECONDS = "run/format", "run/train_seconds"
"""Keys in ``model.npz`` that are not the model's."""


@dataclass(frozen=True)
class RunConfig:
    """What ``config.yaml`` says.

    Attributes:
        model: its name.
        dataset: name or folder that was loaded.
        task: of the data.
        split: its name; one fold has its own, e.g. ``blocked:2``.
        n_train: number or fraction of training rows that was asked for; None: all; 0: none, the scene alone.
        seed: of split and fit.
        scene: name, scene folder, Mitsuba XML or mesh; None: none.
        material: of a bare mesh, or None.
        antennas: stated in place of the data's.
        deterministic: fitted on one thread of the CPU, so bit-identical from run to run.
        settings: of the model, all of them.
    """

    model: str
    dataset: str
    task: str
    split: str
    n_train: float | None
    seed: int
    scene: str | None
    material: str | None
    antennas: AntennaOptions
    deterministic: bool
    settings: Any

    @cached_property
    def entry(self) -> Model:
        """The model.

        Raises:
            InputError: none of that name.
        """
        return known_model(self.model).serving(self.task, self.scene is not None)


def package_versions() -> dict[str, str]:
    """Versions of this package, of those that compute for it, and of Python."""
    packages = ("mitsuba", "drjit", "sionna-rt", "numpy", "scipy", "scikit-image", "scikit-learn")
    return {
        "wrf-mi": __version__,
        **{name: importlib.metadata.version(name) for name in packages},
        "python": platform.python_version(),
    }


def versions() -> dict[str, str]:
    """Versions of what computes: packages, backend and device."""
    backend = init()
    return {
        **package_versions(),
        "backend": f"{backend.name} {backend.llvm_version or ''}".strip(),
        "device": backend.device,
    }


def _plain(value: Any) -> Any:
    """What YAML has words for."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def write_config(folder: Path, config: RunConfig) -> None:
    """Write ``config.yaml``."""
    content = {"format": FORMAT, **_plain(asdict(config)), "versions": versions()}
    write_atomically(folder / CONFIG, yaml.safe_dump(content, sort_keys=False))


def read_config(folder: Path) -> RunConfig:
    """Read ``config.yaml``.

    Raises:
        InputError: missing, not YAML, of another format, or settings that this version does not know.
    """
    path = folder / CONFIG
    missing = f"{folder}: no {CONFIG}, so not a run folder; give one made by train or trace"
    with readable(path, missing, "restore it"):
        content = yaml.safe_load(path.read_text())
        if not isinstance(content, dict):
            raise InputError(f"{path}: not readable (no settings in it); restore it")
        check_format(folder, content)
        names = ("model", "dataset", "task", "split", "n_train", "seed", "scene", "material")
        kept = {name: content[name] for name in names}
        kept |= {"antennas": AntennaOptions(**content["antennas"]), "deterministic": bool(content["deterministic"])}
        config = RunConfig(**kept, settings=None)
        kind: Any = config.entry.settings
        return replace(config, settings=settings_from(kind, content["settings"], str(path)))


def check_format(folder: Path, content: dict[str, Any] | None = None) -> None:
    """Refuse a run folder of version 0.1.

    Args:
        folder: of a run.
        content: of its ``config.yaml``; None: it is read, where it can be.

    Raises:
        InputError: naming the folder.
    """
    if content is None:
        try:
            content = yaml.safe_load((folder / CONFIG).read_text())
        except (OSError, ValueError, yaml.YAMLError):
            content = {"format": FORMAT}  # what is wrong with it is said where it is needed
    stated = content.get("format") if isinstance(content, dict) else FORMAT
    if stated is None or any((folder / name).exists() for name in OLD):
        raise InputError(f"{folder}: a run of version 0.1; train it anew, or use version 0.1")
    if stated != FORMAT:
        where = f"{folder / CONFIG}: format {stated}"
        raise InputError(f"{where}, this version reads {FORMAT}; use the version that wrote it")


def check_new(folder: Path) -> None:
    """See that a folder can be made.

    Raises:
        InputError: it holds something already.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        remedy = f"choose another --out, or go on with train --resume {folder}"
        raise InputError(f"{folder}: exists and is not empty; {remedy}")


def start_run(folder: Path, config: RunConfig, splits: Sequence[Split]) -> None:
    """Make the folder of a run, and those of its folds."""
    for part, rows in _placed(folder, splits):
        part.mkdir(parents=True, exist_ok=True)
        save_split(part / SPLIT, rows)
    write_configs(folder, config, splits)


def write_configs(folder: Path, config: RunConfig, splits: Sequence[Split]) -> None:
    """Write ``config.yaml`` of a run and of its folds."""
    own = [(part, replace(config, split=rows.name)) for part, rows in _placed(folder, splits) if part != folder]
    # Last at the top: a folder with a configuration has all its splits.
    for part, stated in [*own, (folder, config)]:
        write_config(part, stated)


def _placed(folder: Path, splits: Sequence[Split]) -> list[tuple[Path, Split]]:
    """Where each split is kept: one at the top, several in ``fold0``, ..."""
    if len(splits) == 1:
        return [(folder, splits[0])]
    return [(folder / f"fold{k}", rows) for k, rows in enumerate(splits)]


def run_parts(folder: Path) -> list[Path]:
    """The folders of a run that hold a split: its own, or those of its folds."""
    return [folder] if (folder / SPLIT).exists() else sorted(folder.glob("fold*"), key=lambda p: (len(p.name), p.name))


def load_rows(folder: Path, record: Record) -> Split:
    """The rows of a run.

    Raises:
        InputError: no split file, a damaged one, or one with rows that the record has not.
    """
    split = load_split(folder / SPLIT)
    check_rows(split, record, str(folder / SPLIT))
    return split


def write_fitted(folder: Path, arrays: Arrays, seconds: float) -> Path:
    """Write ``model.npz``."""
    own = {VERSION: FORMAT, SECONDS: seconds}
    return write_arrays(folder / FITTED, {**own, **arrays}, compressed=True)


def read_fitted(folder: Path) -> tuple[Arrays, float]:
    """Arrays of ``model.npz``, and the seconds that the fit took.

    Raises:
        InputError: missing, damaged, or of another format.
    """
    path = folder / FITTED
    missing = f"{path}: missing, the fit was stopped; finish it with train --resume"
    with readable(path, missing, "train the run anew"):
        arrays = stored_arrays(path)
        version, seconds = int(arrays.pop(VERSION)), float(arrays.pop(SECONDS))
    if version != FORMAT:
        raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
    return arrays, seconds
