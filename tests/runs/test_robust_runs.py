"""Run folders under faults: locks, damaged files, leftovers of killed processes, and chunks of predictions."""

import gc
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from calling import contents, copied
from commands import Command, arrays_in
from small_fits import settings, stop_after

from wrf_mi.core import InputError, Prediction
from wrf_mi.core.array_files import stored_array, stored_arrays, write_arrays
from wrf_mi.core.files import remove_leftovers
from wrf_mi.core.locks import LOCK, alone_in_process, locked_folder
from wrf_mi.core.memory import require_memory
from wrf_mi.models import MODELS
from wrf_mi.runs import folder as folder_module
from wrf_mi.runs import prediction_file
from wrf_mi.runs import run as run_module
from wrf_mi.runs.api import Interrupted, open_run, predict_to_file, resume, train
from wrf_mi.runs.folder import is_finished, read_fitted, write_fitted
from wrf_mi.training.checkpoint import cut_log

DEAD = 2**22 + 1
"""No process of Linux has this number."""
GROWTH_BYTES = 3e6
"""Growth of memory by 300 predictions, whose results take 6 MB, or by 30 opened runs of more than 100 kB."""


@pytest.fixture(scope="module")
def kriging(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "kriging"
    return train(flat_folder, "kriging", out=out, settings=("heading=false", "generic=true")).folder


@pytest.fixture(scope="module")
def stopped(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "stopped"
    with pytest.raises(Interrupted):
        train(folder, "wrf-gs+", out=out, settings=settings("steps=10"), stop=stop_after(4))
    return out


def test_a_folder_has_one_writer(tmp_path: Path) -> None:
    second = pytest.raises(InputError, match="writes into it; wait for its end, or stop it")
    with locked_folder(tmp_path), second, locked_folder(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()
    (tmp_path / LOCK).write_text(f"{DEAD}\n")  # of a process that was killed
    with locked_folder(tmp_path):
        assert (tmp_path / LOCK).exists()


def test_the_lock_of_a_process_that_was_killed_at_the_end_of_a_run_is_removed(kriging: Path, tmp_path: Path) -> None:
    run = copied(kriging, tmp_path / "run")
    assert not is_finished(tmp_path)
    (run / LOCK).write_text(f"{DEAD}\n")
    assert is_finished(run)
    assert not (run / LOCK).exists()
    with locked_folder(run):  # of one that lives
        assert is_finished(run)
        assert (run / LOCK).exists()


def test_a_run_that_ctrl_c_ends_before_its_configuration_is_begun_again(flat_folder, tmp_path, monkeypatch):
    def pressed(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(folder_module, "write_configs", pressed)
        with pytest.raises(KeyboardInterrupt):
            train(flat_folder, "idw", out=tmp_path / "run")
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [LOCK, "split.npz"]
    assert not (train(flat_folder, "idw", out=tmp_path / "run").folder / LOCK).exists()


def test_two_threads_do_not_fit_at_a_time(flat_folder: Path, tmp_path: Path) -> None:
    with alone_in_process(), ThreadPoolExecutor(1) as other:
        error = other.submit(train, flat_folder, "idw", out=tmp_path / "run").exception()
    assert isinstance(error, InputError)
    assert str(error).startswith("another thread of this process fits or scores a model; wait for its end")
    assert not (tmp_path / "run").exists()


def test_leftovers_of_killed_processes_are_removed(tmp_path: Path) -> None:
    (tmp_path / f".model.npz.{DEAD}.part").touch()
    (tmp_path / f".scene.{DEAD}.old").mkdir()
    (tmp_path / f"..scene.{DEAD}.part.{DEAD}.part").mkdir()  # of a folder within a temporary one
    (tmp_path / ".model.npz.1.part").touch()  # process 1 runs
    remove_leftovers(tmp_path, "scene")
    assert contents(tmp_path) == {"scene", f".model.npz.{DEAD}.part", ".model.npz.1.part"}
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"scene", ".model.npz.1.part"}


def test_damaged_lines_of_the_log_are_dropped(tmp_path: Path) -> None:
    complete_line = b'{"step": 2, "loss": 1.0}\n'
    (tmp_path / "log.jsonl").write_bytes(complete_line + b'\xff\xfe\n[1]\n{"step": 4}\n{"step": 2, "lo')
    cut_log(tmp_path, 3)
    assert (tmp_path / "log.jsonl").read_bytes() == complete_line


@pytest.mark.parametrize("name", MODELS)
def test_arrays_that_are_not_finite_are_refused(name: str, tmp_path: Path) -> None:
    """Of every model, those excepted that it states."""
    for task in MODELS[name].tasks or ("spectrum", "rssi", "csi"):
        entry = MODELS[name].serving(task, MODELS[name].scene == "required")
        for value in (np.nan, np.inf, complex(0, np.nan)):
            write_fitted(tmp_path, {"0/values": np.array([1.0, value])}, 1.0)
            with pytest.raises(InputError, match=r"model\.npz: array 0/values: 1 of 2 values are not finite; train"):
                read_fitted(tmp_path, entry)
        write_fitted(tmp_path, {f"0/{gap}": np.array([1.0, np.nan]) for gap in entry.gaps}, 1.0)
        assert len(read_fitted(tmp_path, entry)[0]) == len(set(entry.gaps))


@pytest.mark.parametrize(
    ("factor", "checksum", "message"),
    [
        (2, False, "not readable .*another checksum.*; train the run anew"),
        (np.nan, True, "array .*weights: .* values are not finite; train the run anew"),
    ],
    ids=["changed", "not finite"],
)
def test_a_run_whose_arrays_were_changed_is_not_opened(factor, checksum, message, kriging, tmp_path, command):
    file = copied(kriging, tmp_path / "run") / "model.npz"
    arrays: dict[str, Any] = stored_arrays(file) if checksum else arrays_in(file)
    name = next(key for key in arrays if key.endswith("weights"))
    arrays[name] = arrays[name] * factor
    write_arrays(file, arrays, checksum=checksum)
    command.refused(["evaluate", file.parent], f"model.npz: {message}")


@pytest.mark.parametrize("change", ["shape", "nan", "huge"])
def test_a_checkpoint_of_other_arrays_is_refused(change: str, stopped: Path, tmp_path: Path) -> None:
    """They are refused before the backend, which ends the process on other shapes."""
    file = copied(stopped, tmp_path / "run") / "checkpoint.npz"
    arrays = stored_arrays(file)
    for group in ("param", "mean", "first", "second"):
        values = arrays[f"{group}/deform.0.bias"]
        filled = np.full_like(values, np.nan if change == "nan" else 1e30)
        arrays[f"{group}/deform.0.bias"] = values[:-1] if change == "shape" else filled
    write_arrays(file, arrays, checksum=True)
    with pytest.raises(InputError, match="train the run anew"):
        resume(tmp_path / "run")


def test_infinite_predictions_are_refused(kriging: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = open_run(kriging)
    infinite = Prediction(np.full(1, np.inf, np.float32))
    monkeypatch.setattr(type(run.fitted), "predict", lambda self, inputs, receiver: infinite)
    with pytest.raises(InputError, match="predictions are infinite, as parameters are too large; train it anew"):
        run.predict(np.zeros((1, 3)), receiver=0)


def test_sizes_are_checked_before_they_are_allocated(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the array takes 931,323 GiB, and .* GiB of memory are free; lower its size"):
        require_memory(1e15, "the array", "lower its size")
    np.save(tmp_path / "lie.npy", np.zeros(3))
    content = (tmp_path / "lie.npy").read_bytes()
    (tmp_path / "lie.npy").write_bytes(content.replace(b"(3,), }          ", b"(30000000000,), }"))
    with pytest.raises(ValueError, match=r"states \[30000000000\] numbers of float64, and has 152 bytes"):
        stored_array(tmp_path / "lie.npy")


def test_too_many_gaussians_are_refused_at_once(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"initial.gaussians=500000000 with batch=.*; lower one of them"):
        train(folder, "wrf-gs+", out=tmp_path / "run", settings=settings("initial.gaussians=500000000"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("largest", [3, 100], ids=["several", "rest at once"])
def test_chunks_give_the_predictions_of_all_at_once(largest, kriging, tmp_path, monkeypatch):
    positions = np.random.default_rng(0).uniform(0, 3, (7, 3))
    expected = open_run(kriging).predict(positions, 1).mean
    monkeypatch.setattr(run_module, "PREDICTED_PER_CHUNK", 2)
    monkeypatch.setattr(run_module, "MOST_PER_CHUNK", largest)
    np.testing.assert_allclose(open_run(kriging).predict(positions, 1).mean, expected, rtol=1e-6)
    for spooled_bytes in (prediction_file.SPOOLED_BYTES, 0):  # in memory, and in a temporary file
        monkeypatch.setattr(prediction_file, "SPOOLED_BYTES", spooled_bytes)
        predict_to_file(kriging, positions, tmp_path / "out.npz")
        np.testing.assert_allclose(np.load(tmp_path / "out.npz")["prediction"][1], expected, rtol=1e-6)
        assert [path.name for path in tmp_path.iterdir()] == ["out.npz"]


@pytest.mark.parametrize("line", ["dataset: [1]", "seed: x", "task: 5", "n_train: {a: 1}", "model: [a]"])
def test_odd_configurations_are_refused(line: str, kriging: Path, tmp_path: Path, command: Command) -> None:
    text = (kriging / "config.yaml").read_text()
    (tmp_path / "config.yaml").write_text(re.sub(rf"(?m)^{line.partition(':')[0]}:.*$", line, text))
    command.refused(["evaluate", tmp_path], "config.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("model", ["kriging", "wrf-gs+"])
def test_predictions_and_opened_runs_keep_no_memory(model: str, kriging: Path, folder: Path, tmp_path: Path) -> None:
    run = kriging if model == "kriging" else train(folder, model, out=tmp_path, settings=settings("steps=4")).folder
    opened, positions = open_run(run), np.random.default_rng(0).uniform(1, 4, (16, 3))

    def resident_after(work: Callable[[], object], calls: int) -> int:
        for _ in range(calls):
            work()
        gc.collect()
        return int(psutil.Process().memory_info().rss)

    for work, calls in ((lambda: opened.predict(positions), 300), (lambda: open_run(run).predict(positions), 30)):
        before = resident_after(work, calls // 10)  # kernels, caches, arenas of the allocator
        assert resident_after(work, calls) - before < GROWTH_BYTES
