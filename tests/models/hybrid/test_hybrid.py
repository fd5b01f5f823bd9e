"""The hybrid as a run: ingredients, resume, restored predictions, refusals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calling import refused
from made_channels import channels
from wrf_mi.models.hybrid.ingredients import INGREDIENTS

import wrf_mi
from wrf_mi.core import InputError, Record, Split
from wrf_mi.models import Interrupted
from wrf_mi.models.held_out import HeldOut
from wrf_mi.tasks.scores import cea_db

UNCLEAR_DB = 0.1
"""Difference on 24 held-out rows that is no clear gain over the most trusted ingredient, kriging."""
EXACT_DB = 30.0
"""CEA of a downlink that is its uplink turned, from twenty rows: single precision and a little penalty."""


def test_hybrid_is_never_far_below_its_ingredients_on_held_out_rows(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, tmp_path / "run", "hybrid", settings=("ingredients=idw,kriging,mri",))
    held = run.metrics["held_out"]
    assert held["hybrid"] <= min(held[name] for name in ("idw", "kriging", "mri")) + UNCLEAR_DB
    assert sum(run.metrics["weights"][0][name] for name in run.metrics["weights"][0] if name != "distance_m") == 1
    assert 0.5 < run.metrics["inside_90"] <= 1


def test_hybrid_is_restored_with_its_predictions(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, tmp_path / "run", "hybrid", settings=("ingredients=idw,mri",))
    again = wrf_mi.open_run(run.folder)
    position = np.array([[2.0, 1.0, 1.3], [3.0, 2.0, 1.0]])
    assert again.predict(position, 1).mean == pytest.approx(run.predict(position, 1).mean)
    assert wrf_mi.evaluate_run(run.folder)["weights"] == run.metrics["weights"]
    assert not list((run.folder / "ingredients").rglob("held_out.npz"))


def test_stopped_hybrid_goes_on_with_finished_folds(flat_folder: Path, tmp_path: Path):
    settings = ("ingredients=idw,kriging",)
    whole = wrf_mi.train(flat_folder, tmp_path / "whole", "hybrid", settings=settings)

    def third() -> Iterator[bool]:
        yield from [False] * 5
        while True:
            yield True

    calls = third()
    with pytest.raises(Interrupted):
        wrf_mi.train(flat_folder, tmp_path / "run", "hybrid", settings=settings, stop=lambda: next(calls))
    kept = list((tmp_path / "run").rglob("held_out.npz"))
    assert kept
    run = wrf_mi.resume(tmp_path / "run")
    assert run.metrics["abs_error_db"] == whole.metrics["abs_error_db"]


def test_two_rows_are_interpolated_by_kriging(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, tmp_path / "run", "hybrid", n_train=2)
    assert list(run.metrics["weights"][0]) == ["distance_m", "kriging"]
    assert "inside_90" not in run.metrics


def test_ingredients_that_do_not_serve_the_data_are_left_out_or_refused(
    one_gateway: Record, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from wrf_mi.models.hybrid.ingredients import problems

    from wrf_mi.models import Problem
    from wrf_mi.models.hybrid.model import HybridSettings

    assert list(problems(Problem(one_gateway, HybridSettings()), None)) == ["kriging", "idw"]
    out = ["--out", str(tmp_path / "run")]
    refused(["train", folder, "--model", "hybrid", "--set", "ingredients=mri", *out], "mri serves rssi", capsys)
    refused(["train", folder, "--model", "hybrid", "--set", "ingredients=physics", *out], "needs a scene", capsys)
    refused(["train", folder, "--model", "hybrid", "--set", "ingredients=none", *out], "'none' is unknown", capsys)


def test_every_named_ingredient_is_a_model():
    assert {ingredient.model for ingredient in INGREDIENTS.values()} <= set(wrf_mi.models.MODELS)


def test_hybrid_mixes_models_from_positions_and_from_the_uplink(tmp_path: Path):
    record = channels()
    run = wrf_mi.train(record, tmp_path / "run", "hybrid", settings=("ingredients=linear,kriging",))
    held, weights = run.metrics["held_out"], run.metrics["weights"]
    assert held["hybrid"] >= held["linear"] > held["kriging"]
    assert all(one["linear"] > 0.5 for one in weights)
    again = wrf_mi.open_run(run.folder, record)
    rows = slice(20, 24)
    found = again.predict(record.tx_pos_m[rows], uplink=record.uplink[rows]).mean
    assert cea_db(found, record.observation[0, rows]).min() > EXACT_DB
    with pytest.raises(InputError, match="linear has a weight and predicts from the uplink"):
        again.predict(record.tx_pos_m[rows])


def test_held_out_observations_are_limited_by_their_size(one_gateway: Record):
    rows = np.arange(1000)
    many = Record("many", "spectrum", np.random.default_rng(0).random((1000, 3)), one_gateway.receivers, np.zeros(0))
    fold = [Split("fold", 0, rows[500:], rows[:0], rows[:500])]
    for shape, most in (((), 500), ((20, 20), 200), ((50,), 400)):
        record = replace(many, observation=np.zeros((1, 1000, *shape), np.float32))
        assert len(HeldOut.of(record, fold, 0)) == most
        assert np.array_equal(HeldOut.of(record, fold, 0).row, HeldOut.of(record, fold, 0).row)
