"""Parts on workers: order, lost workers, errors, what is refused, and the same files as of one process."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import worker_tasks
from commands import Command, arrays_in, positions_file
from made_flat import write_flat
from made_waves import wave_record
from small_fits import official, settings
from worker_tasks import Lossy

from wrf_mi import parallel
from wrf_mi.backend import init
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.models import ray_tracing
from wrf_mi.parallel import Scheduler, SchedulerFailed, open_scheduler, row_parts, run_module, scheduler, worker
from wrf_mi.parallel.scheduler import PartsProgress
from wrf_mi.parallel.threads import on_threads
from wrf_mi.parallel.worker import WorkerEnvironment, worker_environment
from wrf_mi.runs.api import predict_to_file, train
from wrf_mi.tracing import TraceOptions

SECONDS = 60
"""For a process of ours to start on a busy machine."""


@pytest.mark.parametrize(("count", "workers", "least", "most"), [(1, 3, 1, 9), (100, 2, 1, 1000), (100, 2, 30, 60)])
def test_parts_cover_all_rows_once(count: int, workers: int, least: int, most: int) -> None:
    parts = row_parts(count, workers, least, most)
    assert [row for part in parts for row in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in parts]
    assert all(least <= size <= most for size in sizes[:-1])


def test_row_parts_respect_maximum_size_and_number_of_workers() -> None:
    assert len(row_parts(100_000, 1, 1, 1000)) == 100
    assert len(row_parts(80, 2)) == 16


def test_map_returns_results_in_order_and_calls_each_once(two: Scheduler, capsys: pytest.CaptureFixture[str]) -> None:
    received: list[tuple[int, int]] = []
    assert two.map(worker_tasks.double, range(20), what="doubling") == list(range(0, 40, 2))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 10
    assert lines[-1] == "doubling: 20 of 20, 2 workers"
    assert two.map(worker_tasks.double, range(5), each=lambda *one: received.append(one)) == [0, 2, 4, 6, 8]
    assert sorted(received) == [(k, 2 * k) for k in range(5)]
    assert two.map(worker_tasks.double, []) == []


def test_scheduler_without_workers_computes_in_this_process() -> None:
    received: list[tuple[int, int]] = []
    with open_scheduler(None) as serial:
        assert serial.map(worker_tasks.double, [3, 1], each=lambda *one: received.append(one)) == [6, 2]
        assert serial.map(pow, [2, 3], lambda: 2) == [4, 8]
    assert received == [(0, 6), (1, 2)]


def test_workers_adopt_folder_variables_and_backend_and_open_once(
    two: Scheduler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WRF_MI_DATA", "elsewhere")
    found = two.map(worker_tasks.place_of, range(12), partial(worker_tasks.opened, tmp_path))
    processes = {process for process, *_ in found}
    assert os.getpid() not in processes
    assert len(processes) <= two.workers
    assert {tuple(rest) for _, *rest in found} == {(str(tmp_path), "elsewhere", init().variant)}
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


def test_other_versions_and_folders_are_refused(
    two: Scheduler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = worker_environment()
    monkeypatch.chdir(tmp_path)  # is put back after the worker's own change of folder
    other = WorkerEnvironment(environment.folder, (), environment.backend, (("drjit", "0.1"),))
    with pytest.raises(InputError, match=r"drjit 1\.5\.0, but 0\.1 where the command runs; install the same"):
        worker.run_part(other, "", None, worker_tasks.double, 1)
    gone = WorkerEnvironment(str(tmp_path / "gone"), (), environment.backend, environment.versions)
    with pytest.raises(InputError, match=r"cannot enter .*gone .*run the command in a folder that workers see"):
        worker.run_part(gone, "", None, worker_tasks.double, 1)


def test_invalid_scheduler_ends_with_one_line(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    command.refused([*words, "local:2"], r"pip install 'wrf-mi\[cluster\]'")
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
    status, said = run_module("wrf_mi.cli", ["predict", "--no-such-option"], quiet=True)
    assert status == 2
    assert said.startswith("wrf-mi predict: ")


def test_parts_of_a_part_are_computed_in_its_thread() -> None:
    """Else each of them would have as many threads as there are processors."""

    def work(number: int) -> tuple[int, set[int]]:
        return 10 * number, set(on_threads(lambda _: threading.get_ident(), range(4))) ^ {threading.get_ident()}

    assert on_threads(work, range(5)) == [(10 * number, set()) for number in range(5)]
    assert on_threads(lambda _: threading.get_ident(), [0]) == [threading.get_ident()]


PRODUCTS = 1e-5
"""Share of the largest value by which kriging and operators may differ: a product of matrices adds in an order
that depends on how many columns it has. Splatted fields and traces are bit-identical."""
POSITIONS = 12


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Signal strengths at a few places."""
    return write_flat(tmp_path_factory.mktemp("data") / "flat", rows=6, held_out=2)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several parts of few positions."""
    monkeypatch.setattr(ray_tracing, "TRACED_AT_LEAST", 2)


def positions(record: Record, rows: int = POSITIONS) -> np.ndarray:
    """New places among those of a record."""
    low, high = record.tx_pos_m.min(axis=0), record.tx_pos_m.max(axis=0)
    return np.random.default_rng(6).uniform(low, high, (rows, 3))


Arrays = dict[str, np.ndarray]


def both(run: Path, tx_pos_m: np.ndarray, two: Any, folder: Path, heading: Any = None) -> tuple[Arrays, Arrays]:
    """Predictions of one process, and of two workers."""
    predict_to_file(run, tx_pos_m, folder / "serial.npz", heading)
    predict_to_file(run, tx_pos_m, folder / "parallel.npz", heading, two)
    serial, parallel = arrays_in(folder / "serial.npz"), arrays_in(folder / "parallel.npz")
    assert serial.keys() == parallel.keys()
    np.testing.assert_array_equal(parallel["row"], np.arange(len(tx_pos_m)))
    np.testing.assert_array_equal(parallel["tx_pos"], tx_pos_m)
    return serial, parallel


def assert_same_bits(one: Arrays, other: Arrays) -> None:
    assert one.keys() == other.keys()
    for key in one:
        assert one[key].dtype == other[key].dtype, key
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)


def assert_close(one: Arrays, other: Arrays, *keys: str) -> None:
    for key in keys:
        np.testing.assert_allclose(other[key], one[key], rtol=0, atol=PRODUCTS * np.abs(one[key]).max(), err_msg=key)


@pytest.mark.parametrize("model", ["wrf-gs+", "wrf-gs"])
def test_parallel_prediction_of_a_field_equals_serial(
    model: str, two_gateways: Record, two: Scheduler, tmp_path: Path
) -> None:
    """One is splatted; the other is a product of matrices."""
    folder = write_spectrum_folder(tmp_path / "made-here", two_gateways, bits=16)
    record, fit = load(folder), settings("steps=4", model=model)
    run = train(record, tmp_path / "run", model, settings=fit, split=official(record)).folder
    lossy = Lossy(two, tmp_path)
    serial, parallel = both(run, positions(record), lossy, tmp_path)
    lossy.assert_one_was_lost()
    assert serial["prediction"].shape == (2, POSITIONS, *record.observation.shape[-2:])
    assert np.ptp(serial["prediction"]) > 0
    if model == "wrf-gs":
        assert_close(serial, parallel, "prediction")
    else:
        assert_same_bits(serial, parallel)


def test_parallel_trace_and_its_prediction_equal_serial(flat: Path, room: Path, two: Scheduler, tmp_path: Path) -> None:
    """The number of rays is chosen by the search, which uses all positions."""
    known: dict[str, Any] = {"scene": room, "settings": TraceOptions(depth=1, rays="auto")}
    serial, lossy = train(flat, tmp_path / "serial", "ray-tracing", **known).folder, Lossy(two, tmp_path)
    parallel = train(flat, tmp_path / "parallel", "ray-tracing", scheduler=lossy, **known).folder
    lossy.assert_one_was_lost()
    for file in ("paths.npz", "predictions.npz", "split.npz"):
        assert_same_bits(arrays_in(serial / file), arrays_in(parallel / file))
    assert_same_bits(*both(serial, positions(load(flat)), two, tmp_path))


@pytest.mark.slow
def test_parallel_trace_of_random_paths_equals_serial(
    flat: Path, room: Path, two: Scheduler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Diffuse reflections are searched from receivers, diffraction from transmitters."""
    monkeypatch.setattr(ray_tracing, "TRACED_AT_LEAST", 4)  # one part for each worker
    for kind, code in (("scattering", 2), ("diffraction", 8)):
        known: dict[str, Any] = {"scene": room, "settings": TraceOptions(depth=1, rays=1 << 8, **{kind: True})}
        serial = train(flat, tmp_path / f"{kind}-serial", "ray-tracing", **known).folder
        parallel = train(flat, tmp_path / f"{kind}-parallel", "ray-tracing", scheduler=two, **known).folder
        arrays = arrays_in(serial / "paths.npz")
        assert (arrays["interactions"] == code).any()
        assert_same_bits(arrays, arrays_in(parallel / "paths.npz"))


def test_parallel_prediction_of_kriging_equals_serial(flat: Path, two: Scheduler, tmp_path: Path) -> None:
    waves = write_spectrum_folder(tmp_path / "waves", wave_record(24, 6))
    for name, data, given in (("strengths", flat, ()), ("spectra", waves, ("directions=20", "lengths=2"))):
        folder = tmp_path / name
        run = train(data, folder / "run", "kriging", settings=given).folder
        places = positions(load(data))
        heading = np.linspace(-3, 3, len(places)) if name == "strengths" else None
        serial, parallel = both(run, places, two, folder, heading)
        assert_close(serial, parallel, "prediction", "std")


def test_errors_of_parts_name_the_row_of_the_whole_input(
    flat: Path, two: Scheduler, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cabinet stands where the last transmitter is."""
    box = trimesh.creation.box((0.3, 0.3, 0.3))
    box.apply_translation((50.0, 50.0, 1.0))
    box.export(tmp_path / "box.ply")
    known: dict[str, Any] = {"scene": tmp_path / "box.ply", "material": "concrete"}
    direct = TraceOptions(reflection=False, depth=0)
    run = train(flat, tmp_path / "run", "ray-tracing", settings=direct, **known).folder
    places = np.concatenate([positions(load(flat)), [[50.0, 50.0, 1.0]]])
    with pytest.raises(InputError, match=f"^transmitter {POSITIONS + 1} at .* is inside the solid 'box'"):
        predict_to_file(run, places, tmp_path / "p.npz", scheduler=two)
    assert not (tmp_path / "p.npz").exists()
    np.savez(tmp_path / "tx.npz", tx_pos=places[-1:])
    monkeypatch.setattr(parallel, "open_scheduler", lambda text: nullcontext(two))
    given = ["--input", tmp_path / "tx.npz", "--out", tmp_path / "p.npz", "--scheduler", "local"]
    command.refused(["predict", run, *given], "transmitter 1 at .* is inside the solid 'box'; move one of them")
    np.savez(tmp_path / "tx.npz", tx_pos=places[:3])
    status, out, err = command(["predict", run, *given])
    assert status == 0
    assert re.fullmatch("predicting: 3 of 3, [12] workers?", err.splitlines()[-1])
    assert out.startswith("3 predictions: ")
    traced_again = ["trace", tmp_path / "box.ply", flat, "--material", "concrete", "--paths", "line-of-sight"]
    status, _, err = command([*traced_again, "--out", tmp_path / "again", "--scheduler", "local"])
    assert status == 0
    assert re.fullmatch("tracing: 8 of 8, [12] workers?", err.splitlines()[-1])
    assert_same_bits(arrays_in(run / "predictions.npz"), arrays_in(tmp_path / "again" / "predictions.npz"))
