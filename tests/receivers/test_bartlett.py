"""The Bartlett spectrum equals the plain sum for any array, signal and block of directions."""

import numpy as np
import pytest

from wrf_mi.core.angles import pixel_directions
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import array as module
from wrf_mi.receivers import array_response, bartlett_spectrum
from wrf_mi.receivers.array import mirror_order

FREQUENCY_HZ = 920e6
ROUNDING = 1e-12
"""Sums of some hundred products in double precision, of signals of size 1."""
SIZE = 14, 31

RNG = np.random.default_rng(0)
ARRAYS = {
    "regular": planar_array(4, 4, 0.16),
    "odd, off the origin": planar_array(3, 5, 0.16) + np.array([0.3, -0.2, 0.1]),
    "not planar": RNG.normal(size=(70, 3)),
    "single": np.array([[0.2, 0.1, 0.0]]),
    "coinciding": np.array([[0.2, 0, 0], [0.2, 0, 0], [-0.2, 0, 0], [-0.2, 0, 0.0]]),
}


@pytest.mark.parametrize("size", [(14, 31), (9, 24)])
@pytest.mark.parametrize("name", ARRAYS)
def test_spectrum_is_the_plain_sum(name: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch):
    elements = ARRAYS[name]
    h = RNG.normal(size=(3, 2, len(elements))) + 1j * RNG.normal(size=(3, 2, len(elements)))
    expected = np.abs(
        h @ array_response(elements, pixel_directions(*size), FREQUENCY_HZ).conj().reshape(-1, len(elements)).T
    )
    largest = np.abs(h).sum(axis=-1).max()
    found = bartlett_spectrum(h, elements, FREQUENCY_HZ, *size)
    np.testing.assert_allclose(found, expected.reshape(3, 2, *size), rtol=0, atol=ROUNDING * largest)
    monkeypatch.setattr(module, "TABLE_BYTES", 16 * 50 * len(elements))
    monkeypatch.setattr(module, "CHUNK_SIZE", 4)
    blocks = bartlett_spectrum(h, elements, FREQUENCY_HZ, *size)
    np.testing.assert_allclose(blocks, found, rtol=0, atol=ROUNDING * largest)


@pytest.mark.parametrize("factor", [0.0, 1e-200, 1e200])
def test_spectrum_scales_with_signals_of_any_size(factor: float):
    elements = ARRAYS["regular"]
    h = RNG.normal(size=16) + 1j * RNG.normal(size=16)
    expected = factor * bartlett_spectrum(h, elements, FREQUENCY_HZ, *SIZE)
    np.testing.assert_allclose(bartlett_spectrum(factor * h, elements, FREQUENCY_HZ, *SIZE), expected, rtol=ROUNDING)


def test_no_signals_have_no_spectra():
    assert bartlett_spectrum(np.zeros((0, 16)), ARRAYS["regular"], FREQUENCY_HZ, *SIZE).shape == (0, *SIZE)


def test_mirror_order_of_a_line():
    assert mirror_order([[0], [1], [2.0]]).tolist() == [2, 1, 0]
    assert mirror_order([[0], [1], [2.1]]) is None
