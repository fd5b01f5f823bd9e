"""Picture of an import: the rows in their plan, each with its strongest receiver."""

from __future__ import annotations

import io
import textwrap

import numpy as np

from ...core import Record
from ...core.files import listed

MOST_NAMED = 9  # receivers with a colour of their own in the plan; the others are grey


def plan_picture(record: Record) -> bytes:
    """PNG with the rows of signal strengths in their plan and the receivers at known positions."""
    from matplotlib.figure import Figure  # not before: every command imports the data sets

    from ...scene import drawing

    extent_m = np.ptp(record.tx_pos_m[:, :2], axis=0)
    aspect = float(np.clip(extent_m[1] / max(extent_m[0], 1e-6), 0.3, 1.5))
    figure = Figure(figsize=(8, 6.6 * aspect + 1.8), layout="constrained")
    axes = figure.add_subplot()
    heard = np.isfinite(record.observation).any(axis=0)
    strongest = np.where(heard, np.argmax(np.nan_to_num(record.observation, nan=-np.inf), axis=0), -1)
    numbers, counts = np.unique(strongest[heard], return_counts=True)
    named = numbers[np.argsort(-counts, kind="stable")][:MOST_NAMED]
    others = ~np.isin(strongest, named)
    for number in named:
        rows = record.tx_pos_m[strongest == number]
        axes.plot(*rows[:, :2].T, ".", markersize=4, label=record.receivers[number].name[:24])
    if others.any():
        axes.plot(*record.tx_pos_m[others, :2].T, ".", color="0.7", markersize=3, label="another or none", zorder=0)
    places = np.stack([receiver.position_m for receiver in record.receivers])
    surveyed = np.isfinite(places).all(axis=1)
    if surveyed.any():
        drawing.draw_devices(axes, "receiver", places, label="receivers")
    names = np.array([receiver.name[:24] for receiver in record.receivers])
    for name, place in zip(names[surveyed], places[surveyed], strict=True) if surveyed.sum() <= MOST_NAMED else ():
        axes.annotate(name, place[:2], (5, 3), textcoords="offset points", fontsize="small")
    title = f"{record.name}: strongest receiver of each row"
    if (~surveyed).any():
        title = f"{title}\n" + textwrap.fill(f"receivers at unknown places: {listed(names[~surveyed])}", 90)
    drawing.set_plan(axes)
    axes.set_title(title, fontsize="medium")
    drawing.add_legend(figure)
    stream = io.BytesIO()
    drawing.without_formulas(figure).savefig(stream, format="png", dpi=110, metadata={"Software": None})
    return stream.getvalue()
