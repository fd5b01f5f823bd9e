"""A run made smaller: its folder, its size, and what that costs."""

from __future__ import annotations

import itertools
import json
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record
from ..core.files import write_atomically
from ..fit.compress import Compression, compress
from ..fit.folder import (
    CHECKPOINT,
    SPLIT,
    append_log,
    check_new,
    load_predictor,
    load_rows,
    read_checkpoint,
    read_config,
    write_config,
    write_packed,
)
from ..fit.predictor import Predictor
from ..fit.trainer import Progress, final_params
from ..measure import save_split
from ..trace import load_record
from .baseline_run import is_baseline
from .evaluate import stored_metrics
from .hybrid_run import is_hybrid
from .runs import evaluate_run, is_blocked
from .timing import interleaved, ratio
from .traced import is_traced

COMPRESSION = "compression.json"
"""What was done to the run, from which one, and what it cost."""
REPEATS = 60
"""Interleaved pairs of spectra that are timed."""

Listen = Callable[[str, int, Progress], None]


def spectrum_times(predictors: Mapping[str, Predictor], tx_pos_m: Any, repeats: int = REPEATS) -> dict[str, Any]:
    """Times of single spectra, warm, of several fields that take turns.

    Args:
        predictors: by name; the first is what the others are compared with.
        tx_pos_m: transmitter positions [m, 3], metres.
        repeats: rounds.

    Returns:
        By name: ``ms`` (median), ``ms_least``, and ``times_faster`` than the first: median of the rounds' ratios and
        its 95 % interval.
    """
    positions = np.asarray(tx_pos_m, float)

    def call(one: Predictor) -> Callable[[], Any]:
        turn = itertools.cycle(positions[:, None])
        return lambda: one(next(turn))

    taken = interleaved({name: call(one) for name, one in predictors.items()}, repeats)
    first = next(iter(taken.values()))
    result: dict[str, Any] = {}
    for name, own in taken.items():
        faster = ratio(first, own)
        times = {"ms": float(np.median(own)), "ms_least": float(own.min())}
        result[name] = times | {"times_faster": [faster.value, faster.low, faster.high]}
    return result


def plain_size(folder: Path) -> int:
    """Bytes that a run's parameters take as this project stores them for prediction, networks included.

    A run in training stores three more copies for the optimiser, which are not counted.
    """
    arrays = read_checkpoint(folder)
    if "packed_precision" in arrays:
        return (folder / CHECKPOINT).stat().st_size
    with tempfile.TemporaryDirectory() as work:
        return write_packed(Path(work), arrays, final_params(arrays), "single")


def compress_run(
    run: str | Path,
    out: str | Path,
    how: Compression,
    record: Record | None = None,
    listen: Listen = lambda stage, steps, progress: None,
) -> dict[str, Any]:
    """Make a smaller run of a run and score it on the same held-out rows.

    Args:
        run: folder of a learned field (WRF-GS or WRF-GS+).
        out: run folder to make; must not exist or be empty.
        how: what is made smaller.
        record: the data set of the run; None: loaded by its name.
        listen: hears of progress.

    Returns:
        What ``compression.json`` says: ``before`` and ``after`` with ``gaussians``, ``bytes``, ``ssim`` (median) and
        the times of `spectrum_times`; ``times_smaller``, ``ssim_change``, ``seconds`` and the settings.

    Raises:
        InputError: not a run with one learned field, or a folder that is not empty.
    """
    source, folder = Path(run), Path(out)
    check_new(folder)
    if is_traced(source) or is_hybrid(source) or is_baseline(source):
        raise InputError(f"{source}: not a learned field alone; compress a run of wrf-gs or wrf-gs+")
    if is_blocked(source):
        raise InputError(f"{source}: one field for each block; choose one, e.g. {source / 'fold0'}")
    asked, arrays = read_config(source), read_checkpoint(source)
    if asked.scene is not None:
        raise InputError(f"{source}: trained together with the paths of {asked.scene}; compress a run without a scene")
    data = record or load_record(asked.dataset)
    split = load_rows(source, data)
    start = time.perf_counter()

    def heard(stage: str, steps: int, progress: Progress) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        append_log(folder, progress)
        listen(stage, steps, progress)

    before: dict[str, NDArray[np.float32]] = final_params(arrays)
    settings, params = compress(asked.settings, before, data, split, how, heard)
    seconds = time.perf_counter() - start
    folder.mkdir(parents=True, exist_ok=True)
    save_split(folder / SPLIT, split)
    write_config(folder, replace(asked, settings=settings))
    size = write_packed(folder, arrays, params, how.precision)
    known = stored_metrics(source)
    ssim_before = (known or evaluate_run(source))["ssim"]["median"]
    ssim_after = evaluate_run(folder)["ssim"]["median"]
    both = {"before": load_predictor(source), "after": load_predictor(folder)}
    times = spectrum_times(both, data.tx_pos_m[split.all_train])
    result = {
        "run": str(source),
        "how": asdict(how),
        "seconds": seconds,
        "before": {"gaussians": before["position"].shape[1], "bytes": plain_size(source), "ssim": ssim_before}
        | times["before"],
        "after": {"gaussians": params["position"].shape[1], "bytes": size, "ssim": ssim_after} | times["after"],
        "times_smaller": plain_size(source) / size,
        "ssim_change": ssim_after - ssim_before,
    }
    write_atomically(folder / COMPRESSION, json.dumps(result, indent=1) + "\n")
    return result


def render(found: Mapping[str, Any]) -> str:
    """The result of `compress_run` as a table."""
    lines = [f"{'':<8}{'Gaussians':>10}{'kB':>9}{'ms':>8}{'SSIM':>8}"]
    for name in ("before", "after"):
        one = found[name]
        lines.append(f"{name:<8}{one['gaussians']:>10}{one['bytes'] / 1e3:>9.1f}{one['ms']:>8.2f}{one['ssim']:>8.3f}")
    value, low, high = found["after"]["times_faster"]
    lines.append(
        f"{found['times_smaller']:.1f} times smaller, {value:.1f} times as fast ({low:.1f} to {high:.1f}), "
        f"median SSIM {found['ssim_change']:+.3f}, made in {found['seconds']:.0f} s"
    )
    return "\n".join(lines)
