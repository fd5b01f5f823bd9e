"""Kriging of spectra: of grey values along and across the line of sight, and joined with element signals."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_waves import SIZE, WAVELENGTH_M, positions, wave_record, without_array
from scipy.spatial.distance import cdist

from wrf_mi.core import InputError, Record, Split
from wrf_mi.estimators.interpolation import kriging_equations as nearby
from wrf_mi.estimators.interpolation import spectra
from wrf_mi.estimators.interpolation.by_receiver import ByReceiver
from wrf_mi.estimators.interpolation.kriging import Kriged, Kriging, UncertainKriged
from wrf_mi.estimators.interpolation.kriging_equations import (
    AnisotropicKriging,
    fit_anisotropic,
    line_of_sight,
    sight_axes,
)
from wrf_mi.estimators.interpolation.spectra import (
    GAPS,
    LEAST_ROWS,
    KrigedSpectra,
    SpectrumKrigingSettings,
    signal_weight,
)
from wrf_mi.estimators.model import Inputs, Session
from wrf_mi.models import MODELS, Problem
from wrf_mi.receivers import retrieve
from wrf_mi.tasks.scores import inside_interval, ssim
from wrf_mi.training.session import quiet

RECEIVER_M = np.array([3.0, 1.0, -0.5])
UP_M = np.array([0.0, 0.0, 4.0])
LENGTH_M = np.array([0.4, 0.15, 0.25])
NOISE = 0.02
QUICK = SpectrumKrigingSettings(directions=20, lengths=2)
KRIGING = MODELS["kriging"].serving("spectrum", False)
SINGLE = 2e-5  # observations are float32 and of size one; weights of some tens of rows go with them


def fit(record, rows, settings=QUICK, on_progress=quiet):
    """The model ``kriging`` of some rows."""
    split = Split("rows", 0, rows, rows[:0], rows)
    fitted: Any = KRIGING.fit(Problem(record, settings), split, Session(None, None, on_progress))
    return fitted


def coherent(model: ByReceiver, receiver: int = 0) -> KrigedSpectra:
    kriged = model.models[receiver]
    assert isinstance(kriged, KrigedSpectra)
    return kriged


def of_one_receiver(record: Record) -> Record:
    return replace(record, receivers=record.receivers[:1], observation=record.observation[:1])


def process_of(count: int = 25, seed: int = 0, shape: tuple[int, ...] = (4, 5)) -> AnisotropicKriging:
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
    system, right = np.ones((n + 1, n + 1)), np.ones((n + 1, len(where)))
    system[:n, :n] = np.exp(-cdist(local, local)) + process.noise * np.eye(n)
    system[n, n] = 0
    right[:n] = np.exp(-cdist(local, asked))
    solved = np.linalg.solve(system, right)
    return solved[:n].T, 1 + process.noise - (solved * right).sum(axis=0)


def test_prediction_is_ordinary_kriging() -> None:
    process, where = process_of(), positions(6, seed=3)
    weights, variance = kriged(process, np.arange(25), where)
    assert weights.sum(axis=1) == pytest.approx(np.ones(6))
    np.testing.assert_allclose(process.predict(where), np.tensordot(weights, process.observed, 1), atol=SINGLE)
    np.testing.assert_allclose(process.std(where), np.sqrt(variance)[:, None, None] * process.scale, atol=SINGLE)


def test_constant_fields_are_reproduced_and_coincident_rows_fitted() -> None:
    """Weights sum to one, near and far, for any row left out."""
    process = process_of()
    process.observed[:] = 0.25
    np.testing.assert_allclose(process.predict(positions(6, seed=3) * 5), 0.25, atol=SINGLE)
    held_out, deviation = process.held_out(0.2, np.arange(25))
    np.testing.assert_allclose(held_out, 0.25, atol=SINGLE)
    assert deviation.max() < 1e-3
    # All spectra the same, and all at one place.
    where = positions(10)
    same = fit_anisotropic(where, np.full((10, 30), 0.5, np.float32), RECEIVER_M, WAVELENGTH_M)
    np.testing.assert_allclose(same.predict(positions(2, seed=1)), 0.5, atol=SINGLE)
    one_place = np.repeat(where[:1], 10, axis=0)
    observed = np.random.default_rng(0).uniform(size=(10, 30)).astype(np.float32)
    fitted = fit_anisotropic(one_place, observed, RECEIVER_M, WAVELENGTH_M)
    np.testing.assert_allclose(fitted.predict(where[:1])[0], observed.mean(axis=0), atol=SINGLE)


@pytest.mark.parametrize("radius_m", [0.0, 0.1, 0.3, 100.0])
def test_held_out_is_kriging_without_those_rows_or_the_mean_without_any(radius_m: float) -> None:
    process, rows = process_of(), np.array([0, 7, 24])
    mean, deviation = process.held_out(radius_m, rows)
    for number, row in enumerate(rows):
        far_rows = np.flatnonzero(cdist(process.tx_pos_m[[row]], process.tx_pos_m)[0] > radius_m)
        assert len(far_rows) < 25
        assert (len(far_rows) == 0) == (radius_m == 100.0)
        weights, variance = np.full((1, 25), 1 / 25), np.array([1 + NOISE])
        if len(far_rows):
            weights, variance = kriged(process, far_rows, process.tx_pos_m[[row]])
        far_values = process.observed[far_rows] if len(far_rows) else process.observed
        np.testing.assert_allclose(mean[number], np.tensordot(weights[0], far_values, 1), atol=SINGLE)
        np.testing.assert_allclose(deviation[number], np.sqrt(variance[0]) * process.scale, atol=SINGLE)


def test_axes_lie_along_and_across_the_line_of_sight() -> None:
    where = positions(9)
    for receiver_m in (RECEIVER_M, where.mean(axis=0) + UP_M, where.mean(axis=0) - UP_M):
        axes = sight_axes(where, receiver_m)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        way = receiver_m - where.mean(axis=0)
        np.testing.assert_allclose(axes[0], way / np.linalg.norm(way), atol=1e-12)
        assert axes[1, 2] == 0  # level
    np.testing.assert_array_equal(line_of_sight(where, where.mean(axis=0)), [0, 0, 1])


@pytest.mark.parametrize("most", [400, 90])
def test_fit_recovers_lengths_and_noise(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """300 draws at 120 places tell a length to some per cent; all rows predict, even if fewer are fitted to."""
    monkeypatch.setattr(nearby, "MOST_ROWS", most)
    where = positions(120, seed=6)
    local = (where @ sight_axes(where, RECEIVER_M).T) / LENGTH_M
    root = np.linalg.cholesky(np.exp(-cdist(local, local)) + NOISE * np.eye(120))
    observed = (0.5 + 0.1 * root @ np.random.default_rng(1).normal(size=(120, 300))).astype(np.float32)
    fitted = fit_anisotropic(where, observed, RECEIVER_M, WAVELENGTH_M)
    assert fitted.length_m == pytest.approx(LENGTH_M, rel=0.15)
    assert fitted.noise == pytest.approx(NOISE, rel=0.3)
    assert np.mean(fitted.scale) == pytest.approx(0.1, rel=0.05)
    assert fitted.observed.shape == observed.shape


@pytest.fixture(scope="module")
def record() -> Record:
    return wave_record(rows=80, held_out=20)


@pytest.fixture(scope="module")
def progress() -> list[tuple[str, float]]:
    return []


@pytest.fixture(scope="module")
def model(record: Record, progress: list[tuple[str, float]]) -> ByReceiver:
    settings = SpectrumKrigingSettings(directions=60)
    return fit(record, record.official[0], settings, lambda *stage: progress.append(stage[:2]))


@pytest.mark.parametrize("receiver", [0, 1])
def test_mixture_beats_kriging_and_states_its_error(record: Record, model: ByReceiver, receiver: int) -> None:
    rows, truth = record.official[1], record.observation[receiver, record.official[1]]
    where = record.tx_pos_m[rows]
    estimate = model.predict(Inputs(where, np.zeros(len(rows))), receiver)
    assert estimate.mean.shape == estimate.std.shape == (len(rows), *SIZE)
    assert 0 <= estimate.mean.min() <= estimate.mean.max() <= 1
    error = np.square(estimate.mean - truth).mean()
    # These waves obey the model, so that signals tell most of what there is to know.
    assert error < 0.5 * np.square(coherent(model, receiver).nearby.predict(where) - truth).mean()
    assert np.median(ssim(estimate.mean, truth)) > 0.9
    assert error < 0.1 * np.square(model.predict_mean(Inputs(where), 1 - receiver) - truth).mean()
    np.testing.assert_allclose(model.predict_mean(Inputs(where), receiver), estimate.mean, atol=SINGLE)
    # 20 rows of correlated pixels.
    assert inside_interval(estimate.mean, estimate.std, truth) == pytest.approx(0.9, abs=0.08)
    with pytest.raises(InputError, match="give finite x, y, z"):
        model.predict(Inputs(np.array([[0.0, np.nan, 0.0]])), receiver)


def test_deviation_is_that_of_the_grey_values_far_away(record: Record, model: ByReceiver) -> None:
    training_values, far = record.observation[0, record.official[0]], np.array([[100.0, 100.0, 0.0]])
    away, near = (model.predict(Inputs(where), 0) for where in (far, record.tx_pos_m[record.official[0]]))
    np.testing.assert_allclose(away.mean[0], coherent(model).nearby.predict(far)[0], atol=1e-3)
    assert np.sqrt(np.square(away.std).mean()) > 0.7 * training_values.std(axis=0).mean()
    assert near.std.mean() < 0.2 * away.std.mean()
    assert np.abs(near.mean - training_values).mean() < 0.02


def test_fit_reports_progress_and_what_it_found(model, progress) -> None:
    assert progress[0][0] == "one: element signals of spectra"
    assert {stage for stage, _ in progress} >= {"one: signals", "one: weights", "two: weights"}
    assert all(0 <= share <= 1 for _, share in progress)
    assert progress[-1] == ("kriging: receivers", 1.0)
    fitted = model.facts()["fitted"][0]
    assert sum(fitted["coherent_share"]) == pytest.approx(1, abs=1e-3)
    assert 0 < fitted["turned_share"] <= 1


def test_weight_and_spread_are_those_that_fit_rows_held_out(record: Record, model: ByReceiver) -> None:
    weight = signal_weight(np.array([0.0, 0.1, 0.5, 1.0]), 0.1)
    assert (weight[0], weight[3]) == (0, 0)  # at 0 neighbours know as much
    assert weight[1] == pytest.approx(0.5 * 0.9)
    observed, fitted = record.observation[0, record.official[0]], coherent(model)
    rows = np.arange(len(observed))  # fewer than would be drawn from
    by_gap = []
    for gap in GAPS:
        posterior = fitted.signals.held_out(gap * WAVELENGTH_M, rows)
        kriged, deviation = fitted.nearby.held_out(gap * WAVELENGTH_M, rows)
        by_gap.append((fitted.report(posterior), posterior.ignorance, kriged, deviation))

    def left(half: float) -> float:
        errors = []
        for report, ignorance, kriged, _ in by_gap:
            weight = ignorance**2 / (ignorance**2 + half**2)
            errors.append(np.square(kriged + weight[:, None, None] * (report[0] - kriged) - observed).mean())
        return float(np.mean(errors))

    # Chosen between 0.01 and 3 in steps of a tenth.
    others = [half for half in fitted.half * np.array([0.1, 0.8, 1.25, 10.0]) if 0.01 < half < 3]
    assert left(fitted.half) <= min(left(half) for half in others)
    mixed = [fitted.mixed(*parts) for parts in by_gap]
    inside = [np.abs(mean - observed) <= 1.6449 * fitted.spread * std for mean, std in mixed]
    assert np.mean(inside) == pytest.approx(0.9, abs=0.01)


def test_receivers_with_few_rows_are_kriged_generically_beside_others(record: Record, tmp_path: Path) -> None:
    """Rows that one receiver missed are left out there; below `LEAST_ROWS` its spectra themselves are kriged."""
    rows, observed = record.official[0][:24], record.observation.copy()
    observed[1, rows[:4]] = np.nan
    both = fit(replace(record, observation=observed), rows)
    assert [len(coherent(both, receiver).nearby.tx_pos_m) for receiver in (0, 1)] == [24, 20]
    observed[1, rows[: 25 - LEAST_ROWS]] = np.nan
    mixed = fit(replace(record, observation=observed), rows)
    assert isinstance(mixed.models[1], UncertainKriged)
    assert isinstance(mixed.models[0], KrigedSpectra)
    again = KRIGING.load(mixed.arrays(), Problem(record, QUICK), tmp_path)
    asked = Inputs(record.tx_pos_m[record.official[1]])
    for receiver in (0, 1):
        before, after = (each.predict(asked, receiver) for each in (mixed, again))
        np.testing.assert_array_equal(after.mean, before.mean)
        np.testing.assert_array_equal(after.std, before.std)
        assert np.isfinite(before.mean).all()
        assert (before.std > 0).all()
    plain = Kriging().fit(record.tx_pos_m[rows], observed[1, rows]).predict(asked.tx_pos_m)
    np.testing.assert_array_equal(mixed.predict_mean(asked, 1), plain)


def test_deviations_of_generic_kriging_are_those_of_universal_kriging() -> None:
    where, asked = positions(12), positions(5, seed=4)
    observed = np.random.default_rng(0).normal(size=(12, 3))
    kriging = Kriging(length_m=0.3, noise=0.05).fit(where, observed)
    uncertain = UncertainKriged.of(kriging, observed)
    estimate = uncertain.prediction(asked)
    process = AnisotropicKriging(where, observed.astype(np.float32), np.eye(3), np.full(3, 0.3), 0.05)
    np.testing.assert_allclose(estimate.mean, process.predict(asked), atol=SINGLE)
    np.testing.assert_allclose(estimate.std, process.std(asked), atol=SINGLE)
    left = uncertain.left_out()
    for row in (0, 7):
        others = np.arange(12) != row
        single = Kriging(length_m=0.3, noise=0.05).fit(where[others], observed[others]).predict(where[[row]])
        np.testing.assert_allclose(left[row], observed[row] - single[0], atol=1e-9)
    single_row = UncertainKriged.of(Kriging(length_m=0.3, noise=0.05).fit(where[:1], observed[:1]), observed[:1])
    assert (single_row.prediction(asked).std > 0).all()  # a single row says nothing about the spread


def test_weights_keep_their_defaults_without_gaps(record: Record) -> None:
    """Nothing is held out, so nothing is known of how far to trust either part; and no gap is wider than the rows."""
    first = of_one_receiver(record)
    model = fit(replace(first, tx_pos_m=np.zeros_like(first.tx_pos_m)), np.arange(16))
    assert (coherent(model).half, coherent(model).spread) == (1.0, 1.0)
    estimate, training_values = model.predict(Inputs(np.zeros((1, 3))), 0), first.observation[0, :16]
    np.testing.assert_allclose(estimate.mean[0], training_values.mean(axis=0), atol=0.3)
    assert estimate.std.mean() == pytest.approx(training_values.std(axis=0).mean(), rel=0.5)
    close = coherent(fit(replace(first, tx_pos_m=first.tx_pos_m / 10), np.arange(16)))
    assert np.ptp(close.nearby.tx_pos_m, axis=0).max() < GAPS[-2] * WAVELENGTH_M
    assert 0.3 < close.spread < 1.5


def test_spectra_are_read_in_chunks(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many at once as memory bears: the parts are joined in order."""
    sizes, unscale, rows = [], retrieve.unscale, record.official[0][:20]

    def counted(grey: np.ndarray, lags: Any) -> Any:
        sizes.append(len(grey))
        return unscale(grey, lags)

    monkeypatch.setattr(spectra, "UNSCALED_PER_CHUNK", 9)
    monkeypatch.setattr(spectra, "unscale", counted)
    kriged = coherent(fit(of_one_receiver(record), rows))
    assert sizes == [9, 9, 2]
    near = kriged.report(kriged.signals.predict(record.tx_pos_m[rows]))[0]
    assert np.median(ssim(near, record.observation[0, rows])) > 0.9


def test_arrays_on_a_line_and_too_many_rows_are_kriged_generically_with_a_warning(record, monkeypatch, caplog) -> None:
    """Too many for the memory."""
    line = record.with_array(np.outer(np.arange(9), [0.1, 0, 0]))
    for data, reason in ((line, "retrieval: 9 elements on a line"), (record, "12 rows are too many")):
        if data is record:
            monkeypatch.setattr(spectra, "MOST_COVARIANCES", 9 * 11**2)
        models = fit(data, np.arange(12), SpectrumKrigingSettings()).models
        assert all(isinstance(kriged, UncertainKriged) for kriged in models)
        with pytest.raises(InputError, match=f"setting directions: no effect, as .*{reason}.*; omit it"):
            fit(data, np.arange(12), replace(SpectrumKrigingSettings(), directions=20))
        assert f"the spectra themselves are kriged: {reason}" in caplog.text


@pytest.mark.parametrize("settings", [QUICK, replace(QUICK, generic=True), replace(QUICK, length_m=0.2)])
@pytest.mark.parametrize("change", ["array", "frequencies_hz", None])
def test_unknown_instruments_and_stated_covariances_are_kriged_generically(settings, change, record, two_gateways):
    if change is None and settings is QUICK:
        record = two_gateways  # an instrument of which nothing is known
    unknown = {"array": without_array, "frequencies_hz": lambda original: replace(original, frequencies_hz=None)}
    model = fit(unknown.get(change or "", lambda original: original)(record), np.arange(12), settings)
    assert all(type(kriged) is Kriged for kriged in model.models)
    assert model.predict(Inputs(record.tx_pos_m[:2]), 0).std is None


@pytest.mark.parametrize(
    ("setting", "value"), [("cone_deg", 0.0), ("cone_deg", 181.0), ("directions", 0), ("lengths", 0)]
)
def test_settings_that_cannot_be_fitted_are_refused(setting: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"setting {setting}: {value} is out of range, choose"):
        SpectrumKrigingSettings(**{setting: value})
