"""Where to measure next: errors of maps by number of rows, of planned rows and of random ones.

From ten random training rows, rows are added ten at a time, a model is fitted to them, and its error on the official
test rows is stored. Added rows are random ones, or each the farthest from all before, as `wrf_mi.apps.maps.plan` does
it. Strengths are predicted by kriging about the local mean of the power traced in a known scene, as by the hybrid's
mean and residual, spectra by kriging of their pixels. A scene is traced once for all fits.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import wrf_mi
from wrf_mi.apps.maps.plan import farthest_points
from wrf_mi.core import Record
from wrf_mi.core.files import write_figure
from wrf_mi.core.types import IntArray
from wrf_mi.datasets import make_splits
from wrf_mi.estimators.interpolation.kriging import Kriging
from wrf_mi.estimators.interpolation.strengths import fit_strengths
from wrf_mi.models import Inputs
from wrf_mi.scene.make import make_scene
from wrf_mi.stages.strengths import SMOOTH_M, SPACING_M, TRACE
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tasks import RSSI
from wrf_mi.tasks.scores import bootstrap
from wrf_mi.tracing.power_map import trace_map
from wrf_mi.tracing.sionna.scenes import open_scene

from .bench import FLAT
from .comparison import data_folder, line, measured_on, say, stored_part
from .declared import lined
from .random_room import random_room_record

PICTURE = Path("docs/images/planned-rows.png")  # written only in a checkout of the project
SIZES = (10, 20, 30, 40, 50, 60)
STARTS = range(10)
MOST_CANDIDATES, MOST_TESTS = 400, 400  # training rows among which rules choose, and test rows, drawn at random
MOST_RECEIVERS = 6
COARSE = slice(None, None, 3)  # every third row and column of a spectrum
RANDOM, PLAN = "random", "plan"
RULES = (RANDOM, PLAN)
ASKED = "not clearly worse than random rows"
Errors = dict[str, list[list[float]]]  # scores by rule, start and number of rows


@dataclass(frozen=True)
class Place:
    """Data, rows that rules choose from, test rows, and their predictions [n_rx, m, ...] by a model fitted to rows."""

    record: Record
    able: IntArray
    test: IntArray
    fit: Callable[[IntArray], Any]

    def score(self, rows: IntArray) -> float:
        """Mean over test rows and receivers of a model that is fitted to rows."""
        truth = self.record.observation[:, self.test]
        return float(np.nanmean(self.record.task.of_rows(self.fit(rows), truth)))


def _drawn(record: Record, in_scene: bool) -> tuple[Record, IntArray, IntArray]:
    """Rows among which rules choose and test rows, and the record that has only these, and few receivers."""
    official = make_splits(record, "official")[0]
    drawn = [
        np.sort(np.random.default_rng(number).permutation(rows)[:most])
        for number, (rows, most) in enumerate([(official.all_train, MOST_CANDIDATES), (official.test, MOST_TESTS)])
    ]
    rows, able = np.concatenate(drawn), np.arange(len(drawn[0]))
    receivers = np.arange(len(record.receivers))[:: -(-len(record.receivers) // MOST_RECEIVERS)]
    values = record.observation[receivers][:, rows]
    thinned = Record(
        record.name,
        record.task,
        record.tx_pos_m[rows],
        tuple(record.receivers[number] for number in receivers),
        values if in_scene else values[..., COARSE, COARSE],
        frequencies_hz=record.frequencies_hz,
        tx_heading_rad=None if record.tx_heading_rad is None else record.tx_heading_rad[rows],
    )
    return thinned, able, np.arange(len(able), len(rows))


def _strengths(full: Record, scene: Path) -> Place:
    record, able, test = _drawn(full, in_scene=True)
    assert record.frequencies_hz is not None
    opened = open_scene(scene, float(record.frequencies_hz[0]))
    mean = trace_map(opened, record, SPACING_M, SMOOTH_M, TRACE)
    heading, receivers = record.tx_heading_rad, range(len(record.receivers))
    inputs = Inputs(record.tx_pos_m[test], None if heading is None else heading[test])

    def fit(rows: IntArray) -> Any:
        fitted = fit_strengths(record, rows, mean)
        return np.stack([fitted.predict_mean(inputs, receiver) for receiver in receivers])

    return Place(record, able, test, fit)


def _flat(folder: Path) -> Place:
    plan_file = data_folder(FLAT) / "layout.csv"
    return _strengths(wrf_mi.load(FLAT), make_scene(plan_file, folder / "scene", height_m=2.7).folder)


def _scanned(name: str, folder: Path) -> Place:
    record = wrf_mi.load(name)
    return _strengths(record, make_scene(Path(record.source) / SCAN, folder / "scene").folder)


def _room(seed: int, folder: Path) -> Place:
    record, _, scan = random_room_record(seed, folder)
    power_mw = np.square(np.abs(record.observation)).mean(axis=-1)  # of 80 MHz, for 0 dBm sent
    assert record.frequencies_hz is not None
    carrier_hz = record.frequencies_hz.mean(keepdims=True)
    strengths = replace(record, task=RSSI, truth=None, observation=10 * np.log10(power_mw), frequencies_hz=carrier_hz)
    return _strengths(strengths, scan)


def _spectra(name: str, folder: Path) -> Place:
    record, able, test = _drawn(wrf_mi.load(name), in_scene=False)
    values = record.observation[0].astype(float)

    def fit(rows: IntArray) -> Any:
        return Kriging().fit(record.tx_pos_m[rows], values[rows]).predict(record.tx_pos_m[test])[None]

    return Place(record, able, test, fit)


PLACES: Mapping[str, Callable[[Path], Place]] = {
    FLAT: _flat,
    "traced-floor-receivers": partial(_scanned, "traced-floor-receivers"),
    "laboratory": partial(_spectra, "laboratory"),
    "traced-room": partial(_spectra, "traced-room"),
    **{f"random room {seed}": partial(_room, seed) for seed in (201, 202, 203, 204)},
}


def next_rows(rule: str, place: Place, rows: IntArray, count: int, seed: int) -> IntArray:
    """Rows that a rule adds to others."""
    left, positions_m = np.setdiff1d(place.able, rows), place.record.tx_pos_m
    if rule == RANDOM:
        return np.random.default_rng([seed, len(rows)]).choice(left, count, replace=False)
    return left[farthest_points(positions_m[left], count, positions_m[rows])[0]]


def scores_of(place: Place, rule: str, start: int) -> list[float]:
    """Scores by the number of rows, from one start."""
    rows, scores = np.sort(np.random.default_rng([start, 7]).permutation(place.able)[: SIZES[0]]), list[float]()
    for size, following in zip(SIZES, (*SIZES[1:], SIZES[-1]), strict=True):
        scores.append(place.score(rows))
        if following > size:
            rows = np.sort(np.concatenate([rows, next_rows(rule, place, rows, following - size, start)]))
    return scores


def measure(name: str) -> dict[str, Any]:
    """Scores of all rules and starts at a place."""
    errors: Errors = {}
    with tempfile.TemporaryDirectory() as folder:
        place = PLACES[name](Path(folder))
    for rule in RULES:
        errors[rule] = [scores_of(place, rule, start) for start in STARTS]
        say("plan", f"{name}, {rule}: " + ", ".join(f"{score:.3g}" for score in np.mean(errors[rule], axis=0)))
    return {"errors": errors, "higher_is_better": place.record.task.higher_is_better}


def row_of(name: str, part: Mapping[str, Any]) -> dict[str, Any]:
    """Row of the table: mean scores, gain over random rows, and planned rows that equal 60 random ones."""
    errors = {rule: np.asarray(part["errors"][rule]) for rule in RULES}
    sign = 1 if part["higher_is_better"] else -1
    means = {rule: values.mean(axis=0) for rule, values in errors.items()}
    gain = bootstrap(sign * (errors[PLAN] - errors[RANDOM])[:, 1:].mean(axis=1), statistic=np.mean)
    reached = np.flatnonzero(sign * (means[PLAN] - means[RANDOM][-1]) >= 0)
    value = f"{means[PLAN][2]:.3g} with 30 planned rows, {means[RANDOM][-1]:.3g} with 60 random ones"
    return {
        **line(name, value, ASKED),
        "mean": {rule: mean.tolist() for rule, mean in means.items()},
        "gain": [gain.value, gain.low, gain.high],
        "equal": SIZES[reached[0]] if len(reached) else None,
        "label": "SSIM" if part["higher_is_better"] else "error, dB",
    }


def main() -> dict[str, Any]:
    """Measure the places that are not stored; ``failed`` where random rows are clearly better than planned ones."""
    data_folder(FLAT)
    parts = {name: stored_part("plan", name.replace(" ", "-"), partial(measure, name)) for name in PLACES}
    rows = [row_of(name, part) for name, part in parts.items()]
    result: dict[str, Any] = {"rows": rows, "measured": measured_on(parts.values())}
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, picture(rows))
    worse = [row["what"] for row in rows if row["gain"][2] < 0]
    return result | ({"failed": f"clearly worse than random rows: {', '.join(worse)}"} if worse else {})


table = lined(
    "| place | gain over random | planned rows as good as 60 random |",
    "| {what} | {gain[0]:.3f} ({gain[1]:.3f} to {gain[2]:.3f}) | {shown} |",
    lambda row: {**row, "shown": row["equal"] or "more than 60"},
)
"""Gains of planned rows; `picture` shows the scores."""


def picture(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Scores of each rule by the number of rows, a panel for each place."""
    figure = Figure(figsize=(11, 5), layout="constrained", facecolor="white")
    panels = figure.subplots(2, -(-len(rows) // 2), squeeze=False).ravel()
    for axes, row in zip(panels, rows, strict=False):
        for rule, colour in zip(RULES, ("0.6", "#c1121f"), strict=True):
            axes.plot(SIZES, row["mean"][rule], ".-", color=colour, linewidth=1.2, label=rule)
        axes.set(xlabel="rows", ylabel=row["label"])
        axes.set_title(row["what"], fontsize=9)
    for axes in panels[len(rows) :]:
        axes.set_axis_off()
    panels[0].legend(fontsize=7)
    return figure
