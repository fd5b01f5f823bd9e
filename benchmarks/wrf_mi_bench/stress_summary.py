"""The worst of the numbers under stress, a line for each stage: for the README, from the stored rows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .stress_rows import worst_of

STAGES = (
    ("images of random and hard fields", r"image,"),
    ("derivatives of images, float32 against float64", r"derivatives, "),
    ("derivatives of all models in float64, against differences", r"derivatives of (wrf|factorised)"),
    ("receivers: spectra, RSSI, CSI, operators", r"receiver: (?!derivatives)"),
    ("derivatives of receivers", r"receiver: derivatives"),
    ("losses", r"loss: (?!.*differences)"),
    ("phase of paths to 10 km, rad", r"phase"),
    ("derivatives of the tracer, against differences", r"derivatives of (Sionna|the traced)"),
    ("paths and Gaussians together", r"joint: (?!derivatives)"),
    ("derivatives of paths and Gaussians together, against float64", r"joint: derivatives"),
    ("Mitsuba plugins: images", r"plugin: image"),
    ("Mitsuba plugins: derivatives", r"plugin: derivatives"),
)
"""Words for a stage and the beginning of its rows."""
FITS = "fits with random bad"


@dataclass(frozen=True)
class Stage:
    """Rows of one stage of the stress benchmark in short.

    Attributes:
        name: from `STAGES`.
        cases: how many ran; 0 where no row says.
        worst: error of all rows; NaN without a row.
        bound: the widest of them; NaN without a row.
    """

    name: str
    cases: int
    worst: float
    bound: float


def stages(rows: Sequence[Mapping[str, str]]) -> list[Stage]:
    """Each of `STAGES` in rows of the stress benchmark."""
    found = []
    for words, begins in STAGES:
        own = [row for row in rows if re.match(begins, row["what"])]
        # Of a row that states both, cases come last.
        cases = sum(int(said[-1]) for row in own if (said := re.findall(r"(\d+) (?:cases|paths)", row["what"])))
        worst, bound = zip(*map(worst_of, own), strict=True) if own else ((float("nan"),), (float("nan"),))
        found.append(Stage(words, cases, max(worst), max(bound)))
    return found


def summary_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Markdown table of the worst figure of each stage beside its widest bound; of fits, how they ended."""
    lines = ["| what | cases | worst | bound |", "| --- | --- | --- | --- |"]
    lines += [f"| {one.name} | {one.cases or ''} | **{one.worst:.1e}** | {one.bound:g} |" for one in stages(rows)]
    for row in rows:
        if row["what"].startswith(FITS):
            what, _, count = row["what"].rpartition(", ")
            lines.append(f"| {what} | {count.removesuffix(' cases')} | **{row['value']}** | {row['asked']} |")
    return "\n".join(lines)
