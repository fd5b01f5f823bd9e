"""Hard to break: faults of commands, long use, and damaged and hostile files, counted (``wrf-mi bench robustness``)."""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from . import endurance, faults
from .bench import BenchFailed
from .comparison import Row, kept, kept_work, line
from .fault_commands import COMMANDS
from .hostile_files import run_readers
from .hostile_samples import READERS
from .sources import fit_key, source_files

INPUTS, QUICK_INPUTS = 2000, 50  # inputs of each reader
QUICK_KILLS, TOGETHER = 3, 8
"""Kills of each kind of a quick measurement, and readers of one process, whose start takes seconds."""
RUNS = Path("runs/bench/robustness")
NEVER = "0 wrong"
QUICK_COMMANDS, QUICK_CALLS = ("wrf-gs+", "correct", "tables"), (300, 30)
"""Commands of a quick measurement, and its predictions and opened runs."""


Cases = Sequence[Mapping[str, Any]]


def _rows(kinds: Mapping[str, Any], files: Cases, long: Cases, wrong: int) -> list[Row]:
    rows = [line(kind, f"{part['cases']} cases, {len(part['failed'])} wrong", NEVER) for kind, part in kinds.items()]
    for part in files:
        counts = f"{part['inputs']} inputs, {part['refused']} refused, {part['loaded']} read"
        most = f"longest {part['slowest_s']:.1f} s, memory +{part['largest_mb']:.0f} MB"
        rows.append(line(part["reader"], f"{counts}, {len(part['failed'])} wrong; {most}", NEVER))
    rows += [row for part in long for row in part["rows"]]
    # All cases and the worst one.
    cases = sum(part["cases"] for part in kinds.values()) + sum(part["inputs"] for part in files)
    slowest = max(files, key=lambda part: float(part["slowest_s"]))
    largest = max(files, key=lambda part: float(part["largest_mb"]))
    worst = f"longest {slowest['slowest_s']:.1f} s ({slowest['reader']}), most memory +{largest['largest_mb']:.0f} MB "
    worst += f"({largest['reader']})"
    return [*rows, line("all", f"{cases} cases, {wrong} wrong; {worst}", NEVER)]


def _result(kinds: Mapping[str, Any], files: Cases, long: Cases) -> dict[str, Any]:
    wrong = [text for part in kinds.values() for text in part["failed"]]
    wrong += [f"{part['reader']}, input {k}: {text}" for part in files for k, text in part["failed"].items()]
    wrong += [text for part in long for text in part["wrong"]]
    figures = {"rows": _rows(kinds, files, long, len(wrong)), "faults": kinds, "readers": list(files), "wrong": wrong}
    return figures | ({"failed": f"{len(wrong)} cases wrong, first {wrong[0]}"} if wrong else {})


def main() -> dict[str, Any]:
    """All faults, long use, and `INPUTS` changed files of every reader; what this code has measured is kept."""
    place = RUNS / fit_key(source_files())
    kinds: dict[str, Any] = {}
    for name in COMMANDS:
        of_command = kept_work(place, f"faults-{name}", partial(faults.run, names=[name]))
        for kind, counts in of_command.items():
            total = kinds.setdefault(kind, {"cases": 0, "failed": []})
            total["cases"] += counts["cases"]
            total["failed"] += counts["failed"]
    works = (endurance.lost_worker, endurance.memory, endurance.demo)
    long = [kept_work(place, work.__name__, work) for work in works]
    files, groups = list[Any](), [list(READERS)[k : k + TOGETHER] for k in range(0, len(READERS), TOGETHER)]
    for number, names in enumerate(groups):
        files += kept(place / f"readers{number}.json", partial(run_readers, place / "files", names, INPUTS))
    shutil.rmtree(place / "files", ignore_errors=True)
    return _result(kinds, files, long)


def quick(
    inputs: int = QUICK_INPUTS, names: Sequence[str] = QUICK_COMMANDS, kills: int = QUICK_KILLS
) -> dict[str, Any]:
    """Few cases of each kind; `BenchFailed` where one is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        kinds = faults.run(place / "faults", names, kills)
        files = run_readers(place / "files", list(READERS), inputs)
        long = [endurance.lost_worker(place / "lost"), endurance.memory(place / "memory", *QUICK_CALLS)]
    figures = _result(kinds, files, long)
    if "failed" in figures:
        raise BenchFailed(f"bench robustness: {figures['failed']}")
    return figures
