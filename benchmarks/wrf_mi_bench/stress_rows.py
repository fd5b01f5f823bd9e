"""Rows of the stress benchmark: how many cases ran, the worst of them, and its bound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wrf_mi.core.angles import FloatArray

Row = dict[str, str]

IMAGE = 1e-4
"""Relative L2 error of what float32 renders or reports."""
GRADIENT = 1e-3
"""Relative error, in norm, of a derivative in float32."""
EXACT = 1e-5
"""Median relative error of a derivative in float64 against central differences."""
PHASE = 1e-3
"""Radians."""
UNFELT = 1e-3
"""A group whose derivatives, times its parameters, are below this share of the largest group's counts as that large."""
PLAIN = 1e-3
"""Signs are compared of derivatives that are at least this share of their group's largest."""


class Worst:
    """The largest of many errors and where it was. What is not a number is larger than any.

    Attributes:
        error: 0 before the first.
        where: of the largest.
    """

    def __init__(self) -> None:
        self.error, self.where = 0.0, ""

    def add(self, error: Any, where: str = "") -> None:
        """One more."""
        value = float(error) if np.isfinite(error) else float("inf")
        if value > self.error:
            self.error, self.where = value, where

    def row(self, what: str, bound: float, more: str = "") -> Row:
        """As a row of the table."""
        return row(what, self.error, bound, f"{f' ({self.where})' if self.where else ''}{more}")


@dataclass
class GradientWorst:
    """How far derivatives in float32 are from those in float64, group by group, each times its parameters.

    Attributes:
        error: norm of the difference over the norm.
        cosine: largest 1 - cosine of the angle between them.
        norm: largest difference of their norms' ratio from 1.
        signs: how many of those that are not small, see `PLAIN`, have another sign.
        compared: how many have been compared for that.
    """

    error: Worst = field(default_factory=Worst)
    cosine: Worst = field(default_factory=Worst)
    norm: Worst = field(default_factory=Worst)
    signs: int = 0
    compared: int = 0

    def add(
        self,
        single: Mapping[str, FloatArray],
        double: Mapping[str, FloatArray],
        values: Mapping[str, FloatArray],
        where: str = "",
        least: float = 0.0,
    ) -> None:
        """One more field.

        Args:
            single: derivatives in float32 by group.
            double: the same in float64.
            values: of the parameters.
            where: it is.
            least: a group's norm below which it counts as that large; see also `UNFELT`.
        """
        felt = {key: float(np.linalg.norm(double[key] * values[key])) for key in double}
        least = max(least, UNFELT * max(felt.values(), default=0.0))
        for key in double:
            name = f"{key}, {where}" if where else key
            mine, truth = single[key] * values[key], double[key] * values[key]
            if not np.isfinite(mine).all():
                self.error.add(np.nan, name)
                continue
            # Without any derivative at all what float32 finds counts as it is.
            self.error.add(np.linalg.norm(mine - truth) / (max(felt[key], least) or 1.0), name)
            if felt[key] <= least or not felt[key]:
                continue
            size = float(np.linalg.norm(mine))
            # 1 - cosine of nearly equal vectors from their difference: the scalar product has no digits left for it.
            unlike = np.linalg.norm(mine / size - truth / felt[key]) ** 2 / 2 if size else 1.0
            self.cosine.add(unlike, name)
            self.norm.add(abs(size / felt[key] - 1), name)
            plain = np.abs(truth) > PLAIN * np.abs(truth).max()
            self.signs += int((np.sign(mine) != np.sign(truth))[plain].sum())
            self.compared += int(plain.sum())

    def row(self, what: str, bound: float = GRADIENT) -> Row:
        """As a row of the table."""
        more = f"; cosine 1 - {self.cosine.error:.0e}, norm 1 ± {self.norm.error:.0e}"
        if self.compared:
            more += f", {self.signs} of {self.compared} signs wrong"
        return self.error.row(what, bound, more)


def row(what: str, worst: float, bound: float, more: str = "") -> Row:
    """A row of the table."""
    return {"what": what, "value": f"worst {worst:.1e}{more}", "asked": f"at most {bound:g}"}


def worst_of(row: Mapping[str, str]) -> tuple[float, float]:
    """The worst case of a row and its bound."""
    return float(row["value"].split()[1].rstrip(";")), float(row["asked"].split()[2])


def relative(error: Any, truth: Any) -> float:
    """Norm of an error over that of the truth; of the error alone where that is 0."""
    size = float(np.linalg.norm(truth))
    off = float(np.linalg.norm(error))
    return off / size if size else off
