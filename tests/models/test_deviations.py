"""Deviations of readings and of the mean: their coverage of each, and the files that state both."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wrf_mi.core import Prediction, Receiver, Record
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.types import Inputs
from wrf_mi.estimators.interpolation.strengths import Strengths, fit_strengths
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.other_models import score_predictions
from wrf_mi.runs.predict_to_file import write_run_predictions
from wrf_mi.runs.results import read_run
from wrf_mi.tasks.scores import inside_interval

OF_MEAN, OF_READING = (0.80, 0.97), (0.85, 0.95)
"""Bounds of the share of truth without noise, and of readings, in 90 % intervals: errors of the mean are correlated
over a length of shadowing, so that some hundred count as some dozens."""
NOISE_KNOWN = 0.15  # relative error of a noise by the likelihood of 200 rows and by held-out errors
TESTED = 200  # rows beyond those of the fit
# rows, extent (m), shadowing (dB), its length (m), noise (dB)
ROOMS = [(40, 15, 4, 2, 1.2), (40, 20, 2, 4, 1.2), (200, 15, 4, 2, 3.5), (60, 6, 6, 1, 2), (200, 20, 1, 3, 0.2)]
OUTDOORS = [(200, 200, 6, 30, 2)]


def shadowed(seed: int, rows: int, extent_m: float, shadow_db: float, length_m: float, noise_db: float) -> Record:
    """Readings at four receivers, and the power without noise as truth; the last `TESTED` rows are the test."""
    rng, count = np.random.default_rng(seed), rows + TESTED
    tx_pos_m = np.column_stack([rng.uniform(0, extent_m, (count, 2)), np.full(count, 1.3)])
    places_m = np.column_stack([rng.uniform(0, extent_m, (4, 2)), np.full(4, 2.5)])
    apart_m = np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2)
    lower = np.linalg.cholesky(np.exp(-apart_m / length_m) + 1e-9 * np.eye(count))
    law_dbm = -45 - 25 * np.log10(np.linalg.norm(places_m[:, None] - tx_pos_m, axis=2)) + rng.normal(0, 3, (4, 1))
    truth_dbm = law_dbm + shadow_db * (lower @ rng.normal(size=(count, 4))).T
    readings_dbm = truth_dbm + rng.normal(0, noise_db, truth_dbm.shape)
    named = tuple(Receiver(f"r{k}", place_m, np.array(UPRIGHT)) for k, place_m in enumerate(places_m))
    official = np.arange(rows), np.arange(rows, count)
    record = Record("shadowed", "rssi", tx_pos_m, named, readings_dbm.astype(np.float32), official=official)
    return replace(record, frequencies_hz=np.array([2.4e9]), truth=truth_dbm.astype(np.float32))


def predicted(model: Strengths, record: Record, rows: np.ndarray) -> Prediction:
    of_receivers = [model.predict(Inputs(record.tx_pos_m[rows]), k) for k in range(len(record.receivers))]
    mean, std, std_mean = (np.stack([getattr(p, name) for p in of_receivers]) for name in ("mean", "std", "std_mean"))
    return Prediction(mean, std, std_mean=std_mean)


@pytest.fixture(scope="module", params=[*ROOMS, *OUTDOORS], ids=str)
def fits(request: pytest.FixtureRequest) -> list[tuple[Prediction, Record, np.ndarray]]:
    """Predictions of the test rows, by fits to the others, over three seeds."""
    predictions = []
    for seed in range(3):
        record = shadowed(seed, *request.param)
        train_rows, test_rows = record.official
        predictions.append((predicted(fit_strengths(record, train_rows), record, test_rows), record, test_rows))
    return predictions


def test_interval_of_a_reading_contains_readings(fits: list[tuple[Prediction, Record, np.ndarray]]) -> None:
    shares = [inside_interval(p.mean, p.std, record.observation[:, rows]) for p, record, rows in fits]
    assert OF_READING[0] < np.mean(shares) < OF_READING[1]


def test_interval_of_the_mean_contains_the_truth(fits: list[tuple[Prediction, Record, np.ndarray]]) -> None:
    for p, record, rows in fits:
        assert OF_MEAN[0] < inside_interval(p.mean, p.std_mean, record.truth[:, rows]) < OF_MEAN[1]


def test_reading_deviates_by_its_noise_beside_the_mean() -> None:
    record = shadowed(0, 200, 15, 4, 2, 3.0)
    p = predicted(fit_strengths(record, record.official[0]), record, record.official[1])
    np.testing.assert_allclose(np.sqrt(p.std**2 - p.std_mean**2).mean(), 3.0, rtol=NOISE_KNOWN)


def test_run_states_both_deviations_and_scores_the_one_of_its_truth(tmp_path: Path) -> None:
    record = shadowed(0, 60, 15, 4, 2, 2.0)
    metrics = {}
    for name, of in (("mean", record), ("reading", replace(record, truth=None))):
        run = train(of, "kriging", split="official", out=tmp_path / name)
        metrics[name], stored = run.metrics, read_run(run.folder)
        assert run.metrics["intervals_of"] == name
        deviation = {"mean": stored.std_mean, "reading": stored.std}[name]
        assert run.metrics["inside_90"] == inside_interval(stored.prediction, deviation, stored.truth)
        assert (stored.std_mean < stored.std).all()
    run = open_run(tmp_path / "mean", record)
    prediction = run.predict(record.tx_pos_m[-3:])
    np.testing.assert_allclose(prediction.std_mean, read_run(run.folder).std_mean[:, -3:], rtol=1e-5)
    assert set(prediction.to_xarray()) >= {"std", "std_mean"}
    write_run_predictions(run, Inputs(record.tx_pos_m[-3:]), tmp_path / "new.csv")
    header, first = (tmp_path / "new.csv").read_text().splitlines()[:2]
    row = dict(zip(header.split(","), map(float, first.split(",")), strict=True))
    assert row["r0_std_mean_db"] == pytest.approx(prediction.std_mean[0, 0], rel=1e-5)
    write_run_predictions(run, Inputs(record.tx_pos_m), tmp_path / "all.csv")
    scored = score_predictions(record, tmp_path / "all.csv", tmp_path / "other", "other")
    assert scored.metrics["inside_90"] == pytest.approx(metrics["mean"]["inside_90"])
    dataset = run.map(height_m=1.3, step_m=5, receivers=["r0"])
    assert (dataset["power_std_mean_db"] < dataset["power_std_db"]).all()


def test_intervals_of_the_hybrid_contain_readings_and_truth(tmp_path):
    shares = []
    for seed in range(3):
        record = shadowed(seed, 40, 20, 2, 4, 1.2)
        run = train(record, "hybrid", split="official", out=tmp_path / str(seed))
        stored, test_rows = read_run(run.folder), record.official[1]
        of_readings = inside_interval(stored.prediction, stored.std, record.observation[:, test_rows])
        shares.append((run.metrics["inside_90"], of_readings))
    of_truth, of_readings = np.mean(shares, axis=0)
    assert OF_MEAN[0] < of_truth < OF_MEAN[1]
    assert OF_READING[0] < of_readings < OF_READING[1]


def test_intervals_by_held_out_rows_keep_the_deviation_of_the_mean(tmp_path: Path) -> None:
    record = shadowed(1, 60, 15, 4, 2, 2.0)
    run = train(record, "kriging", split="official", out=tmp_path / "run", intervals=True)
    assert OF_MEAN[0] < run.metrics["inside_90"] < OF_MEAN[1]
    assert run.metrics["intervals_of"] == "mean"


def test_model_that_cannot_tell_noise_leaves_the_deviation_of_the_mean_out(tmp_path: Path) -> None:
    record = shadowed(1, 60, 15, 4, 2, 2.0)
    run = train(record, "idw", split="official", out=tmp_path / "run", intervals=True)
    assert run.predict(record.tx_pos_m[:2]).std_mean is None
    assert read_run(run.folder).std_mean is None
    assert run.metrics["intervals_of"] == "reading"


def test_stored_fit_states_its_deviations_as_it_did() -> None:
    record = shadowed(0, 60, 15, 4, 2, 2.0)
    model = fit_strengths(record, record.official[0])
    stored = predicted(Strengths.from_arrays(model.arrays()), record, np.arange(5))
    np.testing.assert_array_equal(stored.std_mean, predicted(model, record, np.arange(5)).std_mean)
