"""Scenes and runs as objects that keep their own folders, settings by name, and presets."""

import gc
from pathlib import Path

import numpy as np
import pytest

import wrf_mi
from wrf_mi.runs.api import plan_run
from wrf_mi.runs.folder import RunRequest


def test_a_run_without_a_folder_lives_as_long_as_its_object(flat_folder):
    run = wrf_mi.train(flat_folder, "kriging")
    folder, truth = run.folder, run.problem.record.observation
    every = run.predict(run.problem.record.tx_pos_m[:3])
    assert every.mean.shape == truth[:, :3].shape
    np.testing.assert_array_equal(every.mean[1], run.predict(run.problem.record.tx_pos_m[:3], 1).mean)
    assert run.score()["n_test"] == run.metrics["n_test"]
    assert run.stages == []
    assert set(run.map(step_m=1.0).sizes) == {"receiver", "y", "x"}
    named = every.to_xarray()
    assert named["prediction"].dims == ("row", "receiver")
    np.testing.assert_array_equal(named["prediction"].sel(receiver=run.receivers[1].name), every.mean[1])
    np.testing.assert_array_equal(run.predict(named["tx_pos_m"].T).mean, every.mean)
    located = run.locate(truth[:, :2])
    observed = run.problem.record.to_xarray()["observation"][:2, ::-1]  # receivers in another order, by their names
    np.testing.assert_array_equal(run.locate(observed).tx_pos_m, located.tx_pos_m)
    assert run.plan(2).tx_pos_m.shape == (2, 3)
    assert len(run.plot().axes) >= truth.shape[0]
    assert run.view().counts["transmitters"] > 0
    del run, every
    gc.collect()
    assert not folder.exists()


def test_a_plan_becomes_a_scene_that_measurements_correct(flat_folder, tmp_path):
    scene = wrf_mi.Scene.from_plan(flat_folder / "layout.csv", 2.7)
    assert scene.correction is None
    opened = scene.edit(remove=["ceiling*"])
    assert scene.folder.is_dir()
    assert not any(Path(opened.folder).rglob("ceiling*.ply"))
    corrected = scene.correct(flat_folder, tmp_path / "corrected")
    assert corrected.correction["rows"] > 0
    traced = corrected.trace(flat_folder, settings={"depth": 1})
    assert traced.metrics["model"] == "ray-tracing"
    with pytest.raises(wrf_mi.InputError, match="exists"):
        scene.correct(flat_folder, tmp_path / "corrected")
    folders = [scene.folder, traced.folder]
    del scene, opened, traced
    gc.collect()
    assert [folder.exists() for folder in folders] == [False, False]
    assert corrected.folder.is_dir()


def test_settings_by_name_and_presets(flat_folder):
    """Names, nested or dotted, are those of texts; presets are refused where a model has none or all is stated."""
    small = {"steps": 3, "initial": {"gaussians": 5}, "network": {"layers": 2, "width": 16}}
    nested = wrf_mi.train(flat_folder, "wrf-gs+", settings=small)
    asked = ["steps=3", "initial.gaussians=5", "network.layers=2", "network.width=16"]
    texts = wrf_mi.train(flat_folder, "wrf-gs+", settings=asked)
    assert nested.config.settings == texts.config.settings
    _, fast, _ = plan_run(flat_folder, RunRequest(preset="fast"))
    assert "field" not in fast.settings.stages
    with pytest.raises(wrf_mi.InputError, match=r"idw .* has no presets"):
        wrf_mi.train(flat_folder, "idw", preset="fast")
    with pytest.raises(wrf_mi.InputError, match="give one of both"):
        wrf_mi.train(flat_folder, preset="fast", settings=fast.settings)


def test_what_is_refused_leaves_no_temporary_folder(flat_folder, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(wrf_mi.InputError, match="no such model"):
        wrf_mi.train(flat_folder, "spline")
    with pytest.raises(wrf_mi.InputError, match="no such file"):
        wrf_mi.train(flat_folder, "wrf-gs+", settings={"initial.points": Path("none.ply")})
    with pytest.raises(wrf_mi.InputError):
        wrf_mi.Scene.from_plan(flat_folder / "layout.csv", -1.0)
    assert not any(tmp_path.iterdir())
