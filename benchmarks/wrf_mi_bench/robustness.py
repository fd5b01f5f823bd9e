"""Hard to break: faults of trainings, and damaged and hostile files, counted (``wrf-mi bench robustness``)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi.runs.fit_key import fit_key, source_files

from . import faults
from .bench import BenchFailed
from .comparison import kept, line
from .hostile_files import run_readers
from .hostile_samples import READERS

INPUTS, QUICK_INPUTS = 2000, 50
"""Inputs of each reader."""
SLOW = {
    "run: operator0.npz": 0.1,
}
"""Share of the inputs for readers that take long: one builds an operator."""
QUICK_KILLS, TOGETHER = 3, 8
"""Kills of each kind of a quick measurement, and readers of one process, whose start takes seconds."""
RUNS = Path("runs/bench/robustness")
NEVER = "0 wrong"


def _rows(trainings: Mapping[str, Any], files: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    rows = []
    for kind, found in trainings.items():
        rows.append(line(kind, f"{found['cases']} cases, {len(found['failed'])} wrong", NEVER))
    for one in files:
        counts = f"{one['inputs']} inputs, {one['refused']} refused, {one['loaded']} read, {len(one['failed'])} wrong"
        most = f"longest {one['slowest_s']:.1f} s, memory +{one['largest_mb']:.0f} MB"
        rows.append(line(one["reader"], f"{counts}; {most}", NEVER))
    rows.append(_summary(trainings, files))
    return rows


def _summary(trainings: Mapping[str, Any], files: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """All cases and the worst one."""
    cases = sum(found["cases"] for found in trainings.values()) + sum(one["inputs"] for one in files)
    wrong = _wrong(trainings, files)
    slowest = max(files, key=lambda one: float(one["slowest_s"]))
    largest = max(files, key=lambda one: float(one["largest_mb"]))
    worst = f"longest {slowest['slowest_s']:.1f} s ({slowest['reader']}), most memory +{largest['largest_mb']:.0f} MB "
    worst += f"({largest['reader']})"
    return line("all", f"{cases} cases, {len(wrong)} wrong; {worst}", NEVER)


def _wrong(trainings: Mapping[str, Any], files: Sequence[Mapping[str, Any]]) -> list[str]:
    found = [text for one in trainings.values() for text in one["failed"]]
    return found + [f"{one['reader']}, input {k}: {text}" for one in files for k, text in one["failed"].items()]


def _result(trainings: Mapping[str, Any], files: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    wrong = _wrong(trainings, files)
    figures = {"rows": _rows(trainings, files), "trainings": trainings, "readers": list(files), "wrong": wrong}
    return figures | ({"failed": f"{len(wrong)} cases wrong, first {wrong[0]}"} if wrong else {})


def main() -> dict[str, Any]:
    """All faults, and `INPUTS` changed files of every reader; what this code has measured is kept."""
    place = RUNS / fit_key(source_files())
    trainings: dict[str, Any] = {}
    for model in faults.SETTINGS:
        folder = place / f"faults-{model}"
        for kind, found in kept(place / f"faults-{model}.json", partial(faults.run, folder, [model])).items():
            total = trainings.setdefault(kind, {"cases": 0, "failed": []})
            total["cases"] += found["cases"]
            total["failed"] += found["failed"]
        shutil.rmtree(folder, ignore_errors=True)
    files = []
    fast = [name for name in READERS if name not in SLOW]
    groups = [(fast[k : k + TOGETHER], INPUTS) for k in range(0, len(fast), TOGETHER)]
    groups += [([name], round(INPUTS * share)) for name, share in SLOW.items()]
    for number, (names, count) in enumerate(groups):
        files += kept(place / f"readers{number}.json", partial(run_readers, place / "files", names, count))
    shutil.rmtree(place / "files", ignore_errors=True)
    return _result(trainings, files)


def quick(inputs: int = QUICK_INPUTS, models: Sequence[str] = ("wrf-gs+",), kills: int = QUICK_KILLS) -> dict[str, Any]:
    """Few cases of each kind.

    Raises:
        BenchFailed: one is wrong.
    """
    with tempfile.TemporaryDirectory() as place:
        trainings = faults.run(Path(place) / "faults", models, kills)
        fast = [name for name in READERS if name not in SLOW]
        files = run_readers(Path(place) / "files", fast, inputs)
        files += run_readers(Path(place) / "files", list(SLOW), max(inputs // 10, 2))
    figures = _result(trainings, files)
    if "failed" in figures:
        raise BenchFailed(f"bench robustness: {figures['failed']}")
    return figures
