"""Long use: memory of many predictions and opened runs, memory of the demo, and tables that lose a worker.

Each measurement returns lines of a table (`wrf_mi_bench.comparison.line`) and what is wrong.
"""

import gc
import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from wrf_mi.core.files import write_atomically
from wrf_mi.core.settings import with_settings
from wrf_mi.parallel import run_module
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.folder import CONFIG
from wrf_mi.runs.results import read_run
from wrf_mi.training.config import default_config

from .bench import FLAT
from .comparison import line
from .fault_commands import FIELD, HOME, SPECTRA, Tables, differing, prepare_data, small_plan

PREDICTIONS, OPENED = 10_000, 1000  # predictions of a run, and runs that are opened, in one process
WARM = 10  # one call in so many precedes the first measurement, for kernels, caches and arenas of the allocator
AT_ONCE, GROWTH_MB = 16, 3.0
"""Positions of a prediction, and growth of the resident memory. 300 results of 16 spectra of 9 x 36 are 6 MB, and an
opened run keeps more than 100 kB; the allocator alone moves the memory by less than 1 MB."""
DEMO_GIB = 6.0
"""Memory of a small machine. Resident memory is measured, as LLVM and CUDA reserve more addresses (``ulimit -v``)."""
POLL_S, LOST_S = 0.1, 600.0
WORKER_CHILD = "wrf_mi.parallel.child"


def growth_mb(work: Callable[[], object], calls: int) -> float:
    """Growth of the resident memory of this process over calls that follow a `WARM`-th as many, MB."""

    def resident_mb() -> float:
        gc.collect()
        return float(psutil.Process().memory_info().rss / 1e6)

    for _ in range(calls // WARM):
        work()
    before = resident_mb()
    for _ in range(calls):
        work()
    return resident_mb() - before


def memory(folder: Path, predictions: int = PREDICTIONS, opened: int = OPENED) -> dict[str, Any]:
    """Growth of memory by predictions and by opened runs, of kriging and of Gaussians: ``rows`` and ``wrong``.

    Each run predicts ``predictions`` times, and is opened and its results read ``opened`` times.
    """
    prepare_data(folder)
    field = with_settings(default_config("spectrum", False), FIELD)
    runs = {
        "kriging": train(folder / HOME / FLAT, "kriging", out=folder / "kriging").folder,
        "wrf-gs+": train(folder / SPECTRA, "wrf-gs+", out=folder / "field", settings=field).folder,
    }
    rng, rows, wrong = np.random.default_rng(0), [], []
    for name, run in runs.items():
        opened_run = open_run(run)

        def predict(opened_run: Any = opened_run) -> None:
            opened_run.predict(rng.uniform(1, 4, (AT_ONCE, 3)))

        def open_again(run: Path = run) -> None:
            open_run(run).predict(rng.uniform(1, 4, (AT_ONCE, 3)))
            read_run(run)

        for what, work, calls in (("predictions", predict, predictions), ("opened runs", open_again, opened)):
            grown = growth_mb(work, calls)
            text = f"{name}: growth of resident memory by {calls} {what}"
            rows.append(line(text, f"{grown:.1f} MB", f"<= {GROWTH_MB:g} MB"))
            if grown > GROWTH_MB:
                wrong.append(f"{text}: {grown:.1f} MB")
    return {"rows": rows, "wrong": wrong}


def _tree(process: psutil.Process) -> Iterator[psutil.Process]:
    with suppress(psutil.Error):
        yield process
        yield from process.children(recursive=True)


def demo(folder: Path) -> dict[str, Any]:
    """Largest resident memory of ``wrf-mi demo`` and its child processes together: ``rows`` and ``wrong``."""
    call = [sys.executable, "-m", "wrf_mi.apps.commands", "demo", "--out", str(folder / "demo")]
    started, most = subprocess.Popen(call, stdout=subprocess.DEVNULL), 0
    process = psutil.Process(started.pid)
    while started.poll() is None:
        now = 0
        for member in _tree(process):
            with suppress(psutil.Error):
                now += member.memory_info().rss
        most = max(most, now)
        time.sleep(POLL_S)
    gib = most / 2**30
    rows = [line("demo: largest resident memory of its processes", f"{gib:.2f} GiB", f"<= {DEMO_GIB:g} GiB")]
    wrong = [] if started.returncode == 0 else [f"demo: ended with status {started.returncode}"]
    return {"rows": rows, "wrong": wrong + ([f"demo: {gib:.2f} GiB"] if gib > DEMO_GIB else [])}


def lost_worker(folder: Path) -> dict[str, Any]:
    """Tables on two workers, one of which is killed at work, against one process: ``rows`` and ``wrong``."""
    stored = folder / "lost.json"
    status, _ = run_module("wrf_mi_bench.endurance", [str(folder), str(stored)])
    wrong = json.loads(stored.read_text()) if status == 0 else [f"lost worker: ended with status {status}"]
    return {"rows": [line("tables that lose a worker", f"{len(wrong)} wrong", "0 wrong")], "wrong": wrong}


def _kill_worker(lost: list[int]) -> None:
    """Kill the first worker whose child has begun a run."""
    until = time.monotonic() + LOST_S
    while not lost and time.monotonic() < until:
        time.sleep(POLL_S)
        for child in _tree(psutil.Process()):
            with suppress(psutil.Error):
                words = child.cmdline()
                if not lost and WORKER_CHILD in words and (Path(words[-1]) / CONFIG).exists():
                    worker = child.parent()
                    assert worker is not None
                    worker.kill()
                    lost.append(worker.pid)


def main(folder: str, out: str) -> None:
    """Measure `lost_worker`, and write what is wrong; the plan of the tables is replaced in this process."""
    from wrf_mi.apps.commands.main import main as command

    place, lost, errors = Path(folder), list[int](), StringIO()
    prepare_data(place)
    tables = Tables("tables", place)
    tables.prepare(children=False)  # but in workers, which import the module themselves
    wrong, content = list[str](), list[dict[str, Any]]()
    for name, scheduler in (("whole", []), ("lost", ["--scheduler", "local:2"])):
        killer = threading.Thread(target=_kill_worker, args=(lost,), daemon=True)
        if scheduler:
            killer.start()
        with redirect_stdout(StringIO()), redirect_stderr(errors):
            status = command([*tables.call(place / name), *scheduler])
        if status != 0:
            wrong.append(f"tables {name}: status {status}, {errors.getvalue().splitlines()[-1]}")
            break
        content.append(tables.content(place / name))
    else:
        lines = Counter(text.partition(":")[0] for text in errors.getvalue().splitlines() if ": median " in text)
        if lines != {row.name: 2 for row in small_plan()}:  # of both
            wrong.append(f"tables: rows {dict(lines)}, each of them once in each table")
        if others := differing(*content):
            wrong.append(f"tables: other results: {', '.join(others)}")
    wrong += [] if lost else ["tables: no worker was killed"]
    write_atomically(Path(out), json.dumps(wrong))


if __name__ == "__main__":
    main(*sys.argv[1:])
