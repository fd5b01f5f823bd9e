"""The worst of the numbers under stress, a line for each stage: for the README, from the stored rows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

STAGES = (
    ("images of random and hard fields", r"image,"),
    ("their derivatives, float32 against float64", r"derivatives, "),
    ("derivatives of all models in float64, against differences", r"derivatives of (wrf|factorised)"),
    ("receivers: spectra, RSSI, CSI, operators", r"receiver: (?!derivatives)"),
    ("their derivatives", r"receiver: derivatives"),
    ("losses", r"loss: (?!.*differences)"),
    ("phase of paths to 10 km, rad", r"phase"),
    ("derivatives of the tracer, against differences", r"derivatives of (Sionna|the traced)"),
    ("paths and Gaussians together", r"joint: (?!derivatives)"),
    ("their derivatives, against float64", r"joint: derivatives"),
    ("Mitsuba plugins: images", r"plugin: image"),
    ("Mitsuba plugins: derivatives", r"plugin: derivatives"),
)
"""Words for a stage and the beginning of its rows."""
FITS = "fits with random bad"


def summary_table(rows: Sequence[Mapping[str, str]]) -> str:
    """Markdown table of the worst figure of each stage beside its widest bound; of fits, how they ended."""
    lines = ["| what | cases | worst | bound |", "| --- | --- | --- | --- |"]
    for words, begins in STAGES:
        own = [row for row in rows if re.match(begins, row["what"])]
        # Of a row that states both, cases come last.
        cases = sum(int(found[-1]) for row in own if (found := re.findall(r"(\d+) (?:cases|paths)", row["what"])))
        worst = max((_worst(row) for row in own), default=float("nan"))
        bound = max((float(row["asked"].removeprefix("at most ")) for row in own), default=float("nan"))
        lines.append(f"| {words} | {cases or ''} | **{worst:.1e}** | {bound:g} |")
    for row in rows:
        if row["what"].startswith(FITS):
            what, _, count = row["what"].rpartition(", ")
            lines.append(f"| {what} | {count.removesuffix(' cases')} | **{row['value']}** | {row['asked']} |")
    return "\n".join(lines)


def _worst(row: Mapping[str, str]) -> float:
    found = re.match(r"worst ([\d.e+-]+)", row["value"])
    # A row that does not say is no good figure.
    return float(found[1]) if found else float("inf")
