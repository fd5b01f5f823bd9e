"""Picture of an import: the rows in their plan, each with its strongest receiver."""

from __future__ import annotations

import io

import numpy as np

from ...core import Record

MOST_NAMED = 9  # receivers with a colour of their own in the plan; the others are grey


def plan_picture(record: Record) -> bytes:
    """PNG with the rows of signal strengths in their plan and the receivers at known positions."""
    from matplotlib.figure import Figure  # not before: every command imports the data sets
    from matplotlib.text import Text

    figure = Figure(figsize=(8, 7), layout="constrained")
    axes = figure.add_subplot(title=f"{record.name}: strongest receiver of each row")
    heard = np.isfinite(record.observation).any(axis=0)
    strongest = np.where(heard, np.argmax(np.nan_to_num(record.observation, nan=-np.inf), axis=0), -1)
    numbers, counts = np.unique(strongest[heard], return_counts=True)
    named = numbers[np.argsort(-counts, kind="stable")][:MOST_NAMED]
    others = record.tx_pos_m[~np.isin(strongest, named)]
    axes.plot(*others[:, :2].T, ".", color="0.7", markersize=3, label="another or none", zorder=0)
    for number in named:
        rows = record.tx_pos_m[strongest == number]
        axes.plot(*rows[:, :2].T, ".", markersize=4, label=record.receivers[number].name[:24])
    places = np.stack([receiver.position_m for receiver in record.receivers])  # NaN, unknown, is not drawn
    axes.plot(*places[:, :2].T, "k^", markersize=7, label="receivers at known places")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    figure.legend(loc="outside lower center", ncols=4, fontsize="small")
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # names may contain dollar signs
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    return stream.getvalue()
