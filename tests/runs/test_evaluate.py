"""Scores of signal strengths and channels: metrics, predictions, pooling, and gains over a constant prediction."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calling import SET
from commands import Command, arrays_in
from hypothesis import given, settings
from hypothesis import strategies as st
from made_building import TESTED, TRAINED, building
from made_channels import channels

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.datasets import make_splits, write_ble_folder, write_nerf2_csi
from wrf_mi.runs.evaluate import evaluate, pool, write_results
from wrf_mi.runs.results import CONSTANT, Results, against_constant, constant_scores, read_run, unbeaten
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import abs_error_db, cea_db, ssim

ROWS = 40
FLOAT32 = 1e-5
"""Rounding of tens of dBm, and of scores of some dB, in float32."""
HEADER = {"dataset": "made-up", "model": "off", "split": "official", "train_seconds": 0.0, "peak_memory_mb": 1.0}
FIELDS = {"median", "mean", "p10", "p90"}


def record(task: str, receivers: int, subcarriers: int = 3) -> Record:
    rng = np.random.default_rng(5)
    shape = (receivers, ROWS)
    if task == "rssi":
        observation = rng.uniform(-90, -40, shape).astype(np.float32)
        observation[0, [1, 8, 39]] = np.nan
        observation[-1, [2, 38, 39]] = np.nan
    else:
        shape = (*shape, subcarriers)
        observation = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    receiver = [Receiver(f"anchor{r}", rng.normal(size=3), np.array([0.0, 0, 0, 1])) for r in range(receivers)]
    known = {"official": (np.arange(30), np.arange(30, ROWS)), "folds": np.arange(ROWS) % 4}
    return Record("made-up", task, rng.normal(size=(ROWS, 3)), tuple(receiver), observation, **known)


class Off:
    """Knows the truth and departs from it: by 1 dB at the first receiver, 2 dB at the next; by a tenth in amplitude."""

    def __init__(self, truth: Record) -> None:
        self.truth = truth

    def __call__(self, rows: np.ndarray, receiver: int) -> np.ndarray:
        observed = self.truth.observation[receiver, rows]
        if self.truth.task == "csi":
            return observed * (1 + 0.1j)
        return np.where(np.isnan(observed), -30.0, observed + 1 + receiver)


def scored(task: str, receivers: int, split: str = "official") -> tuple[Record, list]:
    truth = record(task, receivers)
    return truth, [evaluate(truth, part, Off(truth)) for part in make_splits(truth, split)]


def stored(folder: Path, metrics: dict, arrays: dict) -> Results:
    folder.mkdir()
    write_results(folder, HEADER | metrics, arrays)
    return read_run(folder)


def test_signal_strengths_of_one_receiver(tmp_path: Path):
    truth, [(metrics, arrays)] = scored("rssi", 1)
    assert metrics["task"] == "rssi"
    assert metrics["abs_error_db"] == {key: pytest.approx(1, abs=FLOAT32) for key in FIELDS}
    assert set(metrics["reference"]["idw100"]) == FIELDS
    # Rows 38 and 39 of the one receiver were not received; row 39 was by none and is in no split.
    assert (metrics["n_train"], metrics["n_test"]) == (27, 8)
    assert "receivers" not in metrics
    run = stored(tmp_path / "run", metrics, arrays)
    with np.load(tmp_path / "run" / "predictions.npz") as file:
        assert sorted(file) == ["prediction", "receiver_name", "reference_idw100", "row", "truth", "tx_pos"]
        for key in ("prediction", "truth", "reference_idw100"):
            assert file[key].dtype == np.float32
        assert file["prediction"].shape == (8,)
    assert (run.task, run.dataset, run.receivers) == ("rssi", "made-up", ("anchor0",))
    assert run.prediction.shape == run.truth.shape == run.reference.shape == (1, 8)
    np.testing.assert_array_equal(run.tx_pos_m, truth.tx_pos_m[run.row])
    np.testing.assert_allclose(run.score, np.ones((1, 8)), atol=FLOAT32)
    np.testing.assert_array_equal(run.reference_score, abs_error_db(run.reference, run.truth))


def test_several_receivers_have_a_block_each_and_a_pooled_one(tmp_path: Path):
    _, [(metrics, arrays)] = scored("rssi", 2)
    assert list(metrics["receivers"]) == ["anchor0", "anchor1"]
    for r, (name, count) in enumerate([("anchor0", 9), ("anchor1", 8)]):
        block = metrics["receivers"][name]
        assert block["abs_error_db"]["median"] == pytest.approx(1 + r, abs=FLOAT32)
        assert set(block["reference"]["idw100"]) == FIELDS
        assert block["n_test"] == count
    # Every sample that was received counts once: 9 of 1 dB and 8 of 2 dB.
    assert metrics["abs_error_db"]["mean"] == pytest.approx((9 * 1 + 8 * 2) / 17, abs=FLOAT32)
    assert metrics["n_test"] == 9
    run = stored(tmp_path / "run", metrics, arrays)
    assert run.score.shape == (2, 9)
    assert np.isnan(run.score).sum() == 1
    assert np.isnan(run.score[1, run.row == 38]).all()
    assert run.receivers == ("anchor0", "anchor1")


def test_scores_have_the_same_keys_for_all_tasks():
    by_task = {task: scored(task, 2)[1][0][0] for task in ("rssi", "csi")}
    for task, metrics in by_task.items():
        for block in (metrics, *metrics["receivers"].values()):
            rule = {"metric": TASKS[task].block, "higher_is_better": TASKS[task].higher_is_better}
            assert block["score"] == rule | block[TASKS[task].block]
    assert by_task["rssi"]["score"].keys() == by_task["csi"]["score"].keys() == {"metric", "higher_is_better"} | FIELDS


def test_a_receiver_that_received_no_test_row_has_no_scores():
    truth = record("rssi", 2)
    truth.observation[1, 30:] = np.nan
    metrics, _ = evaluate(truth, make_splits(truth, "official")[0], Off(truth))
    assert metrics["receivers"]["anchor1"] == {"n_test": 0}
    assert metrics["abs_error_db"]["median"] == pytest.approx(1, abs=FLOAT32)


@pytest.mark.parametrize("receivers", [1, 2])
def test_channel_coefficients(tmp_path: Path, receivers: int):
    _, [(metrics, arrays)] = scored("csi", receivers)
    assert metrics["task"] == "csi"
    assert metrics["cea_db"] == {key: pytest.approx(20, abs=FLOAT32) for key in FIELDS}  # a tenth: 20 dB
    assert metrics["n_test"] == 10
    run = stored(tmp_path / "run", metrics, arrays)
    assert run.prediction.shape == (receivers, 10, 3)
    assert run.prediction.dtype == np.complex64
    np.testing.assert_allclose(run.score, np.full((receivers, 10), 20), atol=FLOAT32)
    blend = metrics["reference"]["idw4"]
    assert blend["median"] == pytest.approx(np.median(cea_db(run.reference, run.truth)))
    assert blend["median"] < 3, "white noise cannot be interpolated"


@pytest.mark.parametrize("task", ["rssi", "csi"])
@pytest.mark.parametrize("receivers", [1, 2])
def test_folds_are_pooled(tmp_path: Path, task: str, receivers: int):
    truth, parts = scored(task, receivers, "blocked")
    metrics, arrays = pool(parts)
    assert len(parts) == 4
    received = ~np.isnan(truth.observation).reshape(receivers, ROWS, -1).all(axis=(0, 2))
    assert sorted(arrays["row"].tolist()) == np.flatnonzero(received).tolist()
    assert metrics["n_test"] == received.sum()
    run = stored(tmp_path / "run", metrics, arrays)
    assert run.metrics[TASKS[task].block]["mean"] == pytest.approx(np.nanmean(run.score))
    np.testing.assert_array_equal(run.truth, truth.observation[:, run.row])


def test_predictions_must_be_finite_wherever_something_was_received():
    truth = record("rssi", 1)
    (split,) = make_splits(truth, "official")
    with pytest.raises(InputError, match="8 of 8 values are not finite where the truth is known"):
        evaluate(truth, split, lambda rows, receiver: np.full(len(rows), -np.inf))
    with pytest.raises(InputError, match="differ in shape"):
        evaluate(truth, split, lambda rows, receiver: np.zeros((len(rows), 2)))


def test_rows_that_cannot_be_scored_are_refused():
    truth = record("rssi", 2)
    (split,) = make_splits(truth, "official")
    with pytest.raises(InputError, match="split official: no test rows to score"):
        evaluate(truth, replace(split, test=np.arange(0)), Off(truth))
    truth = record("csi", 2)  # strengths of a silent receiver are predicted from the others
    truth.observation[1, :30] = np.nan
    with pytest.raises(InputError, match="made-up, receiver anchor1: 30 training rows: none of them was received"):
        evaluate(truth, make_splits(truth, "official")[0], Off(truth))


@pytest.mark.parametrize(
    ("task", "change", "message"),
    [
        ("rssi", {"task": "csi"}, "no cea_db or no reference idw4"),
        ("csi", {"task": "rssi"}, "no abs_error_db or no reference idw100"),
        ("rssi", {"task": "colour"}, "task 'colour'; known are spectrum, rssi, csi"),
        ("rssi", {"reference": {"idw4": {"median": 1}}}, "no reference idw100"),
    ],
)
def test_run_folders_of_another_task_are_named(tmp_path: Path, task: str, change: dict, message: str):
    _, [(metrics, arrays)] = scored(task, 1)
    with pytest.raises(InputError, match=message):
        stored(tmp_path / "run", metrics | change, arrays)


def test_predictions_of_another_shape_are_named(tmp_path: Path):
    _, [(metrics, arrays)] = scored("rssi", 2)
    stored(tmp_path / "run", metrics, arrays)
    kept = arrays_in(tmp_path / "run" / "predictions.npz")
    for wrong in (
        {"truth": kept["truth"][:, 1:]},
        {"prediction": kept["prediction"][..., None]},
        {"receiver_name": kept["receiver_name"][:1]},
        {"tx_pos": kept["tx_pos"][:, :2]},
    ):
        np.savez(tmp_path / "run" / "predictions.npz", **kept | wrong)
        with pytest.raises(InputError, match=r"shapes do not fit together .*; run evaluate to write it anew"):
            read_run(tmp_path / "run")


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
        np.testing.assert_allclose(found[receiver], np.abs(truth[receiver] - mean_dbm), atol=FLOAT32)
    assert np.isfinite(found[3]).sum() == 1


def test_receivers_that_are_held_out_take_the_mean_of_the_others() -> None:
    record, tested = building(), np.arange(TRAINED, TRAINED + TESTED)
    split = Split("mine", 0, np.arange(TRAINED), np.zeros(0, np.int64), tested, held_receivers=(0,))
    truth = record.observation[:, split.test]
    expected = np.abs(truth[0] - record.observation[1:, :TRAINED].mean())
    np.testing.assert_allclose(constant_scores(record, split, truth)[0], expected, atol=FLOAT32)


def test_spectra_are_predicted_by_the_mean_spectrum(one_gateway: Record) -> None:
    split = Split("mine", 0, np.arange(16), np.zeros(0, np.int64), np.arange(16, 24))
    truth = one_gateway.observation[:, split.test]
    mean = one_gateway.observation[0, :16].mean(axis=0)
    np.testing.assert_allclose(constant_scores(one_gateway, split, truth)[0], ssim([mean] * 8, truth[0]), atol=FLOAT32)


def test_channels_are_predicted_by_zero() -> None:
    record = channels()
    (split,) = make_splits(record, "official")
    np.testing.assert_array_equal(constant_scores(record, split, record.scored[:, split.test]), 0)


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
    for split in make_splits(record, "blocked"):
        metrics, _ = evaluate(record, split, lambda rows, receiver: record.observation[receiver, rows])
        assert metrics[CONSTANT]["beaten"]


@pytest.mark.parametrize("model", ["idw", "kriging", "mri", "trees"])
@pytest.mark.parametrize("beaten", [True, False], ids=["office", "noise"])
def test_a_model_of_strengths_without_place_says_so(beaten: bool, model: str, tmp_path: Path, command: Command) -> None:
    record, run = building(), tmp_path / "run"
    folder = write_ble_folder(tmp_path / "data", record if beaten else noise(record))
    *_, line, last = command.done(["train", folder, "--model", model, "--out", run]).splitlines()
    assert json.loads((run / "metrics.json").read_text())[CONSTANT]["beaten"] == beaten
    assert last == f"results: {run}"
    assert (f"{model} {LINE}the mean of each receiver's training rows" in line) != beaten
    assert (LINE in command.done(["evaluate", run])) != beaten


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+", "idw"])
def test_a_model_of_channels_that_predicts_no_more_than_zero_says_so(
    model: str, tmp_path: Path, command: Command
) -> None:
    record = channels()
    turned = np.exp(2j * np.pi * np.random.default_rng(0).random(len(record)))  # a phase that no position tells
    record = replace(record, observation=record.observation * turned[:, None, None].astype(np.complex64))
    folder, few = write_nerf2_csi(tmp_path / "data", record), SET if model != "idw" else []
    out = command.done(["train", folder, "--model", model, "--out", tmp_path / "run", *few])
    assert f"{model} {LINE}zero: CEA (dB), median " in out.splitlines()[-2]


def test_a_run_of_an_earlier_version_has_no_such_line() -> None:
    assert unbeaten({"task": "rssi"}) is None
