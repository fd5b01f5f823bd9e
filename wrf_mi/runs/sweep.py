"""Sweep: one run for each combination of settings, and a table of their scores.

    OUT/sweep.json                              common options, settings, versions, and digests of the data
    OUT/seed=0,initial.gaussians=150/           run folder of a combination
    OUT/scores.csv, scores.md, scores.json      the table

Each run is ``wrf-mi train`` in a subprocess, here or on the workers of a scheduler. A finished run is kept, a stopped
run continues from its checkpoint. A folder made with other data, scenes or versions of packages is refused.
"""

from __future__ import annotations

import itertools
import json
import re
import shutil
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import parse

from ..core import AntennaOptions, InputError
from ..core.digest import content_digest
from ..core.files import listed, one_line, readable, write_atomically, write_csv
from ..datasets.registry import locate
from ..models import MODELS
from ..parallel import Scheduler, run_module
from ..synthetic import load_record
from ..tasks import TASKS
from .applications import APPLICATIONS, COMMAND
from .baselines import best_reference
from .evaluate import stored_metrics
from .folder import CONFIG, METRICS, RunRequest, is_finished, package_versions
from .plan import plan_run

OPTIONS = (
    *("dataset", "model", "scene", "material", "evaluation", "split", "n-train", "min-rows", "seed"),
    *("preset", "receiver-model", "stages", "paths", "depth", "reflections", "phase-error", "rays", "calibrate"),
    *(field.name.replace("_", "-") for field in fields(AntennaOptions)),
)
"""Options of ``wrf-mi train`` that may vary, besides settings."""
FLAGS = ("deterministic", "intervals")  # options without a value that may vary: ``true`` gives them
FILES = ("scene", "initial.points", "initial.mesh", "initial.paths")
"""Options and settings that may name a file or folder, besides the data set."""
SHARED = "sweep.json"
SCORES = ("median", "mean", "p10", "p90")
HEADINGS = {key: key for key in ("score", *SCORES)} | {"reference_median": "reference median"}
HEADINGS |= {"n_train": "training rows", "n_test": "test rows", "train_seconds": "training, s"}
HEADINGS |= {"ms_per_sample": "ms per sample", "peak_memory_mb": "peak memory, MB", "status": "status"}
"""Headings of the table's columns after the varied settings."""


@dataclass(frozen=True)
class SweepRun:
    """A combination: its run folder, the varied settings and options, and the arguments of ``wrf-mi`` but ``--out``."""

    folder: Path
    varied: Mapping[str, str]
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """Folder of a sweep, options and settings that all runs share (kept in ``sweep.json``), and the runs."""

    folder: Path
    shared: Mapping[str, Any]
    runs: tuple[SweepRun, ...]

    @property
    def varied(self) -> list[str]:
        """Varied settings and options."""
        return list(self.runs[0].varied)


class SweepFailed(RuntimeError):
    """Some runs of a sweep did not finish."""

    exit_status = 1


def plan_sweep(
    out: str | Path,
    vary: Sequence[str],
    options: Mapping[str, str],
    settings: Sequence[str] = (),
    flags: Sequence[str] = (),
) -> Sweep:
    """Plan all combinations, the last of ``vary`` changing fastest. Nothing is written.

    Args:
        out: folder of the sweep.
        vary: ``KEY=VALUE,VALUE,...`` each; a key is one of `OPTIONS`, one of `FLAGS` with ``true`` and ``false``, or a
            setting as for ``--set``. Where a value has commas, semicolons separate the values.
        options: options of all runs, keys from `OPTIONS`; ``preset`` is that of varied models that have presets.
        settings: ``KEY=VALUE`` of all runs.
        flags: further arguments of all runs, such as ``--deterministic``.

    Raises:
        InputError: nothing varies, a key or value is given twice, or two runs would have the same name.
    """
    fixed = {setting.partition("=")[0].strip() for setting in settings} | set(options)
    choices = _choices(vary, fixed | {flag.removeprefix("--") for flag in flags})
    # A preset of all runs is that of the models that have some.
    with_presets = {name for name in choices.get("model", ()) if name in MODELS and MODELS[name].presets}
    runs: dict[str, SweepRun] = {}
    for chosen in itertools.product(*choices.values()):
        varied = dict(zip(choices, chosen, strict=True))
        words = (re.sub(r"[^\w.+-]+", "-", value).strip("-") or "-" for value in chosen)
        name = ",".join(map("=".join, zip(choices, words, strict=True)))
        if name in runs:
            raise InputError(f"sweep: two runs would be named {name}; choose values that differ in letters or digits")
        run_options = {**options, **varied}
        if with_presets and "preset" in options and varied.get("model") not in with_presets:
            del run_options["preset"]
        runs[name] = SweepRun(Path(out) / name, varied, _arguments(run_options, settings, flags))
    shared = {"vary": sorted(choices), "options": dict(options), "settings": list(settings), "flags": list(flags)}
    return Sweep(Path(out), shared, tuple(runs.values()))


def _choices(vary: Sequence[str], fixed: Collection[str]) -> dict[str, list[str]]:
    """Values of each varied key, none of which may be one of the fixed ones."""
    choices: dict[str, list[str]] = {}
    for text in vary:
        key, equals, listed = (part.strip() for part in text.partition("="))
        values = [value.strip() for value in listed.split(";" if ";" in listed else ",")]
        faults = (
            (not all((key, equals, *values)), "expected KEY=VALUE,VALUE,..., such as seed=0,1,2"),
            (key in {*choices, *fixed}, f"{key} is given already; give it once"),
            (len(set(values)) < len(values), "a value is given twice; leave it out"),
            (key in FLAGS and not set(values) <= {"true", "false"}, f"{key} is on or off; give true, false"),
        )
        for is_fault, fault in faults:
            if is_fault:
                raise InputError(f"--vary {text}: {fault}")
        choices[key] = values
    if not choices:
        raise InputError("sweep: nothing varies; give --vary KEY=VALUE,VALUE,... once or more")
    return choices


def _arguments(run_options: Mapping[str, str], settings: Sequence[str], flags: Sequence[str]) -> tuple[str, ...]:
    """Arguments of ``wrf-mi`` that state the options, flags and settings of a run, besides those of all runs."""
    dataset, options, switched, changed = [], [], list(flags), list(settings)
    for key, value in run_options.items():
        if key == "dataset":
            dataset = [value]
        elif key in OPTIONS:
            options += [f"--{key}", value]
        elif key not in FLAGS:
            changed.append(f"{key}={value}")
        elif value == "true":
            switched.append(f"--{key}")
    set_all = itertools.chain.from_iterable(("--set", setting) for setting in changed)
    return ("train", *dataset, *options, *switched, *set_all)


def check_run(dataset: str, request: RunRequest) -> None:
    """Refuse a run that ``wrf-mi train`` would refuse."""
    plan_run(_record(dataset), request)


_record = lru_cache(maxsize=4)(load_record)


def run_sweep(sweep: Sweep, scheduler: Scheduler | None = None) -> list[dict[str, Any]]:
    """Run what is not finished yet, and write the table.

    Args:
        sweep: planned runs; the folder is made if need be.
        scheduler: computes the runs; None: this process, one after the other. Its workers must see folder, data sets
            and scenes under the same names.

    Returns:
        A dictionary for each run: the varied settings, the keys of `HEADINGS`, ``metrics`` (content of
        ``metrics.json``) and ``run``, its folder. ``status`` is ``done``, ``kept``, or an error message.

    Raises:
        InputError: the folder of another sweep, or with other content.
    """
    _claim(sweep)
    finished: dict[int, dict[str, Any]] = {}

    def each(index: int, row: dict[str, Any]) -> None:
        finished[index] = row
        rows = [finished[k] for k in sorted(finished)]  # written after each run: a sweep may take days
        columns = ["run", *sweep.varied, *HEADINGS]
        write_csv(sweep.folder / "scores.csv", columns, ([row[key] for key in columns] for row in rows))
        write_atomically(sweep.folder / "scores.md", sweep_table(rows, sweep.varied) + "\n")
        write_atomically(sweep.folder / "scores.json", json.dumps(rows, indent=1) + "\n")
        headline = row["status"] if row["median"] is None else f"{row['score']} median {row['median']:.3f}"
        count = f"{len(finished)} of {len(sweep.runs)}"
        print(f"{sweep.runs[index].folder.name}: {headline} ({count})", file=sys.stderr, flush=True)

    return (scheduler or Scheduler()).map(_run, sweep.runs, what="sweeping", each=each)


def _claim(sweep: Sweep) -> None:
    """Make the folder, or check that it belongs to the same sweep, perhaps with other values."""
    folder, path = sweep.folder, sweep.folder / SHARED
    content = {name: content_digest(paths) for name, paths in _files(sweep).items()}
    current: dict[str, dict[str, str]] = {"versions": package_versions(), "content": content}
    if path.exists():
        current = _with_stored(sweep, path, current)
    elif folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder}: exists, is not empty and holds no sweep; choose another --out")
    elif folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; choose another --out")
    write_atomically(path, json.dumps({**sweep.shared, **current}, indent=1) + "\n")


def _with_stored(sweep: Sweep, path: Path, current: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Versions and content, with those that ``sweep.json`` states in addition; `InputError`: it states others."""
    with readable(path, f"{path}: missing; choose another --out", "choose another --out"):
        before = json.loads(path.read_text())
    if not isinstance(before, dict) or {key: before.get(key) for key in sweep.shared} != sweep.shared:
        raise InputError(f"{sweep.folder}: holds a sweep with other settings than this one; choose another --out")
    merged: dict[str, dict[str, str]] = {}
    for key, text in (("versions", "by other versions of"), ("content", "with other content of")):
        stored, now = before.get(key, {}), current[key]
        changed = [name for name in now if stored.get(name, now[name]) != now[name]]
        changed += [] if key in before else ["what it does not state"]
        if changed:
            raise InputError(f"{sweep.folder}: holds a sweep {text} {listed(changed)}; choose another --out")
        merged[key] = stored | now
    return merged


def _files(sweep: Sweep) -> dict[str, list[Path]]:
    """Files of data sets, scenes and settings by the name that the command gives."""
    files: dict[str, list[Path]] = {}
    for run in sweep.runs:
        words = run.arguments[1:]
        for before, word in itertools.pairwise(("dataset", *words)):
            key, _, value = word.partition("=") if before == "--set" else (before.removeprefix("--"), "", word)
            if key == "dataset" and not word.startswith("--"):
                files[value] = dataset_files(value)
            elif key in FILES:
                files[value] = scene_files(value)
    return {name: paths for name, paths in files.items() if paths}


def dataset_files(name_or_folder: str) -> list[Path]:
    """Folder or file of a data set; empty where it is not on this machine; `InputError`: no such data set."""
    path = Path(name_or_folder)
    return [path] if path.exists() else [place for place in (locate(name_or_folder),) if place is not None]


def scene_files(scene: str | Path) -> list[Path]:
    """Folder or file of a scene, with the files that a Mitsuba XML names; empty for the name of an embedded scene.

    `InputError`: an XML that cannot be read.
    """
    path = Path(scene)
    if not path.exists():
        return []
    if path.suffix.lower() != ".xml":
        return [path]
    try:
        values = [node.get("value", "") for node in parse(path, forbid_dtd=True).iter("string")]
    except (ElementTree.ParseError, DefusedXmlException, OSError) as error:
        raise InputError(f"{path}: not readable as XML ({one_line(error)}); correct the scene") from None
    return [path, *(file for value in values if value and (file := path.parent / value).is_file())]


def _run(run: SweepRun) -> dict[str, Any]:
    """Run a combination in a subprocess; return its row of the table."""
    folder = run.folder
    if is_finished(folder):
        return _row(run, "kept")
    resumable = (folder / CONFIG).exists()
    if folder.exists() and not resumable:
        shutil.rmtree(folder)  # stopped before its configuration was there: nothing to go on from
    arguments = ("train", "--resume", str(folder)) if resumable else (*run.arguments, "--out", str(folder))
    status, message = run_module(APPLICATIONS.module(COMMAND).rpartition(".")[0], arguments)
    done = status == 0 and (folder / METRICS).exists()
    return _row(run, "done" if done else message.removeprefix("wrf-mi: ") or f"ended with status {status}")


def _row(run: SweepRun, status: str) -> dict[str, Any]:
    metrics = stored_metrics(run.folder)
    row: dict[str, Any] = {"run": str(run.folder), **run.varied, **dict.fromkeys(HEADINGS), "status": status}
    if not metrics:
        return row | {"metrics": {}}
    task, references = TASKS[metrics["task"]], metrics["reference"]
    row |= {key: metrics[key] for key in HEADINGS if key in metrics} | {"metrics": metrics}
    best = best_reference(references, "median", task.higher_is_better)
    row |= {"score": task.label, "reference_median": references[best]["median"]}
    return row | {key: metrics[task.block][key] for key in SCORES}


def check_failures(rows: Sequence[Mapping[str, Any]]) -> None:
    """Raise `SweepFailed` with the names of runs without scores."""
    if failed := [f"{Path(row['run']).name}: {row['status']}" for row in rows if row["median"] is None]:
        raise SweepFailed(f"sweep: {len(failed)} of {len(rows)} runs failed: {listed(failed, mark='; ')}")


def sweep_table(rows: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> str:
    """Markdown table of the rows of `run_sweep`."""
    cells = ([_cell(key, row[key]) for key in (*varied, *HEADINGS)] for row in rows)
    return markdown_table([*varied, *HEADINGS.values()], cells)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Table in Markdown of a heading and rows of as many cells."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def _cell(key: str, value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}" if key in (*SCORES, "reference_median") else f"{value:.1f}"
    return str(value).replace("|", "\\|")
