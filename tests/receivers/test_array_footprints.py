"""Antenna signals of Gaussian footprints in closed form, against quadrature on a fine grid in the tangent plane."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.constants import speed_of_light

from wrf_mi.core import unit_vectors
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import footprints
from wrf_mi.receivers.footprints import gaussian_signals

FREQUENCY_HZ = 920e6
ELEMENTS = planar_array(4, 4, 0.16)
STATED = {
    1: (1.3e-3, 5e-6),
    3: (0.012, 3.5e-4),
    5: (0.028, 2.2e-3),
    10: (0.085, 0.019),
    20: (0.2, 0.065),
    30: (0.3, 0.1),
}
"""Degrees: error of first and second order in the module's table, rounded up."""


def frame(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a = np.cross(n, [0.6, -0.8, 0])
    a /= np.linalg.norm(a)
    return a, np.cross(n, a)


def by_quadrature(n: np.ndarray, c: np.ndarray, elements: np.ndarray) -> tuple[np.ndarray, float]:
    """Signals and the integral of the footprint; 6 deviations in steps of 0.06: exact to 1e-8 for a Gaussian."""
    a, b = frame(n)
    t = np.arange(-6, 6.01, 0.06)
    grid = np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1).reshape(-1, 2) @ np.linalg.cholesky(c).T
    square = (grid**2).sum(axis=1)
    exponent = np.einsum("gi,ij,gj->g", grid, np.linalg.inv(c), grid)
    weight = np.exp(-exponent / 2) * (1 + square) ** -1.5 * 0.06**2 * np.sqrt(np.linalg.det(c))
    u = (n + grid[:, :1] * a + grid[:, 1:] * b) / np.sqrt(1 + square)[:, None]
    wavenumber = 2 * np.pi * FREQUENCY_HZ / speed_of_light
    return weight @ np.exp(1j * wavenumber * (u @ elements.T)), float(weight.sum())


@pytest.mark.parametrize("degrees", STATED)
def test_error_is_as_stated(degrees: int):
    """Root of the mean square over directions of the upper hemisphere and elements."""
    rng = np.random.default_rng(0)
    n = unit_vectors(rng.uniform(0, 2 * np.pi, 20), np.arcsin(rng.uniform(0, 1, 20)))
    sigma = np.radians(degrees)
    true = [by_quadrature(d, sigma**2 * np.eye(2), ELEMENTS) for d in n]
    for order, stated in zip((1, 2), STATED[degrees], strict=True):
        found = gaussian_signals(n, np.full(20, sigma), ELEMENTS, FREQUENCY_HZ, order)
        error = np.sqrt(np.mean([np.square(np.abs(f - h) / whole) for f, (h, whole) in zip(found, true, strict=True)]))
        assert stated / 2 < error < stated


def test_long_footprints_and_their_part_along_the_direction():
    """6 by 2 degrees, turned; what a 3D covariance has along the direction does not count."""
    n = unit_vectors(2.0, 0.9)
    a, b = frame(n)
    axes = np.stack([np.cos(0.5) * a + np.sin(0.5) * b, -np.sin(0.5) * a + np.cos(0.5) * b])
    widths = np.radians([6.0, 2.0])
    flat = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]) * widths
    true, whole = by_quadrature(n, flat @ flat.T, ELEMENTS)
    solid = (
        np.einsum("k,ki,kj->ij", widths**2, axes, axes)
        + 0.3 * np.outer(n, n)
        + 0.01 * (np.outer(n, a) + np.outer(a, n))
    )
    found = gaussian_signals(n, solid, ELEMENTS, FREQUENCY_HZ)
    assert np.abs(found - true).max() < 0.01 * whole
    assert np.abs(gaussian_signals(n, solid, ELEMENTS, FREQUENCY_HZ, 1) - true).max() > 0.01 * whole


def test_a_small_footprint_is_a_plane_wave():
    n = unit_vectors(1.0, 0.3)
    point = gaussian_signals(n, 1e-5, ELEMENTS, FREQUENCY_HZ) / (2 * np.pi * 1e-10)
    wavenumber = 2 * np.pi * FREQUENCY_HZ / speed_of_light
    np.testing.assert_allclose(point, np.exp(1j * wavenumber * (ELEMENTS @ n)), atol=1e-8)
    assert gaussian_signals(np.stack([n, n, n]), np.zeros(3), ELEMENTS, FREQUENCY_HZ).shape == (3, 16)
    with pytest.raises(ValueError, match="order 3"):
        gaussian_signals(n, 0.1, ELEMENTS, FREQUENCY_HZ, 3)


def test_chunks_are_the_whole(monkeypatch: pytest.MonkeyPatch):
    """Two Gaussians at once, and one where an array alone has more pairs than are taken at once."""
    rng = np.random.default_rng(1)
    n = unit_vectors(rng.uniform(0, 2 * np.pi, (5, 3)), rng.uniform(-1, 1, (5, 3)))
    root = 0.1 * rng.normal(size=(5, 3, 3, 3))
    covariance = root @ root.swapaxes(-1, -2)
    whole = gaussian_signals(n, covariance, ELEMENTS, FREQUENCY_HZ)
    for pairs in (2 * len(ELEMENTS), 3):
        monkeypatch.setattr(footprints, "PAIRS_PER_CHUNK", pairs)
        np.testing.assert_allclose(gaussian_signals(n, covariance, ELEMENTS, FREQUENCY_HZ), whole, rtol=1e-12)
        same = gaussian_signals(n, covariance[0, 0], ELEMENTS, FREQUENCY_HZ)
        np.testing.assert_allclose(same[0, 0], whole[0, 0], rtol=1e-12)
