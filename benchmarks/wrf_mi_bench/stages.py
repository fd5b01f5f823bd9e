"""The hybrid beside its parts alone, over data sets, splits and numbers of rows.

Each cell is a run of the hybrid and one of each part on the same rows. Scores are compared row by row; a part is
*clearly better* where the 95 % bootstrap interval of the mean difference lies above zero. Few rows are drawn three
times, and judged by their means. Each cell is stored when it is measured (`wrf_mi_bench.comparison.stored_part`).
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.correction import default_options, write_page
from wrf_mi.datasets import make_splits
from wrf_mi.runs.api import resume, train
from wrf_mi.runs.folder import CONFIG, is_finished
from wrf_mi.runs.results import Results, read_run
from wrf_mi.stages.correct import correct_scene
from wrf_mi.stages.scene import STAGES
from wrf_mi.synthetic import load_record
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import bootstrap
from wrf_mi_bench.random_room import random_room_record

from .bench import FLAT, RFID
from .comparison import data_folder, line, measured_on, say, stored_part
from .declared import lined
from .sources import fit_key, source_files
from .tables import scene_of_data

RUNS = Path("runs/bench/stages")
LAB, CHANNELS = "laboratory", "random-room"
CHANNELS_SEED = 12  # seed of the room of `CHANNELS`: none of `wrf_mi_bench.rooms`
ROWS: Mapping[tuple[str, str], Sequence[int | None]] = {
    (RFID, "official"): (5, 15, 48, None),
    (RFID, "blocked"): (None,),
    (LAB, "official"): (5, 15, 48, None),
    (LAB, "blocked"): (None,),
    (FLAT, "official"): (5, 15, 64, 400),
    (FLAT, "blocked"): (400,),
    (CHANNELS, "official"): (15, 100, None),
}
"""Numbers of training rows by data set and split; None: all."""
FEW, DRAWS = 50, 3  # number of rows below which they are drawn several times, and how often
LEAST_CORRECTED = 15  # rows of which a correction holds enough out
LIMITS = {"ssim": 0.01, "abs_error_db": 0.1, "cea_db": 0.5}
"""Largest loss against a part that is allowed, in the unit of the score."""
WORSE_SHARE = 0.02  # largest share of comparisons in which the hybrid may be clearly worse
INSIDE = (0.85, 0.95)  # limits of the share of test values inside the 90 % intervals
COPIED = ("train_seconds", "inside_90", "crps", "ms_per_sample", "n_train", "n_test", "constant", "constant_rmse")
"""Keys of ``metrics.json`` that are stored of each model."""
HYBRID, JOINT, CALIBRATED = "hybrid", "wrf-gs+", "ray-tracing, calibrated"
MATERIALS, CORRECTED = "ray-tracing, calibrated materials", "ray-tracing, corrected scene"
TRANSMISSION = ("transmission=true",)  # waves pass the slabs of a scene, furniture among them


@dataclass(frozen=True)
class Alone:
    """A part of the hybrid by itself: model, whether it needs the scene, and settings."""

    model: str
    scene: bool = False
    settings: tuple[str, ...] = ()


IN_A_FLAT = (*TRANSMISSION, "calibration=gain,patterns", "depth=6", "reflections=2")
ALONE: Mapping[str, Alone] = {
    "kriging": Alone("kriging"),
    "idw": Alone("idw"),
    "ray-tracing": Alone("ray-tracing", True, TRANSMISSION),
    JOINT: Alone("wrf-gs+", True),
    CALIBRATED: Alone("ray-tracing", True, IN_A_FLAT),
    MATERIALS: Alone("ray-tracing", True, (*TRANSMISSION, "calibration=gain,materials")),
}
"""Parts by name. Strengths have ray tracing with calibrated patterns in place of Gaussians, as the hybrid has none of
strengths, and of calibrated materials."""


@dataclass(frozen=True)
class Cell:
    """Data set, split, number of training rows (None: all) and seed of their draw."""

    dataset: str
    split: str
    n_train: int | None
    seed: int = 0

    @property
    def name(self) -> str:
        rows = "all" if self.n_train is None else self.n_train
        return f"{self.dataset}-{self.split}-{rows}" + (f"-seed{self.seed}" if self.seed else "")

    @property
    def title(self) -> str:
        return f"{self.dataset}, {self.split}, {'all' if self.n_train is None else self.n_train} rows"


CELLS = tuple(
    Cell(*key, count, seed)
    for key, counts in ROWS.items()
    for count in counts
    for seed in range(DRAWS if count is not None and count < FEW else 1)
)


def data_of(cell: Cell, folder: Path) -> tuple[str | Record, str | None]:
    """Data of a cell and their scene; both of a random room are made in ``folder``, the same ones each time."""
    if cell.dataset != CHANNELS:
        return cell.dataset, scene_of_data(cell.dataset, folder.parent)
    record, _, measured = random_room_record(CHANNELS_SEED, folder / CHANNELS)
    return record, str(measured)


def differences(hybrid: Results, part: Results) -> FloatArray:
    """Scores of the hybrid minus those of a part at the same receivers and rows, the higher the better."""
    task = TASKS[hybrid.task]
    pair = [np.clip(run.score[:, np.argsort(run.row)], *task.limits) for run in (hybrid, part)]
    gain = (1 if task.higher_is_better else -1) * (pair[0] - pair[1])
    return np.asarray(gain[np.isfinite(gain)], float)


def compared(hybrid: Results, others: Mapping[str, Results]) -> list[dict[str, Any]]:
    """Scores, intervals and mean differences of the hybrid and its parts; ``stages`` of the hybrid."""
    block = TASKS[hybrid.task].block
    figures = []
    for name, run in {HYBRID: hybrid, **others}.items():
        figure = {"model": name, "score": run.metrics[block], "block": block}
        figure |= {key: run.metrics.get(key) for key in COPIED}
        if name == HYBRID:
            figure["stages"] = run.metrics["stages"]
        else:
            gain = bootstrap(differences(hybrid, run), statistic=np.mean)
            figure |= {"gain": gain.value, "gain_low": gain.low, "gain_high": gain.high}
        figures.append(figure)
    return figures


def run_of_cell(cell: Cell, data: str | Record, place: Path, model: str, **more: Any) -> Results:
    """Run of a model in a folder on the rows of a cell: finished, continued or new."""
    if not (place / CONFIG).exists():
        shutil.rmtree(place, ignore_errors=True)  # stopped before its configuration was written
        train(data, model, out=place, split=cell.split, n_train=cell.n_train, seed=cell.seed, **more)
    elif not is_finished(place):
        resume(place, record=data if isinstance(data, Record) else None)
    return read_run(place)


def run_alone(cell: Cell, data: str | Record, folder: Path, name: str, scene: str | None) -> Results:
    """Run of a part by itself, as `run_of_cell`."""
    part = ALONE[name]
    more: dict[str, Any] = {"scene": scene if part.scene else None, "settings": part.settings}
    return run_of_cell(cell, data, folder / name.replace(", ", "-"), part.model, **more)


def run_in_corrected(cell: Cell, data: str | Record, scene: str, folder: Path) -> Results:
    """Run of ray tracing in the scene that the training rows of a cell with one split correct, as `run_of_cell`."""
    record, place = data if isinstance(data, Record) else load_record(data), folder / "corrected"
    if not place.exists():
        (split,) = make_splits(record, cell.split, cell.seed, cell.n_train)
        write_page(correct_scene(scene, record, split, default_options(record)), place, False)
    return run_of_cell(cell, data, folder / "in-corrected", "ray-tracing", scene=str(place), settings=TRANSMISSION)


def parts_of(task: str, scene: str | None) -> list[str]:
    """Parts that serve a task, with or without a scene."""
    unused = (JOINT, MATERIALS) if TASKS[task].in_decibel else (CALIBRATED,)
    return [name for name, part in ALONE.items() if name not in unused and (scene is not None or not part.scene)]


def measured(cell: Cell, folder: Path) -> dict[str, Any]:
    """``models``: a cell as it is stored, from runs in ``folder``, of which finished ones are used again."""
    data, scene = data_of(cell, folder)
    hybrid = run_of_cell(cell, data, folder / HYBRID, HYBRID, scene=scene)
    others = {name: run_alone(cell, data, folder, name, scene) for name in parts_of(hybrid.task, scene)}
    enough = cell.n_train is None or cell.n_train >= LEAST_CORRECTED
    if scene is not None and enough and cell.split == "official" and not TASKS[hybrid.task].in_decibel:
        others[CORRECTED] = run_in_corrected(cell, data, scene, folder)
    return {"models": compared(hybrid, others)}


def over_draws(draws: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Means of the models' figures over the draws of a cell.

    Limits of intervals are averaged, too: all draws are scored on the same test rows, so they narrow no interval.
    """
    models = [each["model"] for each in draws[0]]
    return [_mean([next(each for each in draw if each["model"] == model) for draw in draws]) for model in models]


def _mean(draws: Sequence[Any]) -> Any:
    """Mean of figures of the same form; what is no number is that of the first draw, stages kept are those of any."""
    first = draws[0]
    if isinstance(first, Mapping):
        return {key: _mean([draw[key] for draw in draws]) for key in first}
    if isinstance(first, list):  # stages, whose names differ from draw to draw
        kept_stages = [stage["stage"] for draw in draws for stage in draw if stage["kept"]]
        return [
            {"stage": name, "kept": True, "draws": kept_stages.count(name)} for name in STAGES if name in kept_stages
        ]
    return float(np.mean(draws)) if isinstance(first, (int, float)) else first


def rows_of(cell: Cell, figures: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the table: the hybrid, then each part with the hybrid's gain over it."""
    rows = []
    for part in figures:
        score, inside = part["score"], part["inside_90"]
        value = f"median {score['median']:.4g}, mean {score['mean']:.4g}"
        value += "" if inside is None else f", {inside:.0%} inside, CRPS {part['crps']:.3g}"
        asked = "85 to 95 % inside"
        if "gain" in part:
            limit = LIMITS[part["block"]]
            interval = f"{part['gain_low']:.3g} to {part['gain_high']:.3g}"
            asked = f"hybrid better by {part['gain']:.3g} ({interval}), at most {limit} worse"
        rows.append({**line(f"{cell.title}: {part['model']}", value, asked), **part, "cell": cell.name})
    return rows


def _place() -> Path:
    """Folder of the runs of this code; `InputError` where measured data are not on this machine."""
    for name in (RFID, FLAT):
        data_folder(name)
    return RUNS / fit_key(source_files())


def main() -> dict[str, Any]:
    """Measure all cells that are not stored; `InputError` where data are not on this machine.

    ``worse`` is the number of comparisons in which the hybrid is clearly worse, of ``comparisons``; ``inside`` that of
    runs of the hybrid whose intervals cover 85 to 95 %, of ``cells``; ``failed`` is there where a limit is exceeded.
    """
    place, rows, parts = _place(), list[dict[str, Any]](), dict[Cell, dict[str, Any]]()
    for count, cell in enumerate(CELLS, 1):
        say("stages", f"{count} of {len(CELLS)}: {cell.title}, seed {cell.seed}")
        parts[cell] = stored_part("stages", cell.name, partial(measured, cell, place / cell.name))
        for row in rows_of(cell, parts[cell]["models"]):
            say("stages", f"{row['what']}: {row['value']}; {row['asked']}")
    for cell in CELLS:
        if cell.seed == 0:
            draws = [parts[each]["models"] for each in CELLS if each.title == cell.title]
            rows += rows_of(cell, over_draws(draws) if len(draws) > 1 else draws[0])
    return {"rows": rows, "measured": measured_on(parts.values()), **_verdict(rows)}


def _verdict(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    pairs = [row for row in rows if "gain" in row]
    worse = [row for row in pairs if row["gain_high"] < 0]
    beyond = [row for row in pairs if row["gain"] < -LIMITS[row["block"]]]
    hybrids = [row for row in rows if "gain" not in row and row["inside_90"] is not None]
    inside = [row for row in hybrids if INSIDE[0] <= row["inside_90"] <= INSIDE[1]]
    counts: dict[str, Any] = {"comparisons": len(pairs), "worse": len(worse)}
    counts |= {"cells": len(hybrids), "inside": len(inside)}
    if len(worse) > WORSE_SHARE * len(pairs) or beyond:
        text = f"clearly worse than a part alone in {len(worse)} of {len(pairs)} comparisons"
        counts["failed"] = f"{text}, by more than the limit in {len(beyond)}"
    return counts


SAME = 1e-6  # difference of mean scores below which two models predict the same


def _with_best_part(row: Mapping[str, Any], parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    best = min(parts, key=lambda part: part["gain"])
    inside = "" if row["inside_90"] is None else f"{row['inside_90']:.0%}"
    draws = [f" ({stage['draws']} of {DRAWS})" if stage.get("draws", DRAWS) < DRAWS else "" for stage in row["stages"]]
    kept_stages = ", ".join(
        stage["stage"] + of for stage, of in zip(row["stages"], draws, strict=True) if stage["kept"]
    )
    return {"title": row["what"].rpartition(":")[0], "row": row, "best": best, "inside": inside, "kept": kept_stages}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The hybrid, its kept stages and its best part by mean score; without rows on which both predict the same."""
    cells = [[row for row in rows if row["cell"] == cell] for cell in dict.fromkeys(row["cell"] for row in rows)]
    return lined(
        "| data | hybrid | inside | kept stages | best part alone | gain over it |",
        "| {title} | **{row[score][median]:.3g}** | {inside} | {kept} | {best[model]} {best[score][median]:.3g} "
        "| {best[gain]:.2g} ({best[gain_low]:.2g} to {best[gain_high]:.2g}) |",
        lambda shown: shown if abs(shown["best"]["gain"]) >= SAME else None,
    )([_with_best_part(hybrid, parts) for hybrid, *parts in cells])
