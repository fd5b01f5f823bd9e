"""What is added to the mean of signal strengths: kriging, trees or nothing, chosen by held-out rows."""

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.estimators.interpolation.strength_settings import BY_SEARCH, DEFAULT, LIKELIHOOD, NONE, TREES
from wrf_mi.estimators.interpolation.strength_trees import LEAST_STOPS
from wrf_mi.estimators.interpolation.strengths import Strengths, fit_strengths
from wrf_mi.estimators.model import Inputs, default_settings, inputs_of
from wrf_mi.models import MODELS, Problem, Session
from wrf_mi.runs.api import plan_run
from wrf_mi.runs.folder import RunRequest
from wrf_mi.tasks.scores import REAL_90
from wrf_mi.tracing.power_map import PowerMap

ROWS, TESTS, NOISE_DB, EXTENT_M = 300, 100, 2.0, 16.0
KRIGING = DEFAULT, BY_SEARCH, LIKELIHOOD
COVERED = (0.84, 0.96)
"""Share inside 90 % of 300 errors in a dozen cells of shadowing: 0.9 within three standard errors of 2 %."""


def shadows(kind: str, tx_pos_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shadowing in dB [n]: steps at walls across the area every 4 m, smooth over 8 m, or none."""
    if kind == "walls":
        return rng.permutation([0.0, -8.0, -16.0, -24.0])[(tx_pos_m[:, 0] // 4).astype(int)]
    if kind == "smooth":
        covariance = np.exp(-np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2) / 8)
        return 8 * np.linalg.cholesky(covariance + 1e-9 * np.eye(len(covariance))) @ rng.normal(size=len(covariance))
    return np.zeros(len(tx_pos_m))


def made(kind: str, seed: int = 0, headings: bool = False, noise_db: float = NOISE_DB) -> Record:
    """Strengths by a law of exponent 2.5, shadowing and noise at three receivers; the last rows are tests."""
    rng = np.random.default_rng(seed)
    rows = ROWS + TESTS
    tx_pos_m = np.column_stack([rng.uniform(0, EXTENT_M, (rows, 2)), np.full(rows, 1.3)])
    places_m = np.array([[0, 0, 2.5], [15, 2, 2.5], [4, 14, 2.5]])
    law = -45 - 25 * np.log10(np.linalg.norm(places_m[:, None] - tx_pos_m, axis=2))
    observed = law + np.stack([shadows(kind, tx_pos_m, rng) for _ in law]) + rng.normal(0, noise_db, law.shape)
    heading = rng.uniform(-3, 3, rows) if headings else None
    receivers = tuple(Receiver(f"r{k}", place_m, np.array(UPRIGHT)) for k, place_m in enumerate(places_m))
    record = Record("made", "rssi", tx_pos_m, receivers, observed.astype(np.float32), tx_heading_rad=heading)
    return replace(record, official=(np.arange(ROWS), np.arange(ROWS, rows)), frequencies_hz=np.array([2.4e9]))


def fit(record: Record, folder: Path, *settings: str) -> Strengths:
    entry = MODELS["kriging"].serving("rssi", False)
    stated_names = frozenset(text.partition("=")[0] for text in settings)
    problem = Problem(record, default_settings(entry, settings, {}), stated=stated_names)
    split = Split("official", 0, record.official[0], np.zeros(0, np.int64), record.official[1])
    with threadpool_limits(1, "blas"):  # as in runs
        fitted = entry.fit(problem, split, Session(folder, folder))
    assert isinstance(fitted, Strengths)
    return fitted


def relative_errors(fitted: Strengths, record: Record) -> np.ndarray:
    """Errors of the test rows in standard deviations of a reading."""
    test = record.official[1]
    predictions = [fitted.predict(inputs_of(record, test), k) for k in range(len(record.receivers))]
    return np.stack([(p.mean - record.observation[k, test]) / p.stated_std for k, p in enumerate(predictions)])


@pytest.mark.parametrize(
    ("kind", "expected"), [("walls", (TREES,)), ("smooth", KRIGING), ("none", (NONE, LIKELIHOOD, BY_SEARCH))]
)
def test_held_out_rows_choose_the_shadowing(kind: str, expected: tuple[str, ...], tmp_path: Path) -> None:
    record = made(kind)
    fitted = fit(record, tmp_path)
    assert fitted.shadowing in expected
    assert {report["option"] for report in fitted.options} == {*KRIGING, TREES, NONE}
    assert COVERED[0] < np.mean(np.abs(relative_errors(fitted, record)) < REAL_90) < COVERED[1]


def test_deviations_of_the_mean_by_trees_are_as_large_as_its_errors(tmp_path: Path) -> None:
    record, truth = made("walls"), made("walls", noise_db=0.0)
    fitted, test = fit(record, tmp_path, "shadowing=trees"), record.official[1]
    predictions = [fitted.predict(inputs_of(record, test), receiver) for receiver in range(3)]
    errors = np.stack([each.mean for each in predictions]) - truth.observation[:, test]
    deviations = np.stack([each.std_mean for each in predictions if each.std_mean is not None])
    # Both deviations are scaled by errors of readings, so that neither is exact.
    assert 0.5 < np.sqrt(np.mean(deviations**2) / np.mean(errors**2)) < 2


@pytest.mark.parametrize("shadowing", [TREES, NONE])
def test_model_is_stored_bit_for_bit(shadowing: str, tmp_path: Path) -> None:
    record = made("walls", headings=True)
    fitted = fit(record, tmp_path, f"shadowing={shadowing}")
    again = Strengths.from_arrays(fitted.arrays())
    for at in (inputs_of(record, record.official[1]), Inputs(record.tx_pos_m[ROWS:])):  # headings known and unknown
        before, after = (each.predict(at, 1) for each in (fitted, again))
        for name in ("mean", "std", "std_mean"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        np.testing.assert_allclose(fitted.predict_mean(at, 1), before.mean, rtol=1e-12)
    assert again.facts() == fitted.facts()


def test_a_refit_grows_trees_of_its_rows(tmp_path: Path) -> None:
    record = made("walls")
    fitted = fit(record, tmp_path, "shadowing=trees")
    full_refit, part = (fitted.refit(record, rows) for rows in (record.official[0], np.arange(100)))
    at = inputs_of(record, record.official[1])
    np.testing.assert_array_equal(full_refit.predict(at, 0).mean, fitted.predict(at, 0).mean)
    assert np.abs(part.predict(at, 0).mean - fitted.predict(at, 0).mean).mean() > 0.5


def test_receivers_without_rows_have_the_mean_terms_alone(tmp_path: Path) -> None:
    record = made("walls")
    observed = record.observation.copy()
    observed[2, :ROWS] = np.nan
    silent = replace(record, observation=observed)
    fitted = fit(silent, tmp_path, "shadowing=trees")
    field, at = copy(fitted.field), inputs_of(record, record.official[1])
    field.forest = None
    of_terms = replace(fitted, field=field)
    apart_db = [np.abs(fitted.predict(at, k).mean - of_terms.predict(at, k).mean).mean() for k in range(3)]
    assert min(apart_db[:2]) > 3
    assert apart_db[2] == 0


def test_trees_stand_about_the_power_of_an_edited_scene(tmp_path: Path) -> None:
    record = made("walls")
    x, z = np.array([-1.0, 17.0]), np.array([0.0, 3.0])
    settings = default_settings(MODELS["kriging"].serving("rssi", False), ("shadowing=trees",), {})
    power = PowerMap(x, x, z, np.full((3, 2, 2, 2), -60.0), 0)
    fitted = fit_strengths(record, record.official[0], power, settings)
    field = copy(fitted.field)
    # A screen at the first receiver: its power is 7 dB lower, by the fitted factor of traced decibels.
    field.prior = replace(field.prior, traced=replace(power, power_dbm=power.power_dbm - [[[[7]]], [[[0]]], [[[0]]]]))
    at = inputs_of(record, record.official[1])
    for receiver, lower_db in enumerate((7, 0, 0)):
        before, after = (each.predict(at, receiver).mean for each in (fitted, replace(fitted, field=field)))
        np.testing.assert_allclose(before - after, lower_db, atol=0.5 * bool(lower_db))


@pytest.mark.parametrize(
    ("setting", "options"),
    [("shadowing=none", {NONE}), ("shadowing=trees", {TREES}), ("shadow_m=10", {*KRIGING}), ("noise_db=1", {*KRIGING})],
)
def test_a_stated_setting_holds(setting: str, options: set[str], tmp_path: Path) -> None:
    fitted = fit(made("walls"), tmp_path, setting)
    assert {report["option"] for report in fitted.options} == options
    name, _, value = setting.partition("=")
    assert str(fitted.facts()["fitted"][name]) in (value, f"{value}.0")


def test_hyperparameters_of_kriging_are_refused_beside_trees() -> None:
    with pytest.raises(InputError, match=r"shadow_m=3\.0: no effect .*: shadowing=trees"):
        plan_run(made("none"), RunRequest("kriging", settings=["shadowing=trees", "shadow_m=3"]))


def test_trees_need_rows(tmp_path: Path) -> None:
    record = made("walls")
    fitted = fit(replace(record, official=(np.arange(LEAST_STOPS - 1), record.official[1])), tmp_path)
    assert {report["option"] for report in fitted.options} == {*KRIGING, NONE}
