"""Repeatability: equal bits of fits, equal steps on other backends, and the backend of ``--deterministic``."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from small_fits import QUICK, official, settings, stop_after
from step_job import step_in_process

from wrf_mi import backend
from wrf_mi.backend.probe import try_llvm
from wrf_mi.cli import train as cli_train
from wrf_mi.cli.main import main
from wrf_mi.core import BackendError, Record
from wrf_mi.core.array_files import stored_arrays
from wrf_mi.parallel import run_module
from wrf_mi.runs.api import Interrupted, resume, train
from wrf_mi.scene.make import make_scene
from wrf_mi.training.trainer import Trainer

FIT = (
    *(*QUICK, "steps=30", "checkpoint_every=10"),
    *("density.every=12", "density.start=0", "density.stop=1", "density.growth_fraction=0.3"),
)
IMAGE = 1e-5
"""Bound on the largest difference of an image, relative to its largest pixel."""
GRADIENT = 1e-3
"""Bound on the relative difference in norm of a step's gradient, each group, as in the stress benchmark."""


@pytest.fixture
def gpu_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has begun to compute on a GPU."""
    cuda = backend.Backend("cuda", backend.VARIANTS["cuda"], None, None, "made up")
    monkeypatch.setattr(backend, "_active", cuda)


def arrays_of(run: Path) -> dict[str, np.ndarray]:
    """Fitted arrays and predictions of a run, without times."""
    files = [run / name for name in ("model.npz", "paths.npz", "predictions.npz") if (run / name).exists()]
    loaded = {f"{file.name}: {key}": values for file in files for key, values in stored_arrays(file).items()}
    return {name: values for name, values in loaded.items() if not name.endswith("seconds")}


def assert_same_bits(one: Path, other: Path) -> None:
    found, expected = arrays_of(one), arrays_of(other)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert (found[name].dtype, found[name].tobytes()) == (values.dtype, values.tobytes()), name


def test_deterministic_fits_of_two_processes_have_equal_bits(folder: Path, tmp_path: Path) -> None:
    """One trains without a stop, one stops here and is resumed by another process."""
    words = [word for setting in FIT for word in ("--set", setting)]
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    assert (
        run_module(
            "wrf_mi.cli", ["train", str(folder), "--model", "wrf-gs+", "--deterministic", *words, "--out", str(whole)]
        )[0]
        == 0
    )
    with pytest.raises(Interrupted):
        train(folder, resumed, "wrf-gs+", settings=[*FIT, "deterministic=true"], stop=stop_after(17))
    assert run_module("wrf_mi.cli", ["train", "--resume", str(resumed)])[0] == 0
    assert_same_bits(whole, resumed)
    assert stored_arrays(whole / "model.npz")["param/position"].shape[1] > 8


@pytest.mark.parametrize("model", ["kriging", "ray-tracing"])
def test_kriging_and_paths_do_not_depend_on_the_number_of_threads(
    model: str, flat_folder: Path, tmp_path: Path
) -> None:
    scene = make_scene(flat_folder / "layout.csv", tmp_path / "room", height_m=2.7).folder
    for threads in (1, 2):
        backend.set_threads(threads)
        train(flat_folder, tmp_path / f"on-{threads}", model, scene=None if model == "kriging" else scene)
    assert_same_bits(tmp_path / "on-1", tmp_path / "on-2")


def assert_equal_steps(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert np.abs(one["image"] - other["image"]).max() < IMAGE * np.abs(one["image"]).max()
    for name, values in one.items():
        assert np.linalg.norm(values - other[name]) <= GRADIENT * np.linalg.norm(values), name


def other_llvms() -> list[Path]:
    """Usable LLVM libraries of other major versions than this process uses."""
    major = (backend.init().llvm_version or "").split(".")[0]
    verdicts = {library.path: try_llvm(library) for library in backend.find_llvm(ignore_variable=True)}
    return [path for path, one in verdicts.items() if one.usable and one.version.split(".")[0] != major]


@pytest.mark.skipif(not other_llvms(), reason="one version of LLVM here")
def test_another_llvm_gives_equal_steps(folder: Path, tmp_path: Path) -> None:
    one = step_in_process(folder, tmp_path / "one.npz")
    for path in other_llvms():
        assert_equal_steps(one, step_in_process(folder, tmp_path / "other.npz", llvm=path))


@pytest.mark.gpu
def test_gpu_gives_equal_steps(folder: Path, tmp_path: Path) -> None:
    one = step_in_process(folder, tmp_path / "one.npz")
    assert_equal_steps(one, step_in_process(folder, tmp_path / "other.npz", "cuda"))


def test_deterministic_fits_take_one_thread_of_the_cpu(one_gateway: Record) -> None:
    backend.set_threads(2)
    Trainer(one_gateway, official(one_gateway), settings("steps=1"))
    assert dr.thread_count() == 2
    Trainer(one_gateway, official(one_gateway), settings("steps=1", "deterministic=true"))
    assert dr.thread_count() == 1


@pytest.mark.usefixtures("gpu_process")
def test_no_deterministic_fit_on_a_gpu(one_gateway: Record) -> None:
    with pytest.raises(BackendError, match="already computes with cuda: start another for llvm"):
        Trainer(one_gateway, official(one_gateway), settings("steps=1", "deterministic=true"))


@pytest.mark.usefixtures("gpu_process")
def test_no_deterministic_run_on_a_gpu(one_gateway: Record, tmp_path: Path) -> None:
    """Nothing is written, wherever determinism is stated."""
    for stated in ({"model": "wrf-gs+", "settings": ["deterministic=true"]}, {"model": "idw", "deterministic": True}):
        with pytest.raises(BackendError, match="already computes with cuda: start another for llvm"):
            train(one_gateway, tmp_path / "run", **stated)
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("model", ["wrf-gs+", "kriging", "ray-tracing"])
def test_deterministic_command_initialises_the_cpu_first(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is read: whatever reads a data set may choose the GPU."""
    asked: list[tuple[object, ...]] = []
    monkeypatch.setattr(cli_train, "init", lambda name, threads: asked.append((name, threads)))
    call = ["train", str(tmp_path / "none"), "--model", model, "--out", str(tmp_path / "run")]
    call += ["--scene", "laboratory"] if model == "ray-tracing" else []
    assert main(call) == 2
    assert asked == []
    assert main([*call, "--deterministic"]) == 2
    assert asked == [("llvm", 1)]


def test_deterministic_run_is_resumed_on_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, ...]] = []
    monkeypatch.setattr(cli_train, "init", lambda name, threads: asked.append((name, threads)))
    for text in ("settings: {deterministic: true}", "[", "deterministic: false"):
        (tmp_path / "config.yaml").write_text(text)
        assert main(["train", "--resume", str(tmp_path)]) == 2
    assert asked == []
    (tmp_path / "config.yaml").write_text("deterministic: true")
    assert main(["train", "--resume", str(tmp_path)]) == 2
    assert asked == [("llvm", 1)]


def test_deterministic_baseline_is_resumed_on_one_thread(one_gateway: Record, tmp_path: Path) -> None:
    """Stopped before it was fitted, and resumed by a process with more threads."""
    settings = ("steps=5", "width=8", "last=8")
    run = train(one_gateway, tmp_path / "run", "vae", settings=settings, deterministic=True).folder
    assert "deterministic: true" in (run / "config.yaml").read_text()
    fitted = np.load(run / "predictions.npz")["prediction"]
    (run / "model.npz").unlink()
    backend.set_threads(2)
    resume(run, record=one_gateway)
    assert dr.thread_count() == 1
    np.testing.assert_array_equal(np.load(run / "predictions.npz")["prediction"], fitted)
