"""Scores of signal strengths and channels: metrics, predictions, pooling, and gains over a constant prediction."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command
from hypothesis import given, settings
from hypothesis import strategies as st
from made_building import TESTED, TRAINED, building
from made_channels import channels
from made_spectra import spectra

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.datasets import make_splits, write_ble_folder, write_nerf2_csi
from wrf_mi.runs.baselines import (
    CONSTANT,
    CONSTANT_RMSE,
    SCORES,
    VARIATION,
    WORDS,
    against,
    constant_scores,
    variation,
    verdicts,
    warnings_of,
)
from wrf_mi.runs.evaluate import evaluate, pool, write_results
from wrf_mi.runs.results import Results, read_run
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import abs_error_db, cea_db, ssim

ROWS = 40
FLOAT32 = 1e-5
"""Rounding of tens of dBm, and of scores of some dB, in float32."""
HEADER = {"dataset": "made-up", "model": "off", "split": "official", "train_seconds": 0.0, "peak_memory_mb": 1.0}
FIELDS = {"median", "mean", "p10", "p90"}
ERRORS = {"bias", "std", "rmse"}
GAIN = {"gain", "gain_error", "beaten"}


def record(task: str, receivers: int, subcarriers: int = 3) -> Record:
    rng = np.random.default_rng(5)
    shape: tuple[int, ...] = (receivers, ROWS)
    if task == "rssi":
        observation = rng.uniform(-90, -40, shape).astype(np.float32)
        observation[0, [1, 8, 39]] = np.nan
        observation[-1, [2, 38, 39]] = np.nan
    else:
        shape = (*shape, subcarriers)
        observation = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    receiver = [Receiver(f"anchor{r}", rng.normal(size=3), np.array([0.0, 0, 0, 1])) for r in range(receivers)]
    record_fields: dict[str, Any] = {"official": (np.arange(30), np.arange(30, ROWS)), "folds": np.arange(ROWS) % 4}
    return Record("made-up", task, rng.normal(size=(ROWS, 3)), tuple(receiver), observation, **record_fields)


class Off:
    """Knows the truth and departs from it: by 1 dB at the first receiver, 2 dB at the next; by a tenth in amplitude."""

    def __init__(self, truth: Record) -> None:
        self.truth = truth

    def __call__(self, rows: np.ndarray, receiver: int) -> np.ndarray:
        observed = self.truth.observation[receiver, rows]
        if self.truth.task.name == "csi":
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
    expected = {key: pytest.approx(1, abs=FLOAT32) for key in FIELDS | {"bias", "rmse"}}
    assert metrics["abs_error_db"] == expected | {"std": pytest.approx(0, abs=FLOAT32)}
    assert set(metrics["reference"]["idw"]) == FIELDS | ERRORS | GAIN | {f"rmse_{key}" for key in GAIN} | {"neighbours"}
    # Rows 38 and 39 of the one receiver were not received; row 39 was by none and is in no split.
    assert (metrics["n_train"], metrics["n_test"]) == (27, 8)
    assert "receivers" not in metrics
    run = stored(tmp_path / "run", metrics, arrays)
    with np.load(tmp_path / "run" / "predictions.npz") as file:
        assert sorted(file) == ["prediction", "receiver_name", "reference_idw", "row", "truth", "tx_pos"]
        for key in ("prediction", "truth", "reference_idw"):
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
        assert set(block["reference"]["idw"]) == FIELDS | ERRORS
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
    assert by_task["csi"]["score"].keys() == {"metric", "higher_is_better"} | FIELDS
    assert by_task["rssi"]["score"].keys() == {"metric", "higher_is_better"} | FIELDS | ERRORS


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
    blend = metrics["reference"]["idw"]
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


LINE = r"is no better than predicting "


def noise(record: Record) -> Record:
    """The record with strengths that do not depend on the position."""
    drawn = np.random.default_rng(1).normal(-60, 5, record.observation.shape)
    return replace(record, observation=drawn.astype(np.float32))


def test_constant_of_strengths_is_the_median_of_each_receiver_where_errors_are_smallest() -> None:
    record = building(attic=(1, 2, 3, 45))
    (split,) = make_splits(record, "official")
    truth = record.observation[:, split.test]
    arrays = constant_scores(record, split, truth)
    for receiver in range(4):
        median_dbm = np.nanmedian(record.observation[receiver, :TRAINED])
        np.testing.assert_allclose(arrays[SCORES][receiver], np.abs(truth[receiver] - median_dbm), atol=FLOAT32)
    assert np.isfinite(arrays[SCORES][3]).sum() == 1
    assert set(arrays[WORDS].flat) == {"the median of each receiver's training rows"}


def test_receivers_that_are_held_out_take_the_mean_of_the_others() -> None:
    record, tested = building(), np.arange(TRAINED, TRAINED + TESTED)
    split = Split("mine", 0, np.arange(TRAINED), np.zeros(0, np.int64), tested, held_receivers=(0,))
    truth = record.observation[:, split.test]
    expected = np.abs(truth[0] - np.median(record.observation[1:, :TRAINED]))
    np.testing.assert_allclose(constant_scores(record, split, truth)[SCORES][0], expected, atol=FLOAT32)


SPECTRA = Split("mine", 0, np.arange(16), np.zeros(0, np.int64), np.arange(16, 24))


@pytest.mark.parametrize("words", ["the mean of each receiver's training rows", "black"])
def test_constant_of_spectra_is_the_one_that_scores_best_on_training_rows(one_gateway: Record, words: str) -> None:
    record = one_gateway
    if words == "black":  # a bright block in each spectrum, elsewhere than in the others
        blocks = np.zeros_like(record.observation)
        for row in range(blocks.shape[1]):
            top, left = row // 6 * 5, row % 6 * 6
            blocks[0, row, top : top + 3, left : left + 3] = 1
        record = replace(record, observation=blocks)
    truth = record.observation[:, SPECTRA.test]
    constant = record.observation[0, :16].mean(axis=0) * (words != "black")
    arrays = constant_scores(record, SPECTRA, truth)
    assert set(arrays[WORDS].flat) == {words}
    np.testing.assert_allclose(arrays[SCORES][0], ssim([constant] * 8, truth[0]), atol=FLOAT32)


def test_channels_are_predicted_by_zero() -> None:
    record = channels()
    (split,) = make_splits(record, "official")
    np.testing.assert_array_equal(constant_scores(record, split, record.scored[:, split.test])[SCORES], 0)


TASK_RECORDS: dict[str, Callable[[], Record]] = {
    "rssi": building,
    "csi": channels,
    "spectrum": lambda: spectra(rows=24)[0],
}


@pytest.mark.parametrize("task", TASK_RECORDS)
def test_predictions_of_the_truth_vary_as_much_as_it(task: str) -> None:
    record = TASK_RECORDS[task]()
    (split,) = make_splits(record, "official")
    metrics, _ = evaluate(record, split, lambda rows, receiver: record.observation[receiver, rows])
    assert metrics[VARIATION]["ratio"] == pytest.approx(1)
    assert warnings_of(metrics | {"model": "mine"}) == []


@pytest.mark.parametrize("task", TASK_RECORDS)
def test_a_model_that_predicts_a_constant_says_so_whatever_it_is(task: str) -> None:
    record = TASK_RECORDS[task]()
    (split,) = make_splits(record, "official")
    # The best constant of the test rows themselves, which no training row tells.
    constant = np.nanmedian(record.observation[:, split.test].real, axis=1).astype(record.observation.dtype)
    metrics, _ = evaluate(record, split, lambda rows, receiver: np.stack([constant[receiver]] * len(rows)))
    assert metrics[VARIATION]["ratio"] == 0
    assert any(line.startswith("mine predicts nearly the same") for line in warnings_of(metrics | {"model": "mine"}))


def test_variation_leaves_out_rows_that_are_not_scored() -> None:
    truth = np.array([[1.0, 3.0, np.nan]])
    assert variation(np.array([[5.0, 6.0, 100.0]]), truth) == {"prediction": 0.5, "truth": 1.0, "ratio": 0.5}


def test_variation_of_one_row_is_unknown() -> None:
    assert variation(np.ones((2, 1)), np.zeros((2, 1))) is None


@pytest.mark.parametrize("task", ["rssi", "csi"])
@settings(deadline=None, max_examples=30)
@given(st.floats(-3, 3), st.integers(0, 99))
def test_a_gain_counts_beyond_its_standard_error(task: str, gain: float, seed: int) -> None:
    scorer, rng = TASKS[task], np.random.default_rng(seed)
    constant = rng.uniform(2, 6, (2, 30))
    sign = 1 if scorer.higher_is_better else -1
    scores = constant + sign * (gain + rng.normal(0, 1, (2, 30)))
    block = against(scorer, scores, constant)
    assert block["gain"] == pytest.approx(gain, abs=1)  # seven standard errors
    better = sign * np.median(scores) > sign * np.median(constant)
    assert block["beaten"] == (block["gain"] > max(block["gain_error"], 0.01) and better)


def test_constant_of_smallest_rmse_is_the_mean_of_each_receiver() -> None:
    record = building()
    (split,) = make_splits(record, "official")
    metrics, _ = evaluate(record, split, lambda rows, receiver: record.observation[receiver, rows] + 1)
    trained, tested = record.observation[:, :TRAINED].astype(float), record.observation[:, TRAINED:]
    for key, constant_dbm in ((CONSTANT_RMSE, trained.mean(axis=1)), (CONSTANT, np.median(trained, axis=1))):
        error_db = constant_dbm[:, None] - tested
        block = metrics[key]
        assert block["rmse"] == pytest.approx(np.sqrt(np.mean(error_db**2)), abs=FLOAT32)
        assert block["bias"] == pytest.approx(error_db.mean(), abs=FLOAT32)
        assert block["rmse_gain"] == pytest.approx(block["rmse"] - 1, abs=FLOAT32)
        assert block["rmse_beaten"]
    assert metrics[CONSTANT]["words"] == "the median of each receiver's training rows"
    assert metrics[CONSTANT_RMSE]["words"] == "the mean of each receiver's training rows"


def test_verdicts_are_against_the_constant_that_is_best_for_each_score() -> None:
    record = building()
    (split,) = make_splits(record, "official")
    mean_dbm = record.observation[:, :TRAINED].mean(axis=1)
    metrics, _ = evaluate(record, split, lambda rows, receiver: np.full(len(rows), mean_dbm[receiver]))
    median, rmse = verdicts(metrics)
    assert median.startswith(f"median absolute error (dB) {metrics['abs_error_db']['median']:.3f}: no better than the")
    assert "best constant, the median of each receiver's training rows" in median
    assert rmse.startswith(f"RMSE {metrics['abs_error_db']['rmse']:.3f} dB (bias ")
    assert "equal to the best constant, the mean of each receiver's training rows" in rmse
    assert re.search(r"; no better than the best simple model, IDW of \d+ nearest \(\d", rmse)
    truth, _ = evaluate(record, split, lambda rows, receiver: record.observation[receiver, rows])
    assert all(line.count("better than") == 2 and "no better" not in line for line in verdicts(truth))


def test_the_best_reference_is_compared_with() -> None:
    truth = np.zeros((1, 4), np.float32)
    references: dict[str, Any] = {"idw": truth + 3, "law": truth + 2}
    no_metrics: dict[str, Any] = {}
    result_fields = (Path(), "name", "rssi", "data", no_metrics, 0, ("anchor0",), np.arange(4), np.zeros((4, 3)))
    results = Results(*result_fields, truth, truth, references, None, None, no_metrics)
    assert results.best_reference == "law"
    np.testing.assert_array_equal(results.reference, references["law"])
    assert results.reference_name == "one path-loss law of all receivers"


@pytest.mark.parametrize("model", ["kriging", "mri"])
@pytest.mark.parametrize("beaten", [True, False], ids=["office", "noise"])
def test_a_model_of_strengths_without_place_says_so(beaten: bool, model: str, tmp_path: Path, command: Command) -> None:
    record, run = building(), tmp_path / "run"
    folder = write_ble_folder(tmp_path / "data", record if beaten else noise(record))
    out = command.done(["train", folder, "--model", model, "--out", run])
    assert json.loads((run / "metrics.json").read_text())[CONSTANT]["beaten"] == beaten
    assert out.splitlines()[-1] == f"results: {run}"
    assert bool(re.search(f"{re.escape(model)} {LINE}the me(an|dian) of each receiver's training rows", out)) != beaten
    assert (LINE in command.done(["evaluate", run])) != beaten


def test_a_model_of_channels_that_predicts_no_more_than_zero_says_so(tmp_path: Path, command: Command) -> None:
    record = channels()
    turned = np.exp(2j * np.pi * np.random.default_rng(0).random(len(record)))  # a phase that no position tells
    record = replace(record, observation=record.observation * turned[:, None, None].astype(np.complex64))
    folder = write_nerf2_csi(tmp_path / "data", record)
    out = command.done(["train", folder, "--model", "idw", "--out", tmp_path / "run"])
    assert f"idw {LINE}zero: CEA (dB), median " in out


def test_a_run_of_an_earlier_version_has_no_such_line() -> None:
    assert warnings_of({"task": "rssi"}) == []
