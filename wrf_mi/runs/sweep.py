"""A sweep: one run for each combination of settings, and a table of their scores.

    OUT/sweep.json                              what all runs share: options, settings, versions, digests of the data
    OUT/seed=0,initial.gaussians=150/           a run folder for each combination, named after what varies
    OUT/scores.csv, scores.md, scores.json      the table

Each run is ``wrf-mi train`` in a process of its own, one after the other or several on the workers of a scheduler. A
finished one is not run again, one that was stopped goes on from its checkpoint; with other content of the data or
scenes, or with other versions of packages, the folder is refused, so that all runs of a table are comparable.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..core import AntennaOptions, InputError
from ..core.files import one_line, write_atomically
from ..parallel import Scheduler, run_module
from ..synthetic import load_record
from ..tasks import TASKS
from .api import plan_run
from .evaluate import stored_metrics
from .fit_key import content_digest, dataset_files, scene_files
from .folder import CONFIG, METRICS, package_versions

OPTIONS = (
    "dataset",
    "model",
    "scene",
    "material",
    "evaluation",
    "split",
    "n-train",
    "seed",
    "preset",
    "paths",
    "depth",
    "reflections",
    "rays",
    "calibrate",
    *(one.name.replace("_", "-") for one in fields(AntennaOptions)),
)
"""What may vary beside settings: DATASET and the options of ``wrf-mi train``."""
FILES = ("scene", "initial.points", "initial.mesh", "initial.paths")
"""Options and settings that may name a file or folder, beside the data set."""
SHARED = "sweep.json"
SCORES = ("median", "mean", "p10", "p90")
HEADINGS = {
    "score": "score",
    **{key: key for key in SCORES},
    "reference_median": "reference median",
    "n_train": "training rows",
    "n_test": "test rows",
    "train_seconds": "training, s",
    "ms_per_sample": "ms per sample",
    "peak_memory_mb": "peak memory, MB",
    "status": "status",
}
"""Columns of the table behind those that vary."""


@dataclass(frozen=True)
class SweepRun:
    """One combination.

    Attributes:
        folder: of its run.
        varied: what was chosen for it, by setting or option.
        arguments: of ``wrf-mi``, without ``--out``.
    """

    folder: Path
    varied: Mapping[str, str]
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """What `run_sweep` runs.

    Attributes:
        folder: of the sweep.
        shared: options and settings that all runs have in common, as kept in ``sweep.json``.
        runs: one for each combination.
    """

    folder: Path
    shared: Mapping[str, Any]
    runs: tuple[SweepRun, ...]

    @property
    def varied(self) -> list[str]:
        """Settings and options that vary."""
        return list(self.runs[0].varied)


class SweepFailed(RuntimeError):
    """Runs of a sweep did not finish; the others are in the table."""

    exit_status = 1


def plan_sweep(
    out: str | Path,
    vary: Sequence[str],
    options: Mapping[str, str],
    settings: Sequence[str] = (),
    flags: Sequence[str] = (),
) -> Sweep:
    """All combinations, the last of ``vary`` changing fastest. Nothing is written.

    Args:
        out: folder of the sweep.
        vary: ``KEY=VALUE,VALUE,...`` each, where a key is one of `OPTIONS` or a setting as ``--set`` takes it. Where a
            value has commas, semicolons separate the values.
        options: of all runs, keys from `OPTIONS`.
        settings: ``KEY=VALUE`` of all runs.
        flags: further arguments of all runs, such as ``--deterministic``.

    Raises:
        InputError: nothing varies, something does twice, or two runs would have one name.
    """
    choices: dict[str, list[str]] = {}
    fixed = {setting.partition("=")[0].strip() for setting in settings} | set(options)
    for text in vary:
        key, equals, listed = (part.strip() for part in text.partition("="))
        values = [value.strip() for value in listed.split(";" if ";" in listed else ",")]
        if not key or not equals or not all(values):
            raise InputError(f"--vary {text}: expected KEY=VALUE,VALUE,..., such as seed=0,1,2")
        if key in choices or key in fixed:
            raise InputError(f"--vary {text}: {key} is given already; give it once")
        if len(set(values)) < len(values):
            raise InputError(f"--vary {text}: a value is given twice; leave it out")
        choices[key] = values
    if not choices:
        raise InputError("sweep: nothing varies; give --vary KEY=VALUE,VALUE,... once or more")
    runs, named = [], set()
    for chosen in itertools.product(*choices.values()):
        varied = dict(zip(choices, chosen, strict=True))
        name = ",".join(f"{key}={_in_name(value)}" for key, value in varied.items())
        if name in named:
            raise InputError(f"sweep: two runs would be named {name}; choose values that differ in letters or digits")
        named.add(name)
        runs.append(SweepRun(Path(out) / name, varied, _arguments(options, settings, flags, varied)))
    shared = {"vary": sorted(choices), "options": dict(options), "settings": list(settings), "flags": list(flags)}
    return Sweep(Path(out), shared, tuple(runs))


def _arguments(
    options: Mapping[str, str], settings: Sequence[str], flags: Sequence[str], varied: Mapping[str, str]
) -> tuple[str, ...]:
    chosen = {**options, **{key: value for key, value in varied.items() if key in OPTIONS}}
    own = [f"{key}={value}" for key, value in varied.items() if key not in OPTIONS]
    dataset = [chosen.pop("dataset")] if "dataset" in chosen else []
    given = [part for key, value in chosen.items() for part in (f"--{key}", value)]
    return "train", *dataset, *given, *flags, *(part for one in (*settings, *own) for part in ("--set", one))


def _in_name(value: str) -> str:
    return re.sub(r"[^\w.+-]+", "-", value).strip("-") or "-"


def check_run(dataset: str, arguments: Mapping[str, Any]) -> None:
    """Refuse a run that ``wrf-mi train`` would refuse, before anything is written.

    Args:
        dataset: name or folder.
        arguments: of `wrf_mi.runs.api.plan_run`.

    Raises:
        InputError: data, scene, split or settings that cannot be used.
    """
    plan_run(_record(dataset), **arguments)


# Runs of a sweep share most of these.
_record = lru_cache(maxsize=4)(load_record)


def run_sweep(sweep: Sweep, scheduler: Scheduler | None = None) -> list[dict[str, Any]]:
    """Run what is not finished yet, and write the table.

    Args:
        sweep: from `plan_sweep`; its folder is made if need be.
        scheduler: what computes the runs; None: this process, one after the other. Its workers must see its
            folder, data sets and scenes under the same names.

    Returns:
        A dictionary for each run: what varies, the keys of `HEADINGS`, ``metrics`` (content of ``metrics.json``) and
        ``run``, its folder. ``status`` is ``done``, ``kept`` where the run was finished before, else what went wrong.

    Raises:
        InputError: the folder is that of another sweep, or of something else.
    """
    _claim(sweep)
    heard: dict[int, dict[str, Any]] = {}

    def each(index: int, row: dict[str, Any]) -> None:
        heard[index] = row
        # Written after each run: the table of a sweep that takes a day can be looked at any time.
        _write_table(sweep, [heard[k] for k in sorted(heard)])
        name, count = sweep.runs[index].folder.name, f"{len(heard)} of {len(sweep.runs)}"
        print(f"{name}: {_headline(row)} ({count})", file=sys.stderr, flush=True)

    return (scheduler or Scheduler()).map(_run, sweep.runs, what="sweeping", each=each)


def _claim(sweep: Sweep) -> None:
    """Make the folder, or see that it belongs to the same sweep, perhaps with other values."""
    folder, path = sweep.folder, sweep.folder / SHARED
    content = {name: content_digest(places) for name, places in _files(sweep).items()}
    made_of: dict[str, dict[str, str]] = {"versions": package_versions(), "content": content}
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; choose another --out")
    if path.exists():
        try:
            before = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: not readable ({one_line(error)}); choose another --out") from None
        if not isinstance(before, dict) or {key: before.get(key) for key in sweep.shared} != sweep.shared:
            raise InputError(f"{folder}: holds a sweep with other settings than this one; choose another --out")
        for key, what in (("versions", "by other versions of"), ("content", "with other content of")):
            known = before.get(key, {})
            changed = [name for name, now in made_of[key].items() if known.get(name, now) != now]
            if changed or key not in before:
                named = ", ".join(changed or ["what it does not state"])
                raise InputError(f"{folder}: holds a sweep {what} {named}; choose another --out")
            made_of[key] = known | made_of[key]
    elif folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: exists, is not empty and holds no sweep; choose another --out")
    write_atomically(path, json.dumps({**sweep.shared, **made_of}, indent=1) + "\n")


def _files(sweep: Sweep) -> dict[str, list[Path]]:
    """Files of data sets, scenes and settings that name some, by what the command calls them."""
    found: dict[str, list[Path]] = {}
    for run in sweep.runs:
        words = run.arguments[1:]
        for before, word in itertools.pairwise(("dataset", *words)):
            key, _, value = word.partition("=") if before == "--set" else (before.removeprefix("--"), "", word)
            if key == "dataset" and not word.startswith("--"):
                found[value] = dataset_files(value)
            elif key in FILES:
                found[value] = scene_files(value)
    return {name: places for name, places in found.items() if places}


def _run(run: SweepRun) -> dict[str, Any]:
    """One run, in this process's children; its row of the table."""
    folder = run.folder
    if (folder / METRICS).exists():
        return _row(run, "kept")
    resumable = (folder / CONFIG).exists()
    if folder.exists() and not resumable:
        shutil.rmtree(folder)  # stopped before its configuration was there: nothing to go on from
    arguments = ("train", "--resume", str(folder)) if resumable else (*run.arguments, "--out", str(folder))
    status, said = run_module("wrf_mi.cli", arguments)
    if status == 0 and (folder / METRICS).exists():
        return _row(run, "done")
    return _row(run, said.removeprefix("wrf-mi: ") or f"ended with status {status}")


def _row(run: SweepRun, status: str) -> dict[str, Any]:
    metrics = stored_metrics(run.folder)
    row: dict[str, Any] = {"run": str(run.folder), **run.varied, **dict.fromkeys(HEADINGS), "status": status}
    if not metrics:
        return row | {"metrics": {}}
    task = TASKS[metrics["task"]]
    held = task.headline(metrics["reference"])
    row |= {"score": task.label, "reference_median": metrics["reference"][held]["median"]}
    row |= {key: metrics[task.block][key] for key in SCORES}
    row |= {key: metrics[key] for key in HEADINGS if key in metrics}
    return row | {"metrics": metrics}


def _headline(row: Mapping[str, Any]) -> str:
    return row["status"] if row["median"] is None else f"{row['score']} median {row['median']:.3f}"


def check_failures(rows: Sequence[Mapping[str, Any]]) -> None:
    """Say which runs have no scores.

    Raises:
        SweepFailed: there are such.
    """
    failed = [f"{Path(row['run']).name}: {row['status']}" for row in rows if row["median"] is None]
    if failed:
        raise SweepFailed(f"sweep: {len(failed)} of {len(rows)} runs failed: {'; '.join(failed)}")


def sweep_table(rows: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> str:
    """Markdown table of the rows of `sweep`."""
    columns = [*varied, *HEADINGS.values()]
    lines = ["| " + " | ".join(columns) + " |", "| " + " | ".join("---" for _ in columns) + " |"]
    for row in rows:
        cells = [_cell(key, row[key]) for key in (*varied, *HEADINGS)]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(key: str, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}" if key in (*SCORES, "reference_median") else f"{value:.1f}"
    return str(value).replace("|", "\\|")


def _write_table(sweep: Sweep, rows: Sequence[Mapping[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, ["run", *sweep.varied, *HEADINGS], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(sweep.folder / "scores.csv", text.getvalue())
    write_atomically(sweep.folder / "scores.md", sweep_table(rows, sweep.varied) + "\n")
    write_atomically(sweep.folder / "scores.json", json.dumps(rows, indent=1) + "\n")
