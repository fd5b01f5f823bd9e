"""Lags against squared spectra computed from signals, for regular and irregular arrays."""

import numpy as np
import pytest

from wrf_mi.core import InputError, pixel_directions
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import Lags, array_response, bartlett_spectrum

FREQUENCY_HZ = 920e6
EXACT = 1e-9  # sums of 256 products of size one in float64

IRREGULAR = np.array([[0, 0, 0], [0.13, 0.02, 0], [-0.03, 0.11, 0], [0.09, 0.15, 0.05]])


def lags_of(lags: Lags, h: np.ndarray) -> np.ndarray:
    """Lags [..., count] of snapshots [..., m]."""
    products = (h[..., :, None] * h[..., None, :].conj()).reshape(*h.shape[:-1], -1)
    return products.real @ lags.pairs[0] + products.imag @ lags.pairs[1]


def squared(lags: Lags, values: np.ndarray) -> np.ndarray:
    """Squared spectra [..., height, width] of lags [..., count]."""
    return (values @ lags.basis.T).reshape(*values.shape[:-1], *lags.shape)


def signals(count: int, batch: int = 3) -> np.ndarray:
    rng = np.random.default_rng(count)
    return rng.normal(size=(batch, count)) + 1j * rng.normal(size=(batch, count))


REGULAR = [(planar_array(4, 4, 0.16), 49), (planar_array(2, 3, 0.1), 15), (planar_array(1, 1, 0.1), 1)]
COINCIDING = np.repeat(planar_array(1, 2, 0.1), 2, axis=0)


@pytest.mark.parametrize(("elements", "count"), [*REGULAR, (IRREGULAR, 13), (COINCIDING, 3)])
def test_lags_give_the_squared_spectrum_of_their_signals(elements: np.ndarray, count: int):
    """A regular a x b array has (2 a - 1)(2 b - 1) lags; n irregular ones n (n - 1) + 1; coinciding ones add none."""
    lags, h = Lags(elements, FREQUENCY_HZ, 10, 40), signals(len(elements))
    expected = bartlett_spectrum(h, elements, FREQUENCY_HZ, 10, 40) ** 2
    assert lags.count == count
    np.testing.assert_allclose(squared(lags, lags_of(lags, h)), expected, atol=EXACT)
    mean = squared(lags, lags_of(lags, h).mean(axis=0))  # of snapshots
    np.testing.assert_allclose(mean, expected.mean(axis=0), atol=EXACT)
    if elements is not IRREGULAR:
        np.testing.assert_allclose(lags.coordinates(expected), lags.to_coordinates(lags_of(lags, h)), atol=1e-7)


def test_lags_of_a_plane_wave_are_those_of_its_direction():
    """h = exp(+j k p . u): each of the (4 - a)(4 - b) pairs of a lag has the phase k l . u; r_0 is 16."""
    elements, u = planar_array(4, 4, 0.16), pixel_directions(9, 36)[4, 7]
    lags = Lags(elements, FREQUENCY_HZ, 9, 36)
    wave_lags = lags_of(lags, array_response(elements, u, FREQUENCY_HZ))
    assert wave_lags[0] == pytest.approx(16)
    steps = np.rint(np.abs(lags.lag_m[1:]) / 0.16)
    expected = (4 - steps[:, 0]) * (4 - steps[:, 1]) * array_response(lags.lag_m[1:], u, FREQUENCY_HZ)
    np.testing.assert_allclose(wave_lags[1:25] + 1j * wave_lags[25:], np.sqrt(2) * expected, atol=EXACT)


def test_residual_is_orthogonal_to_all_squared_spectra():
    """So the projection is the nearest squared spectrum; coordinates keep distances of images in the span."""
    elements = planar_array(3, 3, 0.15)
    lags = Lags(elements, FREQUENCY_HZ, 12, 48)
    image = np.random.default_rng(0).normal(size=(2, 12, 48))
    np.testing.assert_allclose(lags.residual(image).reshape(2, -1) @ lags.basis, 0, atol=1e-8)
    spectra = bartlett_spectrum(signals(9, 2), elements, FREQUENCY_HZ, 12, 48) ** 2
    np.testing.assert_allclose(lags.residual(spectra), 0, atol=EXACT)
    distance = np.linalg.norm(lags.coordinates(spectra[0]) - lags.coordinates(spectra[1]))
    assert distance == pytest.approx(np.linalg.norm(spectra[0] - spectra[1]))


def test_ambiguous_grids_and_wrong_elements_are_refused():
    upright = planar_array(4, 4, 0.16) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    lags = Lags(np.concatenate([upright, [[0.03, 0.02, 0.01]]]), FREQUENCY_HZ, 2, 5)
    with pytest.raises(InputError, match="cannot be told apart"):
        lags.coordinates(np.zeros((2, 5)))
    with pytest.raises(InputError, match="build the lags for its grid"):
        Lags(planar_array(2, 2, 0.1), FREQUENCY_HZ, 9, 36).coordinates(np.zeros((3, 9, 35)))
    for wrong in (np.zeros((4, 2)), np.full((4, 3), np.nan), np.zeros((0, 3))):
        with pytest.raises(InputError, match="give finite"):
            Lags(wrong, FREQUENCY_HZ, 9, 36)
