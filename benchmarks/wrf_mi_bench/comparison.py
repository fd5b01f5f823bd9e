"""Rows of the benchmarks' tables, and data that they need."""

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi.core import InputError
from wrf_mi.core.files import write_atomically
from wrf_mi.datasets.registry import locate
from wrf_mi.tracing import open_scene

from .bench import BenchFailed, modules_of, provenance

Row = dict[str, str]
STORED = Path("benchmarks/results")  # stored results, in a checkout
MEASURED = "measured"  # machine, versions and date of a stored part


def line(what: str, value: str, asked: str = "") -> Row:
    """Row of a check's table."""
    return {"what": what, "value": value, "asked": asked}


def say(name: str, text: str) -> None:
    """Print a line of progress of a benchmark on standard error."""
    print(f"{name}: {text}", file=sys.stderr, flush=True)


def kept(file: Path, measure: Callable[[], Any]) -> Any:
    """Result of a measurement, read from a JSON file where it was made before, else made and written."""
    if not file.exists():
        write_atomically(file, json.dumps(measure(), indent=1))
    return json.loads(file.read_text(encoding="utf-8"))


def kept_work(place: Path, name: str, measure: Callable[[Path], Any]) -> Any:
    """As `kept`, of a measurement in a folder below ``place``, which is removed after it."""
    folder = place / name
    shutil.rmtree(folder, ignore_errors=True)  # of a stopped measurement
    result = kept(place / f"{name}.json", partial(measure, folder))
    shutil.rmtree(folder, ignore_errors=True)
    return result


def stored_part(benchmark: str, name: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Part of a long benchmark, from ``benchmarks/results/<benchmark>/<name>.json`` where it was measured before.

    Parts are stored when they are done, with machine, versions and date, so that a measurement of many hours goes on,
    on another machine too. A part is measured again where its file is deleted.
    """
    file = STORED / benchmark / f"{name}.json"
    return dict(kept(file, lambda: {MEASURED: provenance(*modules_of(benchmark)), **measure()}))


def measured_on(parts: Iterable[Mapping[str, Any]]) -> str:
    """First and last date of the parts of a benchmark."""
    dates = sorted({part[MEASURED]["date"] for part in parts})
    return dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"


def data_folder(name: str) -> Path:
    """Folder of a known data set; `InputError` where it is not on this machine."""
    folder = locate(name)
    if folder is None:
        raise InputError(f"{name}: not on this machine; run `wrf-mi data fetch {name}`")
    return folder


def room_file(name: str) -> Path:
    """File ``<room>.npz`` of a NeWRF room; `InputError` where it is not on this machine."""
    return data_folder(f"newrf-{name}") / f"{name}.npz"


def opened(mesh: Any, frequency_hz: float, material: str) -> Any:
    """Scene (``sionna.rt.Scene``) of one ``trimesh.Trimesh``."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "mesh.ply"
        mesh.export(file, vertex_normal=False)
        return open_scene(file, frequency_hz, material=material)


def command(*arguments: str | Path, beside: Sequence[Sequence[str | Path]] = ()) -> float:
    """Seconds of a command, with others that start at the same time; `BenchFailed` unless all end well."""
    calls = [[sys.executable, "-m", "wrf_mi.apps.commands", *map(str, each)] for each in (arguments, *beside)]
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+") as errors:
        started = [subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=errors) for call in calls]
        status = [process.wait() for process in started]
        seconds = time.perf_counter() - start
        errors.seek(0)
        if any(status):
            raise BenchFailed(f"bench: `wrf-mi {' '.join(calls[0][3:])}`: {errors.read().strip().splitlines()[-1:]}")
    return seconds
