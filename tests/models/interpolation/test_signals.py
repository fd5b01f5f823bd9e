"""Element signals as a Gaussian process: its covariances, its fit, and the spectra that it is expected to give."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_waves import CONE_DEG, ELEMENTS_M, FREQUENCY_HZ, WAVELENGTH_M, WAVENUMBER, positions, signals
from scipy.spatial.distance import cdist
from scipy.stats import rice

from wrf_mi.core.angles import fibonacci_sphere
from wrf_mi.core.array_files import write_arrays
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.stored import from_arrays, to_arrays
from wrf_mi.estimators.interpolation import signals as module
from wrf_mi.estimators.interpolation.signals import (
    Covariances,
    Posterior,
    RowCovariances,
    SignalProcess,
    departures,
    fit_shares,
    fit_signals,
)
from wrf_mi.estimators.interpolation.spectra import ExpectedSpectrum, rician
from wrf_mi.receivers.array import bartlett_spectrum, mirror_order
from wrf_mi.receivers.scaling import minmax_scale

TOWARDS = np.array([3.0, 1.0, -0.5]) / np.linalg.norm([3.0, 1.0, -0.5])
DICTIONARY = Covariances(np.array([4.0, 1.0, 0.3]) * WAVELENGTH_M, departures(TOWARDS, WAVENUMBER, CONE_DEG, count=60))
ROUNDING = 1e-9  # of sums of some hundred numbers of size one, through the inverse of a matrix of condition 1e4


def drawn(covariance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A circular complex Gaussian vector."""
    value, vector = np.linalg.eigh(covariance)
    pair = rng.normal(size=(2, len(value))) / np.sqrt(2)
    return vector @ (np.sqrt(np.maximum(value, 0)) * (pair[0] + 1j * pair[1]))


def each_covariance(dictionary: Covariances, where: np.ndarray) -> np.ndarray:
    """All covariances between positions, [count, n, n], length slowest."""
    return dictionary.mixed(where, where, np.eye(dictionary.count))


def process_of(rows: int = 30, seed: int = 1, noise: float = 1e-3) -> SignalProcess:
    """Of three components with shares of their own; two rows lie at one position."""
    rng = np.random.default_rng(seed)
    where = positions(rows, seed)
    where[1] = where[0]
    weight = rng.uniform(size=(3, DICTIONARY.count)) * (rng.uniform(size=(3, DICTIONARY.count)) < 0.1)
    basis = np.linalg.qr(rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3)))[0]
    values = rng.normal(size=(rows, 3)) + 1j * rng.normal(size=(rows, 3))
    values[1] = values[0]
    return SignalProcess(where, values, DICTIONARY, basis, weight, noise * np.array([1.0, 2.0, 0.5]))


def unit_signals(where: np.ndarray, elements_m: np.ndarray = ELEMENTS_M) -> np.ndarray:
    h = signals(where, TOWARDS, elements_m)
    return h / np.linalg.norm(h, axis=1, keepdims=True)


def overlaps(h: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Magnitudes [n] of the inner products of rows."""
    return np.abs(np.einsum("nm,nm->n", h.conj(), other))


def cost_of(signal: np.ndarray, covariance: np.ndarray) -> float:
    """Of a circular complex vector the logarithm of the determinant counts whole, not half."""
    return float((signal.conj() @ np.linalg.solve(covariance, signal)).real + np.linalg.slogdet(covariance)[1])


def test_each_covariance_is_positive_semidefinite() -> None:
    """Hermitian, one on the diagonal, positive semidefinite, and what its formula says."""
    where = positions(12)
    where[3] = where[7]
    each = each_covariance(DICTIONARY, where)
    assert each.shape == (DICTIONARY.count, 12, 12)
    np.testing.assert_allclose(each, each.conj().swapaxes(1, 2), atol=ROUNDING)
    np.testing.assert_allclose(np.diagonal(each, axis1=1, axis2=2), 1, atol=ROUNDING)
    assert np.linalg.eigvalsh(each).min() > -ROUNDING
    length, turn = divmod(DICTIONARY.count - 2, len(DICTIONARY.turns))
    apart = where[2] - where[9]
    expected = np.exp(-np.linalg.norm(apart) / DICTIONARY.lengths_m[length] + 1j * DICTIONARY.turns[turn] @ apart)
    assert each[-2, 2, 9] == pytest.approx(expected, abs=ROUNDING)


def test_mixtures_and_traces_equal_sums_over_the_dictionary() -> None:
    where, others, rng = positions(9, 1), positions(5, 2), np.random.default_rng(0)
    weight = rng.uniform(size=(2, DICTIONARY.count))
    weight[:, ::3] = 0
    atol = ROUNDING * weight.sum()
    block = each_covariance(DICTIONARY, np.concatenate([where, others]))[:, :9, 9:]
    expected = np.tensordot(weight, block, 1)
    np.testing.assert_allclose(DICTIONARY.mixed(where, others, weight), expected, rtol=0, atol=atol)
    each, rows, weight = each_covariance(DICTIONARY, where), RowCovariances(DICTIONARY, where), weight[0]
    np.testing.assert_allclose(rows.mixed(weight), np.tensordot(weight, each, 1), rtol=0, atol=ROUNDING * weight.sum())
    root = rng.normal(size=(9, 9)) + 1j * rng.normal(size=(9, 9))
    matrix = root @ root.conj().T
    expected = np.where(weight > 0, np.einsum("cij,ji->c", each, matrix).real, 0)
    # Single precision, of 81 terms of the size of the matrix's trace.
    np.testing.assert_allclose(rows.traces(matrix, weight), expected, rtol=0, atol=1e-5 * np.trace(matrix).real)


def test_departures_cover_the_cone_and_directions_the_sphere_evenly() -> None:
    turns = departures(TOWARDS, WAVENUMBER, CONE_DEG, count=400)
    assert not turns[0].any()
    leaving = turns / WAVENUMBER + TOWARDS
    np.testing.assert_allclose(np.linalg.norm(leaving, axis=1), 1, atol=ROUNDING)
    angle = np.degrees(np.arccos(np.clip(leaving @ TOWARDS, -1, 1)))
    assert CONE_DEG - 10 < angle.max() < CONE_DEG  # neighbours are 10 degrees apart
    share = (1 - np.cos(np.radians(CONE_DEG))) / 2
    assert len(turns) - 1 == pytest.approx(share * 400, rel=0.03)
    directions = fibonacci_sphere(500)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=ROUNDING)
    np.testing.assert_allclose(directions.T @ directions / 500, np.eye(3) / 3, atol=2e-3)
    nearest = np.sort(cdist(directions, directions), axis=1)[:, 1]
    assert nearest.min() > 0.7 * nearest.max()


def test_each_step_raises_the_likelihood() -> None:
    rng, where = np.random.default_rng(0), positions(25)
    each, rows = each_covariance(DICTIONARY, where), RowCovariances(DICTIONARY, where)
    signal = drawn(each[40] + 0.3 * each[0] + 0.01 * np.eye(25), rng)
    costs = [fit_shares(signal, rows, steps)[2] for steps in range(12)]
    # Shares of a ten-thousandth are dropped on the way, which may cost as much.
    assert np.diff(costs).max() < 1e-4 * abs(costs[0])
    assert costs[-1] < costs[0] - 5
    weight, noise, cost = fit_shares(signal, rows, 7)
    assert cost == pytest.approx(cost_of(signal, np.tensordot(weight, each, 1) + noise * np.eye(25)))


def test_fit_recovers_the_shares() -> None:
    """As far as one signal at 120 positions tells them; no less likely than the truth itself."""
    rng = np.random.default_rng(1)
    where = rng.uniform(-1.5, 1.5, (120, 3)) * WAVELENGTH_M * [1, 1, 0.3]
    few = Covariances(np.array([6.0, 0.6]) * WAVELENGTH_M, departures(TOWARDS, WAVENUMBER, 60.0, 16))
    each, truth = each_covariance(few, where), np.zeros(few.count)
    turned, short = 2, slice(len(few.turns), None)
    truth[turned], truth[short.start] = 2.0, 1.0
    covariance = np.tensordot(truth, each, 1) + 0.1 * np.eye(120)
    signal = drawn(covariance, rng)
    weight, noise, cost = fit_shares(signal, RowCovariances(few, where), 40)
    assert cost < cost_of(signal, covariance)
    assert weight.argmax() == turned
    # A long coherence has few independent parts here: ten leave a third of the variance uncertain.
    assert weight[turned] == pytest.approx(2, rel=0.4)
    assert weight[short].sum() == pytest.approx(1, rel=0.4)
    assert noise == pytest.approx(0.1, rel=0.5)


def test_more_elements_than_rows_and_their_components_of_rounding() -> None:
    """Components of fewer rows than elements: their likelihood says nothing, and is the same for all of them."""
    rows = RowCovariances(DICTIONARY, positions(6))
    rng = np.random.default_rng(0)
    costs = [
        fit_shares((1e-17 * scale * rng.normal(size=6)).astype(np.complex128), rows, 10, 1e-6)[2] for scale in (1, 30)
    ]
    assert costs[0] == pytest.approx(costs[1], abs=1e-6)
    assert np.isfinite(fit_shares(np.zeros(6, complex), rows, 10)[2])
    where = positions(8)
    process = fit_signals(signals(where, TOWARDS), where, ELEMENTS_M, DICTIONARY)
    posterior = process.predict(positions(3, seed=1))
    assert np.isfinite(posterior.mean).all()
    assert ((posterior.ignorance > 0) & (posterior.ignorance <= 1)).all()


def test_prediction_is_that_of_a_gaussian_process_and_restored(tmp_path: Path) -> None:
    process, where = process_of(), positions(4, seed=9)
    posterior = process.predict(where)
    every = np.concatenate([process.tx_pos_m, where])
    components = process.signals @ process.basis.conj()
    for c in range(3):
        covariance = np.tensordot(process.weight[c], each_covariance(DICTIONARY, every), 1)
        training_covariance, cross = covariance[:30, :30] + process.noise[c] * np.eye(30), covariance[30:, :30]
        mean = cross @ np.linalg.solve(training_covariance, components[:, c])
        left = (
            covariance[0, 0]
            - np.diagonal(cross @ np.linalg.solve(training_covariance, cross.conj().T))
            + process.noise[c]
        )
        np.testing.assert_allclose(posterior.mean @ process.basis.conj()[:, c], mean, atol=1e-8)
        np.testing.assert_allclose(posterior.variance[:, c], left.real, atol=1e-8)
    write_arrays(tmp_path / "process.npz", to_arrays(process))
    with np.load(tmp_path / "process.npz") as stored:
        again = from_arrays(SignalProcess, dict(stored)).predict(where)
    np.testing.assert_array_equal(again.mean, posterior.mean)
    np.testing.assert_array_equal(again.variance, posterior.variance)


@pytest.mark.parametrize("radius_m", [0.0, 0.12, 0.25, 100.0])
def test_held_out_is_a_fit_without_those_rows_or_the_prior_without_any(radius_m: float) -> None:
    process, rows = process_of(), np.array([0, 4, 17])
    posterior = process.held_out(radius_m, rows)
    for number, row in enumerate(rows):
        far = cdist(process.tx_pos_m[[row]], process.tx_pos_m)[0] > radius_m
        assert far.sum() < 30
        assert far.any() == (radius_m < 100)
        mean, variance = np.zeros(3), process.prior
        if far.any():
            far_process = replace(process, tx_pos_m=process.tx_pos_m[far], signals=process.signals[far])
            without = far_process.predict(process.tx_pos_m[[row]])
            mean, variance = without.mean[0], without.variance[0]
        np.testing.assert_allclose(posterior.mean[number], mean, atol=1e-8)
        np.testing.assert_allclose(posterior.variance[number], variance, atol=1e-8)


SHAPES = {"symmetric": ELEMENTS_M, "without opposites": np.delete(planar_array(3, 3, 0.15), [0, 5], axis=0)}


@pytest.mark.parametrize("elements_m", SHAPES.values(), ids=SHAPES)
@pytest.mark.parametrize("most", [70, 45])
def test_fit_resolves_phases_and_mirror_images(elements_m, most, monkeypatch) -> None:
    """Whatever phase and mirror image each row comes with; where rows are many, shares are fitted to some of them."""
    monkeypatch.setattr(module, "MOST_ROWS", most)
    monkeypatch.setattr(module, "STEPS", 10)
    rng, where = np.random.default_rng(0), positions(80, seed=2)
    truth, opposite = unit_signals(where, elements_m), mirror_order(elements_m)
    assert (opposite is None) == (len(elements_m) == 7)
    ambiguous = truth.copy()
    if opposite is not None:
        exchanged = rng.uniform(size=80) < 0.5
        ambiguous[exchanged] = ambiguous[exchanged][:, opposite].conj()
    ambiguous *= 3 * np.exp(2j * np.pi * rng.uniform(size=(80, 1)))
    train, test = np.arange(70), np.arange(70, 80)
    process = fit_signals(ambiguous[train], where[train], elements_m, DICTIONARY)
    assert process.signals.shape == (70, len(elements_m))
    # Not the mirror images, each as it was: a cone in the wrong direction would be less likely.
    assert overlaps(process.signals, truth[train]).min() > 1 - 1e-9
    predicted = process.predict(where[test]).mean
    overlap = overlaps(predicted, truth[test]) / np.linalg.norm(predicted, axis=1)
    nearest = cdist(where[test], where[train]).argmin(axis=1)
    assert (1 - overlap**2).mean() < 0.5 * (1 - overlaps(truth[train][nearest], truth[test]) ** 2).mean()


def test_realignment_corrects_single_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the alignment of neighbours got wrong: a mirror image, and a phase."""
    monkeypatch.setattr(module, "STEPS", 10)
    where, opposite = positions(60, seed=2), mirror_order(ELEMENTS_M)
    truth = unit_signals(where)
    right = fit_signals(truth, where, ELEMENTS_M, DICTIONARY)
    rows = right.signals.copy()
    rows[7] = 1j * rows[7, opposite].conj()
    rows[30] *= np.exp(2j)
    turned = module.realigned(replace(right, signals=rows), opposite)
    angle = np.angle(np.einsum("nm,nm->n", right.signals.conj(), turned))
    np.testing.assert_allclose(turned, right.signals * np.exp(1j * angle)[:, None], atol=ROUNDING)
    assert np.ptp(angle) < 0.5  # all are turned a little by what was wrong
    monkeypatch.setattr(module, "align_signals", lambda *arguments: rows)
    assert overlaps(fit_signals(truth, where, ELEMENTS_M, DICTIONARY).signals, truth).min() > 1 - ROUNDING


@pytest.mark.parametrize("dtype", [np.complex128, np.complex64])
def test_magnitude_is_rician(dtype: type) -> None:
    """As SciPy has it, with a deviation of sqrt(variance / 2) in each part; far from zero too, in single precision."""
    mean = np.array([0, 0.3, 1, 3, 10, 30, 100, 2000]).astype(dtype) * np.exp(0.7j)
    variance = np.full(len(mean), 2.0, mean.real.dtype)
    expected, deviation = rician(mean.astype(dtype), variance)
    rel = 1e-5 if dtype is np.complex128 else 3e-4  # of the series where it begins; of float32's differences before
    magnitude = np.abs(mean.astype(complex))[:-2]  # beyond, SciPy overflows; there the mean is b + 1 / (2 b)
    assert expected == pytest.approx([*rice.mean(magnitude), 100.005, 2000.00025], rel=rel)
    assert deviation == pytest.approx([*rice.std(magnitude), 0.999975, 1.0], rel=rel)
    expected, deviation = rician(np.array([0, 2j, 1e-3]), np.zeros(3))
    assert expected == pytest.approx([0, 2, 1e-3])
    assert not deviation.any()


def certain(mean: np.ndarray, variance: float) -> Posterior:
    m = mean.shape[1]
    basis = np.linalg.qr(np.random.default_rng(5).normal(size=(m, m)))[0].astype(complex)
    return Posterior(mean, np.full(mean.shape, variance) * np.linspace(0.5, 1.5, m), basis, np.ones(m))


@pytest.mark.parametrize("size", [(12, 24), (90, 360)])
def test_known_signals_give_their_spectrum(size: tuple[int, int]) -> None:
    """On any grid: extremes are sought as far apart as lobes of the array allow, not so many pixels.
    A null is a cone; where its tip lies between the directions that are looked at, all is some per cent too low.
    """
    h = signals(positions(4), TOWARDS)
    expected = minmax_scale(bartlett_spectrum(h, ELEMENTS_M, FREQUENCY_HZ, *size))
    grey, deviation = ExpectedSpectrum(ELEMENTS_M, FREQUENCY_HZ, *size)(certain(h, 1e-12))
    np.testing.assert_allclose(grey, expected, rtol=0, atol=0.03)
    assert deviation.max() < 1e-5


def test_expected_spectrum_is_the_mean_of_many() -> None:
    """Up to 1 / sqrt(64) of the deviation, which the observation's own draws leave in the extremes."""
    h = signals(positions(2), TOWARDS)
    posterior = certain(h, 0.5 * float(np.square(np.abs(h)).mean()))
    rng = np.random.default_rng(0)
    pair = rng.normal(size=(2, 1500, 1, 9)) / np.sqrt(2)
    noise = (pair[0] + 1j * pair[1]) * np.sqrt(posterior.variance)
    h = posterior.mean + noise @ posterior.basis.T
    drawn = minmax_scale(bartlett_spectrum(h, ELEMENTS_M, FREQUENCY_HZ, 16, 32))
    grey, deviation = ExpectedSpectrum(ELEMENTS_M, FREQUENCY_HZ, 16, 32)(posterior)
    assert np.abs(grey - drawn.mean(axis=0)).max() < 0.05
    assert np.sqrt(np.square(grey - drawn.mean(axis=0)).mean()) < 0.02
    # That the scale is a draw's own is not in the deviation stated.
    assert deviation.mean() == pytest.approx(drawn.std(axis=0).mean(), rel=0.1)


def test_cached_basis_follows_the_process() -> None:
    h = signals(positions(2), TOWARDS)
    first = certain(h, 0.1)
    turned = np.linalg.qr(np.random.default_rng(1).normal(size=first.basis.shape))[0].astype(complex)
    second = replace(first, basis=turned, variance=first.variance * np.arange(1, 10))
    used = ExpectedSpectrum(ELEMENTS_M, FREQUENCY_HZ, 16, 32)
    for posterior in (first, second, first):
        fresh = ExpectedSpectrum(ELEMENTS_M, FREQUENCY_HZ, 16, 32)
        np.testing.assert_array_equal(used(posterior), fresh(posterior))
