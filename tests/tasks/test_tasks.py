"""Tasks and layouts: the registry, and what another package adds by entry points alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.datasets import layouts
from wrf_mi.tasks import TASKS, instrument_of, require, task_of

PACKAGE = '''
"""A package that measures delay spreads: a task and the layout of its data."""

import csv

import numpy as np

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.datasets.layouts import Layout
from wrf_mi.tasks.task import Task


class DelaySpread(Task):
    name = "delay-spread"
    block, label, higher_is_better = "abs_error_ns", "absolute error (ns)", False
    axes = 0
    heading, quantity, note = "delay spread", "delay spread (ns)", "The absolute error in ns."

    def score(self, prediction, truth):
        return np.abs(np.asarray(prediction, float) - np.asarray(truth, float))

    def instrument(self, record):
        raise InputError(f"{record.name}: nothing traces delay spreads")


TASK = DelaySpread()


def read(path, name):
    with (path / "delays.csv").open() as file:
        table = np.array([[float(value) for value in row] for row in list(csv.reader(file))[1:]])
    rows = np.arange(len(table))
    receiver = Receiver("sounder", np.array([0.0, 0, 2]), np.array([0.0, 0, 0, 1]))
    official = rows[rows % 4 > 0], rows[rows % 4 == 0]
    values = table[None, :, 3].astype(np.float32)
    return Record(name or path.name, TASK.name, table[:, :3], (receiver,), values, official=official, source=str(path))


LAYOUT = Layout("delays", TASK.name, read, files=("delays.csv",))
'''
ENTRY_POINTS = "[wrf_mi.tasks]\ndelay-spread = delays_of_others:TASK\n"
ENTRY_POINTS += "[wrf_mi.layouts]\ndelays = delays_of_others:LAYOUT\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, str], Path]:
    """The environment of a Python that has the package installed, and a folder of its data."""
    site = tmp_path_factory.mktemp("site")
    (site / "delays_of_others.py").write_text(PACKAGE)
    info = site / "delays_of_others-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: delays-of-others\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    data = tmp_path_factory.mktemp("data") / "corridor"
    data.mkdir()
    places = np.random.default_rng(0).uniform(0, 5, (40, 3))
    delay = 30 + 5 * places[:, 0] + np.sin(places[:, 1])
    lines = [",".join(f"{value:.4f}" for value in (*place, ns)) for place, ns in zip(places, delay, strict=True)]
    (data / "delays.csv").write_text("\n".join(["x,y,z,delay_ns", *lines]) + "\n")
    path = os.pathsep.join([str(site), *(part for part in sys.path if part)])
    return {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "error::RuntimeWarning"}, data


CALLS = """
import contextlib, io, json, sys
from wrf_mi.cli.main import main

for words in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(words)
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""


def commands(environment: dict[str, str], *calls: list[str | Path]) -> list[tuple[int, str, str]]:
    """Status, standard output and standard error of commands, one after the other in a process of their own."""
    words = json.dumps([list(map(str, call)) for call in calls])
    done = subprocess.run(
        [sys.executable, "-c", CALLS, words], env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


SERVED = {"trees": "rssi", "wrf-gs": "spectrum, rssi and csi", "factorised": "spectrum, rssi and csi"}


def test_task_and_layout_of_another_package_are_trained_evaluated_predicted_and_compared(installed, tmp_path) -> None:
    environment, data = installed
    runs = [tmp_path / name for name in ("idw", "kriging", "hybrid")]
    models = [*(run.name for run in runs), *SERVED]
    trained = commands(environment, *(["train", data, "--model", name, "--out", tmp_path / name] for name in models))
    for status, out, err in trained[: len(runs)]:
        assert status == 0, err
        assert "absolute error (ns) on 10 test rows" in out
    for (model, tasks), (status, _, err) in zip(SERVED.items(), trained[len(runs) :], strict=True):
        assert (status, err.count("\n")) == (2, 1), err
        assert f"holds delay-spread; {model} serves {tasks}, so choose another model: hybrid, idw, kriging" in err
        assert not (tmp_path / model).exists()
    (runs[0] / "metrics.json").unlink()  # as a run that was stopped before its scores
    (tmp_path / "tx.csv").write_text("x,y,z\n1,2,1\n3,1,2\n")
    done = commands(
        environment,
        ["train", "--resume", runs[0]],
        ["evaluate", runs[0]],
        ["predict", runs[1], "--tx", tmp_path / "tx.csv", "--out", tmp_path / "p.npz"],
        ["compare", *runs, "--out", tmp_path / "compare"],
    )
    assert [status for status, _, _ in done] == [0] * 4, done
    with np.load(tmp_path / "p.npz") as predicted:
        assert predicted["prediction"] == pytest.approx([30 + 5 + np.sin(2), 30 + 15 + np.sin(1)], abs=3)
    assert "absolute error (ns)" in (tmp_path / "compare" / "index.html").read_text()


def record(task: str, shape: tuple[int, ...]) -> Record:
    receiver = Receiver("one", np.zeros(3), np.array([0.0, 0, 0, 1]))
    return Record("made", task, np.ones((2, 3)), (receiver,), np.zeros(shape, np.float32), frequencies_hz=np.ones(1))


def test_names_in_the_registry_are_those_of_the_tasks() -> None:
    assert {name: task.name for name, task in TASKS.items()} == {name: name for name in TASKS}
    assert set(TASKS) >= {"spectrum", "rssi", "csi"}
    assert len({task.block for task in TASKS.values()}) == len(TASKS)


def test_unknown_tasks_are_refused() -> None:
    with pytest.raises(InputError, match="made: task 'sound'; known are spectrum, rssi, csi"):
        task_of(record("sound", (1, 2)))
    with pytest.raises(InputError, match="made: holds rssi; spectra are needed"):
        require(record("rssi", (1, 2)), "spectrum", why="spectra are needed")


def test_instruments_need_positions_carrier_and_arrays() -> None:
    spectra = record("spectrum", (1, 2, 8, 8))
    with pytest.raises(InputError, match="antenna array unknown"):
        instrument_of(spectra)
    with pytest.raises(InputError, match="antennas' positions unknown"):
        instrument_of(record("csi", (1, 2, 4, 3)))
    known = spectra.with_array(np.zeros((4, 3)))
    assert instrument_of(known).carrier_hz == 1


def test_layout_is_recognised_by_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"an empty folder; a data set is a folder with receivers\.csv"):
        layouts.layout_of(tmp_path)
    for layout in layouts.BUILT_IN:
        folder = tmp_path / layout.name
        folder.mkdir()
        name = layout.files[0] if layout.files else f"data{layout.suffixes[0]}"
        if layout.array:
            np.savez(folder / name, **{layout.array: np.array(1)})
        else:
            (folder / name).touch()
        assert layouts.layout_of(folder) is layout
        assert callable(layout.read)
