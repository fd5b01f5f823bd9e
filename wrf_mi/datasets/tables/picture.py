"""Plan of the rows of a data set, coloured by the receiver that was strongest."""

from __future__ import annotations

import io

import numpy as np

from ...core import Record

MOST_NAMED = 9
"""Receivers with a colour of their own; the others are grey."""


def plan_picture(record: Record) -> bytes:
    """PNG with the rows of signal strengths in their plan and the receivers at known positions."""
    from matplotlib.figure import Figure  # not before: every command imports the data sets

    figure = Figure(figsize=(8, 6), layout="constrained")
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
    if np.isfinite(places).all(axis=1).any():
        axes.plot(*places[:, :2].T, "k^", markersize=7, label="receivers")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=f"{record.name}: strongest receiver of each row")
    figure.legend(loc="outside right upper", fontsize="small")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    return stream.getvalue()
