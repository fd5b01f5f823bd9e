"""Entries of the table (`wrf_mi.apps.table`) from stored results of the other benchmarks that compare methods."""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from wrf_mi.apps.table.entries import ALL_ROWS, Entry, write_entry

from .buildings import HYBRID as ALONE_HYBRID
from .buildings import SETS, WITH_PLAN
from .comparison import MEASURED
from .stages import ALONE, CELLS, CHANNELS, COPIED, HYBRID, Cell
from .table_plan import SEEDS, plan
from .tables import FOLDER, LICENCE
from .unmeasured import CARRIER, CARRIERS, IDW, LAW, LEFT, OWN_KRIGING, OWN_TREES, RECEIVERS, Held, gains

BLOCKS = {"ssim": "spectrum", "abs_error_db": "rssi", "cea_db": "csi"}  # task by key of its score in ``metrics.json``
OPEN = ("rfid-lab",)  # data sets without a scene
METHODS = {"wrf-gs+": "wrf-gs+-joint", "ray-tracing, calibrated": "ray-tracing-calibrated"}
METHODS |= {"ray-tracing, calibrated materials": "ray-tracing-materials", ALONE_HYBRID: "hybrid"}
METHODS |= {"ray-tracing, corrected scene": "ray-tracing-corrected", "ray tracing": "ray-tracing"}
METHODS |= {"ray tracing, corrected scene": "ray-tracing-corrected", IDW: "idw", LAW: "mri", CARRIER: "carrier"}
METHODS |= {OWN_KRIGING: "kriging", OWN_TREES: "trees"}
"""Names of methods in the table, where a benchmark has another."""


OF = frozenset(("stages", "buildings", "new-carriers", "new-receivers"))  # benchmarks with entries


def write_entries(results: Path) -> None:
    """Write the entries of all stored results into the folder of entries beside theirs."""
    for entry in stored_entries(results):
        write_entry(results.parent / FOLDER, entry)


def stored_entries(results: Path) -> Iterator[Entry]:
    """Entries of the stored parts of the benchmarks; of a method, data and rows those of the first of them."""
    listed = {row.name for row in plan()}
    for entry in (*_stages(results), *_buildings(results), *_unmeasured(results)):
        # Runs of IDW by themselves are entries with the constant and the best simple models (`wrf-mi table add`).
        if entry.name not in listed and (entry.method != "idw" or entry.dataset == CHANNELS or entry.seed is None):
            listed.add(entry.name)
            yield entry


def _read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else {}


def _facts(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Date, machine, versions and source of the last of some parts."""
    last: Mapping[str, Any] = max((part[MEASURED] for part in parts), key=lambda measured: str(measured["date"]))
    return {key: last[key] for key in ("date", "machine", "versions", "source") if key in last} | {"licence": LICENCE}


def _stages(results: Path) -> Iterator[Entry]:
    for cell in CELLS:
        part = _read(results / "stages" / f"{cell.name}.json")
        for figures in part.get("models", ()):
            yield Entry(**_of_stage(cell, figures), **_facts([part]), command="wrf-mi bench stages")


def _of_stage(cell: Cell, figures: Mapping[str, Any]) -> dict[str, Any]:
    name = figures["model"]
    scene = cell.dataset not in OPEN and (name == HYBRID or name not in ALONE or ALONE[name].scene)
    method = METHODS.get(name, name) if scene else name
    facts = {"method": method, "label": f"{name}, knows the scene" if scene else name, "task": BLOCKS[figures["block"]]}
    facts |= {"dataset": cell.dataset, "split": cell.split, "score": figures["score"]}
    facts |= {"share": ALL_ROWS if cell.n_train is None else cell.n_train, "n_train": cell.n_train}
    facts |= {"seed": cell.seed}
    return facts | {key: figures[key] for key in COPIED if figures.get(key) is not None}


def _buildings(results: Path) -> Iterator[Entry]:
    for name, count in SETS:
        part = _read(results / "buildings" / f"{name}-{count or 'all'}.json")
        for row in part.get("rows", ()):
            # With a scene the table calls it the hybrid, elsewhere too.
            methods = {ALONE_HYBRID: ("hybrid-no-plan", "hybrid, no plan"), WITH_PLAN: ("hybrid", WITH_PLAN)}
            method, label = methods.get(row["model"], (row["model"], row["model"]))
            facts = {"method": method, "label": label, "task": "rssi", "dataset": name, "split": "official"}
            facts |= {"share": count or ALL_ROWS, "n_train": count, "inside_90": row["inside"]}
            facts |= {"score": {key: row[key] for key in ("median", "mean")}, "train_seconds": row["seconds"]}
            yield Entry(**facts, **_facts([part]), command="wrf-mi bench buildings")


def _unmeasured(results: Path) -> Iterator[Entry]:
    for case in CARRIERS:
        yield from _of_held(case, case.kind, results / "new-carriers", case.dataset)
    for case in RECEIVERS:
        for left in LEFT:
            split = f"{case.kind}+{left}" if left else case.kind
            yield from _of_held(case, split, results / "new-receivers", f"{case.dataset}-{left}")


def _of_held(case: Held, split: str, place: Path, prefix: str) -> Iterator[Entry]:
    """Entries that are pooled over folds and seeds."""
    files = [place / f"{prefix}-{fold}-{seed}.json" for seed in SEEDS for fold in range(case.folds)]
    parts = [part for file in files if (part := _read(file))]
    for name, (median, mean, _) in gains(parts).items() if parts else ():
        method = METHODS.get(name, name.replace(" ", "-"))
        facts: dict[str, Any] = {"method": method, "label": name, "task": parts[0]["task"], "dataset": case.dataset}
        facts |= {"split": split, "share": case.n_train or ALL_ROWS, "n_train": case.n_train, "seed": None}
        facts |= {"score": {"median": median, "mean": mean}}
        yield Entry(**facts, **_facts(parts), command=f"wrf-mi bench {place.name}")
