"""The hybrid as a run without a scene: parts, restored predictions, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_channels import channels

import wrf_mi
from wrf_mi.core import InputError, Record, Split
from wrf_mi.datasets import make_splits
from wrf_mi.models import Problem
from wrf_mi.models.hybrid.model import HybridSettings, parts_of
from wrf_mi.tasks.scores import cea_db
from wrf_mi.training.selection import HeldOut

UNCLEAR_DB = 0.1
"""Difference on 24 held-out rows that is no clear gain over the most trusted ingredient, kriging."""
EXACT_DB = 30.0
"""CEA of a downlink that is its uplink turned, from twenty rows: single precision and a little penalty."""


def test_strengths_without_a_scene_are_those_of_kriging(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, tmp_path / "run")
    kriging = wrf_mi.train(flat_folder, tmp_path / "kriging", "kriging")
    assert run.metrics["abs_error_db"] == kriging.metrics["abs_error_db"]
    assert run.metrics["weights"] == [{"distance_m": 0.0, "kriging": 1.0}]
    assert 0.5 < run.metrics["inside_90"] <= 1


def test_hybrid_is_restored_with_its_predictions(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, tmp_path / "run")
    again = wrf_mi.open_run(run.folder)
    position = np.array([[2.0, 1.0, 1.3], [3.0, 2.0, 1.0]])
    assert again.predict(position, 1).mean == pytest.approx(run.predict(position, 1).mean)
    assert again.predict(position, 1).std == pytest.approx(run.predict(position, 1).std)
    assert wrf_mi.evaluate_run(run.folder)["weights"] == run.metrics["weights"]


def test_two_rows_are_interpolated_by_kriging(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, tmp_path / "run", "hybrid", n_train=2)
    assert list(run.metrics["weights"][0]) == ["distance_m", "kriging"]
    assert "inside_90" not in run.metrics


def test_five_spectra_have_intervals(folder: Path, tmp_path: Path):
    """Three remain where two are held out, through which kriging may pass without any deviation."""
    run = wrf_mi.train(folder, tmp_path / "run", n_train=5)
    assert 0 < run.metrics["inside_90"] <= 1


def test_field_alone_is_a_part_where_it_is_named(folder: Path, tmp_path: Path):
    asked = HybridSettings(stages="field,residual")
    problem = Problem(wrf_mi.load(str(folder)), asked)
    split = make_splits(problem.record, "official")[0]
    assert list(parts_of(problem, split)) == ["field", "kriging"]
    assert list(parts_of(replace(problem, settings=HybridSettings()), split)) == ["kriging"]


def test_hybrid_mixes_models_from_positions_and_from_the_uplink(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without the networks, whose training takes a minute."""
    monkeypatch.setattr("wrf_mi.models.hybrid.model.UPLINK_PARTS", ("r2f2", "linear"))
    record = channels()
    run = wrf_mi.train(record, tmp_path / "run")
    held, weights = run.metrics["held_out"], run.metrics["weights"]
    assert {"r2f2", "linear", "kriging"} <= set(held)
    assert held["hybrid"] >= held["linear"] - UNCLEAR_DB > held["kriging"]
    assert all(one.get("kriging", 0) < 0.5 for one in weights)
    again = wrf_mi.open_run(run.folder, record)
    rows = slice(20, 24)
    found = again.predict(record.tx_pos_m[rows], uplink=record.uplink[rows]).mean
    assert cea_db(found, record.observation[0, rows]).min() > EXACT_DB
    with pytest.raises(InputError, match="has a weight and predicts from the uplink"):
        again.predict(record.tx_pos_m[rows])


def test_held_out_observations_are_limited_by_their_size(one_gateway: Record):
    rows = np.arange(1000)
    many = Record("many", "spectrum", np.random.default_rng(0).random((1000, 3)), one_gateway.receivers, np.zeros(0))
    fold = Split("fold", 0, rows[500:], rows[:0], rows[:500])
    for shape, most in (((), 500), ((20, 20), 200), ((50,), 400)):
        record = replace(many, observation=np.zeros((1, 1000, *shape), np.float32))
        assert len(HeldOut.of(record, fold, 0)) == most
        assert np.array_equal(HeldOut.of(record, fold, 0).row, HeldOut.of(record, fold, 0).row)
