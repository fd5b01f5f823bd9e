"""Intervals from held-out errors, and the probability of reception: calibration, and ways into runs, files and maps."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import wrf_mi
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.coverage import run_reliability
from wrf_mi.core import InputError, Prediction, Record, Split
from wrf_mi.datasets import load, make_splits
from wrf_mi.estimators.held_out import held_out_predictions
from wrf_mi.estimators.model import default_settings
from wrf_mi.estimators.reception import Sensitivity
from wrf_mi.models import MODELS, Problem, Session
from wrf_mi.runs.predict_to_file import write_run_predictions
from wrf_mi.scene.correction_data import FILE, CorrectionData
from wrf_mi.tasks.scores import crps, inside_interval, probability_scores
from wrf_mi.training.by_distance import fit_intervals
from wrf_mi.training.selection import HeldOut, hold_out

ROUNDING_DB = 2e-5  # of powers near -60 dBm in single precision, a few units in the last place
COVERED = 0.02  # allowed difference of a coverage of 0.9 over 4,000 draws: four standard errors


def fold_of(record: Record, n_train: int | None = None) -> tuple[Split, Split]:
    split = make_splits(record, "official", n_train=n_train)[0]
    return split, hold_out(record, split)


@pytest.mark.parametrize("n_train", [None, 20, 6, 4, 3])
def test_held_out_rows_are_a_part_of_the_training_rows(flat_folder: Path, n_train: int | None):
    split, fold = fold_of(load(flat_folder), n_train)
    assert not set(fold.test) & set(fold.all_train)
    assert set(fold.test) | set(fold.all_train) == set(split.all_train)
    assert min(2, len(split.all_train) - 2) <= len(fold.test) <= len(split.all_train) / 2


def test_nothing_is_held_out_of_two_rows_or_one_position_and_distances_are_those_to_remaining_rows(flat_folder: Path):
    record = load(flat_folder)
    assert fold_of(record, 2)[1] is None
    rows, still = np.arange(6), replace(record, tx_pos_m=np.zeros_like(record.tx_pos_m))
    assert hold_out(still, Split("still", 0, rows, rows[:0], rows[:0])) is None
    _, fold = fold_of(record)
    held_out = HeldOut.of(record, fold, 0)
    for place in (0, len(held_out) // 2, len(held_out) - 1):
        training_rows = fold.all_train[np.isfinite(record.observation[held_out.receiver[place], fold.all_train])]
        apart = np.linalg.norm(record.tx_pos_m[training_rows] - record.tx_pos_m[held_out.row[place]], axis=1)
        assert held_out.distance_m[place] == pytest.approx(apart.min())


@pytest.mark.parametrize("is_complex", [False, True])
def test_intervals_cover_new_errors_that_grow_with_size_and_distance(is_complex: bool):
    rng = np.random.default_rng(0)

    def draw(rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        distance, mean = rng.uniform(0, 1, rows), rng.uniform(1, 3, (rows, 10)) + 0j * is_complex
        noise = rng.normal(size=mean.shape) + (1j * rng.normal(size=mean.shape) if is_complex else 0)
        return mean, mean + noise * (0.1 + distance[:, None]) * np.abs(mean), distance

    mean, observed, distance = draw(400)
    intervals = fit_intervals(mean, observed, np.abs(mean), distance, np.arange(400))
    mean, truth, distance = draw(400)
    prediction = intervals(mean, np.abs(mean), distance)
    assert inside_interval(mean, prediction.stated_std, truth) == pytest.approx(0.9, abs=COVERED)
    for part in (distance < 0.3, distance > 0.7):
        assert inside_interval(mean[part], prediction.stated_std[part], truth[part]) == pytest.approx(0.9, abs=0.06)
    assert prediction.stated_std[distance > 0.7].mean() > 2 * prediction.stated_std[distance < 0.3].mean()


def test_intervals_of_few_rows_are_not_too_narrow():
    """Channels of 15 rows, each held out twice, whose errors have the scale of their row: sizes say nothing of them."""
    rng, inside = np.random.default_rng(2), []

    def draw(rows: int) -> tuple[np.ndarray, np.ndarray]:
        scale, phase = np.exp(rng.normal(0, 1, (rows, 1))), np.exp(2j * np.pi * rng.uniform(size=(rows, 8)))
        mean = rng.uniform(1, 3, (rows, 1)) * phase
        return mean, mean + 0.1 * scale * (rng.normal(size=mean.shape) + 1j * rng.normal(size=mean.shape))

    for _ in range(100):
        mean, observed = (np.concatenate([half, half]) for half in draw(15))
        distance = rng.uniform(0, 1, 30)
        intervals = fit_intervals(mean, observed, np.abs(mean), distance, np.tile(np.arange(15), 2))
        mean, truth = draw(100)
        prediction = intervals(mean, np.abs(mean), rng.uniform(0, 1, 100))
        inside.append(inside_interval(mean, prediction.stated_std, truth))
    # Of one draw the share varies by 0.06, so that the mean of 100 is known to 0.01; groups of single rows have 0.82.
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03)


def test_intervals_hold_values_of_groups_that_they_do_not_know():
    """Images of 6 rows in 3 groups: errors of each group have a size of their own, which differs by a factor e."""
    rng = np.random.default_rng(3)
    inside: dict[bool, list[Any]] = {False: [], True: []}

    def draw(groups: int) -> tuple[np.ndarray, np.ndarray]:
        scale = np.repeat(np.exp(rng.normal(0, 1, groups)), 2)[:, None]
        mean = rng.uniform(1, 3, (2 * groups, 50))
        return mean, mean + scale * rng.normal(size=mean.shape)

    for _ in range(200):
        mean, observed = draw(3)
        group, ones, distances_m = np.repeat(np.arange(3), 2), np.ones(mean.shape), np.zeros(6)
        new_mean, truth = draw(50)
        for is_known in inside:
            intervals = fit_intervals(mean, observed, ones, distances_m, np.arange(6), group if is_known else None)
            prediction = intervals(new_mean, np.ones(new_mean.shape), np.zeros(100))
            inside[is_known].append(inside_interval(new_mean, prediction.stated_std, truth))
    assert np.mean(inside[False]) < 0.86
    assert np.mean(inside[True]) == pytest.approx(0.9, abs=0.03)


def test_intervals_beyond_all_distances_are_as_wide_as_the_widest_and_those_of_exact_predictions_not_empty():
    rng = np.random.default_rng(1)
    distance, mean = np.linspace(0, 1, 100), np.zeros((100, 5))
    intervals = fit_intervals(mean, rng.normal(size=mean.shape), np.ones(mean.shape), distance, np.arange(100))
    far = intervals(np.zeros((1, 5)), np.ones((1, 5)), np.array([np.inf])).stated_std
    assert np.isfinite(far).all()
    assert far.max() >= intervals(mean, np.ones(mean.shape), distance).stated_std.max()
    distance = np.arange(20.0)
    for level in (-50.0, 0.0, 1e-6):
        exact = np.full((20, 3), level, np.float32)
        predicted = fit_intervals(exact, exact, np.abs(exact), distance, np.arange(20))(exact, np.abs(exact), distance)
        assert (predicted.stated_std.astype(np.float32) > 0).all(), level


def test_crps_equals_its_integral():
    mean, std, truth, x = 1.0, 2.0, 2.5, np.linspace(-30, 30, 600_001)
    integral = np.trapezoid((norm.cdf(x, mean, std) - (x >= truth)) ** 2, x)
    assert crps([mean], [std], [truth]) == pytest.approx(integral, abs=1e-4)
    assert crps([mean + 1j * mean], [std * 2**0.5], [truth + 1j * truth]) == pytest.approx(integral, abs=1e-4)
    assert crps([mean, 0], [std, 1], [truth, np.nan]) == crps([mean], [std], [truth])


def test_errors_of_rows_that_a_corrected_scene_knows_are_enlarged(flat_folder: Path, tmp_path: Path):
    record = load(flat_folder)
    _, fold = fold_of(record)
    held_out = HeldOut.of(record, fold, 0)
    entry, observed = MODELS["kriging"].serving("rssi", True), held_out.observed(record)

    def errors(scene: Path) -> np.ndarray:
        problem = Problem(record, default_settings(entry, (), {}), scene=str(scene))
        prediction = held_out_predictions(entry, problem, fold, held_out, Session(tmp_path, tmp_path), "kriging")
        return prediction.mean - observed

    plain = errors(tmp_path)
    corrected_rows = np.unique(held_out.row)[::2]
    data = CorrectionData(record.name, corrected_rows, 1.5)
    for name, factor in ((record.name, 1.5), ("another", 1)):
        (tmp_path / FILE).write_text(json.dumps({"data": {**data.facts(), "name": name}}))
        expected = plain * np.where(np.isin(held_out.row, corrected_rows), factor, 1)
        np.testing.assert_allclose(errors(tmp_path), expected, atol=ROUNDING_DB)
    (tmp_path / FILE).write_text('{"data": {"rows": 3}}')
    with pytest.raises(InputError, match="correct the scene again"):
        errors(tmp_path)


def test_training_with_intervals_predicts_as_without_and_is_restored(flat_folder: Path, tmp_path: Path):
    plain = wrf_mi.train(flat_folder, "kriging", out=tmp_path / "plain", settings=("generic=true",))
    run = wrf_mi.train(flat_folder, "kriging", out=tmp_path / "run", settings=("generic=true",), intervals=True)
    asked: dict[str, Any] = {"tx_pos_m": [[2.0, 1.0, 1.3]], "tx_heading_rad": [0.5]}
    prediction = wrf_mi.open_run(run.folder).predict(**asked)
    assert prediction.mean == pytest.approx(plain.predict(**asked).mean)
    assert plain.predict(**asked).std is None
    assert (prediction.stated_std > 0).all()
    assert "inside_90" not in plain.metrics
    assert 0.5 < run.metrics["inside_90"] <= 1
    assert run.metrics["crps"] > 0
    assert not (run.folder / "held_out").exists()


def test_intervals_without_rows_to_hold_out_are_refused(flat_folder: Path, tmp_path: Path, command):
    arguments = ["train", flat_folder, "--model", "kriging", "--n-train", "2", "--intervals", "--out", tmp_path / "run"]
    command.refused(arguments, "2 training rows; intervals need three at least")
    assert not (tmp_path / "run").exists()
    record = load(flat_folder)
    record.tx_pos_m[0] = np.nan
    with pytest.raises(wrf_mi.InputError, match="positions are not known"):
        wrf_mi.train(record, "kriging", out=tmp_path / "run", intervals=True)


ROWS = 360
SENSITIVITY_DBM, CEILING, WIDTH_DB = np.array([-85.0, -80.0, -77.0]), np.array([0.98, 0.9, 0.8]), 2.0
STD_DB = 4.0
FLOAT32 = 1e-6
DRAWS = 20_000
DB, SHARE = 0.5, 0.02
"""Of estimates from `DRAWS` draws: four standard errors of about 0.1 dB and 0.005."""


def test_sensitivities_ceilings_and_width_of_drawn_reception_are_recovered() -> None:
    rng = np.random.default_rng(0)
    mean, receiver = rng.uniform(-100, -60, DRAWS), rng.integers(0, 3, DRAWS)
    std = rng.uniform(0.5, 2, DRAWS) * STD_DB
    power = rng.normal(mean, std)
    received = power > rng.normal(SENSITIVITY_DBM[receiver], WIDTH_DB)
    received &= rng.uniform(size=DRAWS) < CEILING[receiver]
    rate = np.array([received[receiver == number].mean() for number in range(3)])
    fitted = Sensitivity.fit(mean, std, receiver, received, rate)
    np.testing.assert_allclose(fitted.sensitivity_dbm, SENSITIVITY_DBM, atol=DB)
    np.testing.assert_allclose(fitted.ceiling, CEILING, atol=SHARE)
    assert fitted.width_db == pytest.approx(WIDTH_DB, abs=2 * DB)
    assert probability_scores(fitted(mean, std, receiver), received)["calibration_error"] < SHARE


def field(seed: int = 0) -> Record:
    """A smooth field about a law of distance at two receivers, with noise of 2 dB."""
    rng = np.random.default_rng(seed)
    at_m = rng.uniform([0, 0, 1.5], [20, 20, 1.5], (ROWS, 3))
    places = np.array([[0.0, 0, 2], [20, 10, 2]])
    wave = rng.normal(0, 0.4, (2, 30, 2)), rng.uniform(0, 2 * np.pi, (2, 30, 1))
    smooth = np.cos(np.einsum("rfa,na->rfn", wave[0], at_m[:, :2]) + wave[1]).sum(axis=1)
    distance = np.linalg.norm(at_m - places[:, None], axis=2)
    observed = -40 - 25 * np.log10(distance) + smooth + rng.normal(0, 2, (2, ROWS))
    receivers = tuple(wrf_mi.Receiver(f"rx{k}", place, np.array([0.0, 0, 0, 1])) for k, place in enumerate(places))
    record_fields: dict[str, Any] = {
        "frequencies_hz": np.array([2.4e9]),
        "official": (np.arange(240), np.arange(240, ROWS)),
    }
    return Record("field", "rssi", at_m, receivers, observed.astype(np.float32), **record_fields)


def weak_missing(record: Record) -> Record:
    """The record without the weaker third of its values."""
    limit = np.quantile(record.observation, 1 / 3)
    return replace(record, observation=np.where(record.observation < limit, np.nan, record.observation))


def test_reception_is_calibrated_better_than_both_references_and_changes_no_strength(tmp_path, monkeypatch):
    record = weak_missing(field())
    options: dict[str, Any] = {"split": "blocked", "intervals": True}
    run = wrf_mi.train(record, "kriging", out=tmp_path / "run", **options)
    block = run.metrics["reception"]
    for reference in block["reference"].values():
        assert all(block[name] < value for name, value in reference.items())
    with np.load(run.folder / "predictions.npz") as arrays:
        assert block["received"] == pytest.approx(np.isfinite(arrays["truth"]).mean())
    sensitivity = wrf_mi.open_run(run.folder / "fold0", record).metrics["sensitivity"]["receivers"].values()
    np.testing.assert_allclose([of["dbm"] for of in sensitivity], np.nanmin(record.observation), atol=STD_DB)
    monkeypatch.setattr(HeldOut, "of", classmethod(without_pairs(HeldOut.of)))
    plain = wrf_mi.train(record, "kriging", out=tmp_path / "plain", **options)
    assert "reception" not in plain.metrics
    assert plain.metrics["abs_error_db"] == run.metrics["abs_error_db"]


def test_hybrid_states_the_reception_without_being_asked_for_intervals(tmp_path: Path) -> None:
    block = wrf_mi.train(weak_missing(field()), "hybrid", out=tmp_path / "run").metrics["reception"]
    assert block["log_loss"] < block["reference"]["reception_rate"]["log_loss"]


def without_pairs(of: Callable[..., HeldOut]) -> Callable[..., HeldOut]:
    """`HeldOut.of` that states no pairs for the reception."""
    return lambda kind, *arguments: replace(of(*arguments), every=np.zeros((0, 2), np.int64))


def test_reception_is_in_files_and_maps_and_coverage_is_received_and_strong(tmp_path: Path) -> None:
    run = wrf_mi.train(weak_missing(field()), "kriging", out=tmp_path / "run", intervals=True)
    at_m = np.array([[1.0, 1, 1.5], [19, 1, 1.5]])
    prediction = run.predict(at_m, 0)
    with np.load(run.folder / "predictions.npz") as arrays:
        again = run.predict(arrays["tx_pos"], 1)
        np.testing.assert_allclose(arrays["probability_of_reception"][1], again.reception, rtol=FLOAT32)
    write_run_predictions(run, wrf_mi.models.Inputs(at_m), tmp_path / "new.npz")
    write_run_predictions(run, wrf_mi.models.Inputs(at_m), tmp_path / "new.csv")
    with np.load(tmp_path / "new.npz") as arrays:
        np.testing.assert_allclose(arrays["probability_of_reception"][0], prediction.reception, rtol=FLOAT32)
    assert "rx0_received" in (tmp_path / "new.csv").read_text().splitlines()[0].split(",")
    always = radio_map(run, step_m=2.0, threshold_dbm=-300)
    np.testing.assert_allclose(always["coverage_probability"], always["probability_of_reception"], rtol=FLOAT32)
    strong = radio_map(run, step_m=2.0, threshold_dbm=-60)
    fewer = always["coverage_probability"] - strong["coverage_probability"]
    assert bool((fewer >= 0).all())
    assert float(fewer.max()) > 0.3
    # Values that were not received are not covered at any threshold.
    everything = run_reliability(run.folder, np.array([-300.0]))
    assert everything.count.sum() == 2 * run.metrics["n_test"]
    assert everything.brier == pytest.approx(run.metrics["reception"]["brier"], rel=1e-5)


def test_losses_by_chance_have_the_rate_of_each_receiver(tmp_path: Path) -> None:
    record, rng = field(), np.random.default_rng(3)
    assert record.official is not None
    lost = rng.uniform(size=(2, ROWS)) < [[0.1], [0.3]]
    record = replace(record, observation=np.where(lost, np.nan, record.observation))
    run = wrf_mi.train(record, "idw", out=tmp_path / "run", intervals=True)
    rows = record.official[0][~lost[:, record.official[0]].all(axis=0)]  # others are in no split
    rate = 1 - lost[:, rows].mean(axis=1)
    for receiver in range(2):
        reception = run.predict(record.tx_pos_m, receiver).reception
        assert np.mean(reception) == pytest.approx(rate[receiver], abs=2 * SHARE)
    gained = run.metrics["reception"]["reference"]["reception_rate"]["log_loss"] - run.metrics["reception"]["log_loss"]
    assert gained > -SHARE  # of 60 held-out rows
    # Neither strength nor neighbours tell of losses by chance.
    sensitivity = run.metrics["sensitivity"]
    assert sensitivity["weights"]["rate"] == pytest.approx(1)
    assert set(sensitivity["held_out"]) == {"mixture", "rate", "neighbours"}


def test_nothing_is_stated_where_everything_was_received(tmp_path: Path) -> None:
    record = field()
    split = wrf_mi.make_splits(record, "official")[0]
    fold = hold_out(record, split)
    assert fold is not None
    assert not len(HeldOut.of(record, fold, 0).every)
    run = wrf_mi.train(record, "kriging", out=tmp_path / "run", intervals=True)
    assert "reception" not in run.metrics
    assert run.predict(record.tx_pos_m[:2], 0).reception is None
    assert Prediction(np.zeros(1)).reception is None
