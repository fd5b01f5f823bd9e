"""Probability of reception: known sensitivities, calibration, weights, and its ways into runs, files and maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import wrf_mi
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.coverage import run_reliability
from wrf_mi.core import Prediction, Record
from wrf_mi.estimators.reception import Sensitivity
from wrf_mi.tasks.scores import probability_scores
from wrf_mi.training.selection import HeldOut, hold_out

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
    known = {"frequencies_hz": np.array([2.4e9]), "official": (np.arange(240), np.arange(240, ROWS))}
    return Record("field", "rssi", at_m, receivers, observed.astype(np.float32), **known)


def weak_missing(record: Record) -> Record:
    """The record without the weaker third of its values."""
    limit = np.quantile(record.observation, 1 / 3)
    return replace(record, observation=np.where(record.observation < limit, np.nan, record.observation))


@pytest.mark.parametrize(("model", "intervals"), [("kriging", True), ("hybrid", False)])
def test_reception_is_calibrated_better_than_both_references_and_changes_no_strength(
    model: str, intervals: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record, options = weak_missing(field()), {"split": "blocked", "intervals": intervals}
    run = wrf_mi.train(record, model, out=tmp_path / "run", **options)
    block = run.metrics["reception"]
    for reference in block["reference"].values():
        assert all(block[name] < value for name, value in reference.items())
    with np.load(run.folder / "predictions.npz") as arrays:
        assert block["received"] == pytest.approx(np.isfinite(arrays["truth"]).mean())
    sensitivity = wrf_mi.open_run(run.folder / "fold0", record).metrics["sensitivity"]["receivers"].values()
    np.testing.assert_allclose([of["dbm"] for of in sensitivity], np.nanmin(record.observation), atol=STD_DB)
    monkeypatch.setattr(HeldOut, "of", classmethod(without_pairs(HeldOut.of)))
    plain = wrf_mi.train(record, model, out=tmp_path / "plain", **options)
    assert "reception" not in plain.metrics
    assert plain.metrics["abs_error_db"] == run.metrics["abs_error_db"]


def without_pairs(of: object) -> object:
    """`HeldOut.of` that states no pairs for the reception."""
    return lambda kind, *arguments: replace(of(*arguments), every=np.zeros((0, 2), np.int64))  # type: ignore[operator]


def test_reception_is_in_files_and_maps_and_coverage_is_received_and_strong(tmp_path: Path) -> None:
    run = wrf_mi.train(weak_missing(field()), "kriging", out=tmp_path / "run", intervals=True)
    at_m = np.array([[1.0, 1, 1.5], [19, 1, 1.5]])
    stated = run.predict(at_m, 0)
    with np.load(run.folder / "predictions.npz") as arrays:
        again = run.predict(arrays["tx_pos"], 1)
        np.testing.assert_allclose(arrays["probability_of_reception"][1], again.reception, rtol=FLOAT32)
    run.predict_to_file(wrf_mi.models.Inputs(at_m), tmp_path / "new.npz")
    run.predict_to_file(wrf_mi.models.Inputs(at_m), tmp_path / "new.csv")
    with np.load(tmp_path / "new.npz") as arrays:
        np.testing.assert_allclose(arrays["probability_of_reception"][0], stated.reception, rtol=FLOAT32)
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
        stated = run.predict(record.tx_pos_m, receiver).reception
        assert np.mean(stated) == pytest.approx(rate[receiver], abs=2 * SHARE)
    gained = run.metrics["reception"]["reference"]["reception_rate"]["log_loss"] - run.metrics["reception"]["log_loss"]
    assert gained > -SHARE  # of 60 held-out rows


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
