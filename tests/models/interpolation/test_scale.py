"""Lengths of strengths over areas larger than a floor are told by the rows, and intervals cover there."""

from pathlib import Path

import numpy as np
import pytest
from changed_folders import DATA, needs
from threadpoolctl import threadpool_limits

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.datasets import load
from wrf_mi.estimators.interpolation.strength_settings import SHADOWINGS, StrengthSettings
from wrf_mi.estimators.interpolation.strengths import Strengths, fit_strengths
from wrf_mi.estimators.model import default_settings, inputs_of
from wrf_mi.models import MODELS, Problem, Session
from wrf_mi.runs.api import train
from wrf_mi.tasks.scores import REAL_90

LIKELY = StrengthSettings(shadowing="likelihood")
FACTOR = 2.5  # of a length by the likelihood of some hundred rows about the true one, either way
COVERED = (0.84, 0.96)
"""Share inside 90 % of some hundred errors, which shadowing correlates: 0.9 within three standard errors of 2 %."""


def area(seed: int, shadow_m: float, extent_m: float = 400.0, receivers: int = 18, rows: int = 300) -> Record:
    """Strengths by the law of exponent 3.2, shadowing of 7 dB, noise of 2 dB, over a square; the last fifth tests."""
    rng = np.random.default_rng(seed)
    tx_pos_m = np.column_stack([rng.uniform(0, extent_m, (rows, 2)), np.full(rows, 1.5)])
    places_m = np.column_stack([rng.uniform(0, extent_m, (receivers, 2)), np.full(receivers, 6.0)])
    apart_m = np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2)
    lower = np.linalg.cholesky(np.exp(-apart_m / shadow_m) + 1e-9 * np.eye(rows))
    observed = np.empty((receivers, rows), np.float32)
    for values, place_m in zip(observed, places_m, strict=True):
        law_dbm = -35 + rng.normal(0, 3) - 32 * np.log10(np.linalg.norm(tx_pos_m - place_m, axis=1))
        values[:] = law_dbm + 7 * lower @ rng.normal(size=rows) + rng.normal(0, 2, rows)
    observed[observed < -110] = np.nan
    named = tuple(Receiver(f"r{k}", place_m, np.array(UPRIGHT)) for k, place_m in enumerate(places_m))
    official = np.arange(rows * 4 // 5), np.arange(rows * 4 // 5, rows)
    return Record("area", "rssi", tx_pos_m, named, observed, official=official, frequencies_hz=np.array([868e6]))


def errors_db(record: Record, model: str, folder: Path, *settings: str) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors of the test rows, and the same in standard deviations."""
    known, test = record.official
    split = Split("official", 0, known[len(known) // 10 :], known[: len(known) // 10], test)
    entry = MODELS[model].serving("rssi", False)
    with threadpool_limits(1, "blas"):  # as in runs
        fitted = entry.fit(Problem(record, default_settings(entry, settings, {})), split, Session(folder, folder))
    predictions = [fitted.predict(inputs_of(record, test), k) for k in range(len(record.receivers))]
    errors = np.abs(np.stack([each.mean for each in predictions]) - record.observation[:, test])
    received = np.isfinite(errors)
    return errors[received], (errors / np.stack([each.stated_std for each in predictions]))[received]


@pytest.mark.parametrize("shadow_m", [15.0, 60.0])
def test_length_is_that_of_the_data(shadow_m: float) -> None:
    record = area(0, shadow_m, receivers=6)
    fitted = fit_strengths(record, np.arange(240), settings=LIKELY).field.hyperparameters
    assert shadow_m / FACTOR < fitted.shadow_m < FACTOR * shadow_m


def test_sectors_of_antennas_are_learned_where_there_are_any() -> None:
    record = area(2, 30.0, receivers=4)
    plain = fit_strengths(record, np.arange(240), settings=LIKELY).field.prior.rx_sd_db
    for values, receiver in zip(record.observation, record.receivers, strict=True):
        away = record.tx_pos_m - receiver.position_m
        values += (8 * np.cos(np.arctan2(away[:, 1], away[:, 0]))).astype(np.float32)
    assert fit_strengths(record, np.arange(240), settings=LIKELY).field.prior.rx_sd_db > 1.5 * plain


@pytest.mark.parametrize("model", ["kriging", "hybrid"])
def test_intervals_cover(model: str, tmp_path: Path) -> None:
    _, relative = errors_db(area(0, 30.0), model, tmp_path)
    assert COVERED[0] < np.mean(relative < REAL_90) < COVERED[1]


@pytest.mark.slow
@needs("duke-cbrs")
def test_hybrid_over_a_real_campus(tmp_path: Path) -> None:
    """Within the error of generic kriging, whose lengths are by likelihood, and intervals that cover."""
    metrics = train(load(DATA / "duke-cbrs"), "hybrid", out=tmp_path / "run").metrics
    assert metrics["abs_error_db"]["median"] <= 6.1
    assert 0.85 < metrics["inside_90"] < 0.95


def test_the_mean_of_a_receiver_has_its_carrier_and_is_stored() -> None:
    """At one place free space differs by 20 log10 of the carriers' ratio, as of Friis' law."""
    place, carriers_hz = np.array([0.0, 0, 2]), np.array([0.9e9, 3.6e9])
    receivers = tuple(Receiver(f"cell:{hz:g}", place, np.array(UPRIGHT)) for hz in carriers_hz)
    positions_m = np.random.default_rng(0).uniform(1, 9, (12, 3))
    level = -20 * np.log10(np.linalg.norm(positions_m - place, axis=1))
    observed = np.stack([level - 40, level - 52]).astype(np.float32)
    plain = Record("cells", "rssi", positions_m, receivers, observed, frequencies_hz=np.array([0.9e9]))
    for record, ratio in ((plain.at_receiver_carriers(carriers_hz), 4), (plain, 1)):
        fitted = fit_strengths(record, np.arange(12))
        again = Strengths.from_arrays(fitted.arrays())
        np.testing.assert_array_equal(again.field.prior.frequency_hz, fitted.field.prior.frequency_hz)
        poses = again.field.stops.poses
        difference_db = np.subtract(*(again.field.prior.columns(poses, receiver)[0] for receiver in (0, 1)))
        np.testing.assert_allclose(difference_db, 20 * np.log10(ratio), rtol=1e-12)


UNCLEAR = 1.05
"""Largest ratio of the mean error to that of the best origin of lengths, chosen by a fifth of some hundred rows."""


@pytest.mark.parametrize(
    ("shadow_m", "extent_m", "receivers"),
    [(2.5, 90.0, 3), (200.0, 1500.0, 6)],
    ids=["large building of short lengths", "outdoors"],
)
def test_held_out_rows_choose_the_lengths(shadow_m: float, extent_m: float, receivers: int, tmp_path: Path) -> None:
    record = area(1, shadow_m, extent_m, receivers)
    chosen = errors_db(record, "kriging", tmp_path / "chosen")[0].mean()
    of_each = [errors_db(record, "kriging", tmp_path / name, f"shadowing={name}")[0].mean() for name in SHADOWINGS]
    assert chosen < UNCLEAR * min(of_each)
    assert max(of_each) > 1.02 * min(of_each)  # else nothing could be chosen wrongly
