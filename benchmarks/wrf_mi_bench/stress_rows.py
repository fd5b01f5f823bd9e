"""Rows of the stress benchmark: number of cases, worst error and bound; and their summary for the README."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wrf_mi.backend import init
from wrf_mi.core.angles import FloatArray

init()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

Row = dict[str, str]
DOUBLE: Any = dr.float64_array_t(mi.Float)

IMAGE = 1e-4  # bound on the relative L2 error of float32 images and reports
GRADIENT = 1e-3  # bound on the relative error, in norm, of a derivative in float32
EXACT = 1e-5  # bound on the median relative error of a derivative in float64 against central differences
PHASE = 1e-3  # bound on the error of a phase, rad
UNFELT = 1e-3  # floor of the norm of a group's derivatives times parameters, as a share of the largest group's
PLAIN = 1e-3  # share of a group's largest derivative above which signs are compared
NEITHER = "0 neither"  # bound of the row on fits: no fit with values that are not finite and no message
FITS = "fits with random bad"

STAGES = (
    ("images of random and hard fields", r"image,"),
    ("derivatives of images, float32 against float64", r"derivatives, "),
    ("derivatives of all models in float64, against differences", r"derivatives of (wrf|factorised)"),
    ("receivers: spectra, RSSI, CSI", r"receiver: (?!derivatives)"),
    ("derivatives of receivers", r"receiver: derivatives"),
    ("losses", r"loss: (?!.*differences)"),
    ("phase of paths to 10 km, rad", r"phase"),
    ("paths and Gaussians together", r"joint: (?!derivatives)"),
    ("derivatives of paths and Gaussians together, against float64", r"joint: derivatives"),
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
        return row(what, self.error, bound, f"{f' ({self.where})' if self.where else ''}{more}")


@dataclass
class GradientWorst:
    """Largest differences of derivatives in float32 from float64, by group, each times its parameters."""

    error: Worst = field(default_factory=Worst)  # norm of the difference over the norm
    cosine: Worst = field(default_factory=Worst)  # 1 - cosine of the angle between both
    norm: Worst = field(default_factory=Worst)  # difference of the ratio of their norms from 1
    signs: int = 0  # number of wrong signs among derivatives above `PLAIN`
    compared: int = 0  # number of signs compared

    def add(
        self,
        single: Mapping[str, FloatArray],
        double: Mapping[str, FloatArray],
        values: Mapping[str, FloatArray],
        where: str = "",
        least: float = 0.0,
    ) -> None:
        """Include the derivatives of a case; ``least`` and `UNFELT` are floors of a group's norm."""
        felt = {key: float(np.linalg.norm(double[key] * values[key])) for key in double}
        least = max(least, UNFELT * max(felt.values(), default=0.0))
        for key in double:
            name = f"{key}, {where}" if where else key
            derivative, truth = single[key] * values[key], double[key] * values[key]
            if not np.isfinite(derivative).all():
                self.error.add(np.nan, name)
                continue
            # Where the true derivative is zero the error is absolute.
            self.error.add(np.linalg.norm(derivative - truth) / (max(felt[key], least) or 1.0), name)
            if felt[key] <= least or not felt[key]:
                continue
            size = float(np.linalg.norm(derivative))
            # 1 - cosine of nearly equal vectors from their difference: the scalar product has no digits left for it.
            unlike = np.linalg.norm(derivative / size - truth / felt[key]) ** 2 / 2 if size else 1.0
            self.cosine.add(unlike, name)
            self.norm.add(abs(size / felt[key] - 1), name)
            plain = np.abs(truth) > PLAIN * np.abs(truth).max()
            self.signs += int((np.sign(derivative) != np.sign(truth))[plain].sum())
            self.compared += int(plain.sum())

    def row(self, what: str, bound: float = GRADIENT) -> Row:
        more = f"; cosine 1 - {self.cosine.error:.0e}, norm 1 ± {self.norm.error:.0e}"
        if self.compared:
            more += f", {self.signs} of {self.compared} signs wrong"
        return self.error.row(what, bound, more)


def row(what: str, worst: float, bound: float, more: str = "") -> Row:
    return {"what": what, "value": f"worst {worst:.1e}{more}", "asked": f"at most {bound:g}"}


def worst_of(row: Mapping[str, str]) -> tuple[float, float]:
    """Worst error of a row and its bound."""
    return float(row["value"].split()[1].rstrip(";")), float(row["asked"].split()[2])


def held(row: Row) -> bool:
    if row["asked"] == NEITHER:
        return row["value"].endswith(" 0 did neither")
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
        # Where a row states paths and cases, the cases come last.
        counts = [re.findall(r"(\d+) (?:cases|paths)", row["what"]) for row in members]
        worst, bound = zip(*map(worst_of, members), strict=True) if members else ((float("nan"),), (float("nan"),))
        titled.append((title, sum(int(count[-1]) for count in counts if count), max(worst), max(bound)))
    return titled
