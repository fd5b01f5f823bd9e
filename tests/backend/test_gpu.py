"""A GPU computes what the CPU computes: recorded functions, float64, fits and predictions."""

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_fits import QUICK

from wrf_mi.backend.vectors import Float64
from wrf_mi.gaussians.footprint import depth_order
from wrf_mi.parallel import run_module
from wrf_mi.runs.api import train

pytestmark = pytest.mark.gpu
SCORE = 0.05
"""Bound on the difference of the mean SSIM of fits on both: sums of gradients have no defined order on a GPU, and their
last digits grow during a fit, as between two seeds."""
FIELDS = ("wrf-gs", "wrf-gs+", "factorised")
PIXEL = 1e-5
"""Bound on the difference of images of one checkpoint, relative to the largest pixel."""


def on_cpu(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the command in a process that sees no GPU."""
    with monkeypatch.context() as hidden:
        hidden.setenv("CUDA_VISIBLE_DEVICES", "")
        assert run_module("wrf_mi.apps.commands", arguments) == (0, "")


def test_sorting_in_a_recording_is_replayed():
    """Dr.Jit 1.5 records its own sort on CUDA, and its replay ends the process."""
    frozen = dr.freeze(depth_order)
    rng = np.random.default_rng(0)
    for size in (50, 50, 3000, 3000):
        depth = rng.integers(1, 9, size).astype(float)
        position = rng.integers(-2, 3, (3, size)).astype(np.float32)
        order = frozen(Float64(depth), [mi.Float(row) for row in position]).numpy()
        np.testing.assert_array_equal(order, np.lexsort((*position[::-1], depth)))


def test_division_and_roots_are_exact():
    values = np.random.default_rng(0).uniform(0.1, 1000, 1000)
    x = Float64(values)
    for result, expected in ((1 / x, 1 / values), (dr.sqrt(x), np.sqrt(values)), (dr.rcp(x), 1 / values)):
        np.testing.assert_allclose(result.numpy(), expected, rtol=1e-15)


@pytest.mark.parametrize("model", [*FIELDS, "kriging"])
def test_fits_score_alike(model, folder, tmp_path, monkeypatch):
    options = [*QUICK, "steps=60"] if model in FIELDS else []
    on_gpu = train(folder, model, out=tmp_path / "gpu", settings=options).metrics["ssim"]["mean"]
    words = [word for setting in options for word in ("--set", setting)]
    on_cpu(["train", str(folder), "--model", model, *words, "--out", str(tmp_path / "cpu")], monkeypatch)
    cpu_score = json.loads((tmp_path / "cpu" / "metrics.json").read_text())["ssim"]["mean"]
    assert on_gpu == pytest.approx(cpu_score, abs=SCORE)


@pytest.mark.parametrize("model", ["wrf-gs+", "factorised"])
def test_a_run_predicts_alike(model, folder, tmp_path, monkeypatch):
    run = train(folder, model, out=tmp_path / "run", settings=[*QUICK, "steps=20"])
    tx = np.random.default_rng(0).uniform(-2, 2, (8, 3)).astype(np.float32)
    np.savez(tmp_path / "tx.npz", tx_pos=tx)
    expected = run.predict(tx).mean
    positions, out = tmp_path / "tx.npz", tmp_path / "predictions.npz"
    on_cpu(["predict", str(run.folder), "--input", str(positions), "--out", str(out)], monkeypatch)
    with np.load(out) as arrays:
        predicted = arrays["prediction"]
    assert np.abs(expected - predicted).max() < PIXEL * predicted.max()


@pytest.mark.parametrize(
    ("model", "options"),
    [("ray-tracing", ["--calibrate", "gain,materials"]), ("hybrid", []), ("wrf-gs+", ["--set", "steps=200"])],
)
def test_models_of_a_scene_score_alike(model, options, tmp_path, monkeypatch):
    """Traced, in stages and joint."""
    words = [
        "train",
        "laboratory",
        "--scene",
        "laboratory",
        "--n-train",
        "24",
        "--seed",
        "1",
        "--model",
        model,
        *options,
    ]
    assert run_module("wrf_mi.apps.commands", [*words, "--out", str(tmp_path / "gpu")]) == (0, "")
    on_cpu([*words, "--out", str(tmp_path / "cpu")], monkeypatch)
    gpu, cpu = (json.loads((tmp_path / name / "metrics.json").read_text())["ssim"] for name in ("gpu", "cpu"))
    assert gpu["mean"] == pytest.approx(cpu["mean"], abs=SCORE)
