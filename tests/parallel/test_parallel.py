"""Parts on workers: order, what is opened once, lost workers, errors, what is refused."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import worker_tasks
from commands import positions_file
from worker_tasks import Lossy

from wrf_mi.backend import init
from wrf_mi.core import InputError
from wrf_mi.parallel import Scheduler, SchedulerFailed, open_scheduler, row_parts, run_module, scheduler, worker
from wrf_mi.parallel.scheduler import PartsProgress
from wrf_mi.parallel.threads import on_threads
from wrf_mi.parallel.worker import WorkerEnvironment, worker_environment

SECONDS = 60
"""For a process of ours to start on a busy machine."""


@pytest.mark.parametrize(("count", "workers", "least", "most"), [(1, 3, 1, 9), (100, 2, 1, 1000), (100, 2, 30, 60)])
def test_parts_cover_all_rows_once(count: int, workers: int, least: int, most: int) -> None:
    parts = row_parts(count, workers, least, most)
    assert [row for part in parts for row in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in parts]
    assert all(least <= size <= most for size in sizes[:-1])


def test_a_folder_with_the_name_of_the_package_does_not_hide_it(tmp_path, monkeypatch):
    """As where the project is cloned."""
    (tmp_path / "wrf_mi").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run_module("wrf_mi.apps.commands", ["--version"]) == (0, "")


def test_row_parts_respect_maximum_size_and_number_of_workers() -> None:
    assert len(row_parts(100_000, 1, 1, 1000)) == 100
    assert len(row_parts(80, 2)) == 16


def test_map_returns_results_in_order_and_calls_each_once(two: Scheduler, capsys: pytest.CaptureFixture[str]) -> None:
    received: list[tuple[int, int]] = []
    assert two.map(worker_tasks.double, range(20), what="doubling") == list(range(0, 40, 2))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[-1] == "doubling: 20 of 20, 2 workers"
    assert two.map(worker_tasks.double, range(5), each=lambda *arguments: received.append(arguments)) == [0, 2, 4, 6, 8]
    assert sorted(received) == [(k, 2 * k) for k in range(5)]
    assert two.map(worker_tasks.double, []) == []


def test_scheduler_without_workers_computes_in_this_process() -> None:
    received: list[tuple[int, int]] = []
    with open_scheduler(None) as serial:
        assert serial.map(worker_tasks.double, [3, 1], each=lambda *arguments: received.append(arguments)) == [6, 2]
        assert serial.map(pow, [2, 3], lambda: 2) == [4, 8]
    assert received == [(0, 6), (1, 2)]


def test_workers_adopt_folder_variables_and_backend_and_open_once(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WRF_MI_DATA", "elsewhere")
    places = two.map(worker_tasks.place_of, range(12), partial(worker_tasks.opened, tmp_path))
    processes = {process for process, *_ in places}
    assert os.getpid() not in processes
    assert len(processes) <= two.workers
    assert {tuple(environment) for _, *environment in places} == {(str(tmp_path), "elsewhere", init().variant)}
    assert len(list(tmp_path.glob("opened-*"))) == len(processes)


def test_parts_of_a_lost_worker_are_computed_by_another(two: Scheduler, tmp_path: Path) -> None:
    lossy = Lossy(two, tmp_path)
    assert lossy.map(worker_tasks.double, range(9)) == list(range(0, 18, 2))
    lossy.assert_one_was_lost()


def test_part_that_ends_four_workers_fails(two: Scheduler) -> None:
    with pytest.raises(SchedulerFailed, match="computing: 4 workers in a row ended in one part"):
        two.map(worker_tasks.die, [0])
    assert two.map(worker_tasks.double, [1]) == [2]


def test_errors_of_parts_are_raised_unchanged(two: Scheduler) -> None:
    with pytest.raises(InputError, match=r"^part -1: negative; give another$"):
        two.map(worker_tasks.refuse_negative, [1, 2, -1, 3])
    with pytest.raises(ZeroDivisionError, match="no such number"):
        two.map(worker_tasks.fail, [1])
    assert two.map(worker_tasks.refuse_negative, [4]) == [4]


def test_other_versions_and_folders_are_refused(two, tmp_path, monkeypatch):
    environment = worker_environment()
    monkeypatch.chdir(tmp_path)  # is put back after the worker's own change of folder
    other = WorkerEnvironment(environment.folder, (), environment.backend, (("drjit", "0.1"),))
    with pytest.raises(InputError, match=r"drjit 1\.5\.0, but 0\.1 where the command runs; install the same"):
        worker.run_part(other, "", None, worker_tasks.double, 1)
    gone = WorkerEnvironment(str(tmp_path / "gone"), (), environment.backend, environment.versions)
    with pytest.raises(InputError, match=r"cannot enter .*gone .*run the command in a folder that workers see"):
        worker.run_part(gone, "", None, worker_tasks.double, 1)


def test_invalid_scheduler_ends_with_one_line(tmp_path, command, monkeypatch):
    monkeypatch.setattr(scheduler, "CONNECT_S", 0.2)
    positions = positions_file(tmp_path / "tx.csv", [[1, 1, 1]])
    words = ["predict", tmp_path, "--tx", positions, "--out", tmp_path / "p.npz", "--scheduler"]
    for wrong, message in (
        ("locals", "expected local, local:N or the address"),
        ("local:0", "give the number of workers, 1 or more"),
        ("tcp://127.0.0.1:1", "no Dask scheduler answers there"),
        ("nonsense://127.0.0.1:1", "no Dask scheduler answers there"),
    ):
        command.refused([*words, wrong], message)
    monkeypatch.setitem(sys.modules, "distributed", None)
    command.refused([*words, "local:2"], r"pip install '\.\[cluster\]'")
    assert not (tmp_path / "p.npz").exists()


def test_waiting_for_a_worker_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    with PartsProgress("tracing", 2, lines=True) as bar:
        bar.waiting()
        bar.waiting()
        bar.add(1, 1)
    assert capsys.readouterr().err.splitlines() == [
        "tracing: waiting for a worker to connect to the scheduler",
        "tracing: 1 of 2, 1 worker",
    ]


def test_workers_of_this_machine_that_never_start_are_not_awaited_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import Client, LocalCluster

    monkeypatch.setattr(scheduler, "LOST_S", 0.5)
    monkeypatch.setattr(scheduler, "POLL_S", 0.1)
    cluster = LocalCluster(n_workers=0, dashboard_address=":0", silence_logs=logging.CRITICAL)
    without_workers = Scheduler(Client(cluster, set_as_default=False), cluster)
    with without_workers, pytest.raises(SchedulerFailed, match="no worker of this machine has started"):
        without_workers.map(worker_tasks.double, [1])


def awaited(file: Path) -> str:
    """Content of a file that another process writes."""
    until = time.monotonic() + SECONDS
    while not (file.exists() and file.read_text()) and time.monotonic() < until:
        time.sleep(0.05)
    return file.read_text()


@pytest.fixture
def sleeper(tmp_path: Path) -> dict[str, Any]:
    """Folder and environment of a module that writes its process's number and then sleeps while it is imported."""
    code = "import os, pathlib, time\npathlib.Path('pid').write_text(str(os.getpid()))\ntime.sleep(600)\n"
    (tmp_path / "sleeper.py").write_text(code)
    return {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}}


def test_child_that_is_stopped_while_it_imports_prints_no_traceback(tmp_path: Path, sleeper: dict[str, Any]) -> None:
    words = [sys.executable, "-m", "wrf_mi.parallel.child", "0", "sleeper"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE, **sleeper) as child:
        assert awaited(tmp_path / "pid")
        child.send_signal(signal.SIGINT)
        assert child.wait(SECONDS) == 130
        assert child.stderr is not None
        assert child.stderr.read() == b""


def test_child_ends_with_its_parent(tmp_path: Path, sleeper: dict[str, Any]) -> None:
    """Even a parent that is killed."""
    code = "from wrf_mi.parallel import run_module; run_module('sleeper', [])"
    parent = subprocess.Popen([sys.executable, "-c", code], **sleeper)
    child, until = int(awaited(tmp_path / "pid")), time.monotonic() + SECONDS
    os.kill(child, 0)
    parent.kill()
    parent.wait()
    while time.monotonic() < until:
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail("the child lives on")


def test_child_reports_status_and_last_line() -> None:
    status, said = run_module("wrf_mi.apps.commands", ["predict", "--no-such-option"], quiet=True)
    assert status == 2
    assert said.startswith("wrf-mi predict: ")


def test_parts_of_a_part_are_computed_in_its_thread() -> None:
    """Else each of them would have as many threads as there are processors."""

    def work(number: int) -> tuple[int, set[int]]:
        return 10 * number, set(on_threads(lambda _: threading.get_ident(), range(4))) ^ {threading.get_ident()}

    assert on_threads(work, range(5)) == [(10 * number, set()) for number in range(5)]
    assert on_threads(lambda _: threading.get_ident(), [0]) == [threading.get_ident()]
