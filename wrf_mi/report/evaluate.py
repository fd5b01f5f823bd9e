"""Scores of a run on its held-out rows: ``metrics.json`` and ``predictions.npz``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..baselines.idw import InverseDistance
from ..core import Record, Split
from ..core.angles import FloatArray
from ..core.files import write_arrays, write_atomically
from .metrics import ssim, summary
from .run_folder import METRICS, PREDICTIONS, Spectra

Predict = Callable[[FloatArray, int], Spectra]
"""Spectra [m, H, W] of transmitter positions [m, 3] at the receiver of an index."""

REPEATS = 20
"""Single predictions that are timed; the median is stated."""


def milliseconds_per_sample(predict: Predict, tx_pos_m: FloatArray) -> float:
    """Median time of one spectrum from one transmitter position, warm, in ms."""
    one = tx_pos_m[:1]
    predict(one, 0)
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        predict(one, 0)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def evaluate(record: Record, split: Split, predict: Predict) -> tuple[dict[str, Any], dict[str, Any]]:
    """Score a method on the test rows of a split, with the nearest-neighbour blend beside it.

    Args:
        record: spectra [n_rx, n, H, W].
        split: the blend is fitted on all its training rows, validation rows included.
        predict: the method.

    Returns:
        The blocks of ``metrics.json`` that scoring gives (``ssim``, ``reference``, for several receivers
        ``receivers``, ``n_train``, ``n_test``, ``ms_per_sample``), and the arrays of ``predictions.npz``.
    """
    rows, known = split.test, split.all_train
    tx_pos = record.tx_pos_m[rows]
    receivers = range(len(record.receivers))
    prediction = np.stack([predict(tx_pos, r) for r in receivers]).astype(np.float32)
    reference = np.stack(
        [InverseDistance().fit(record.tx_pos_m[known], record.observation[r, known]).predict(tx_pos) for r in receivers]
    ).astype(np.float32)
    arrays = {
        "row": rows,
        "prediction": prediction,
        "truth": record.observation[:, rows],
        "tx_pos": tx_pos,
        "reference_idw4": reference,
        "receiver_name": np.asarray([r.name for r in record.receivers]),
    }
    metrics = score(arrays) | {
        "n_train": len(known),
        "ms_per_sample": milliseconds_per_sample(predict, tx_pos),
    }
    return metrics, arrays


def score(arrays: dict[str, Any]) -> dict[str, Any]:
    """The score blocks of ``metrics.json`` from the arrays of ``predictions.npz``."""
    own, blend = ssim(arrays["prediction"], arrays["truth"]), ssim(arrays["reference_idw4"], arrays["truth"])
    metrics: dict[str, Any] = {
        "ssim": summary(own),
        "reference": {"idw4": summary(blend)},
        "n_test": len(arrays["row"]),
    }
    if len(own) > 1:
        metrics["receivers"] = {
            str(name): {"ssim": summary(own[r]), "reference": {"idw4": summary(blend[r])}}
            for r, name in enumerate(arrays["receiver_name"])
        }
    return metrics


def pool(parts: list[tuple[dict[str, Any], dict[str, Any]]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics and predictions of several folds as one: every row's score counts once.

    ``n_train`` is the mean over the folds, times are medians (per sample) and sums (training).
    """
    every = [arrays for _, arrays in parts]
    arrays = {"row": np.concatenate([a["row"] for a in every]), "tx_pos": np.concatenate([a["tx_pos"] for a in every])}
    for key in ("prediction", "truth", "reference_idw4"):
        arrays[key] = np.concatenate([a[key] for a in every], axis=1)
    arrays["receiver_name"] = every[0]["receiver_name"]
    blocks = [metrics for metrics, _ in parts]
    metrics = score(arrays) | {
        "n_train": round(float(np.mean([m["n_train"] for m in blocks]))),
        "ms_per_sample": float(np.median([m["ms_per_sample"] for m in blocks])),
    }
    return metrics, arrays


def write_results(folder: Path, metrics: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write ``predictions.npz`` and then ``metrics.json``, which marks the run as finished."""
    write_predictions(folder / PREDICTIONS, arrays)
    write_atomically(folder / METRICS, json.dumps(metrics, indent=1) + "\n")


def write_predictions(path: Path, arrays: dict[str, Any]) -> dict[str, Any]:
    """Write spectra as ``.npz``: greys in 0..1, float32, [m, H, W] for one receiver, else [n_rx, m, H, W].

    ``row`` [m] are rows from 0, ``tx_pos`` [m, 3] metres, ``receiver_name`` [n_rx]. Returns the arrays as written.
    """
    single = len(arrays["receiver_name"]) == 1
    spectra = ("prediction", "truth", "reference_idw4")
    written = {k: v[0] if single and k in spectra else v for k, v in arrays.items()}
    write_arrays(path, written, compressed=True)
    return written
