"""Kriging of spectra, and the physics model for spectra without a mesh that joins it with element signals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_waves import FREQUENCY_HZ, SIZE, WAVELENGTH_M, positions, wave_record, without_array
from scipy.spatial.distance import cdist

from wrf_mi.core import InputError, Record
from wrf_mi.models.interpolation import kriging_equations as nearby
from wrf_mi.models.interpolation.kriging_equations import AnisotropicKriging, fit_anisotropic, line_of_sight, sight_axes
from wrf_mi.models.model import field_arrays, from_field_arrays
from wrf_mi.models.physics import measured_spectrum
from wrf_mi.models.physics.measured_spectrum import (
    GAPS,
    LEAST_ROWS,
    MeasuredSpectrumPhysics,
    MeasuredSpectrumSettings,
    fit_measured_spectrum,
    signal_weight,
)
from wrf_mi.receivers.lags import Lags
from wrf_mi.tasks.scores import inside_interval, ssim

RECEIVER_M = np.array([3.0, 1.0, -0.5])
UP_M = np.array([0.0, 0.0, 4.0])
LENGTH_M = np.array([0.4, 0.15, 0.25])
NOISE = 0.02
SINGLE = 2e-5
"""Observations are float32 and of size one; weights of some tens of rows go with them."""


def some(count: int = 25, seed: int = 0, shape: tuple[int, ...] = (4, 5)) -> AnisotropicKriging:
    """Rows of random observations; two of them at one place."""
    where = positions(count, seed)
    where[1] = where[0]
    observed = np.random.default_rng(seed).uniform(size=(count, *shape)).astype(np.float32)
    return AnisotropicKriging(where, observed, sight_axes(where, RECEIVER_M), LENGTH_M, NOISE)


def kriged(process: AnisotropicKriging, kept: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights [q, kept] and variances [q] of ordinary kriging, as textbooks have it: one bordered system."""
    local = (process.tx_pos_m[kept] @ process.axes.T) / process.length_m
    asked = (where @ process.axes.T) / process.length_m
    n = len(kept)
    system = np.ones((n + 1, n + 1))
    system[:n, :n] = np.exp(-cdist(local, local)) + process.noise * np.eye(n)
    system[n, n] = 0
    right = np.ones((n + 1, len(where)))
    right[:n] = np.exp(-cdist(local, asked))
    solved = np.linalg.solve(system, right)
    return solved[:n].T, 1 + process.noise - (solved * right).sum(axis=0)


def test_prediction_is_ordinary_kriging() -> None:
    process, where = some(), positions(6, seed=3)
    weights, variance = kriged(process, np.arange(25), where)
    assert weights.sum(axis=1) == pytest.approx(np.ones(6))
    np.testing.assert_allclose(process.predict(where), np.tensordot(weights, process.observed, 1), atol=SINGLE)
    np.testing.assert_allclose(process.std(where), np.sqrt(variance)[:, None, None] * process.scale, atol=SINGLE)


def test_constant_field_is_reproduced() -> None:
    """Weights sum to one, near and far, for any row left out."""
    process = some()
    process.observed[:] = 0.25
    np.testing.assert_allclose(process.predict(positions(6, seed=3) * 5), 0.25, atol=SINGLE)
    held_out, deviation = process.held_out(0.2, np.arange(25))
    np.testing.assert_allclose(held_out, 0.25, atol=SINGLE)
    assert deviation.max() < 1e-3


@pytest.mark.parametrize("radius_m", [0.0, 0.1, 0.3])
def test_held_out_is_kriging_without_those_rows(radius_m: float) -> None:
    process, rows = some(), np.array([0, 7, 24])
    mean, deviation = process.held_out(radius_m, rows)
    for number, row in enumerate(rows):
        here = process.tx_pos_m[[row]]
        kept = np.flatnonzero(cdist(here, process.tx_pos_m)[0] > radius_m)
        assert 0 < len(kept) < 25
        weights, variance = kriged(process, kept, here)
        np.testing.assert_allclose(mean[number], np.tensordot(weights[0], process.observed[kept], 1), atol=SINGLE)
        np.testing.assert_allclose(deviation[number], np.sqrt(variance[0]) * process.scale, atol=SINGLE)


def test_held_out_without_any_other_row_is_the_mean() -> None:
    process = some()
    mean, deviation = process.held_out(100.0, np.array([3]))
    np.testing.assert_allclose(mean[0], process.observed.mean(axis=0), atol=SINGLE)
    np.testing.assert_allclose(deviation[0], np.sqrt(1 + NOISE) * process.scale, atol=SINGLE)


def test_far_away_is_the_mean_by_generalised_least_squares() -> None:
    process = some()
    away = process.tx_pos_m[:1] + 1000.0
    local = (process.tx_pos_m @ process.axes.T) / LENGTH_M
    inverse = np.linalg.inv(np.exp(-cdist(local, local)) + NOISE * np.eye(25))
    mean = np.tensordot(inverse.sum(axis=0) / inverse.sum(), process.observed, 1)
    np.testing.assert_allclose(process.predict(away)[0], mean, atol=SINGLE)
    expected = np.sqrt(1 + NOISE + 1 / inverse.sum()) * process.scale
    np.testing.assert_allclose(process.std(away)[0], expected, atol=SINGLE)


def test_axes_lie_along_and_across_the_line_of_sight() -> None:
    where = positions(9)
    for receiver_m in (RECEIVER_M, where.mean(axis=0) + UP_M, where.mean(axis=0) - UP_M):
        axes = sight_axes(where, receiver_m)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        way = receiver_m - where.mean(axis=0)
        np.testing.assert_allclose(axes[0], way / np.linalg.norm(way), atol=1e-12)
        assert axes[1, 2] == 0  # level
    np.testing.assert_array_equal(line_of_sight(where, where.mean(axis=0)), [0, 0, 1])


def drawn(length_m: np.ndarray, noise: float, count: int, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    where = positions(count, seed=6)
    local = (where @ sight_axes(where, RECEIVER_M).T) / length_m
    root = np.linalg.cholesky(np.exp(-cdist(local, local)) + noise * np.eye(count))
    field = root @ np.random.default_rng(1).normal(size=(count, pixels))
    return where, (0.5 + 0.1 * field).astype(np.float32)


@pytest.mark.parametrize("most", [400, 90])
def test_fit_recovers_lengths_and_noise(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """300 draws at 120 places tell a length to some per cent; all rows predict, even if fewer are fitted to."""
    monkeypatch.setattr(nearby, "MOST_ROWS", most)
    where, observed = drawn(LENGTH_M, NOISE, 120, 300)
    fitted = fit_anisotropic(where, observed, RECEIVER_M, WAVELENGTH_M)
    assert fitted.length_m == pytest.approx(LENGTH_M, rel=0.15)
    assert fitted.noise == pytest.approx(NOISE, rel=0.3)
    assert np.mean(fitted.scale) == pytest.approx(0.1, rel=0.05)
    assert fitted.observed.shape == observed.shape


def test_equal_spectra_and_coincident_rows_can_be_fitted() -> None:
    """All spectra the same, and all at one place."""
    where = positions(10)
    same = fit_anisotropic(where, np.full((10, 30), 0.5, np.float32), RECEIVER_M, WAVELENGTH_M)
    np.testing.assert_allclose(same.predict(positions(2, seed=1)), 0.5, atol=SINGLE)
    one_place = np.repeat(where[:1], 10, axis=0)
    observed = np.random.default_rng(0).uniform(size=(10, 30)).astype(np.float32)
    found = fit_anisotropic(one_place, observed, RECEIVER_M, WAVELENGTH_M)
    np.testing.assert_allclose(found.predict(where[:1])[0], observed.mean(axis=0), atol=SINGLE)


def test_kriging_is_restored_from_arrays(tmp_path: Path) -> None:
    process, where = some(), positions(3, seed=5)
    np.savez(tmp_path / "nearby.npz", **field_arrays(process, ""))
    with np.load(tmp_path / "nearby.npz") as stored:
        again = from_field_arrays(AnisotropicKriging, stored, "")
    np.testing.assert_array_equal(again.predict(where), process.predict(where))
    np.testing.assert_array_equal(again.std(where), process.std(where))


# Both estimates together


@pytest.fixture(scope="module")
def record() -> Record:
    return wave_record(rows=80, held_out=20)


@pytest.fixture(scope="module")
def progress() -> list[tuple[str, float]]:
    return []


@pytest.fixture(scope="module")
def physics(record: Record, progress: list[tuple[str, float]]) -> MeasuredSpectrumPhysics:
    assert record.official is not None
    settings = MeasuredSpectrumSettings(directions=60)
    return fit_measured_spectrum(record, record.official[0], settings, 0, lambda *stage: progress.append(stage))


@pytest.mark.parametrize("receiver", [0, 1])
def test_mixture_beats_kriging_and_states_its_error(
    record: Record, physics: MeasuredSpectrumPhysics, receiver: int
) -> None:
    assert record.official is not None
    rows, truth = record.official[1], record.observation[receiver, record.official[1]]
    where = record.tx_pos_m[rows]
    estimate = physics.predict(where, receiver, np.zeros(len(rows)))
    assert estimate.mean.shape == estimate.std.shape == (len(rows), *SIZE)
    assert estimate.mean.min() >= 0
    assert estimate.mean.max() <= 1
    error = np.square(estimate.mean - truth).mean()
    # These waves obey the model, so that signals tell most of what there is to know.
    assert error < 0.5 * np.square(physics.sides[receiver].nearby.predict(where) - truth).mean()
    assert np.median(ssim(estimate.mean, truth)) > 0.9
    other = physics.predict(where, 1 - receiver).mean
    assert error < 0.1 * np.square(other - truth).mean()
    # 20 rows of correlated pixels.
    assert inside_interval(estimate.mean, estimate.std, truth) == pytest.approx(0.9, abs=0.08)


def test_deviation_is_that_of_the_grey_values_far_away(record: Record, physics: MeasuredSpectrumPhysics) -> None:
    assert record.official is not None
    known = record.observation[0, record.official[0]]
    away = physics.predict([[100.0, 100.0, 0.0]])
    near = physics.predict(record.tx_pos_m[record.official[0]])
    side = physics.sides[0]
    np.testing.assert_allclose(away.mean[0], side.nearby.predict([[100.0, 100.0, 0.0]])[0], atol=1e-3)
    assert np.sqrt(np.square(away.std).mean()) > 0.7 * known.std(axis=0).mean()
    assert near.std.mean() < 0.2 * away.std.mean()
    assert np.abs(near.mean - known).mean() < 0.02


def test_fit_reports_progress_and_summary(physics: MeasuredSpectrumPhysics, progress: list[tuple[str, float]]) -> None:
    assert progress[0][0] == "one: element signals of spectra"
    assert {stage for stage, _ in progress} >= {"one: signals", "one: weights", "two: weights"}
    assert all(0 <= share <= 1 for _, share in progress)
    assert progress[-1] == ("two: weights", 1.0)
    found = physics.summary()
    assert sum(found["coherent_share"]) == pytest.approx(1, abs=1e-3)
    assert 0 < found["turned_share"] <= 1


def test_model_is_restored_from_arrays(record: Record, physics: MeasuredSpectrumPhysics, tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", **physics.arrays())
    with np.load(tmp_path / "model.npz", allow_pickle=False) as stored:
        again = MeasuredSpectrumPhysics.from_arrays(dict(stored))
    assert [r.name for r in again.receivers] == ["one", "two"]
    for receiver in (0, 1):
        before, after = (model.predict(record.tx_pos_m[:5], receiver) for model in (physics, again))
        np.testing.assert_array_equal(after.mean, before.mean)
        np.testing.assert_array_equal(after.std, before.std)
    assert again.summary() == physics.summary()


def test_weight_of_signals_falls_with_their_ignorance() -> None:
    weight = signal_weight(np.array([0.0, 0.1, 0.5, 1.0]), 0.1)
    assert weight[0] == 0  # then neighbours know as much
    assert weight[1] == pytest.approx(0.5 * 0.9)
    assert weight[3] == 0


def test_weight_and_spread_are_those_that_fit_rows_held_out(record: Record, physics: MeasuredSpectrumPhysics) -> None:
    assert record.official is not None
    observed = record.observation[0, record.official[0]]
    fitted = physics.sides[0]
    rows = np.arange(len(observed))  # fewer than would be drawn from

    by_gap = []
    for gap in GAPS:
        posterior = fitted.signals.held_out(gap * WAVELENGTH_M, rows)
        kriged, deviation = fitted.nearby.held_out(gap * WAVELENGTH_M, rows)
        by_gap.append((posterior, kriged, deviation))

    def left(half: float) -> float:
        errors = []
        for posterior, kriged, _ in by_gap:
            weight = posterior.ignorance**2 / (posterior.ignorance**2 + half**2)
            mixed = kriged + weight[:, None, None] * (fitted.report(posterior)[0] - kriged)
            errors.append(np.square(mixed - observed).mean())
        return float(np.mean(errors))

    # Chosen between 0.01 and 3 in steps of a tenth.
    others = [half for half in fitted.half * np.array([0.1, 0.8, 1.25, 10.0]) if 0.01 < half < 3]
    assert left(fitted.half) <= min(left(half) for half in others)
    inside = []
    for posterior, kriged, deviation in by_gap:
        mean, std = fitted.mixed(posterior, kriged, deviation)
        inside.append((np.abs(mean - observed) <= 1.6449 * fitted.spread * std).mean())
    assert np.mean(inside) == pytest.approx(0.9, abs=0.01)


def test_rows_that_one_receiver_missed_are_left_out_there(record: Record) -> None:
    assert record.official is not None
    rows = record.official[0][:24]
    observed = record.observation.copy()
    observed[1, rows[:4]] = np.nan
    quick = MeasuredSpectrumSettings(directions=20, lengths=2)
    model = fit_measured_spectrum(replace(record, observation=observed), rows, quick)
    assert [len(side.nearby.tx_pos_m) for side in model.sides] == [24, 20]
    missed = model.predict(record.tx_pos_m[rows[:4]], 1).mean
    assert np.isfinite(missed).all()
    np.testing.assert_array_equal(model.predict(record.tx_pos_m[rows[:4]], record.receivers[1].name).mean, missed)
    observed[1, rows[: 25 - LEAST_ROWS]] = np.nan
    with pytest.raises(InputError, match=f"receiver two: {LEAST_ROWS - 1} training rows without a mesh; give"):
        fit_measured_spectrum(replace(record, observation=observed), rows, quick)


def test_weights_keep_their_defaults_without_gaps(record: Record) -> None:
    """Nothing is held out, so nothing is known of how far to trust either part; and no gap is wider than the rows."""
    quick = MeasuredSpectrumSettings(directions=20, lengths=2)
    one = replace(record, receivers=record.receivers[:1], observation=record.observation[:1])
    model = fit_measured_spectrum(replace(one, tx_pos_m=np.zeros_like(one.tx_pos_m)), np.arange(16), quick)
    assert (model.sides[0].half, model.sides[0].spread) == (1.0, 1.0)
    estimate = model.predict([[0.0, 0.0, 0.0]])
    known = one.observation[0, :16]
    np.testing.assert_allclose(estimate.mean[0], known.mean(axis=0), atol=0.3)
    assert estimate.std.mean() == pytest.approx(known.std(axis=0).mean(), rel=0.5)
    close = fit_measured_spectrum(replace(one, tx_pos_m=one.tx_pos_m / 10), np.arange(16), quick).sides[0]
    assert np.ptp(close.nearby.tx_pos_m, axis=0).max() < GAPS[-2] * WAVELENGTH_M
    assert 0.3 < close.spread < 1.5


def test_spectra_are_read_in_chunks(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many at once as memory bears: the parts are joined in order."""
    assert record.official is not None
    sizes = []
    unscale = measured_spectrum.unscale

    def counted(grey: np.ndarray, lags: Lags) -> Any:
        sizes.append(len(grey))
        return unscale(grey, lags)

    monkeypatch.setattr(measured_spectrum, "UNSCALED_PER_CHUNK", 9)
    monkeypatch.setattr(measured_spectrum, "unscale", counted)
    one = replace(record, receivers=record.receivers[:1], observation=record.observation[:1])
    model = fit_measured_spectrum(one, record.official[0][:20], MeasuredSpectrumSettings(directions=20, lengths=2))
    assert sizes == [9, 9, 2]
    near = model.sides[0].report(model.sides[0].signals.predict(record.tx_pos_m[record.official[0][:20]]))[0]
    assert np.median(ssim(near, record.observation[0, record.official[0][:20]])) > 0.9


@pytest.mark.parametrize(
    ("change", "count", "message"),
    [
        ({"task": "csi"}, 20, "holds csi; this physics model predicts spectra"),
        ({"array_m": None}, 20, "array or frequency is not known; state both in its gateway_info.yml"),
        ({"frequencies_hz": None}, 20, "array or frequency is not known"),
        ({}, LEAST_ROWS - 1, f"7 training rows without a mesh; give {LEAST_ROWS} or more, or a scene"),
        ({}, 0, "0 training rows without a mesh"),
        ({"array_m": np.outer(np.arange(9), [0.1, 0, 0])}, 20, "on a line"),
    ],
)
def test_insufficient_data_are_refused(change: dict[str, Any], count: int, message: str, record: Record) -> None:
    broken = record.with_array(change["array_m"]) if "array_m" in change else replace(record, **change)
    with pytest.raises(InputError, match=message):
        fit_measured_spectrum(broken, np.arange(count))


def test_spectra_of_an_unknown_instrument_are_refused(two_gateways: Record, record: Record) -> None:
    for unknown in (two_gateways, without_array(record)):
        with pytest.raises(InputError, match=f"{unknown.name}: its array or frequency is not known"):
            fit_measured_spectrum(unknown, np.arange(20))
    assert record.frequencies_hz is not None
    assert record.frequencies_hz[0] == FREQUENCY_HZ


@pytest.mark.parametrize(
    ("setting", "value"),
    [("cone_deg", 0.0), ("cone_deg", 181.0), ("directions", 0), ("lengths", 0), ("starts", 0), ("shortest", 5.0)],
)
def test_settings_that_cannot_be_fitted_are_refused(setting: str, value: float) -> None:
    with pytest.raises(InputError, match=f"setting {setting}: {value} is out of range, choose"):
        MeasuredSpectrumSettings(**{setting: value})


@pytest.mark.parametrize("where", [[[0.0, 0.0]], [[0.0, np.nan, 0.0]]])
def test_invalid_positions_are_refused(where: list[list[float]], physics: MeasuredSpectrumPhysics) -> None:
    with pytest.raises(InputError, match="give finite positions"):
        physics.predict(where)
