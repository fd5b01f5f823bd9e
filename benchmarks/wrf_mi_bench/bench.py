"""Cases and checks of ``wrf-mi bench``: measured in subprocesses and stored as JSON with machine and versions.

A case is a run of ``wrf-mi`` with a run folder; a check is a function that compares a part with a reference.
"""

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

from wrf_mi.backend import choose
from wrf_mi.core import InputError
from wrf_mi.core.files import write_atomically
from wrf_mi.core.registry import Registry, resolve
from wrf_mi.parallel import Scheduler, run_module, worker_threads
from wrf_mi.runs.folder import CONFIG, METRICS, is_finished, versions
from wrf_mi.runs.sweep import dataset_files

from .declared import lined
from .sources import SOURCE, fit_key, modules_of_benchmark, modules_of_command, source_digests

RFID, FLAT, CONFERENCE, OFFICE = "rfid-lab", "flat-ble", "newrf-conference", "newrf-office"
"""Public data sets; all others are made on this machine."""


class BenchFailed(RuntimeError):
    """A case or check failed."""

    exit_status = 1


REFUSED = 2  # exit status of bad input
ENTRY_POINTS = "wrf_mi.benchmarks"  # group of entry points by which other packages add checks
MEASURED, STORED_CHECK = "bench.json", "check.json"  # files in the folder of a finished case, and of a finished check


class CheckRefused(InputError):
    """Data of a check are missing; its process has printed that on standard error."""


@dataclass(frozen=True)
class Case:
    """A run of ``wrf-mi``: its title, arguments without ``--out``, and data sets."""

    title: str
    arguments: tuple[str, ...]
    data: tuple[str, ...] = (RFID,)


@dataclass(frozen=True)
class Check:
    """A measurement by a function.

    Attributes:
        title: title in the table.
        function: ``module:function`` without arguments that returns ``rows`` (dictionaries of ``what``, ``value`` with
            its unit and ``asked``), other figures, and ``failed``, a line, where the command has to end with status 1.
        quick: ``module:function`` with few cases, which raises `BenchFailed` beyond a bound; "": none.
        data: data sets that it reads where they are on this machine.
        resumes: whether the function keeps its results and is called every time.
        table: ``module:name`` of a table of ``rows`` (`wrf_mi_bench.declared`); "": `check_table`.
        gpu: whether it needs a GPU.
    """

    title: str
    function: str
    quick: str = ""
    data: tuple[str, ...] = ()
    resumes: bool = False
    table: str = ""
    gpu: bool = False


def _here(title: str, function: str, *data: str, quick: str = "", table: str = "", **more: Any) -> Check:
    function, quick, table = (name and f"{__package__}.{name}" for name in (function, quick, table))
    return Check(title, function, quick, data, table=table, **more)


CASES: Mapping[str, Case] = {
    "wrf-gs+-paper": Case(
        "WRF-GS+, L = 9 as the paper",
        ("train", RFID, *("--model", "wrf-gs+", "--preset", "paper"), "--set", "steps=15000"),
    ),
    "wrf-gs+-fast": Case("WRF-GS+, fast preset", ("train", RFID, "--model", "wrf-gs+", "--preset", "fast")),
}
"""Runs that are not rows of the tables (`wrf_mi_bench.table_plan`)."""

_STORED: Any = {"resumes": True}  # of checks that keep their parts
_OWN: Mapping[str, Check] = {
    "image-method": _here("traced paths against MATLAB", "trace:newrf", CONFERENCE, OFFICE),
    "scan-to-paths": _here("mesh from a scan", "scene:scans", CONFERENCE, OFFICE),
    "large-scan": _here("mesh from a scan", "scene:large_scan", OFFICE),
    "phone-scans": _here("mesh from a phone's scan", "phone_scans:main", table="phone_scans:table", **_STORED),
    "flat-plan": _here("mesh of a flat", "scene:flat_plan", FLAT),
    "stress": _here("numbers under stress", "stress:main", quick="stress:quick"),
    "pareto": _here("run time against error", "table_pages:pareto", resumes=True, table="table_pages:front_table"),
    "scaling": _here("cost against work", "scaling:main"),
    "side-by-side": _here("side by side", "side_by_side:main", resumes=True, table="side_by_side:table"),
    "skips": _here("what is not evaluated", "skips:main", table="skips:table"),
    "stages": _here("hybrid and its parts alone", "stages:main", RFID, FLAT, resumes=True, table="stages:table"),
    "new-carriers": _here("carriers without measurements", "unmeasured:carriers", table="unmeasured:table", **_STORED),
    "new-receivers": _here(
        "receivers without measurements, and with few",
        "unmeasured:receivers",
        FLAT,
        table="unmeasured:table",
        **_STORED,
    ),
    "ablation": _here("mechanisms of signal strengths", "ablation:main", FLAT, resumes=True, table="ablation:table"),
    "journey": _here("plan and walk", "journey:main", table="journey:table"),
    "buildings": _here("measured buildings", "buildings:main", FLAT, resumes=True, table="buildings:table"),
    "devices": _here("own readings of a device", "buildings:devices", resumes=True, table="buildings:devices_table"),
    "rooms": _here("random rooms", "rooms:main", resumes=True, table="rooms:table"),
    "fdtd": _here("Maxwell's equations in a toy scene", "fdtd:main", table="fdtd:table"),
    "far-scans": _here("scans off by wavelengths", "far_scans:main", resumes=True, table="far_scans:table"),
    "locate": _here("positions from strengths", "locate:main", FLAT, resumes=True, table="locate:table"),
    "reception": _here("reception", "reception:main", FLAT, resumes=True, table="reception:table"),
    "moved": _here("furniture moved", "moved:main", resumes=True, table="moved:table"),
    "phase-error": _here("spectra from scans", "rooms:phase_errors", resumes=True, table="rooms:phase_table"),
    "closed-forms": _here("traced channels against closed forms", "closed_forms:main", table="closed_forms:table"),
    "elsewhere": _here("the same elsewhere", "elsewhere:main", table="elsewhere:table"),
    "gpu": _here("a GPU beside the CPU", "gpu:main", table="gpu:table", gpu=True),
    "plan": _here("where to measure next", "planning:main", FLAT, resumes=True, table="planning:table"),
    "waits": _here("what a person waits for", "waits:main", RFID, FLAT, resumes=True, table="waits:table"),
    "sentinels": _here(
        "figures kept", "sentinels:main", RFID, FLAT, CONFERENCE, OFFICE, resumes=True, table="sentinels:table"
    ),
}
_CHECKS = Registry[Check]("benchmark", ENTRY_POINTS, _OWN)
CHECKS: Mapping[str, Check] = _CHECKS  # all checks by name


def register(name: str, check: Check) -> None:
    """Add a check for this process; an installed package names it by an entry point of the group `ENTRY_POINTS`."""
    _CHECKS.add(name, check)


SHARED_NOTE = (
    "bench: cases that share a machine slow each other down: for times that can be compared start one worker on each "
    "machine, with OMP_NUM_THREADS at its number of cores (docs/cluster.md)"
)


def bench(names: Sequence[str], out: Path, runs: Path, scheduler: Scheduler | None = None) -> list[dict[str, Any]]:
    """Measure cases and checks, each in a subprocess, and write ``<case>.json`` and ``README.md`` to ``out``.

    A case that is finished in ``runs`` for the same arguments, source, data and versions is used again; a stopped one
    is resumed. Workers of a scheduler must have ``runs`` and the data under the same paths. Content of each JSON file.
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


def all_here() -> list[str]:
    """All cases and checks, without those that need a GPU where none works."""
    able = choose().name == "cuda"
    return [*CASES, *(name for name, check in CHECKS.items() if able or not check.gpu)]


def quick_checks(names: Sequence[str]) -> list[dict[str, Any]]:
    """``case``, ``title`` and ``figures`` of checks with few cases, measured in this process and not stored."""
    able = [name for name, check in CHECKS.items() if check.quick]
    for name in names:
        if name not in able:
            what = "has no quick form" if name in CHECKS or name in CASES else "unknown"
            raise InputError(f"bench {name} --quick: {what}; only {', '.join(able)} has one, or omit --quick")
    return [{"case": name, "title": CHECKS[name].title, "figures": resolve(CHECKS[name].quick)()} for name in names]


def _case(runs: Path, name: str) -> dict[str, Any]:
    folder = case_folder(runs, name)
    resumes = name in CHECKS and CHECKS[name].resumes
    if not resumes and (folder / (STORED_CHECK if name in CHECKS else MEASURED)).exists():
        print(f"{name}: finished before in {folder}, with the same source, data and versions", file=sys.stderr)
    return _check(name, folder) if name in CHECKS else _measure(name, folder)


def case_folder(runs: Path, name: str) -> Path:
    """Folder of a case or check: its name and a `fit_key` of arguments, source, data and versions."""
    entry: Case | Check = CHECKS[name] if name in CHECKS else CASES[name]
    what = entry.function if isinstance(entry, Check) else entry.arguments
    # A check that goes on keys its parts itself.
    source = {} if isinstance(entry, Check) and entry.resumes else source_digests(*modules_of(name))
    return runs / f"{name}-{fit_key(what, source, [dataset_files(dataset) for dataset in entry.data])}"


def modules_of(name: str) -> tuple[str, ...]:
    """Modules that a case or check executes."""
    if name in CHECKS:
        return modules_of_benchmark(CHECKS[name].function.partition(":")[0])
    return modules_of_command(CASES[name].arguments)


def _measure(name: str, folder: Path) -> dict[str, Any]:
    case = CASES[name]
    if not is_finished(folder) or not (folder / MEASURED).exists():
        wall = run_command(case.arguments, folder, f"bench {name}: ")
        write_atomically(folder / MEASURED, json.dumps({"wall_seconds": wall, **provenance(*modules_of(name))}))
    return {
        "case": name,
        "title": case.title,
        "command": f"wrf-mi {' '.join(case.arguments)} --out {folder}",
        **json.loads((folder / MEASURED).read_text()),
        "metrics": json.loads((folder / METRICS).read_text()),
    }


def run_command(arguments: Sequence[str], folder: Path, where: str = "", resumes: bool = True) -> float | None:
    """Run ``wrf-mi`` into a run folder, or resume it there; elapsed seconds, None where it was resumed."""
    resumed = resumes and (folder / CONFIG).exists()
    call = ["train", "--resume", str(folder)] if resumed else [*arguments, "--out", str(folder)]
    start = time.perf_counter()
    status, message = run_module("wrf_mi.apps.commands", call)
    if status != 0:
        raise BenchFailed(f"{where}`wrf-mi {' '.join(call)}` ended with status {status} {message}".rstrip())
    return None if resumed else time.perf_counter() - start


def _check(name: str, folder: Path) -> dict[str, Any]:
    """Stored result of a check, measured in a subprocess where there is none."""
    stored = folder / STORED_CHECK
    if CHECKS[name].resumes or not stored.exists():
        folder.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        status, message = run_module("wrf_mi_bench.check", [CHECKS[name].function, str(stored)])
        if status == REFUSED:
            # The output of a worker's subprocess is captured.
            raise InputError(message.removeprefix("wrf-mi: ")) if message else CheckRefused(f"bench {name}: refused")
        if status != 0:
            raise BenchFailed(f"bench {name}: ended with status {status} {message}".rstrip())
        figures = json.loads(stored.read_text())
        measured = {"wall_seconds": time.perf_counter() - start, **provenance(*modules_of(name)), "figures": figures}
        write_atomically(stored, json.dumps(measured, indent=1))
    header = {"case": name, "title": CHECKS[name].title, "command": f"wrf-mi bench {name}"}
    return header | json.loads(stored.read_text())


def provenance(*modules: str) -> dict[str, Any]:
    """Date, machine, versions of packages, digests of the source and, in a worker, its number of threads.

    ``modules`` made the result; what they import counts too.
    """
    count, installed_versions = worker_threads(), versions()
    machine = {"processor": installed_versions["device"], "cores": os.cpu_count()}
    machine["memory_gb"] = round(psutil.virtual_memory().total / 1e9)
    machine["system"] = f"{platform.system()} {platform.machine()}"
    facts = {"date": time.strftime("%Y-%m-%d"), "machine": machine, "versions": installed_versions}
    return facts | {SOURCE: source_digests(*modules)} | ({} if count is None else {"worker_threads": count})


def read_results(out: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Stored results of `CASES` and of `CHECKS`, in their order."""

    def stored(names: Mapping[str, Any]) -> list[dict[str, Any]]:
        return [json.loads(path.read_text()) for name in names if (path := out / f"{name}.json").exists()]

    return stored(CASES), stored(CHECKS)


CHECK_NOTE = "Checks against other programs, or against bounds:"

NOTE = (
    "SSIM is scikit-image's, over test rows; *IDW* is inverse-distance weighting of the nearest training spectra "
    "on the same rows; time is training time on the machine named in each JSON file, which also holds the versions, "
    "the date and the command."
)


table = lined(
    "| what | SSIM median | mean | p10 | p90 | IDW median | steps | training | ms per spectrum | peak memory |",
    "| {title} | **{ssim[median]:.3f}** | {ssim[mean]:.3f} | {ssim[p10]:.3f} | {ssim[p90]:.3f} "
    "| {idw:.3f} | {steps:,} | {minutes:.1f} min | {ms_per_sample:.1f} | {peak_memory_mb:.0f} MB |",
    lambda row: {
        "title": row["title"],
        **row["metrics"],
        "minutes": row["metrics"]["train_seconds"] / 60,
        # Earlier results name it with its number of neighbours.
        "idw": next(block["median"] for key, block in row["metrics"]["reference"].items() if key.startswith("idw")),
    },
)
"""Scores and costs of `CASES`."""


def own_table(result: Mapping[str, Any]) -> str:
    """Markdown table of one check, in the form that it states."""
    form = CHECKS[result["case"]].table
    return str(resolve(form)(result["figures"]["rows"])) if form else check_table([result])


def check_table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of the rows of checks."""
    rows = [{"title": result["title"], **row} for result in results for row in result["figures"]["rows"]]
    return lined("| what | measured | asked |", "| {title}: {what} | **{value}** | {asked} |")(rows)
