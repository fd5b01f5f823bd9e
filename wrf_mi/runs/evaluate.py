"""Scores of a method on held-out rows: ``metrics.json`` and ``predictions.npz``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record, Split
from ..core.carriers import FREQUENCY
from ..core.files import write_arrays, write_atomically
from ..core.types import IntArray
from ..datasets.observations import scorable
from ..tasks import TASKS, Task
from ..tasks.scores import summary
from .folder import METRICS, PREDICTIONS
from .references import reference_predictions
from .results import reference_key

Predict = Callable[[IntArray, int], NDArray[Any]]
"""What the receiver of an index observes in rows [m] of the record: spectra [m, H, W], powers [m] in dBm or channel
coefficients [m, subcarriers] or [m, antennas, subcarriers]. Rows, and not positions, because a method may use how the
transmitter was turned, or the uplink."""

NOT_SCORED = "n_not_scored"
"""Key of the number of observations of test rows that are not finite, though the receiver received something."""
REPEATS = 20
"""Single predictions that are timed at most; the median is stated."""
TIMED_S = 10.0
"""After so many seconds no further one is begun: some methods optimise for each sample."""


def milliseconds_per_sample(predict: Predict, rows: IntArray, repeats: int = REPEATS) -> float:
    """Median time of one prediction at one transmitter position, warm, in ms."""
    one = rows[:1]
    predict(one, 0)
    times: list[float] = []
    while len(times) < repeats and sum(times) < TIMED_S:
        start = time.perf_counter()
        predict(one, 0)
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def evaluate(
    record: Record, split: Split, predict: Predict, single: Predict | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Score a method on the test rows of a split, with the references that the data allow beside it.

    Args:
        record: of any task in `wrf_mi.tasks.TASKS`.
        split: references (`wrf_mi.runs.references`) know all its training rows, validation rows included.
        predict: the method; finite wherever something was received.
        single: the same where it is timed at one row; None: ``predict``.

    Returns:
        The blocks of ``metrics.json`` that scoring gives (``task``, the task's metric, ``reference``, for several
        receivers ``receivers``, ``n_train``, ``n_test``, ``n_not_scored``, ``ms_per_sample``), and the arrays of
        ``predictions.npz``. An observation that is not finite is not scored: the truth has NaN there.

    Raises:
        InputError: no test rows or none that is finite, predictions of another shape or not finite, or a receiver that
            received no training row.
    """
    rows, known = split.test, split.all_train
    if len(rows) == 0:
        raise InputError(f"split {split.name}: no test rows to score; use another split")
    truth, broken = scorable(record.scored[:, rows])
    if np.isnan(truth).all():
        raise InputError(f"{record.name}, split {split.name}: no test row to score is finite; use another split")
    arrays = {
        "row": rows,
        "prediction": np.stack([predict(rows, r) for r in range(len(truth))]).astype(truth.dtype),
        "truth": truth,
        "tx_pos": record.tx_pos_m[rows],
        **({} if record.carriers_hz is None else {FREQUENCY: record.carriers_hz[rows]}),
        **{reference_key(key): values for key, values in reference_predictions(record, known, rows).items()},
        "receiver_name": np.asarray([r.name for r in record.receivers]),
    }
    metrics = score(arrays, record.task) | {
        NOT_SCORED: broken,
        "n_train": len(known),
        "ms_per_sample": milliseconds_per_sample(single or predict, rows),
    }
    return metrics, arrays


def score(arrays: dict[str, Any], task: str) -> dict[str, Any]:
    """The score blocks of ``metrics.json`` from the arrays of ``predictions.npz`` (with a first axis per receiver).

    Rows that a receiver did not receive are left out; with several receivers each has a block of its own, with the
    number of rows that count, and the block at the top pools all.
    """
    scorer = TASKS[task]
    own = scorer.of_rows(arrays["prediction"], arrays["truth"])
    held = {key: scorer.of_rows(arrays[reference_key(key)], arrays["truth"]) for key in _stored(scorer, arrays)}

    def blocks(chosen: Any) -> dict[str, Any]:
        references = {key: summary(scores[chosen]) for key, scores in held.items()}
        return {scorer.block: summary(own[chosen]), "reference": references}

    metrics: dict[str, Any] = {"task": task, **blocks(slice(None)), "n_test": len(arrays["row"])}
    if len(own) > 1:
        counts = np.count_nonzero(~np.isnan(own), axis=1)
        metrics["receivers"] = {
            str(name): {**(blocks(r) if counts[r] else {}), "n_test": int(counts[r])}
            for r, name in enumerate(arrays["receiver_name"])
        }
    return metrics


def _stored(task: Task, arrays: dict[str, Any]) -> list[str]:
    """References that the arrays hold."""
    return [key for key in task.references if reference_key(key) in arrays]


def pool(parts: list[tuple[dict[str, Any], dict[str, Any]]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics and predictions of several folds as one: every row's score counts once.

    ``n_train`` is the mean over the folds, ``ms_per_sample`` the median.
    """
    blocks, every = zip(*parts, strict=True)
    task = blocks[0]["task"]
    shared = [key for key in ("row", "tx_pos", FREQUENCY) if key in every[0]]
    arrays = {key: np.concatenate([a[key] for a in every]) for key in shared}
    known = ("prediction", "truth", "std", *(reference_key(key) for key in _stored(TASKS[task], every[0])))
    for key in (key for key in known if key in every[0]):
        arrays[key] = np.concatenate([a[key] for a in every], axis=1)
    arrays["receiver_name"] = every[0]["receiver_name"]
    metrics = score(arrays, task) | {
        NOT_SCORED: sum(m[NOT_SCORED] for m in blocks),
        "n_train": round(float(np.mean([m["n_train"] for m in blocks]))),
        "ms_per_sample": float(np.median([m["ms_per_sample"] for m in blocks])),
    }
    return metrics, arrays


def write_results(folder: Path, metrics: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Write ``predictions.npz`` and then ``metrics.json``, which marks the run as finished."""
    write_predictions(folder / PREDICTIONS, arrays)
    write_atomically(folder / METRICS, json.dumps(metrics, indent=1) + "\n")


def write_predictions(path: Path, arrays: dict[str, Any]) -> dict[str, Any]:
    """Write predictions as ``.npz``, observations without their first axis where there is one receiver.

    ``row`` [m] are rows from 0, ``tx_pos`` [m, 3] metres, ``frequency_hz`` [m] the carriers of rows that have several,
    ``receiver_name`` [n_rx]. ``prediction`` and, where they are
    known, ``truth`` and ``reference_<name>``: grey in 0..1 [m, H, W] or [n_rx, m, H, W] float32, power in dBm [m] or
    [n_rx, m] float32 (NaN: not received), channel coefficients [m, k], or of several antennas [m, antennas, k],
    complex64, in either case with a first axis where there are several receivers. ``std``, where a method states it,
    is the predicted standard deviation, of the same shape, real.

    Returns:
        The arrays as written.
    """
    single = len(arrays["receiver_name"]) == 1
    shared = ("row", "tx_pos", FREQUENCY, "receiver_name")
    written = {k: v[0] if single and k not in shared else v for k, v in arrays.items()}
    write_arrays(path, written, compressed=True)
    return written


def stored_metrics(folder: Path) -> dict[str, Any]:
    """The last ``metrics.json``; nothing where it is missing or damaged, since scoring writes it anew."""
    try:
        stored = json.loads((folder / METRICS).read_text())
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) else {}
