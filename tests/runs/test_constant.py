"""Models that are no better than a constant prediction say so."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SET, call
from hypothesis import given, settings
from hypothesis import strategies as st
from made_building import TESTED, TRAINED, building
from made_channels import channels

from wrf_mi.core import Record, Split
from wrf_mi.datasets import make_splits, write_ble_folder, write_nerf2_csi
from wrf_mi.runs.evaluate import evaluate
from wrf_mi.runs.results import CONSTANT, against_constant, constant_scores, unbeaten
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import ssim

SINGLE = 1e-5
"""Rounding of tens of dBm in single precision."""
LINE = r"is no better than predicting "


def noise(record: Record) -> Record:
    """The record with strengths that do not depend on the position."""
    drawn = np.random.default_rng(1).normal(-60, 5, record.observation.shape)
    return replace(record, observation=drawn.astype(np.float32))


def test_strengths_are_predicted_by_the_mean_of_the_receiver() -> None:
    record = building(attic=(1, 2, 3, 45))
    (split,) = make_splits(record, "official")
    truth = record.observation[:, split.test]
    found = constant_scores(record, split, truth)
    for receiver in range(4):
        mean_dbm = np.nanmean(record.observation[receiver, :TRAINED])
        np.testing.assert_allclose(found[receiver], np.abs(truth[receiver] - mean_dbm), atol=SINGLE)
    assert np.isfinite(found[3]).sum() == 1


def test_receivers_that_are_held_out_take_the_mean_of_the_others() -> None:
    record, none = building(), np.zeros(0, np.int64)
    split = Split("mine", 0, np.arange(TRAINED), none, np.arange(TRAINED, TRAINED + TESTED), held_receivers=(0,))
    truth = record.observation[:, split.test]
    expected = np.abs(truth[0] - record.observation[1:, :TRAINED].mean())
    np.testing.assert_allclose(constant_scores(record, split, truth)[0], expected, atol=SINGLE)


def test_spectra_are_predicted_by_the_mean_spectrum(one_gateway: Record) -> None:
    split = Split("mine", 0, np.arange(16), np.zeros(0, np.int64), np.arange(16, 24))
    truth = one_gateway.observation[:, split.test]
    mean = one_gateway.observation[0, :16].mean(axis=0)
    np.testing.assert_allclose(constant_scores(one_gateway, split, truth)[0], ssim([mean] * 8, truth[0]), atol=SINGLE)


def test_channels_are_predicted_by_zero() -> None:
    record = channels()
    (split,) = make_splits(record, "official")
    found = constant_scores(record, split, record.scored[:, split.test])
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize("task", ["rssi", "csi"])
@settings(deadline=None, max_examples=30)
@given(st.floats(-3, 3), st.integers(0, 99))
def test_a_gain_counts_beyond_its_standard_error(task: str, gain: float, seed: int) -> None:
    scorer, rng = TASKS[task], np.random.default_rng(seed)
    constant = rng.uniform(2, 6, (2, 30))
    sign = 1 if scorer.higher_is_better else -1
    scores = constant + sign * (gain + rng.normal(0, 1, (2, 30)))
    block = against_constant(scorer, scores, constant)
    assert block["gain"] == pytest.approx(gain, abs=1)  # seven standard errors
    better = sign * np.median(scores) > sign * np.median(constant)
    assert block["beaten"] == (block["gain"] > max(block["gain_error"], 0.01) and better)


@pytest.mark.parametrize("task", ["rssi", "csi", "spectrum"])
def test_a_prediction_as_good_as_the_constant_does_not_beat_it(task: str) -> None:
    scores = np.random.default_rng(0).uniform(0, 1, (1, 20))
    sign = 1 if TASKS[task].higher_is_better else -1
    for gain in (0.0, 1e-4):
        assert not against_constant(TASKS[task], scores + sign * gain, scores)["beaten"]


def test_folds_are_scored_together() -> None:
    record = building()
    metrics = [
        evaluate(record, split, lambda rows, receiver: record.observation[receiver, rows])[0]
        for split in make_splits(record, "blocked")
    ]
    assert all(one[CONSTANT]["beaten"] for one in metrics)


@pytest.mark.parametrize("model", ["idw", "kriging", "mri", "trees"])
def test_a_model_of_strengths_without_place_says_so(
    model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, record in (("office", building()), ("noise", noise(building()))):
        folder, run = write_ble_folder(tmp_path / name, record), tmp_path / f"run-{name}"
        status, out, _ = call(["train", folder, "--model", model, "--out", run], capsys)
        last, metrics = out.splitlines()[-2:], json.loads((run / "metrics.json").read_text())
        assert status == 0
        assert metrics[CONSTANT]["beaten"] == (name == "office")
        assert last[1] == f"results: {run}"
        assert (f"{model} {LINE}the mean of each receiver's training rows" in last[0]) == (name == "noise")
        again = call(["evaluate", run], capsys)[1]
        assert (LINE in again) == (name == "noise")


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+", "idw"])
def test_a_model_of_channels_that_predicts_no_more_than_zero_says_so(
    model: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = channels()
    turned = np.exp(2j * np.pi * np.random.default_rng(0).random(len(record)))  # a phase that no position tells
    record = replace(record, observation=record.observation * turned[:, None, None].astype(np.complex64))
    folder = write_nerf2_csi(tmp_path / "data", record)
    asked: list[Any] = ["train", folder, "--model", model, "--out", tmp_path / "run"]
    status, out, err = call([*asked, *(SET if model != "idw" else [])], capsys)
    assert status == 0, err
    assert f"{model} {LINE}zero: CEA (dB), median " in out.splitlines()[-2]


def test_a_run_of_an_earlier_version_has_no_such_line() -> None:
    assert unbeaten({"task": "rssi"}) is None
