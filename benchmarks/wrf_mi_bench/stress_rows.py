"""Rows of the stress benchmark: number of cases, worst error and bound; and their summary for a document."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from wrf_mi.core.angles import FloatArray

Row = dict[str, str]

IMAGE = 1e-4  # bound on the relative L2 error of float32 images and observations
GRADIENT = 1e-3  # bound on the relative error, in norm, of a derivative in float32
UNFELT = 1e-3  # floor of the norm of a group's derivatives times parameters, as a share of the largest group's

STAGES = (
    ("images of random and hard fields", r"image,"),
    ("derivatives of images, float32 against float64", r"derivatives, "),
    ("receivers: spectra, RSSI, CSI", r"receiver: (?!derivatives)"),
    ("derivatives of receivers", r"receiver: derivatives"),
    ("Mitsuba plugins: images", r"plugin: image"),
    ("Mitsuba plugins: derivatives", r"plugin: derivatives"),
)
"""Title of each stage and pattern of the beginning of its rows."""


class Worst:
    """The largest of many errors and its case; NaN counts as infinite."""

    def __init__(self) -> None:
        self.error, self.where = 0.0, ""

    def add(self, error: Any, where: str = "") -> None:
        value = float(error) if np.isfinite(error) else float("inf")
        if value > self.error:
            self.error, self.where = value, where

    def row(self, what: str, bound: float, more: str = "") -> Row:
        where = f" ({self.where})" if self.where else ""
        return {"what": what, "value": f"worst {self.error:.1e}{where}{more}", "asked": f"at most {bound:g}"}


def gradient_errors(
    single: Mapping[str, FloatArray], double: Mapping[str, FloatArray], values: Mapping[str, FloatArray]
) -> Iterator[tuple[str, float]]:
    """Norm of the difference of derivatives in float32 and float64 over their norm, by group of parameters.

    Derivatives are multiplied by the parameters' ``values``, which makes them comparable; `UNFELT` is the floor of a
    group's norm. Where all true derivatives are zero, the error is absolute.
    """
    norms = {name: float(np.linalg.norm(double[name] * values[name])) for name in double}
    least = UNFELT * max(norms.values(), default=0.0)
    for name, norm in norms.items():
        difference = (single[name] - double[name]) * values[name]
        yield name, float(np.linalg.norm(difference)) / (max(norm, least) or 1.0)


def worst_of(row: Mapping[str, str]) -> tuple[float, float]:
    """Worst error of a row and its bound."""
    return float(row["value"].split()[1].rstrip(";")), float(row["asked"].split()[2])


def held(row: Row) -> bool:
    """Whether the worst error of a row is within its bound."""
    worst, bound = worst_of(row)
    return worst <= bound


def relative(error: Any, truth: Any) -> float:
    """Norm of an error relative to the truth's, or absolute where that is 0."""
    return float(np.linalg.norm(error)) / (float(np.linalg.norm(truth)) or 1.0)


def stages(rows: Sequence[Mapping[str, str]]) -> list[tuple[str, int, float, float]]:
    """Title, number of cases, worst error and widest bound of each of `STAGES`; NaN for a stage without rows."""
    titled = []
    for title, begins in STAGES:
        members = [row for row in rows if re.match(begins, row["what"])]
        counts = [re.findall(r"(\d+) cases", row["what"]) for row in members]
        worst, bound = zip(*map(worst_of, members), strict=True) if members else ((float("nan"),), (float("nan"),))
        titled.append((title, sum(int(count[-1]) for count in counts), max(worst), max(bound)))
    return titled
