"""Fields at several budgets, compared with WRF-GS+ at its defaults: stored size, time of a spectrum and SSIM."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wrf_mi.core import Record
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.compressed import compress_run, spectrum_times
from wrf_mi.runs.folder import FITTED
from wrf_mi.runs.results import read_run
from wrf_mi.synthetic import load_record
from wrf_mi.training.compress import Compression
from wrf_mi.training.config import TrainConfig

from .comparison import Row, line

BEST = "WRF-GS+"  # reference: the paper's network with default settings
SCHEDULE = ("steps=15000",)  # settings of every fit; small fields improve beyond 9,000 steps
REPEATS = 100
MOST_LOSS, LEAST_FASTER, LEAST_SMALLER = 0.01, 5.0, 10.0
"""Bounds of a small field: loss of median SSIM, and factors of speed and size."""


@dataclass(frozen=True)
class Budget:
    """Settings of a fit beside the defaults, compression after it, and another budget whose fit is compressed."""

    settings: tuple[str, ...]
    how: Compression | None
    of: str = ""


def _factorised(gaussians: int, terms: int, width: int) -> tuple[str, ...]:
    sizes = {"initial.gaussians": min(gaussians, 270), "density.max_gaussians": gaussians}
    sizes |= {"network.terms": terms, "network.width": width}
    return ("model=factorised", *(f"{name}={value}" for name, value in sizes.items()))


LARGE, HALF, SMALL = "320 Gaussians, 32 terms", "160 of these", "80 Gaussians, 16 terms"
BUDGETS: Mapping[str, Budget] = {
    BEST: Budget((), None),
    LARGE: Budget(_factorised(320, 32, 128), Compression(precision="8bit")),
    HALF: Budget((), Compression(budget=160, fine_tune=4000, precision="8bit"), of=LARGE),
    SMALL: Budget(_factorised(80, 16, 64), Compression(precision="8bit")),
}


def budgets(
    record: Record, work: Path, schedule: Sequence[str] = (), plan: Mapping[str, Budget] = BUDGETS
) -> dict[str, Any]:
    """Fit a field at each budget on the official split and measure them beside each other; by name:

    ``gaussians``, ``bytes``, ``ssim`` (quantiles on the test rows), ``train_seconds``, the times of
    `wrf_mi.runs.compressed.spectrum_times`, and ``times_smaller`` and ``ssim_loss`` against the first.
    """
    fits, folders = dict[str, Path](), dict[str, Path]()
    for number, (name, budget) in enumerate(plan.items()):
        if not budget.of:
            config = with_settings(TrainConfig(), [*schedule, *budget.settings])
            fits[name] = train(record, work / f"fit{number}", config.model, settings=config).folder
        folders[name] = source = fits[budget.of or name]
        if budget.how is not None:
            folders[name] = work / f"small{number}"
            compress_run(source, folders[name], budget.how, record)
    first = folders[next(iter(folders))]
    predictors = {name: open_run(folder, record).predictor() for name, folder in folders.items()}
    known = make_splits(record, "official")[0].all_train
    times = spectrum_times(predictors, record.tx_pos_m[known], REPEATS)
    figures, full_ssim = {}, read_run(first).metrics["ssim"]["median"]
    for name, folder in folders.items():
        metrics, size = read_run(folder).metrics, (folder / FITTED).stat().st_size
        figures[name] = {
            **{key: metrics[key] for key in ("gaussians", "ssim", "train_seconds")},
            **times[name],
            "bytes": size,
            "times_smaller": (first / FITTED).stat().st_size / size,
            "ssim_loss": full_ssim - metrics["ssim"]["median"],
        }
    return figures


def rows_of(figures: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Rows of the benchmark's table from what `budgets` returns."""
    asked = f">= {LEAST_FASTER:.0f} times faster, >= {LEAST_SMALLER:.0f} times smaller, SSIM loss <= {MOST_LOSS}"
    rows = []
    for index, (name, fit) in enumerate(figures.items()):
        value = f"{fit['ssim']['median']:.3f} SSIM, {fit['bytes'] / 1e3:.0f} kB, {fit['ms']:.2f} ms"
        what = f"{name}, 8 bits a weight" if index else f"{name}, {fit['gaussians']} Gaussians"
        if index:
            ratio, low, high = fit["times_faster"]
            value += f": {ratio:.1f} times faster ({low:.1f} to {high:.1f}), {fit['times_smaller']:.0f} times smaller"
        rows.append(line(what, value, asked if index else ""))
    return rows


def main() -> dict[str, Any]:
    """Budgets on rfid-lab's official split, with rows for the table."""
    record = load_record("rfid-lab")
    with tempfile.TemporaryDirectory() as work:
        figures = budgets(record, Path(work), SCHEDULE)
    return {"rows": rows_of(figures), "budgets": figures}
