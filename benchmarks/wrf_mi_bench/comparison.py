"""Parts that comparisons of methods share: data, rows of the table, verdicts over seeds, times of predictions."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import InputError
from wrf_mi.datasets.registry import locate
from wrf_mi.runs.paired_bootstrap import PairedDifference, agreed, paired_difference

Row = dict[str, str]


def line(what: str, value: str, asked: str = "") -> Row:
    """Row of a check's table."""
    return {"what": what, "value": value, "asked": asked}


def listed(values: Iterable[Mapping[str, float]], key: str, digits: int) -> str:
    """Values of a key in several blocks of scores, as text."""
    return ", ".join(f"{one[key]:.{digits}f}" for one in values)


def data_folder(name: str) -> Path:
    """Folder of a known data set; `InputError` where it is not on this machine."""
    folder = locate(name)
    if folder is None:
        raise InputError(f"{name}: not on this machine; run `wrf-mi data fetch {name}`")
    return folder


def room_file(name: str) -> Path:
    """File ``<room>.npz`` of a NeWRF room; `InputError` where it is not on this machine."""
    return data_folder(f"newrf-{name}") / f"{name}.npz"


def compared(ours: Sequence[Any], others: Sequence[Any], seeds: Sequence[int], task: str) -> list[PairedDifference]:
    """Paired differences of the scores of two methods, seed by seed."""
    return [paired_difference(a, b, seed, task) for a, b, seed in zip(ours, others, seeds, strict=True)]


def verdicts(pairs: Sequence[PairedDifference]) -> tuple[str, str]:
    """Verdicts by medians and by means on which all seeds agree."""
    return agreed(pair.verdict for pair in pairs), agreed(pair.mean_verdict for pair in pairs)


def timed(fit: Callable[[], Any], many: Callable[[Any], Any], one: Callable[[Any, int], Any], count: int) -> Any:
    """A fitted model, its predictions of ``count`` rows, and times.

    Args:
        fit: fits the model.
        many: predictions of all rows by a model.
        one: prediction of a row by a model, timed for 20 rows at most.
        count: number of predictions of ``many``.

    Returns:
        Model, predictions and ``fit_seconds``, ``predict_ms_each``, ``predict_ms_alone`` (median).
    """
    start = time.perf_counter()
    model = fit()
    fitted = time.perf_counter()
    predictions = many(model)
    predicted = time.perf_counter()
    alone = []
    for row in range(min(20, count)):
        begin = time.perf_counter()
        one(model, row)
        alone.append(time.perf_counter() - begin)
    times = {
        "fit_seconds": fitted - start,
        "predict_ms_each": 1e3 * (predicted - fitted) / count,
        "predict_ms_alone": 1e3 * float(np.median(alone)),
    }
    return model, predictions, times
