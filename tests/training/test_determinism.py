"""Repeatability: equal bits of fits, equal steps on other backends, and the backend of ``--deterministic``."""

from functools import partial

import drjit as dr
import numpy as np
import pytest
from calling import without_seconds
from small_fits import QUICK, official, settings, stop_after
from step_job import step_in_process

from wrf_mi import backend
from wrf_mi.apps.commands import train as cli_train
from wrf_mi.apps.commands.main import main
from wrf_mi.backend.probe import try_llvm
from wrf_mi.core import BackendError
from wrf_mi.core.array_files import stored_arrays
from wrf_mi.parallel import run_module
from wrf_mi.runs.api import Interrupted, resume, train
from wrf_mi.scene.make import make_scene
from wrf_mi.training.trainer import Trainer

FIT = (
    *(*({*QUICK} - {"density.every=0"}), "steps=30", "checkpoint_every=10"),
    *("density.every=12", "density.start=0", "density.stop=1", "density.growth_fraction=0.3"),
)
IMAGE = 1e-5  # Bound on the largest difference of an image, relative to its largest pixel
GRADIENT = 1e-3  # Bound on the relative difference in norm of a step's gradient, each group, as in the stress benchmark


def arrays_of(run):
    """Fitted arrays and predictions of a run, without times."""
    files = [run / name for name in ("model.npz", "paths.npz", "predictions.npz") if (run / name).exists()]
    arrays = {f"{file.name}: {key}": values for file in files for key, values in stored_arrays(file).items()}
    return {name: values for name, values in arrays.items() if not name.endswith("seconds")}


def assert_same_bits(run, other):
    arrays = ({key: without_seconds(values) for key, values in arrays_of(folder).items()} for folder in (run, other))
    computed, expected = ({key: (values.dtype, values.tobytes()) for key, values in each.items()} for each in arrays)
    assert computed.keys() == expected.keys()
    assert [name for name, bits in expected.items() if computed[name] != bits] == []


def test_deterministic_fits_of_two_processes_have_equal_bits(folder, tmp_path):
    """Another process trains without a stop, this one stops and resumes from the files."""
    words, complete, resumed = [word for s in FIT for word in ("--set", s)], tmp_path / "complete", tmp_path / "resumed"
    asked = ["train", str(folder), "--model", "wrf-gs+", "--deterministic", *words, "--out", str(complete)]
    assert run_module("wrf_mi.apps.commands", asked)[0] == 0
    with pytest.raises(Interrupted):
        train(folder, "wrf-gs+", out=resumed, settings=[*FIT, "deterministic=true"], stop=stop_after(17))
    backend.set_threads(2)
    resume(resumed)
    assert_same_bits(complete, resumed)
    assert stored_arrays(complete / "model.npz")["params/position"].shape[1] > 8


@pytest.mark.parametrize("model", ["kriging", "ray-tracing"])
def test_kriging_and_paths_do_not_depend_on_the_number_of_threads(model, flat_folder, tmp_path):
    scene = make_scene(flat_folder / "layout.csv", tmp_path / "room", height_m=2.7).folder
    for threads in (1, 2):
        backend.set_threads(threads)
        train(flat_folder, model, out=tmp_path / f"on-{threads}", scene=None if model == "kriging" else scene)
    assert_same_bits(tmp_path / "on-1", tmp_path / "on-2")


def assert_equal_steps(one, other):
    assert np.abs(one["image"] - other["image"]).max() < IMAGE * np.abs(one["image"]).max()
    for name, values in one.items():
        assert np.linalg.norm(values - other[name]) <= GRADIENT * np.linalg.norm(values), name


def other_llvms():
    """Usable LLVM libraries of other major versions than this process uses."""
    major = (backend.init().llvm_version or "").split(".")[0]
    verdicts = {library.path: try_llvm(library) for library in backend.find_llvm(ignore_variable=True)}
    return [path for path, verdict in verdicts.items() if verdict.usable and verdict.version.split(".")[0] != major]


def test_another_llvm_gives_equal_steps(folder, tmp_path):
    libraries = other_llvms()
    if not libraries:
        pytest.skip("one version of LLVM here")
    step = step_in_process(folder, tmp_path / "one.npz")
    for path in libraries:
        assert_equal_steps(step, step_in_process(folder, tmp_path / "other.npz", llvm=path))


@pytest.mark.gpu
def test_gpu_gives_equal_steps(folder, tmp_path):
    step = step_in_process(folder, tmp_path / "one.npz")
    assert_equal_steps(step, step_in_process(folder, tmp_path / "other.npz", "cuda"))


def test_deterministic_fits_take_one_thread_of_the_cpu(one_gateway):
    backend.set_threads(2)
    Trainer(one_gateway, official(one_gateway), settings("steps=1"))
    assert dr.thread_count() == 2
    Trainer(one_gateway, official(one_gateway), settings("steps=1", "deterministic=true"))
    assert dr.thread_count() == 1


def test_no_deterministic_fit_or_run_on_a_gpu(one_gateway, tmp_path, monkeypatch):
    """In a process that has begun to compute on one: nothing is written, wherever determinism is stated."""
    cuda = backend.Backend("cuda", backend.VARIANTS["cuda"], None, None, "made up")
    monkeypatch.setattr(backend, "_active", cuda)
    refused = partial(pytest.raises, BackendError, match="already computes with cuda: start another for llvm")
    with refused():
        Trainer(one_gateway, official(one_gateway), settings("steps=1", "deterministic=true"))
    for options in ({"model": "wrf-gs+", "settings": ["deterministic=true"]}, {"model": "idw", "deterministic": True}):
        with refused():
            train(one_gateway, out=tmp_path / "run", **options)
        assert not (tmp_path / "run").exists()


@pytest.fixture
def asked(monkeypatch):
    """Backends and threads that `train` asks for."""
    calls = []
    monkeypatch.setattr(cli_train, "init", lambda name, threads: calls.append((name, threads)))
    return calls


@pytest.mark.parametrize("model", ["wrf-gs+", "kriging", "ray-tracing"])
def test_deterministic_command_initialises_the_cpu_first(model, tmp_path, asked):
    """Before anything is read: whatever reads a data set may choose the GPU."""
    call = ["train", str(tmp_path / "none"), "--model", model, "--out", str(tmp_path / "run")]
    call += ["--scene", "laboratory"] if model == "ray-tracing" else []
    for words, backends in (([], []), (["--deterministic"], [("llvm", 1)])):
        assert main([*call, *words]) == 2
        assert asked == backends


def test_deterministic_run_is_resumed_on_the_cpu(tmp_path, asked):
    for text in ("settings: {deterministic: true}", "[", "deterministic: false", "deterministic: true"):
        assert asked == []
        (tmp_path / "config.yaml").write_text(text)
        assert main(["train", "--resume", str(tmp_path)]) == 2
    assert asked == [("llvm", 1)]


def test_deterministic_baseline_is_resumed_on_one_thread(one_gateway, tmp_path):
    """Stopped before it was fitted, and resumed by a process with more threads."""
    settings = ("steps=5", "width=8", "last=8")
    run = train(one_gateway, "vae", out=tmp_path / "run", settings=settings, deterministic=True).folder
    assert "deterministic: true" in (run / "config.yaml").read_text()
    fitted = np.load(run / "predictions.npz")["prediction"]
    (run / "model.npz").unlink()
    backend.set_threads(2)
    resume(run, record=one_gateway)
    assert dr.thread_count() == 1
    np.testing.assert_array_equal(np.load(run / "predictions.npz")["prediction"], fitted)
