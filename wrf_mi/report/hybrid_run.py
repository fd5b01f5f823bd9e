"""The hybrid as a run: what physics and measurements tell together, in the run folder of a learned model.

config.yaml      data set, split, seed, versions, scene and settings
split.npz        rows that train and rows that score
hybrid.npz       the fitted model, arrays only
metrics.json, predictions.npz (with ``std``, the predicted standard deviation)

With several splits ``fold0``, ... are each such a folder, and the one above pools their scores.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.files import one_line, write_arrays, write_atomically
from ..core.types import IntArray
from ..fit.config import with_settings
from ..fit.folder import CONFIG, SPLIT, load_rows, versions
from ..fit.trainer import peak_memory_mb
from ..hybrid.models import HybridKind, HybridModel, kind_of
from ..measure import make_splits, save_split
from ..trace import load_record, open_scene
from ..trace.tracer import instrument_of
from .evaluate import evaluate, pool, stored_metrics, write_results
from .metrics import inside_interval
from .run_folder import stated_model

MODEL = "hybrid"
FITTED = "hybrid.npz"
FORMAT = 1
"""Version of that file."""
VERSION, SECONDS = "run/format", "run/train_seconds"
"""Keys in it that are not the model's."""

Listen = Callable[[str, float], None]


@dataclass(frozen=True)
class HybridConfig:
    """What ``config.yaml`` says of a run of the hybrid.

    Attributes:
        dataset: name or folder that was loaded.
        scene: name, scene folder, Mitsuba XML or mesh; None: without a mesh.
        material: of a bare mesh, or None.
        split: its name.
        n_train: number or fraction of training rows; None: all; 0: none, the scene alone.
        seed: of split and fit.
        settings: those of the model that were changed, as ``key=value``.
    """

    dataset: str
    scene: str | None
    material: str | None
    split: str
    n_train: float | None
    seed: int
    settings: tuple[str, ...]


def is_hybrid(folder: Path) -> bool:
    """Whether a folder is a run of the hybrid."""
    return stated_model(folder) == MODEL


def read_hybrid_config(folder: Path) -> HybridConfig:
    """Read ``config.yaml`` of a run of the hybrid.

    Raises:
        InputError: missing, not YAML, or not of such a run.
    """
    path = folder / CONFIG
    try:
        content = yaml.safe_load(path.read_text())
        if content["model"] != MODEL:
            raise InputError(f"{folder}: a run of {content['model']}, not of the hybrid; give one of the hybrid")
        names = ("dataset", "scene", "material", "split", "n_train", "seed")
        return HybridConfig(**{name: content[name] for name in names}, settings=tuple(content["settings"]))
    except FileNotFoundError:
        raise InputError(f"{folder}: no {CONFIG}, so not a run folder; give one made by train") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not readable ({one_line(error)}); restore it") from None


def train_hybrid(
    dataset: str | Path | Record,
    out: str | Path,
    scene: str | Path | None = None,
    *,
    material: str | None = None,
    split: str = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    settings: tuple[str, ...] = (),
    listen: Listen = lambda what, share: None,
) -> Path:
    """Fit a hybrid to a data set and score it.

    Args:
        dataset: name, folder, or a record that was loaded.
        out: run folder to make; must not exist or be empty.
        scene: name, scene folder, Mitsuba XML or mesh; None: without a mesh.
        material: of a bare mesh.
        split: name of a split; ``blocked`` fits every fold in turn and pools the scores.
        n_train: number or fraction of the training rows to use; None: all; 0: none, physics alone (needs a scene).
        seed: of split and fit.
        settings: ``key=value`` of the model (see `wrf_mi.hybrid.models`).
        listen: hears what is being done and the share of it that is done.

    Returns:
        The run folder.

    Raises:
        InputError: data, scene, settings or folder that cannot be used.
    """
    folder = Path(out)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists and is not empty; choose another --out")
    record = dataset if isinstance(dataset, Record) else load_record(str(dataset))
    source = record.source or record.name if isinstance(dataset, Record) else str(dataset)
    place = None if scene is None else str(scene)
    config = HybridConfig(source, place, material, split, n_train, seed, settings)
    kind = kind_of(record, scene is not None)
    with_settings(kind.settings(), settings)
    if n_train == 0 and scene is None:
        raise InputError("--n-train 0: nothing to predict from; give training rows or a scene")
    opened = _open(config, record)
    splits = _splits(record, config)
    folder.mkdir(parents=True, exist_ok=True)
    for part, rows in _parts(folder, splits):
        part.mkdir(exist_ok=True)
        save_split(part / SPLIT, rows)
        write_atomically(part / CONFIG, _config_text(replace(config, split=rows.name)))
    # Last at the top: a folder with a configuration has all its splits.
    write_atomically(folder / CONFIG, _config_text(config))
    try:
        return _fit(folder, record, config, kind, opened, listen)
    except InputError:
        if not any(folder.rglob(FITTED)):  # what cannot be fitted leaves nothing behind
            shutil.rmtree(folder)
        raise


def resume_hybrid(folder: Path, listen: Listen = lambda what, share: None) -> Path:
    """Go on with a run that was stopped: folds that were fitted are kept.

    Raises:
        InputError: not a run of the hybrid.
    """
    config = read_hybrid_config(folder)
    record = load_record(config.dataset)
    return _fit(folder, record, config, kind_of(record, config.scene is not None), _open(config, record), listen)


def evaluate_hybrid(folder: Path, split: str | None = None) -> dict[str, Any]:
    """Score a run again.

    Args:
        folder: the run; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: score on another split's test rows that the run has not seen; nothing is written.

    Raises:
        InputError: not a finished run, or no row of ``split`` is left that it has not seen.
    """
    config = read_hybrid_config(folder)
    record = load_record(config.dataset)
    kind, opened = kind_of(record, config.scene is not None), _open(config, record)
    if split is None:
        return _scored(folder, record, config, kind, opened)
    if not (folder / SPLIT).exists():
        raise InputError(f"{folder}: every row is held out in one of its folds; leave --split away")
    rows = load_rows(folder, record)
    asked = np.unique(np.concatenate([s.test for s in make_splits(record, split, config.seed)]))
    seen = rows.all_train if config.n_train != 0 else np.zeros(0, np.int64)
    unseen = np.setdiff1d(asked, seen)
    if not len(unseen):
        raise InputError(f"{folder}: trained on all test rows of split {split}; nothing is left to score")
    model, seconds = load_hybrid(folder, kind, opened)
    metrics, _ = _evaluated(record, replace(rows, test=unseen), model, config)
    name = f"{split} (rows unseen by {config.split})"
    return _header(folder, config, seconds, model) | metrics | {"split": name}


def open_hybrid(folder: str | Path) -> HybridModel:
    """The fitted model of a run: ``open_hybrid(run).predict(tx_pos_m, receiver)`` gives mean and standard deviation.

    Raises:
        InputError: not a finished run, or one over several splits; a data set or scene that is not there any more.
    """
    path = Path(folder)
    config = read_hybrid_config(path)
    if not (path / SPLIT).exists():
        raise InputError(f"{path}: one model for each block; choose one, e.g. {path / 'fold0'}")
    record = load_record(config.dataset)
    return load_hybrid(path, kind_of(record, config.scene is not None), _open(config, record))[0]


def predict_hybrid(
    folder: Path, tx_pos_m: FloatArray, tx_heading_rad: FloatArray | None = None
) -> tuple[NDArray[Any], FloatArray, tuple[str, ...]]:
    """What a run's receivers report of new transmitter positions.

    Args:
        folder: the run, with one split.
        tx_pos_m: positions [q, 3], metres.
        tx_heading_rad: how the transmitter is turned, [q]; None: unknown.

    Returns:
        Observations [n_rx, q, ...], their predicted standard deviations, and the receivers' names.

    Raises:
        InputError: not a finished run, or one over several splits.
    """
    return predict_with(open_hybrid(folder), tx_pos_m, tx_heading_rad)


def predict_with(
    model: HybridModel, tx_pos_m: FloatArray, tx_heading_rad: FloatArray | None
) -> tuple[NDArray[Any], FloatArray, tuple[str, ...]]:
    """The same with a run's model from `open_hybrid`."""
    found = [model.predict(tx_pos_m, r, tx_heading_rad) for r in range(len(model.receivers))]
    names = tuple(receiver.name for receiver in model.receivers)
    return np.stack([e.mean for e in found]), np.stack([e.std for e in found]), names


def load_hybrid(folder: Path, kind: HybridKind, scene: Any | None) -> tuple[HybridModel, float]:
    """The fitted model of a run folder, and the seconds that its fit took.

    Raises:
        InputError: missing, damaged, or of another format version.
    """
    path = folder / FITTED
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
        version, seconds = int(arrays.pop(VERSION)), float(arrays.pop(SECONDS))
        if version == FORMAT:
            return kind.load(arrays, scene), seconds
    except FileNotFoundError:
        raise InputError(f"{path}: missing, the fit was stopped; finish it with train --resume") from None
    except InputError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{path}: not readable ({one_line(error)}); train the run anew") from None
    raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")


def _fit(
    folder: Path, record: Record, config: HybridConfig, kind: HybridKind, scene: Any | None, listen: Listen
) -> Path:
    settings = with_settings(kind.settings(), config.settings)
    for part in _folders(folder):
        if (part / FITTED).exists():
            continue
        rows = load_rows(part, record)
        known = rows.all_train if config.n_train != 0 else np.zeros(0, np.int64)
        start = time.perf_counter()
        name = "" if part == folder else f"{part.name}: "
        # Matrices of a few hundred rows: with a pool of threads BLAS spends its time waiting for other processes.
        with threadpool_limits(1, "blas"):
            model = kind.fit(record, known, scene, settings, config.seed, partial(_named, listen, name))
        arrays = {VERSION: FORMAT, SECONDS: time.perf_counter() - start, **model.arrays()}
        write_arrays(part / FITTED, arrays, compressed=True)
    _scored(folder, record, config, kind, scene)
    return folder


def _named(listen: Listen, name: str, what: str, share: float) -> None:
    listen(name + what, share)


def _scored(folder: Path, record: Record, config: HybridConfig, kind: HybridKind, scene: Any | None) -> dict[str, Any]:
    parts, seconds, models = [], 0.0, []
    for part in _folders(folder):
        model, spent = load_hybrid(part, kind, scene)
        rows = load_rows(part, record)
        models.append(model)
        seconds += spent
        parts.append(_evaluated(record, rows, model, config))
        if part != folder:
            own = _header(part, replace(config, split=rows.name), spent, model)
            write_results(part, own | parts[-1][0], parts[-1][1])
    metrics, arrays = parts[0] if len(parts) == 1 else pool(parts)
    merged = _header(folder, config, seconds, models[0]) | metrics | _uncertainty(arrays)
    write_results(folder, merged, arrays)
    return merged


def _evaluated(
    record: Record, rows: Split, model: HybridModel, config: HybridConfig
) -> tuple[dict[str, Any], dict[str, Any]]:
    heading = record.tx_heading_rad
    std: dict[int, FloatArray] = {}

    def predict(chosen: IntArray, receiver: int) -> NDArray[Any]:
        turned = None if heading is None else heading[chosen]
        estimate = model.predict(record.tx_pos_m[chosen], receiver, turned)
        if len(chosen) == len(rows.test):  # all at once; single ones are timed
            std[receiver] = estimate.std
        return estimate.mean

    metrics, arrays = evaluate(record, rows, predict)
    arrays["std"] = np.stack([std[r] for r in range(len(record.receivers))]).astype(np.float32)
    if config.n_train == 0:
        metrics["n_train"] = 0
    return metrics | _uncertainty(arrays), arrays


def _uncertainty(arrays: dict[str, Any]) -> dict[str, Any]:
    return {"inside_90": inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])}


def _header(folder: Path, config: HybridConfig, seconds: float, model: HybridModel) -> dict[str, Any]:
    known = {"dataset": config.dataset, "scene": config.scene, "split": config.split, "seed": config.seed}
    # What the fit needed, where it is known already.
    memory_mb = stored_metrics(folder).get("peak_memory_mb", peak_memory_mb())
    return {"model": MODEL, **known, "train_seconds": seconds, "peak_memory_mb": memory_mb, "fitted": model.summary()}


def _open(config: HybridConfig, record: Record) -> Any | None:
    if config.scene is None:
        if config.material is not None:
            raise InputError("--material belongs to a bare mesh; give it with --scene")
        return None
    return open_scene(config.scene, instrument_of(record).carrier_hz, material=config.material)


def _splits(record: Record, config: HybridConfig) -> list[Split]:
    # Without training rows the split keeps them for the blend beside the model, which needs some.
    n_train = None if config.n_train == 0 else config.n_train
    return make_splits(record, config.split, config.seed, n_train)


def _parts(folder: Path, splits: list[Split]) -> list[tuple[Path, Split]]:
    if len(splits) == 1:
        return [(folder, splits[0])]
    return [(folder / f"fold{k}", rows) for k, rows in enumerate(splits)]


def _folders(folder: Path) -> list[Path]:
    return [folder] if (folder / SPLIT).exists() else sorted(folder.glob("fold*"))


def _config_text(config: HybridConfig) -> str:
    content = {"model": MODEL, **{k: v for k, v in asdict(config).items() if k != "settings"}}
    return yaml.safe_dump(content | {"settings": list(config.settings), "versions": versions()}, sort_keys=False)
