"""The figures of this project, measured by its own command and stored with how they were made.

A case is either a run of ``wrf-mi`` that leaves a run folder, or a check: a function that measures one part
against what it is held to, on data or scenes that others made.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import yaml

from wrf_mi.core import InputError
from wrf_mi.core.files import write_atomically
from wrf_mi.core.registry import Registry, resolve
from wrf_mi.parallel import Scheduler, run_module, worker_threads
from wrf_mi.runs.fit_key import dataset_files, fit_key
from wrf_mi.runs.folder import CONFIG, METRICS, versions

RFID, FLAT, CONFERENCE, OFFICE = "rfid-lab", "flat-ble", "newrf-conference", "newrf-office"
"""Data sets that are measured elsewhere; all others are made on this machine."""


class BenchFailed(RuntimeError):
    """A case did not finish; its command said why."""

    exit_status = 1


REFUSED = 2
"""Exit status of bad input."""


class CheckRefused(InputError):
    """What a check needs is not on this machine; its process has said so on standard error."""


ENTRY_POINTS = "wrf_mi.benchmarks"
"""Group of the entry points by which other packages add checks."""


def _here(function: str) -> str:
    return f"{__package__}.{function}"


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes:
        title: for the table.
        arguments: of ``wrf-mi``, without ``--out``.
        data: data sets that it reads.
    """

    title: str
    arguments: tuple[str, ...]
    data: tuple[str, ...] = (RFID,)


@dataclass(frozen=True)
class Check:
    """One measurement by a function.

    Attributes:
        title: for the table.
        function: ``module:function``; it takes nothing and returns ``rows``, a list of dictionaries ``what``, ``value``
            (text with its unit) and ``asked``, beside whatever else it measured, and ``failed``, a line, where the
            command has to end with status 1 after all is stored.
        quick: likewise, the same with few cases, for `quick_checks`; it raises `BenchFailed` where a bound is not held.
            Empty: there is none.
        data: data sets that it reads where they are on this machine.
        resumes: whether the function keeps what it measured, and every call of the benchmark calls it; others are
            called again with other versions or data only.
        table: ``module:function`` that makes a table of ``rows``; empty: their ``what``, ``value`` and ``asked``.
    """

    title: str
    function: str
    quick: str = ""
    data: tuple[str, ...] = ()
    resumes: bool = False
    table: str = ""


MEASURED, STORED_CHECK = "bench.json", "check.json"
"""In the folder of a case that is finished, and of a check."""


SHORT = ("--set", "steps=3000", "--set", "holdout_steps_fraction=0")
"""The schedule of the blocked split, whose five folds are fitted in turn."""


LONG = ("--set", "steps=15000")
"""The schedule of the authors' split; the default of WRF-GS+, 9,000 steps, scores as high on held-out rows."""


def _train(*arguments: str) -> tuple[str, ...]:
    return ("train", RFID, *arguments)


CASES: Mapping[str, Case] = {
    **{
        f"wrf-gs+-official-seed{seed}": Case(
            f"WRF-GS+, authors' split, seed {seed}", _train("--model", "wrf-gs+", "--seed", str(seed), *LONG)
        )
        for seed in range(3)
    },
    "wrf-gs-official": Case("WRF-GS, authors' split", _train("--model", "wrf-gs", *LONG)),
    "wrf-gs+-paper": Case("WRF-GS+, L = 9 as the paper", _train("--model", "wrf-gs+", "--preset", "paper", *LONG)),
    "wrf-gs+-blocked": Case("WRF-GS+, blocked", _train("--model", "wrf-gs+", "--split", "blocked", *SHORT)),
    "wrf-gs-blocked": Case("WRF-GS, blocked", _train("--model", "wrf-gs", "--split", "blocked", *SHORT)),
    "demo": Case("the demo (WRF-GS+, short)", ("demo",), (RFID, FLAT)),
}


_OWN: Mapping[str, Check] = {
    "traced-and-splatted": Check("Mitsuba integrator", _here("traced:main")),
    "image-method": Check("Sionna RT against MATLAB", _here("trace:newrf"), data=(CONFERENCE, OFFICE)),
    "scan-to-paths": Check("mesh from a scan", _here("scene:scans"), data=(CONFERENCE, OFFICE)),
    "large-scan": Check("mesh from a scan", _here("scene:large_scan"), data=(OFFICE,)),
    "flat-plan": Check("mesh of a flat", _here("plan:flat_plan"), data=(FLAT,)),
    "flat-ble": Check("ray tracing in a flat", _here("calibration:flat"), data=(FLAT,)),
    "stress": Check("numbers under stress", _here("stress:main"), _here("stress:quick")),
    "determinism": Check("the same again", _here("determinism:main"), data=(RFID, FLAT, CONFERENCE)),
    "physics-rfid-lab": Check("physics, rfid-lab", _here("physics_spectrum:rfid_lab"), data=(RFID,)),
    "physics-flat": Check("physics, flat-ble", _here("physics_rssi:all_rows"), data=(FLAT,)),
    "physics-flat-64": Check("physics, flat-ble", _here("physics_rssi:few_rows"), data=(FLAT,)),
    "physics-conference": Check("physics, newrf", _here("physics_csi:conference"), data=(CONFERENCE,)),
    "physics-office": Check("physics, newrf", _here("physics_csi:office"), data=(OFFICE,)),
    "physics-room": Check("physics, traced room", _here("physics_room:main")),
    "physics-starts": Check("WRF-GS+, traced room", _here("starts:main")),
    "pareto": Check("traced room", _here("pareto:main"), data=("traced-room",)),
    "scaling": Check("cost against work", _here("scaling:main")),
    "operator": Check("prediction by operator", _here("operator:main")),
    "budgets": Check("fields at budgets", _here("budget:main"), data=(RFID,)),
    "training": Check("training", _here("training:main"), data=(RFID,)),
    "sentinels": Check(
        "figures kept",
        _here("sentinels:main"),
        data=(RFID, FLAT, CONFERENCE, OFFICE),
        resumes=True,
        table=_here("sentinels:table"),
    ),
}
_CHECKS = Registry[Check]("benchmark", ENTRY_POINTS, _OWN)
CHECKS: Mapping[str, Check] = _CHECKS
"""Every check by its name."""


def register(name: str, check: Check) -> None:
    """Add a check for this process; an installed package names it by an entry point of the group `ENTRY_POINTS`.

    Raises:
        InputError: a name that is taken.
    """
    _CHECKS.add(name, check)


SHARED_NOTE = (
    "bench: cases that share a machine slow each other down: for times that can be compared start one worker on each "
    "machine, with OMP_NUM_THREADS at its number of cores (docs/cluster.md)"
)


def bench(names: Sequence[str], out: Path, runs: Path, scheduler: Scheduler | None = None) -> list[dict[str, Any]]:
    """Measure cases one after the other, each as a process of its own, and write the table.

    A case that is finished for the same arguments, data and versions is only written down again; one that was stopped
    goes on.

    Args:
        names: keys of `CASES` and `CHECKS`.
        out: folder for ``<case>.json`` and the tables, ``README.md``.
        runs: folder for run folders.
        scheduler: whose workers measure a case each at a time, with their number of threads, and must see ``runs`` and
            the data under the same names; None: this process.

    Returns:
        One dictionary a case, as in its JSON file.

    Raises:
        InputError: an unknown case, or what a check needs is not on this machine.
        BenchFailed: a case that did not finish.
    """
    for name in names:
        if name not in CASES and name not in CHECKS:
            raise InputError(f"bench {name}: unknown; choose from {', '.join([*CASES, *CHECKS])}")
    out.mkdir(parents=True, exist_ok=True)

    def each(index: int, result: dict[str, Any]) -> None:
        name = names[index]
        write_atomically(out / f"{name}.json", json.dumps(result, indent=1) + "\n")
        print(f"{name}: {out / name}.json", file=sys.stderr)

    if scheduler is not None:
        print(SHARED_NOTE, file=sys.stderr)
    rows = (scheduler or Scheduler()).map(partial(_case, runs), names, what="measuring", each=each)
    trained, checked = read_results(out)
    parts = ["# Figures", f"Written by `wrf-mi bench`. {NOTE}", table(trained), CHECK_NOTE, check_table(checked)]
    write_atomically(out / "README.md", "\n\n".join(parts) + "\n")
    return rows


def quick_checks(names: Sequence[str]) -> list[dict[str, Any]]:
    """Checks with few cases, in this process; nothing is stored, as stored figures are those of all cases.

    Args:
        names: keys of `CHECKS`.

    Returns:
        One dictionary a check: ``case``, ``title`` and ``figures``.

    Raises:
        InputError: an unknown name, or one without a quick form.
        BenchFailed: a bound that is not held.
    """
    able = [name for name, check in CHECKS.items() if check.quick]
    for name in names:
        if name not in able:
            what = "has no quick form" if name in CHECKS or name in CASES else "unknown"
            raise InputError(f"bench {name} --quick: {what}; only {', '.join(able)} has one, or leave --quick away")
    results = []
    for name in names:
        figures = resolve(CHECKS[name].quick)()
        results.append({"case": name, "title": CHECKS[name].title, "figures": figures})
    return results


def _case(runs: Path, name: str) -> dict[str, Any]:
    folder = case_folder(runs, name)
    resumes = name in CHECKS and CHECKS[name].resumes
    if not resumes and (folder / (STORED_CHECK if name in CHECKS else MEASURED)).exists():
        print(f"{name}: finished before in {folder}, with the same data and versions", file=sys.stderr)
    return _check(name, folder) if name in CHECKS else _measure(name, folder)


def case_folder(runs: Path, name: str) -> Path:
    """Folder of a case or check: its name and a key of arguments, data and versions (`wrf_mi.runs.fit_key`)."""
    made: Case | Check = CHECKS[name] if name in CHECKS else CASES[name]
    what = made.function if isinstance(made, Check) else made.arguments
    return runs / f"{name}-{fit_key(what, [dataset_files(one) for one in made.data])}"


def _measure(name: str, folder: Path) -> dict[str, Any]:
    case = CASES[name]
    arguments = [*case.arguments, "--out", str(folder)]
    if not (folder / METRICS).exists() or not (folder / MEASURED).exists():
        resumed = (folder / CONFIG).exists()
        call = ["train", "--resume", str(folder)] if resumed else arguments
        start = time.perf_counter()
        status, said = run_module("wrf_mi.cli", call)
        if status != 0:
            raise BenchFailed(f"bench {name}: `wrf-mi {' '.join(call)}` ended with status {status} {said}".rstrip())
        # The time of the whole process means something only where it ran in one go.
        wall = None if resumed else time.perf_counter() - start
        # Written when it is measured: the table may be made again elsewhere.
        measured = {"wall_seconds": wall, "date": time.strftime("%Y-%m-%d"), "machine": machine(), **threads()}
        write_atomically(folder / MEASURED, json.dumps(measured))
    config = yaml.safe_load((folder / CONFIG).read_text())
    return {
        "case": name,
        "title": case.title,
        "command": "wrf-mi " + " ".join(arguments),
        **json.loads((folder / MEASURED).read_text()),
        "versions": config["versions"],
        "metrics": json.loads((folder / METRICS).read_text()),
    }


def _check(name: str, folder: Path) -> dict[str, Any]:
    """The stored result of a check, measured now if there is none; in a process of its own, as it states its memory."""
    stored = folder / STORED_CHECK
    if CHECKS[name].resumes or not stored.exists():
        folder.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        status, said = run_module("wrf_mi_bench.check", [CHECKS[name].function, str(stored)])
        if status == REFUSED:
            # A worker's process is quiet, and its last line comes back.
            raise InputError(said.removeprefix("wrf-mi: ")) if said else CheckRefused(f"bench {name}: refused")
        if status != 0:
            raise BenchFailed(f"bench {name}: ended with status {status} {said}".rstrip())
        measured = json.loads(stored.read_text())
        where = {"date": time.strftime("%Y-%m-%d"), "machine": machine(), "versions": versions(), **threads()}
        measured = {"wall_seconds": time.perf_counter() - start, **where, "figures": measured}
        write_atomically(stored, json.dumps(measured, indent=1))
    known = {"case": name, "title": CHECKS[name].title, "command": f"wrf-mi bench {name}"}
    return known | json.loads(stored.read_text())


def threads() -> dict[str, int]:
    """What must be known of a measurement in a worker beside its machine."""
    count = worker_threads()
    return {} if count is None else {"worker_threads": count}


def machine() -> dict[str, Any]:
    """What this machine is."""
    return {
        "processor": versions()["device"],
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9),
        "system": f"{platform.system()} {platform.machine()}",
    }


def read_results(out: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """All stored results, those of `CASES` and those of `CHECKS`, each in their order."""

    def stored(names: Mapping[str, Any]) -> list[dict[str, Any]]:
        return [json.loads(path.read_text()) for name in names if (path := out / f"{name}.json").exists()]

    return stored(CASES), stored(CHECKS)


CHECK_NOTE = "Checks against what others made, or against what a part is held to:"

NOTE = (
    "SSIM is scikit-image's, over test rows; *blend* is the inverse-distance blend of the four nearest training "
    "spectra on the same rows; time is training time on the machine named in each JSON file, which also holds the "
    "versions, the date and the command."
)


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of results."""
    lines = [
        "| what | SSIM median | mean | p10 | p90 | blend median | steps | training | ms per spectrum | peak memory |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for result in results:
        m = result["metrics"]
        own, blend = m["ssim"], m["reference"]["idw4"]["median"]
        minutes = f"{m['train_seconds'] / 60:.1f} min"
        lines.append(
            f"| {result['title']} | **{own['median']:.3f}** | {own['mean']:.3f} | {own['p10']:.3f} | {own['p90']:.3f} "
            f"| {blend:.3f} | {m['steps']:,} | {minutes} | {m['ms_per_sample']:.1f} | {m['peak_memory_mb']:.0f} MB |"
        )
    return "\n".join(lines)


def own_table(result: Mapping[str, Any]) -> str:
    """Markdown table of one check, in the form that it states."""
    form = CHECKS[result["case"]].table
    return str(resolve(form)(result["figures"]["rows"])) if form else check_table([result])


def check_table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of checks."""
    lines = ["| what | measured | asked |", "| --- | --- | --- |"]
    for result in results:
        rows = result["figures"]["rows"]
        lines += [f"| {result['title']}: {r['what']} | **{r['value']}** | {r['asked']} |" for r in rows]
    return "\n".join(lines)
