"""Repeatability: comparison of subprocesses, and the backend of ``--deterministic``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from small_fits import QUICK, official, settings
from wrf_mi_bench.determinism import GRADIENT, IMAGE, cuda_works, different, distance, other_llvms
from wrf_mi_bench.subprocess_job import Job, SubprocessJobFailed, subprocess_job

from wrf_mi import backend
from wrf_mi.cli import train as cli_train
from wrf_mi.cli.main import main
from wrf_mi.core import BackendError, Record
from wrf_mi.runs.api import resume, train
from wrf_mi.training.trainer import Trainer

FIT = (
    *(*QUICK, "steps=30", "checkpoint_every=10"),
    *("density.every=12", "density.start=0", "density.stop=1", "density.growth_fraction=0.3"),
)
STEP = ("initial.gaussians=8", "batch=4")


@pytest.fixture
def gpu_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has begun to compute on a GPU."""
    cuda = backend.Backend("cuda", backend.VARIANTS["cuda"], None, None, "made up")
    monkeypatch.setattr(backend, "_active", cuda)


def test_deterministic_fits_of_two_processes_have_equal_bits(folder: Path) -> None:
    """One trains in one go, one stops, and a third goes on: parameters, moments, test rows and new positions."""
    job = Job("field", str(folder), FIT, deterministic=True)
    whole = subprocess_job(job)
    assert different(whole, subprocess_job(replace(job, stop=17))) == []
    assert {"score", "model.npz: param/position", "predictions.npz: prediction", "new.npz: prediction"} <= set(whole)
    assert whole["model.npz: param/position"].shape[1] > 8


def test_any_bit_that_differs_is_found() -> None:
    one = {"zero": np.zeros(2), "nan": np.array([np.nan]), "count": np.arange(3)}
    assert different(one, {name: values.copy() for name, values in one.items()}) == []
    assert different(one, one | {"zero": np.array([0.0, -0.0])}) == ["zero"]
    assert different(one, one | {"zero": np.array([0.0, 5e-324])}) == ["zero"]
    assert different(one, one | {"count": np.arange(3, dtype=np.int32)}) == ["count"]
    assert different(one, {"nan": one["nan"], "zero": one["zero"], "more": np.zeros(1)}) == ["count", "more"]


def test_distance_of_two_steps() -> None:
    one = {"image": np.array([0.5, -2.0]), "gradient/a": np.array([3.0, 4.0]), "gradient/b": np.zeros(2)}
    other = {"image": np.array([0.5, -1.9]), "gradient/a": np.array([3.0, 4.5]), "gradient/b": np.zeros(2)}
    assert distance(one, other) == {"image": pytest.approx(0.05), "gradient": pytest.approx(0.1)}


def test_failed_subprocess_job_states_its_error() -> None:
    with pytest.raises(SubprocessJobFailed, match=r"nothing of nowhere ended with status 1: KeyError: 'nothing'"):
        subprocess_job(Job("nothing", "nowhere"))


@pytest.mark.skipif(not other_llvms(), reason="one version of LLVM here")
def test_another_llvm_gives_equal_steps(folder: Path) -> None:
    one = subprocess_job(Job("step", str(folder), STEP, threads=1))
    for path in other_llvms().values():
        found = distance(one, subprocess_job(Job("step", str(folder), STEP, threads=1), path))
        assert found["image"] < IMAGE
        assert found["gradient"] < GRADIENT


@pytest.mark.gpu
def test_gpu_gives_equal_steps(folder: Path) -> None:
    assert cuda_works()
    one = subprocess_job(Job("step", str(folder), STEP, threads=1))
    found = distance(one, subprocess_job(Job("step", str(folder), STEP, backend="cuda")))
    assert found["image"] < IMAGE
    assert found["gradient"] < GRADIENT


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
    for stated in ({"settings": ["deterministic=true"]}, {"model": "idw", "deterministic": True}):
        with pytest.raises(BackendError, match="already computes with cuda: start another for llvm"):
            train(one_gateway, tmp_path / "run", **stated)
        assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("model", ["wrf-gs+", "physics", "ray-tracing"])
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
