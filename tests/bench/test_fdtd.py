"""Published calibration against quadrature; channels from a field whose channel is known; tables."""

from typing import Any

import numpy as np
import pytest
from scipy.constants import c, epsilon_0, mu_0
from scipy.integrate import dblquad, quad
from wrf_mi_bench import far_scans, fdtd
from wrf_mi_bench.von_mises import calibrated, free_energy, phase_posterior, prior_concentration, resultant

QUADRATURE = 1e-8
RNG = np.random.default_rng(3)
CELL_M, STEP_S = 2.498e-3, 4.811e-12


def unit_waves(delays_s):
    return np.exp(-2j * np.pi * np.outer(delays_s, np.linspace(0, 1e8, 6)))


def test_free_energy_of_one_path_is_the_marginal_likelihood():
    wave, prior, noise = (0.8 - 0.3j) * unit_waves([1e-8]), 1.7, 0.9
    channel = wave[0] * np.exp(0.8j) + 0.5 * (RNG.normal(size=6) + 1j * RNG.normal(size=6))

    def density(phase):
        error = np.square(np.abs(channel - wave[0] * np.exp(1j * phase))).sum()
        return np.exp(prior * np.cos(phase) - error / noise) / (2 * np.pi * np.i0(prior) * (np.pi * noise) ** 6)

    expected = -np.log(quad(density, -np.pi, np.pi, epsabs=0, epsrel=1e-11)[0])
    posterior = phase_posterior(wave, channel, prior, noise)
    assert free_energy(wave, channel, posterior, prior, noise) == pytest.approx(expected, rel=QUADRATURE)


def test_free_energy_of_two_paths_is_a_close_bound():
    waves, noise = unit_waves([0.0, 3e-8]) * np.array([[1.0], [0.4]]), 0.3
    channel = waves.T @ np.exp([0.4j, -2.0j])

    def density(first, second):
        error = np.square(np.abs(channel - waves.T @ np.exp([1j * first, 1j * second]))).sum()
        return np.exp(-error / noise) / ((2 * np.pi) ** 2 * (np.pi * noise) ** 6)

    expected = -np.log(dblquad(density, -np.pi, np.pi, -np.pi, np.pi, epsabs=1e-12)[0])
    bound = free_energy(waves, channel, phase_posterior(waves, channel, 0.0, noise), 0.0, noise)
    assert 0 <= bound - expected < 0.1


def test_amplitudes_are_calibrated_whatever_the_phases():
    waves, rows = unit_waves([0.0, 2e-8]), 12
    phases = RNG.uniform(-np.pi, np.pi, (rows, 2))
    channels = np.exp(1j * phases) * np.array([1.0, 0.5]) @ waves
    log_gains, prior = calibrated(
        lambda x: [np.exp(x)[:, None] * waves] * rows, channels, np.log([0.7, 0.7]), np.full(rows, 1e-3)
    )
    np.testing.assert_allclose(np.exp(log_gains), [1.0, 0.5], rtol=0.02)
    assert prior < 1.5
    certain = [np.full(4, 10.0 + 0.0j)]
    assert resultant(np.array(prior_concentration(certain))) == pytest.approx(float(resultant(np.array(10.0))))
    assert prior_concentration([-certain[0]]) == 0


def test_grid_is_slower_than_light_along_its_axes():
    hz = np.array([6e9])
    slower = [
        fdtd.grid_wavenumber(hz, CELL_M, STEP_S, np.radians(a))[0] / (2 * np.pi * hz[0] / c) - 1 for a in (0, 45, 90)
    ]
    assert slower[0] == pytest.approx(slower[2])
    assert slower[0] > 3 * slower[1] > 0
    assert fdtd.grid_wavenumber(hz, CELL_M / 50, STEP_S / 50, 0.0)[0] == pytest.approx(2 * np.pi * hz[0] / c, rel=2e-6)


def test_channel_of_a_dipole_in_free_space(tmp_path):
    """From the field that the source radiates in the grid, to 0.2 %: linear interpolation, and 1 / f by the grid's."""
    h5py = pytest.importorskip("h5py")
    count, distance_m = 4096, np.array([2.0, 2.5, 3.0])
    hz = np.asarray(np.fft.rfftfreq(count, STEP_S), float)
    current = np.fft.rfft(fdtd.ricker(STEP_S * np.arange(float(count))))
    k = 2 * np.pi * hz / c
    grid = np.zeros(len(hz))
    low = (hz > 0) & (hz < 20e9)  # beyond, the source radiates nothing
    grid[low] = fdtd.grid_wavenumber(hz[low], CELL_M, STEP_S, fdtd.GRID_RAD)
    field = -1j * np.sqrt(mu_0 / epsilon_0) * k * current * CELL_M / (4 * np.pi) * low
    field = np.fft.irfft(field * np.exp(-1j * grid * distance_m[:, None]) / distance_m[:, None], count)
    with h5py.File(tmp_path / "toy.out", "w") as file:
        file.attrs["dt"], file.attrs["dx_dy_dz"] = STEP_S, [CELL_M] * 3
        for number, ez in enumerate(field, start=1):
            file[f"rxs/rx{number}/Ez"] = ez.astype(np.float32)
    wavenumber = 2 * np.pi * fdtd.WIDE_HZ / c
    expected = np.exp(-1j * wavenumber * distance_m[:, None]) / (2 * wavenumber * distance_m[:, None])
    channels = fdtd.measured_channels(tmp_path / "toy.out", fdtd.WIDE_HZ)
    np.testing.assert_allclose(channels / expected, 1, atol=2e-3)


def test_tables_have_a_line_for_each_row():
    rows: list[dict[str, Any]] = [
        {"what": "true scene", "unexplained_db": [-10.0, -11.0, -9.0], "power_db": [0.4, 0.1, -0.1]}
    ]
    assert fdtd.table(rows).splitlines()[2] == "| true scene | -9.0 | -0.1 |"
    errors = {far_scans.SCAN: 0.6, far_scans.WITHOUT: 0.6, far_scans.WITH: 0.1}
    rows = [
        {"what": "304: room", "median_db": errors, "mean_db": errors, "kept": {far_scans.WITH: "materials, phases"}}
    ]
    assert far_scans.table(rows).splitlines()[2] == (
        "| 304: room | 0.60 (0.60) | 0.60 (0.60) | 0.10 (0.10) | materials, phases |"
    )
