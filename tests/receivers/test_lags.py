"""Lags against squared spectra computed from signals, for regular and irregular arrays."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.core import InputError, pixel_directions
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import Lags, array_response, bartlett_spectrum

FREQUENCY_HZ = 920e6
EXACT = 1e-9
"""Sums of 256 products of size one in float64."""

IRREGULAR = np.array([[0, 0, 0], [0.13, 0.02, 0], [-0.03, 0.11, 0], [0.09, 0.15, 0.05]])


def signals(count: int, batch: int = 3) -> np.ndarray:
    rng = np.random.default_rng(count)
    return rng.normal(size=(batch, count)) + 1j * rng.normal(size=(batch, count))


@pytest.mark.parametrize(
    ("elements", "count"),
    [
        (planar_array(4, 4, 0.16), 49),
        (planar_array(2, 3, 0.1), 15),
        (planar_array(1, 1, 0.1), 1),
        (IRREGULAR, 13),
        (np.repeat(planar_array(1, 2, 0.1), 2, axis=0), 3),
    ],
)
def test_lags_give_the_squared_spectrum_of_their_signals(elements: np.ndarray, count: int):
    """A regular a x b array has (2 a - 1)(2 b - 1) lags; n elements without order n (n - 1) + 1; twins add none."""
    lags, h = Lags(elements, FREQUENCY_HZ, 10, 40), signals(len(elements))
    squared = bartlett_spectrum(h, elements, FREQUENCY_HZ, 10, 40) ** 2
    assert lags.count == count
    np.testing.assert_allclose(lags.squared(lags.of_signals(h)), squared, atol=EXACT)
    if elements is not IRREGULAR:
        np.testing.assert_allclose(lags.of_squared(squared), lags.of_signals(h), rtol=1e-5, atol=1e-5)


def test_lags_of_a_plane_wave_are_those_of_its_direction():
    """h = exp(+j k p . u): each of the (4 - a)(4 - b) pairs of a lag has the phase k l . u; r_0 is 16."""
    elements, u = planar_array(4, 4, 0.16), pixel_directions(9, 36)[4, 7]
    lags = Lags(elements, FREQUENCY_HZ, 9, 36)
    found = lags.of_signals(array_response(elements, u, FREQUENCY_HZ))
    assert found[0] == pytest.approx(16)
    steps = np.rint(np.abs(lags.lag_m[1:]) / 0.16)
    expected = (4 - steps[:, 0]) * (4 - steps[:, 1]) * array_response(lags.lag_m[1:], u, FREQUENCY_HZ)
    np.testing.assert_allclose(found[1:25] + 1j * found[25:], np.sqrt(2) * expected, atol=EXACT)


def test_nearest_lags_of_an_image_that_has_none():
    """Noise: what is left is across the span, so no other lags are nearer; a mean of snapshots is a mean of lags."""
    elements = planar_array(3, 3, 0.15)
    lags = Lags(elements, FREQUENCY_HZ, 12, 48)
    image = np.random.default_rng(0).normal(size=(2, 12, 48))
    fitted = lags.of_squared(image)
    left = image - lags.squared(fitted)
    np.testing.assert_allclose(left, lags.residual(image), atol=EXACT)
    np.testing.assert_allclose(left.reshape(2, -1) @ lags.basis, 0, atol=1e-8)
    h = signals(9, 50)
    mean = (bartlett_spectrum(h, elements, FREQUENCY_HZ, 12, 48) ** 2).mean(axis=0)
    np.testing.assert_allclose(lags.squared(lags.of_signals(h).mean(axis=0)), mean, atol=EXACT)


def test_row_offset_raises_all_elevations():
    elements, h = planar_array(2, 2, 0.16), signals(4)
    raised = Lags(elements, FREQUENCY_HZ, 9, 36, row_offset=1)
    squared = raised.squared(raised.of_signals(h))
    plain = bartlett_spectrum(h, elements, FREQUENCY_HZ, 9, 36) ** 2
    np.testing.assert_allclose(squared[:, :-1], plain[:, 1:], atol=EXACT)


def test_what_cannot_be_told_apart_is_refused():
    upright = planar_array(4, 4, 0.16) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    lags = Lags(np.concatenate([upright, [[0.03, 0.02, 0.01]]]), FREQUENCY_HZ, 2, 5)
    with pytest.raises(InputError, match="cannot be told apart"):
        lags.of_squared(np.zeros((2, 5)))
    with pytest.raises(InputError, match="build the lags for its grid"):
        Lags(planar_array(2, 2, 0.1), FREQUENCY_HZ, 9, 36).of_squared(np.zeros((3, 9, 35)))
    for wrong in (np.zeros((4, 2)), np.full((4, 3), np.nan), np.zeros((0, 3))):
        with pytest.raises(InputError, match="give finite"):
            Lags(wrong, FREQUENCY_HZ, 9, 36)
