"""Pictures: spectra on the polar sky, score distributions, training curves.

Figures are made without pyplot: no global state, no window system.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from wrf_mi.core.angles import azimuth_rad, elevation_rad
from wrf_mi.core.files import write_atomically

PANEL_IN = 2.3
"""Side of one polar picture in inches."""


def polar_spectrum(axes: Axes, spectrum: ArrayLike, title: str = "") -> None:
    """Draw a spectrum on polar axes: azimuth as angle, 90 degrees - elevation as radius.

    Args:
        axes: made with ``projection="polar"``.
        spectrum: grey values [H, W]; colours span 0..1.
        title: above the picture.
    """
    values = np.asarray(spectrum)
    height, width = values.shape
    radius_deg = 90 - np.degrees(elevation_rad(height))
    axes.pcolormesh(azimuth_rad(width), radius_deg, values, shading="nearest", cmap="viridis", vmin=0, vmax=1)
    axes.set_rlim(0, 90)  # type: ignore[attr-defined]
    axes.set_yticks([30, 60, 90], ["60°", "30°", ""], fontsize=6, color="white")
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"], fontsize=6)
    axes.tick_params(pad=-2)
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.set_title(title, fontsize=8)


def spectrum_table(rows: Sequence[tuple[str, Sequence[ArrayLike | None]]], columns: Sequence[str]) -> Figure:
    """Polar pictures side by side, for example truth beside prediction.

    Args:
        rows: a name and one spectrum [H, W] per column; None leaves the place empty.
        columns: a title for each column.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(PANEL_IN * len(columns), PANEL_IN * len(rows) + 0.2), layout="constrained")
    grid = figure.subplots(len(rows), len(columns), squeeze=False, subplot_kw={"projection": "polar"})
    for r, (name, spectra) in enumerate(rows):
        for c, (title, spectrum) in enumerate(zip(columns, spectra, strict=True)):
            axes = grid[r, c]
            if spectrum is None:
                axes.set_axis_off()
            else:
                polar_spectrum(axes, spectrum, title if r == 0 else "")
            if c == 0:
                axes.text(-0.25, 0.5, name, transform=axes.transAxes, rotation=90, va="center", fontsize=7)
    return figure


def score_cdf(scores: Mapping[str, ArrayLike], references: Mapping[str, ArrayLike], label: str = "SSIM") -> Figure:
    """Cumulative distributions of a score over test rows, one step curve each; references dashed.

    Args:
        scores: values of each run by its name.
        references: the same for what runs are held against.
        label: of the score's axis.
    """
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for group, style in ((scores, "-"), (references, "--")):
        for name, values in group.items():
            axes.ecdf(np.ravel(values), label=name, linestyle=style)
    axes.set_xlabel(label)
    axes.set_ylabel("share of test rows below")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def training_curves(curves: Mapping[str, Sequence[tuple[float, float]]]) -> Figure:
    """Score on validation rows over training time.

    Args:
        curves: pairs (seconds, SSIM) of each run by its name.
    """
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, points in curves.items():
        seconds, score = zip(*points, strict=True)
        axes.plot(seconds, score, marker=".", label=name)
    axes.set_xlabel("training time (s)")
    axes.set_ylabel("SSIM on validation rows")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def save(figure: Figure, path: Path, dpi: int = 110) -> Path:
    """Write a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return write_atomically(path, buffer.getvalue())
