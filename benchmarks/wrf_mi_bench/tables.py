"""Tables of every method of the paper for each task, from runs of ``wrf-mi train``.

Each row of `wrf_mi_bench.table_plan` is stored as an entry of `wrf_mi.apps.table` when it is done, so an interrupted
measurement can be resumed, on another machine too. A row is measured again where its arguments or the content of its
data set have changed, or its file is deleted; rows of other versions of packages are kept and reported. The name of a
run folder has a key of command, source, data, scene and versions (`wrf_mi_bench.sources`).
"""

import json
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.apps.table.entries import Entry, entry_of, predictions_digest, read_entries, write_entry
from wrf_mi.core import InputError
from wrf_mi.core.digest import content_digest
from wrf_mi.core.files import atomic_folder, one_line, remove_leftovers
from wrf_mi.parallel import Scheduler
from wrf_mi.runs.folder import CONFIG, is_finished, package_versions
from wrf_mi.runs.results import read_run
from wrf_mi.runs.sweep import dataset_files, scene_files
from wrf_mi.scene.correction_data import FILE as CORRECTION
from wrf_mi.scene.make import make_scene
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.floor_channels import MEASURED
from wrf_mi.synthetic.stored import SCAN

from .bench import BenchFailed, provenance, run_command
from .comparison import data_folder, say
from .sources import fit_key, modules_of_command, source_digests, source_files
from .table_pages import write_tables
from .table_plan import CORRECTED, PARTS, Row, TablePart, available, plan

FOLDER = "table"  # folder of the entries beside that of the results; ``table-quick`` for the small version
LICENCE = "MIT"  # of this project
FLAT_HEIGHT_M = 2.7  # height of the ceiling of the flat, which its layout lacks
FAR_M, PLATE_M = 100.0, 0.01  # distance and size of the only surface of the open scene; Sionna RT needs one


def scene_of(part: TablePart, folder: Path) -> Path:
    """Scene of a part, which is made in ``folder`` where needed."""
    if part.scene == "open":
        place = folder / f"open-{fit_key(FAR_M, PLATE_M)}"
        if not place.exists():
            plate = sheet(0, FAR_M, (FAR_M, FAR_M + PLATE_M), (FAR_M, FAR_M + PLATE_M))
            with atomic_folder(place, False) as unfinished:
                write_scene(unfinished, {"plate": ("itu_wood", plate)}, "Nothing but a small plate far away")
        return place
    if part.scene == "lidar":
        return meshed_scan(part.dataset, folder)
    if part.scene == "floor":
        load_record(part.dataset)  # made where needed
        return data_folder(part.dataset) / MEASURED
    layout = data_folder(part.dataset) / "layout.csv"
    place = folder / f"flat-{fit_key(layout, FLAT_HEIGHT_M)}"
    if not place.exists():
        make_scene(layout, place, height_m=FLAT_HEIGHT_M)  # whole, or not at all
    return place


def scene_of_data(dataset: str, folder: Path) -> str | None:
    """Scene of a data set, made in ``folder`` where needed, as its part of the tables or else its scan states it.

    None: nothing is known but free space.
    """
    part = next((part for part in PARTS if part.dataset == dataset), None)
    if part is None:
        return str(meshed_scan(dataset, folder))
    return None if part.scene == "open" else str(scene_of(part, folder))


def meshed_scan(dataset: str, folder: Path) -> Path:
    """Scene in ``folder`` from the scan of a data set, which is made where needed."""
    load_record(dataset)
    scan = data_folder(dataset) / SCAN
    scene = folder / f"{dataset}-{fit_key(scan)}"
    if not scene.exists():
        make_scene(scan, scene)
    return scene


def corrected_scene(row: Row, folder: Path) -> Path:
    """Scene of a row in ``folder``, corrected by its training rows."""
    original_scene = scene_of(row.part, folder)
    scene = folder / f"corrected-{row.part.dataset}-{fit_key(row.rows, source_files(), scene_files(original_scene))}"
    if not scene.exists():
        run_command(["correct", row.part.dataset, "--scene", str(original_scene), *row.rows], scene, resumes=False)
    return scene


def _scenes(row: Row, place: Path) -> list[Path]:
    if not row.entry.scene:
        return []
    return [corrected_scene(row, place) if row.entry.scene == CORRECTED else scene_of(row.part, place)]


def measure(runs: Path, row: Row) -> Entry:
    """Entry of a row, from a finished run of the same key or a new one."""
    scenes, data = _scenes(row, runs / "scenes"), _data_digest(row.part.dataset)
    source = source_digests(*modules_of_command(row.command.split()))
    folder = runs / f"{row.name}-{fit_key(row.command, source, data, [scene_files(place) for place in scenes])}"
    wall = None
    if is_finished(folder):
        say("tables", f"{row.name}: finished before in {folder}, with the same source, data and versions")
    else:
        # Ray tracing takes seconds and cannot be resumed.
        resumes = not row.method.startswith("ray-tracing")
        if folder.exists() and not (resumes and (folder / CONFIG).exists()):
            shutil.rmtree(folder)  # stopped before its configuration was written
        scene = ["--scene", str(scenes[0])] if scenes else []
        wall = run_command(row.arguments(scene), folder, resumes=resumes)
    run, of_part = read_run(folder), row.part
    facts: dict[str, Any] = {"method": row.method, "label": row.entry.label, "share": row.share, "seed": row.seed}
    facts |= {"dataset": of_part.dataset, "split": of_part.split, "command": row.command, "licence": LICENCE}
    facts |= {**provenance(*modules_of_command(row.command.split())), "data": data, "wall_seconds": wall}
    entry = entry_of(run, predictions_digest(run), **facts)
    if row.entry.scene != CORRECTED:
        return entry
    seconds = json.loads((scenes[0] / CORRECTION).read_text(encoding="utf-8"))["seconds"]
    return replace(entry, train_seconds=(entry.train_seconds or 0) + seconds)


def tables(
    place: Path, runs: Path, quick: bool = False, scheduler: Scheduler | None = None, most_s: float | None = None
) -> dict[str, Entry]:
    """Measure all rows that are not stored yet and write tables and pictures into a folder; all its entries.

    A row whose command fails is reported and omitted; the other rows are measured.
    """
    place.mkdir(parents=True, exist_ok=True)
    remove_leftovers(place)
    rows = plan(quick)
    for name in sorted({row.part.dataset for row in rows if not available(row.part)}):
        say("tables", f"data set {name} is not on this machine and is left out; see wrf-mi data list")
    stored, digests = read_entries(place), dict[str, str]()
    left = [row for row in rows if available(row.part) and not _holds(stored.get(row.name), row, digests)]
    say("tables", f"{len(left)} of {len(rows)} rows to measure; results in {place}")
    _report_versions([stored[row.name] for row in rows if row.name in stored and row not in left])
    begun, failures = time.perf_counter(), list[str]()

    def each(index: int, result: Entry | str) -> None:
        if isinstance(result, str):
            if result:
                failures.append(result)
                say("tables", result)
            return
        write_entry(place, result)
        say(result.name, f"median {result.score['median']:.3f}, {result.train_seconds or 0:.0f} s")
        write_tables(place, quick)

    for part in dict.fromkeys(row.part for row in left if row.entry.scene):
        # Before workers need them at the same time; failures are reported row by row.
        with suppress(InputError):
            scene_of(part, runs / place.name / "scenes")
    call = partial(_guarded, runs / place.name, None if most_s is None else time.time() + most_s)
    (scheduler or Scheduler()).map(call, left, what="measuring", each=each)
    write_tables(place, quick)
    say("tables", f"{place / 'README.md'} after {(time.perf_counter() - begun) / 60:.0f} min")
    if failures:
        raise BenchFailed(f"tables: {len(failures)} rows did not finish: {failures[0]}")
    return read_entries(place)


def _data_digest(dataset: str) -> str:
    """Digest of the content of a data set, which is made where possible and needed."""
    if not dataset_files(dataset):
        load_record(dataset)
    return content_digest(dataset_files(dataset))


def _holds(stored: Entry | None, row: Row, digests: dict[str, str]) -> bool:
    """Whether a stored row has the planned command and, where it states them, the present data; fills ``digests``."""
    if stored is None or stored.command != row.command:
        return False
    dataset = row.part.dataset
    if stored.data is None or not dataset_files(dataset):
        return True
    if dataset not in digests:
        digests[dataset] = _data_digest(dataset)
    return stored.data == digests[dataset]


def _report_versions(rows: Sequence[Entry]) -> None:
    """Report how many kept rows have other versions of packages or do not state their data."""
    now = package_versions()
    others = sum(any((row.versions or {}).get(name) != version for name, version in now.items()) for row in rows)
    silent = sum(row.data is None for row in rows)
    for count, what in ((others, "were measured by other versions of packages"), (silent, "do not state their data")):
        if count:
            say("tables", f"{count} of {len(rows)} stored rows {what} and are kept; delete their files to measure them")


def _guarded(runs: Path, until: float | None, row: Row) -> Entry | str:
    """Entry of a row, or the reason of its failure; "" where the time is over."""
    if until is not None and time.time() > until:
        return ""
    try:
        return measure(runs, row)
    except (InputError, OSError, RuntimeError) as error:
        return f"{row.name}: {one_line(error)}"
