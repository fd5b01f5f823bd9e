"""Compression of a run, with the change of size, speed and accuracy."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError, Record
from ..core.files import write_atomically
from ..datasets import save_split
from ..graph.settings import TRACED
from ..tasks.scores import bootstrap
from ..training.checkpoint import append_log
from ..training.compress import Compression, compress
from ..training.loop import Progress
from ..training.predictor import Predictor
from ..training.session import OnProgress, quiet
from .api import evaluate_run, open_run
from .evaluate import stored_metrics
from .folder import FITTED, SPLIT, check_new, load_rows, read_fitted, write_config, write_fitted

COMPRESSION = "compression.json"  # file of settings, source and results of a compression
REPEATS = 60  # number of interleaved pairs of spectra that are timed
WARM_UP = 2  # pairs before them: the first call compiles, the second still fills caches


def spectrum_times(predictors: Mapping[str, Predictor], tx_pos_m: Any, repeats: int = REPEATS) -> dict[str, Any]:
    """Times of single warm spectra of several predictors called in turn at positions [m, 3] in metres, by name.

    ``ms`` is the median, ``ms_least`` the least; ``times_faster`` than the first are the median of the rounds' ratios
    and its 95 % interval.
    """
    turns = itertools.islice(itertools.cycle(np.asarray(tx_pos_m, float)[:, None]), WARM_UP + repeats)
    ms = np.empty((WARM_UP + repeats, len(predictors)))
    for times, position in zip(ms, turns, strict=True):
        for number, predictor in enumerate(predictors.values()):
            start = time.perf_counter()
            predictor(position)
            times[number] = 1e3 * (time.perf_counter() - start)
    result: dict[str, Any] = {}
    for name, times in zip(predictors, ms[WARM_UP:].T, strict=True):
        # A changing load affects both predictors of a round alike, so that its ratio varies less than either time.
        faster = bootstrap(ms[WARM_UP:, 0] / times)
        interval = [faster.value, faster.low, faster.high]
        result[name] = {"ms": float(np.median(times)), "ms_least": float(times.min()), "times_faster": interval}
    return result


def compress_run(
    run: str | Path,
    out: str | Path,
    how: Compression,
    record: Record | None = None,
    on_progress: OnProgress = quiet,
) -> dict[str, Any]:
    """Make a smaller run in ``out`` from a run of a learned field, and score it on the same held-out rows.

    Returns:
        Content of ``compression.json``: ``before`` and ``after`` with ``gaussians``, ``bytes``, ``ssim`` (median) and
        the times of `spectrum_times`; ``times_smaller``, ``ssim_change``, ``seconds`` and the settings.

    Raises:
        InputError: not a run of a learned field of spectra without a scene, or a folder that is not empty.
    """
    source, folder = Path(run), Path(out)
    check_new(folder)
    opened = open_run(source, record)
    config, field = opened.config, opened.field
    if config.scene is not None:
        raise InputError(f"{source}: trained together with the paths of {config.scene}; compress a run without a scene")
    if field.config.evaluation == TRACED:
        raise InputError(f"{source}: evaluated by tracing; compress a run with evaluation=splatted")
    data = opened.problem.record
    split = load_rows(source, data)
    start = time.perf_counter()

    def log(stage: str, steps: int, progress: Progress) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        append_log(folder, progress)
        on_progress(stage, progress.step / steps, progress)

    settings, params = compress(field.config, field.params, data, split, how, log)
    seconds = time.perf_counter() - start
    folder.mkdir(parents=True, exist_ok=True)
    save_split(folder / SPLIT, split)
    write_config(folder, replace(config, model=settings.model, settings=settings))
    size = (
        write_fitted(folder, field.packed(params, how.precision), read_fitted(source, config.entry)[1]).stat().st_size
    )
    ssim_before = (stored_metrics(source) or evaluate_run(source))["ssim"]["median"]
    ssim_after = evaluate_run(folder)["ssim"]["median"]
    both = {"before": opened.predictor(), "after": open_run(folder, record).predictor()}
    times = spectrum_times(both, data.tx_pos_m[split.all_train])
    size_before, count = (source / FITTED).stat().st_size, field.params["position"].shape[1]
    result = {
        "run": str(source),
        "how": asdict(how),
        "seconds": seconds,
        "before": {"gaussians": count, "bytes": size_before, "ssim": ssim_before} | times["before"],
        "after": {"gaussians": params["position"].shape[1], "bytes": size, "ssim": ssim_after} | times["after"],
        "times_smaller": size_before / size,
        "ssim_change": ssim_after - ssim_before,
    }
    write_atomically(folder / COMPRESSION, json.dumps(result, indent=1) + "\n")
    return result


def render(result: Mapping[str, Any]) -> str:
    """Table of the result of `compress_run`."""
    lines = [f"{'':<8}{'Gaussians':>10}{'kB':>9}{'ms':>8}{'SSIM':>8}"]
    for name in ("before", "after"):
        row = result[name]
        lines.append(f"{name:<8}{row['gaussians']:>10}{row['bytes'] / 1e3:>9.1f}{row['ms']:>8.2f}{row['ssim']:>8.3f}")
    value, low, high = result["after"]["times_faster"]
    lines.append(
        f"{result['times_smaller']:.1f} times smaller, {value:.1f} times as fast ({low:.1f} to {high:.1f}), "
        f"median SSIM {result['ssim_change']:+.3f}, made in {result['seconds']:.0f} s"
    )
    return "\n".join(lines)
