"""Reading what a run left behind."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from wrf_mi.core import InputError
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray

from .metrics import ssim

METRICS = "metrics.json"
PREDICTIONS = "predictions.npz"
LOG = "log.jsonl"
CONFIG = "config.yaml"

Spectra = NDArray[np.float32]


@dataclass(frozen=True)
class Run:
    """A finished run on spectra, with one first axis per receiver.

    Attributes:
        path: the run folder.
        name: for tables and legends.
        metrics: content of ``metrics.json``.
        seed: of the configuration, or None where it states none.
        row: test rows, shape [m].
        prediction: grey values, shape [n_rx, m, H, W].
        truth: the same shape.
        reference: the blend of the four nearest training spectra, the same shape.
        validation: by fold name ("" without folds), pairs (seconds, SSIM on validation rows while they were held out).
    """

    path: Path
    name: str
    metrics: dict[str, Any]
    seed: int | None
    row: IntArray
    prediction: Spectra
    truth: Spectra
    reference: Spectra
    validation: dict[str, list[tuple[float, float]]]

    @cached_property
    def ssim(self) -> FloatArray:
        """Structural similarity of each prediction, shape [n_rx, m]."""
        return ssim(self.prediction, self.truth)

    @cached_property
    def reference_ssim(self) -> FloatArray:
        """Structural similarity of the blend, shape [n_rx, m]."""
        return ssim(self.reference, self.truth)


def read_run(path: str | Path, name: str | None = None) -> Run:
    """Read a run folder.

    Args:
        path: the folder; a run over all blocks has subfolders ``fold0``, ... and pooled files at its top.
        name: for tables and legends; the folder's own name without one.

    Raises:
        InputError: not a run folder, or a file in it that is missing, damaged or of another task.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a run folder made by train or trace")
    metrics = _read_metrics(folder / METRICS)
    arrays = _read_predictions(folder / PREDICTIONS)
    parts = [folder, *sorted(p for p in folder.glob("fold*") if p.is_dir())]
    curves = {p.name if p != folder else "": _read_log(p / LOG) for p in parts}
    return Run(
        path=folder,
        name=name or folder.resolve().name,
        metrics=metrics,
        seed=_read_seed(folder, metrics),
        row=arrays["row"],
        prediction=arrays["prediction"],
        truth=arrays["truth"],
        reference=arrays["reference_idw4"],
        validation={fold: points for fold, points in curves.items() if points},
    )


def read_runs(paths: Sequence[str | Path]) -> list[Run]:
    """Read several run folders under names that differ: folders of the same name get as many parents as needed.

    Raises:
        InputError: no folder, one of them twice, or one that is no run.
    """
    resolved = [Path(p).resolve() for p in paths]
    if not resolved:
        raise InputError("nothing to compare: give at least one run folder")
    for folder in resolved:
        if resolved.count(folder) > 1:
            raise InputError(f"{folder}: given twice; give each run once")
    depth = 1
    while len({p.parts[-depth:] for p in resolved}) < len(resolved):
        depth += 1
    return [read_run(path, "/".join(p.parts[-depth:])) for path, p in zip(paths, resolved, strict=True)]


def _read_metrics(path: Path) -> dict[str, Any]:
    try:
        metrics = json.loads(path.read_text())
    except FileNotFoundError:
        raise InputError(f"{path.parent}: no {METRICS}, so no finished run; finish it with train --resume") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable as JSON ({error}); run evaluate to write it anew") from None
    needed = ("task", "model", "split", "n_train", "n_test", "ms_per_sample", "train_seconds", "peak_memory_mb")
    missing = [key for key in needed if key not in metrics]
    if missing:
        raise InputError(f"{path}: no {', '.join(missing)}; run evaluate to write it anew")
    if metrics["task"] != "spectrum":
        raise InputError(f"{path}: task {metrics['task']!r}; only runs on spectra can be compared")
    blocks = (metrics.get("ssim"), (metrics.get("reference") or {}).get("idw4"))
    if any(not isinstance(block, dict) or "median" not in block for block in blocks):
        raise InputError(f"{path}: no ssim or no reference idw4 with a median; run evaluate to write it anew")
    return metrics


def _read_predictions(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in ("row", "prediction", "truth", "reference_idw4")}
    except FileNotFoundError:
        raise InputError(f"{path}: missing; run evaluate to write it") from None
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]}; run evaluate to write it anew") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not readable ({error}); run evaluate to write it anew") from None
    spectra = {key: arrays[key] if arrays[key].ndim == 4 else arrays[key][None] for key in arrays if key != "row"}
    shape = spectra["truth"].shape
    if len(shape) != 4 or shape[1] != len(arrays["row"]) or any(s.shape != shape for s in spectra.values()):
        shapes = ", ".join(f"{key} {value.shape}" for key, value in arrays.items())
        raise InputError(f"{path}: shapes do not fit together ({shapes}); run evaluate to write it anew")
    return {"row": arrays["row"], **spectra}


def _read_seed(folder: Path, metrics: dict[str, Any]) -> int | None:
    if "seed" in metrics:
        return metrics["seed"]
    path = folder / CONFIG
    try:
        config = yaml.safe_load(path.read_text()) or {}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise InputError(f"{path}: not readable as YAML ({str(error).splitlines()[0]}); restore it") from None
    return config.get("seed")


def _read_log(path: Path) -> list[tuple[float, float]]:
    """Pairs (seconds, SSIM on held-out validation rows); methods without training leave no log."""
    if not path.is_file():
        return []
    points = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            entry = json.loads(line)
            # Once the fit trains on the validation rows, their score says nothing about rows it has not seen.
            if entry["validation_ssim"] is not None and entry["held_out"]:
                points.append((float(entry["seconds"]), float(entry["validation_ssim"])))
        except (ValueError, KeyError, AttributeError, TypeError):
            raise InputError(f"{path}: line {number} is no log entry; remove the line") from None
    return points
