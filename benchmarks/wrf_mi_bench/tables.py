"""Every method of the paper in one table for each task, measured by the project's own command.

Each row is a run of ``wrf-mi train`` in a process of its own. It is written down the moment it is done, as a JSON file
among the results, so an interrupted measurement goes on where it stopped, on another machine too. A row is measured
again where the plan has other arguments for it by now, where the data set has other content than the row states, or
where its file is deleted; a stored row that other versions of packages measured is kept and said. The folder of a run
has a key of command, data, scene and versions in its name (`wrf_mi.runs.fit_key`), so a finished run is used again
only for the same fit. The rows of `wrf_mi_bench.table_plan` are in an order that makes tables whole early.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.furnished import write_scene

from wrf_mi.core import InputError
from wrf_mi.core.files import atomic_folder, one_line, write_atomically
from wrf_mi.datasets.registry import locate
from wrf_mi.parallel import Scheduler, run_module
from wrf_mi.runs.fit_key import content_digest, dataset_files, fit_key, scene_files
from wrf_mi.runs.folder import CONFIG, METRICS, package_versions, versions
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.floor_channels import MEASURED
from wrf_mi.synthetic.furnished_room import traced_room
from wrf_mi.tasks.scores import summary

from .bench import BenchFailed, machine, threads
from .physics_csi import SCANNED, scanned_scene
from .table_pages import read_rows, write_tables
from .table_plan import NAMED, Part, Row, available, plan

FOLDER = "tables"
"""In the folder of results; ``tables-quick`` for the small version."""
QUANTILES = 101
"""Of the scores of a row, equally spaced shares: what a distribution is drawn from."""
FLAT_HEIGHT_M = 2.7
"""Ceiling of the flat whose layout has none."""
FAR_M, PLATE_M = 100.0, 0.01
"""Where a scene's only surface is, and its edge: Sionna RT opens none without any."""
SCAN_SEED = 1
"""Of the noise of simulated scans."""
KEPT = ("n_train", "n_test", "train_seconds", "ms_per_sample", "peak_memory_mb", "reference")


def scene_of(part: Part, folder: Path) -> list[str]:
    """Arguments that name the scene of a part, which is made in ``folder`` where nobody has made it.

    Raises:
        InputError: data that are not on this machine.
    """
    if part.scene == "open":
        return ["--scene", str(_once(folder / f"open-{fit_key(FAR_M, PLATE_M)}", _open_scene))]
    if part.scene == "room":
        return ["--scene", str(traced_room()[1])]
    if part.scene == "floor":
        load_record(part.dataset)  # makes it where nobody has
    place = locate(part.dataset)
    if place is None:
        raise InputError(f"data set {part.dataset}: not on this machine; see wrf-mi data list")
    if part.scene == "floor":
        return ["--scene", str(place / MEASURED)]
    if part.scene == "flat":
        layout = place / "layout.csv"
        made = folder / f"flat-{fit_key(layout, FLAT_HEIGHT_M)}"
        if not made.exists():
            make_scene(layout, made, height_m=FLAT_HEIGHT_M)  # whole, or not at all
        return ["--scene", str(made)]
    # The room's own mesh is what the data were computed with: a model is given one made from a scan, as on site.
    paths = place / f"{part.dataset.removeprefix('newrf-')}.npz"
    place = folder / f"{part.dataset}-{fit_key(place, SCAN_SEED)}"
    scanned = _once(place, lambda made: scanned_scene(paths, made, SCAN_SEED))
    return ["--scene", str(scanned / SCANNED)]


def _once(place: Path, make: Callable[[Path], object]) -> Path:
    """A folder that is made where there is none: whole, or not at all."""
    if not place.exists():
        with atomic_folder(place, False) as part:
            make(part)
    return place


def _open_scene(folder: Path) -> None:
    plate = sheet(0, FAR_M, (FAR_M, FAR_M + PLATE_M), (FAR_M, FAR_M + PLATE_M))
    write_scene(folder, {"plate": ("itu_wood", plate)}, "Nothing but a small plate far away")


def _scene(part: Part, runs: Path) -> list[str]:
    return scene_of(part, runs / "scenes") if part.scene else []


def measure(runs: Path, row: Row) -> dict[str, Any]:
    """One row: the run, unless the same one is finished, and its figures.

    Raises:
        BenchFailed: the command ended with an error.
        InputError: data or a scene that are not on this machine.
    """
    scene = _scene(row.part, runs) if NAMED in row.entry.arguments else []
    data = _data_digest(row.part.dataset)
    folder = runs / f"{row.name}-{fit_key(row.command, data, [scene_files(place) for place in scene[1:]])}"
    arguments = row.arguments(scene)
    wall = None
    if (folder / METRICS).exists():
        print(f"tables: {row.name}: finished before in {folder}, with the same data and versions", file=sys.stderr)
    else:
        # Tracing takes seconds and has nothing to go on from.
        resumed = (folder / CONFIG).exists() and row.method != "ray-tracing"
        if folder.exists() and not resumed:
            shutil.rmtree(folder)  # stopped before it said what it is
        call = ["train", "--resume", str(folder)] if resumed else [*arguments, "--out", str(folder)]
        start = time.perf_counter()
        status, said = run_module("wrf_mi.cli", call)
        if status != 0:
            raise BenchFailed(f"`wrf-mi {' '.join(call)}` ended with status {status} {said}".rstrip())
        wall = None if resumed else time.perf_counter() - start
    run = read_run(folder)
    scores = np.sort(run.score[~np.isnan(run.score)])
    return {
        "row": row.name,
        "label": row.entry.label,
        "share": row.share,
        "seed": row.seed,
        "command": row.command,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(),
        "versions": versions(),
        "data": data,
        "wall_seconds": wall,
        **threads(),
        **{key: run.metrics[key] for key in KEPT},
        "score": summary(scores),
        "quantiles": [round(float(q), 5) for q in np.quantile(scores, np.linspace(0, 1, QUANTILES))],
    }


def tables(
    out: Path, runs: Path, quick: bool = False, scheduler: Scheduler | None = None, most_s: float | None = None
) -> list[dict[str, Any]]:
    """Measure all rows that are not stored yet and write tables and pictures.

    A row whose command fails is reported and left out; the others go on.

    Args:
        out: folder of results; rows go to ``tables/`` in it, or ``tables-quick/``.
        runs: folder for run folders.
        quick: the small version.
        scheduler: whose workers measure a row each at a time; None: this process.
        most_s: no row is begun after so many seconds; None: all are.

    Returns:
        All stored rows.

    Raises:
        BenchFailed: rows that did not finish, after all others.
    """
    place = out / (f"{FOLDER}-quick" if quick else FOLDER)
    place.mkdir(parents=True, exist_ok=True)
    rows = plan(quick)
    missing = sorted({row.part.dataset for row in rows if not available(row.part)})
    for name in missing:
        print(f"tables: data set {name} is not on this machine and is left out; see wrf-mi data list", file=sys.stderr)
    stored, digests = {one["row"]: one for one in read_rows(place)}, dict[str, str]()
    left = [row for row in rows if available(row.part) and not _holds(stored.get(row.name), row, digests)]
    print(f"tables: {len(left)} of {len(rows)} rows to measure; results in {place}", file=sys.stderr)
    _tell_versions([stored[row.name] for row in rows if row.name in stored and row not in left])
    begun = time.perf_counter()
    failures: list[str] = []

    def each(index: int, result: dict[str, Any] | str) -> None:
        if isinstance(result, str):
            if result:
                failures.append(result)
                print(f"tables: {result}", file=sys.stderr, flush=True)
            return
        write_atomically(place / f"{left[index].name}.json", json.dumps(result, indent=1) + "\n")
        text = f"{result['row']}: median {result['score']['median']:.3f}, {result['train_seconds']:.0f} s"
        print(text, file=sys.stderr, flush=True)
        write_tables(place, quick)

    for part in dict.fromkeys(row.part for row in left if NAMED in row.entry.arguments):
        # Before workers ask for them at the same time; what cannot be made is told row by row.
        with suppress(InputError):
            _scene(part, runs / place.name)
    call = partial(_guarded, runs / place.name, None if most_s is None else time.time() + most_s)
    (scheduler or Scheduler()).map(call, left, what="measuring", each=each)
    write_tables(place, quick)
    print(f"tables: {place / 'README.md'} after {(time.perf_counter() - begun) / 60:.0f} min", file=sys.stderr)
    if failures:
        raise BenchFailed(f"tables: {len(failures)} rows did not finish: {failures[0]}")
    return read_rows(place)


def _data_digest(dataset: str) -> str:
    """Digest of the content of a data set, which is made where it can be and is not there.

    Raises:
        InputError: it is not on this machine.
    """
    if not dataset_files(dataset):
        load_record(dataset)
    return content_digest(dataset_files(dataset))


def _holds(stored: Mapping[str, Any] | None, row: Row, digests: dict[str, str]) -> bool:
    """Whether a stored row is what would be measured; rows that do not state their data hold for any.

    Args:
        stored: content of its file, or None.
        row: as planned.
        digests: of data sets, filled as they are asked for.
    """
    if stored is None or stored["command"] != row.command:
        return False
    dataset = row.part.dataset
    if "data" not in stored or not dataset_files(dataset):
        return True
    if dataset not in digests:
        digests[dataset] = _data_digest(dataset)
    return stored["data"] == digests[dataset]


def _tell_versions(kept: Sequence[Mapping[str, Any]]) -> None:
    """Say how many rows that are kept were measured by other versions of packages, or do not state their data."""
    now = package_versions()
    others = sum(any(row["versions"].get(name) != version for name, version in now.items()) for row in kept)
    silent = sum("data" not in row for row in kept)
    for count, what in ((others, "were measured by other versions of packages"), (silent, "do not state their data")):
        if count:
            text = f"tables: {count} of {len(kept)} stored rows {what} and are kept; delete their files to measure them"
            print(text, file=sys.stderr)


def _guarded(runs: Path, until: float | None, row: Row) -> dict[str, Any] | str:
    """A row, or why there is none; "" where there was no time for it."""
    if until is not None and time.time() > until:
        return ""
    try:
        return measure(runs, row)
    except (InputError, OSError, RuntimeError) as error:
        return f"{row.name}: {one_line(error)}"
