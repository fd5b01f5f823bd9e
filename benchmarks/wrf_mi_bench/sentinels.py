"""Sentinels: figures of every task and family of models, measured again and compared with stored ones.

They take three quarters of an hour on two cores, the tables many hours. Each figure has an interval of equality:

| figures | interval |
| --- | --- |
| medians of the tables (all training rows, seed 0) | 95 % interval of the stored median over its test rows |
| paths that MATLAB's image method has, found again | 95 % Wilson interval of the stored share over these paths |
| worst errors of `stress` and of the Mitsuba integrator, fewer of the same cases | up to the bound of that benchmark |

Results are kept by the content of the packages' files (`wrf_mi_bench.sources.source_files`): a stopped call is
resumed, and changed code is measured again.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, quantile_test

from wrf_mi.apps.table.entries import read_entry
from wrf_mi.core import InputError
from wrf_mi.core.files import one_line, write_atomically
from wrf_mi.runs.sweep import dataset_files
from wrf_mi.tasks import TASKS

from .bench import FLAT, RFID, BenchFailed
from .comparison import STORED, say
from .declared import lined
from .sources import fit_key, source_files
from .stress_rows import stages
from .table_pages import STORED as ENTRIES
from .table_plan import Row, available, plan
from .tables import measure

RUNS = Path("runs/bench/sentinels")
TABLE_ROWS = (
    *(f"spectrum-{RFID}-official-{name}" for name in ("kriging", "vae", "dcgan", "ray-tracing", "wrf-gs+")),
    *(f"spectrum-{RFID}-blocked-{name}" for name in ("idw", "kriging", "wrf-gs")),
    *(f"rssi-{FLAT}-official-{name}" for name in ("idw", "kriging", "trees", "mri", "wrf-gs", "nerf2")),
    *(f"csi-traced-csi-flat-official-{name}" for name in ("linear", "fire", "optml", "wrf-gs")),
)
"""Rows of the tables with all training rows and seed 0, of at most five minutes each."""
CONFIDENCE = 0.95
FIELDS = 5  # random fields of the integrator's comparison with splatting, of the 20 that are stored
EQUAL, BETTER, WORSE, FAILED, ABSENT = "equal", "better", "worse", "failed", "not on this machine"


@dataclass(frozen=True)
class Figure:
    """A stored figure: name with its unit, value, ends of its interval of equality, and whether higher is better."""

    name: str
    stored: float
    low: float
    high: float
    higher_is_better: bool

    def verdict(self, measured: float) -> str:
        """``equal`` inside the interval, else ``better`` or ``worse``; NaN is worse."""
        if self.low <= measured <= self.high:
            return EQUAL
        return BETTER if (measured > self.high if self.higher_is_better else measured < self.low) else WORSE

    def row(self, measured: float | None, verdict: str, why: str = "") -> dict[str, Any]:
        """Row of the table; ``measured`` is None where the measurement failed, for the reason ``why``."""
        value = verdict if measured is None else f"{measured:.4g}, {verdict}"
        return {
            "what": self.name,
            "value": f"{value}: {why}" if why else value,
            "asked": f"{self.stored:.4g} ({self.low:.4g} to {self.high:.4g}), or better",
            **{"stored": self.stored, "low": self.low, "high": self.high, "measured": measured, "verdict": verdict},
        }


@dataclass(frozen=True)
class Group:
    name: str  # name for files and progress
    figures: tuple[Figure, ...]  # stored figures
    measure: Callable[[Path], Sequence[float]]  # function from the folder of runs to the figures' values
    present: bool = True  # whether the data are on this machine or can be made here


def median_interval(quantiles: Sequence[float], rows: int) -> tuple[float, float]:
    """Distribution-free 95 % interval of a median over test rows, from equally spaced quantiles of their scores.

    Source: order statistics and the binomial distribution, Conover, "Practical Nonparametric Statistics" (1999),
    section 3.2; `scipy.stats.quantile_test`.
    """
    scores = np.interp(np.linspace(0, 1, rows), np.linspace(0, 1, len(quantiles)), quantiles)
    interval = quantile_test(scores, p=0.5).confidence_interval(CONFIDENCE)
    return float(interval.low), float(interval.high)


def _stored(name: str) -> dict[str, Any]:
    path = STORED / f"{name}.json"
    if not path.exists():
        raise InputError(f"{path}: stored figures are not on this machine; call it in a checkout that has them")
    result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return result


def _of_table(row: Row) -> Group:
    stored, task = read_entry(ENTRIES / f"{row.name}.json"), TASKS[row.part.task]
    if stored.command != row.command:
        raise InputError(f"{row.name}: the tables plan it otherwise than it is stored; run wrf-mi bench tables first")
    low, high = median_interval(stored.quantiles, stored.n_test or 0)
    name = f"{row.part.dataset}, {row.part.split}: {row.method}, median {task.label}"
    figure = Figure(name, stored.score["median"], low, high, task.higher_is_better)

    def again(runs: Path) -> list[float]:
        measured = measure(runs, row)
        if stored.data not in (None, measured.data):
            raise InputError(f"{row.part.dataset}: other content than the stored figure's; fetch it again")
        return [measured.score["median"]]

    return Group(row.name, (figure,), again, available(row.part))


def _stress() -> Group:
    def again(_: Path) -> list[float]:
        from .stress import quick_rows

        return [worst for _, _, worst, _ in stages(quick_rows())]

    stress_stages = stages(_stored("stress")["figures"]["rows"])
    figures = [
        Figure(f"stress, {name}: worst error", worst, 0.0, bound, False) for name, _, worst, bound in stress_stages
    ]
    return Group("stress", tuple(figures), again)


def _integrator() -> Group:
    from .traced import LARGEST_ERROR, LOWEST_SSIM, against_splatted, worst

    def again(_: Path) -> list[float]:
        errors = worst(against_splatted(FIELDS))
        return [errors["lowest_ssim"], errors["largest_complex_error"]]

    stored = _stored("side-by-side")["figures"]["small"]
    words = "Mitsuba integrator against splatting"
    ssim = Figure(f"{words}, lowest SSIM", stored["lowest_ssim"], LOWEST_SSIM, 1.0, True)
    error = Figure(f"{words}, largest L2 error", stored["largest_complex_error"], 0.0, LARGEST_ERROR, False)
    return Group("integrator", (ssim, error), again)


def _image_method(room: str, stored: Mapping[str, Any]) -> Group:
    def again(_: Path) -> list[float]:
        from .trace import image_method_agreement, room_file

        return [image_method_agreement(room_file(room))["share_found"]]

    interval = binomtest(stored["paths_found"], stored["paths_matlab"]).proportion_ci(CONFIDENCE, "wilson")
    words = f"image method, {room}: share of MATLAB's paths found"
    figure = Figure(words, stored["share_found"], float(interval.low), float(interval.high), True)
    return Group(f"image-method-{room}", (figure,), again, bool(dataset_files(f"newrf-{room}")))


def groups() -> list[Group]:
    """All sentinels, with their stored figures."""
    planned = {row.name: row for row in plan()}
    if gone := [name for name in TABLE_ROWS if f"{name}-100-seed0" not in planned]:
        raise InputError(f"sentinel {gone[0]}: no row of the tables any more; choose another")
    rooms = _stored("image-method")["figures"]["rooms"]
    return [
        *(_image_method(room, stored) for room, stored in rooms.items()),
        _integrator(),
        _stress(),
        *(_of_table(planned[f"{name}-100-seed0"]) for name in TABLE_ROWS),
    ]


def main() -> dict[str, Any]:
    """Measure all sentinels whose data are on this machine, unless this code was measured before.

    Rows have, of each figure, ``what``, ``stored``, ``low``, ``high``, ``measured`` (or None), ``verdict``, and
    ``date`` and ``seconds`` of its group; ``failed`` is a line, where a figure got worse or was not measured.
    """
    sentinel_groups = groups()
    place = RUNS / fit_key(source_files())
    place.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    begun = time.perf_counter()
    for count, group in enumerate(sentinel_groups, 1):
        minutes = (time.perf_counter() - begun) / 60
        say("sentinels", f"{count} of {len(sentinel_groups)} after {minutes:.0f} min: {group.name}")
        group_rows = _rows(group, place)
        rows += group_rows
        for row in group_rows:
            say("sentinels", f"{row['what']}: {row['value']}; stored {row['asked']}")
    return {"rows": rows, **_failure(rows)}


def _rows(group: Group, place: Path) -> list[dict[str, Any]]:
    if not group.present:
        return [figure.row(None, ABSENT) for figure in group.figures]
    file = place / f"{group.name}.json"
    try:
        if not file.exists():
            begun = time.perf_counter()
            values = [float(value) for value in group.measure(place)]
            measured = {"values": values, "date": time.strftime("%Y-%m-%d"), "seconds": time.perf_counter() - begun}
            write_atomically(file, json.dumps(measured))
        content = json.loads(file.read_text())
        more = {"date": content["date"], "seconds": content["seconds"]}
        pairs = zip(group.figures, content["values"], strict=True)
        return [figure.row(value, figure.verdict(value)) | more for figure, value in pairs]
    except (InputError, BenchFailed, OSError, RuntimeError, ValueError, KeyError) as error:
        return [figure.row(None, FAILED, one_line(error)) for figure in group.figures]


def _failure(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    lost = [row for row in rows if row["verdict"] in (WORSE, FAILED)]
    if not lost:
        return {}
    first = f"{lost[0]['what']}: {lost[0]['value']}, stored {lost[0]['asked']}"
    return {"failed": f"{len(lost)} of {len(rows)} figures got worse or were not measured, first {first}"}


table = lined(
    "| figure | stored | equal within | measured | verdict |",
    "| {what} | {stored:.4g} | {low:.4g} to {high:.4g} | {shown} | {verdict} |",
    lambda row: {**row, "shown": "" if row["measured"] is None else f"{row['measured']:.4g}"},
)
