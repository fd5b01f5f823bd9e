"""The chunked beam former equals the plain sum for any array and chunk; the memory of its tables is bounded."""

import numpy as np
import pytest

from wrf_mi.core.angles import pixel_directions
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import array_response, bartlett_spectrum
from wrf_mi.receivers.beams import KEPT_ARRAYS, TABLE_BYTES, Beams, beams, mirror_order

FREQUENCY_HZ = 920e6
ROUNDING = 1e-12
"""Sums of some hundred products in double precision, of signals of size 1."""
SIZE = 14, 31

RNG = np.random.default_rng(0)
ARRAYS = {
    "regular": planar_array(4, 4, 0.16),
    "odd, off the origin": planar_array(3, 5, 0.16) + np.array([0.3, -0.2, 0.1]),
    "two lines": planar_array(9, 8, 0.16) + np.array([0.1, 0, 0]),
    "two lines, odd, shuffled": RNG.permutation(planar_array(9, 9, 0.12)),
    "uneven lines": (np.array([[x, y, 0] for x in (0, 0.1, 0.3) for y in range(40)], float) * [1, 0.1, 1]),
    "mirrored circle": np.array([[np.cos(t), np.sin(t), 0] for t in 2 * np.pi * np.arange(6) / 6]),
    "not planar": RNG.normal(size=(70, 3)),
    "tilted": planar_array(8, 8, 0.1) @ np.linalg.qr(RNG.normal(size=(3, 3)))[0],
    "single": np.array([[0.2, 0.1, 0.0]]),
    "coinciding": np.array([[0.2, 0, 0], [0.2, 0, 0], [-0.2, 0, 0], [-0.2, 0, 0.0]]),
}


@pytest.mark.parametrize("size", [(14, 31), (9, 24)])
@pytest.mark.parametrize("name", ARRAYS)
def test_spectrum_is_the_plain_sum(name: str, size: tuple[int, int]):
    elements = ARRAYS[name]
    h = RNG.normal(size=(3, 2, len(elements))) + 1j * RNG.normal(size=(3, 2, len(elements)))
    expected = np.abs(
        h @ array_response(elements, pixel_directions(*size), FREQUENCY_HZ).conj().reshape(-1, len(elements)).T
    )
    largest = np.abs(h).sum(axis=-1).max()
    found = bartlett_spectrum(h, elements, FREQUENCY_HZ, *size)
    np.testing.assert_allclose(found, expected.reshape(3, 2, *size), rtol=0, atol=ROUNDING * largest)
    # In chunks of directions and of transmitters, with tables that are kept and with tables made for each chunk.
    flat = h.reshape(6, -1)
    for kept in (0, TABLE_BYTES):
        chunked = Beams(elements, FREQUENCY_HZ, *size, table_bytes=kept)
        parts = chunked.magnitude(flat, directions=50, chunk_size=8 * 2 * 16 * 50)
        np.testing.assert_allclose(parts, expected.reshape(6, *size), rtol=0, atol=ROUNDING * largest)


@pytest.mark.parametrize("factor", [0.0, 1e-200, 1e200])
def test_spectrum_scales_with_signals_of_any_size(factor: float):
    elements = ARRAYS["regular"]
    h = RNG.normal(size=16) + 1j * RNG.normal(size=16)
    expected = factor * bartlett_spectrum(h, elements, FREQUENCY_HZ, *SIZE)
    np.testing.assert_allclose(bartlett_spectrum(factor * h, elements, FREQUENCY_HZ, *SIZE), expected, rtol=ROUNDING)


def test_no_signals_have_no_spectra():
    assert bartlett_spectrum(np.zeros((0, 16)), ARRAYS["regular"], FREQUENCY_HZ, *SIZE).shape == (0, *SIZE)


def test_tables_of_few_arrays_are_kept():
    """Of one grid more than are kept, the last ones stay."""
    array = planar_array(8, 8, 0.01)
    found = [beams(array, FREQUENCY_HZ, 10, width) for width in range(20, 22 + 2 * KEPT_ARRAYS, 2)]
    assert beams(array, FREQUENCY_HZ, 10, 24) is found[2]
    assert beams(array, FREQUENCY_HZ, 10, 20) is not found[0]


def test_large_tables_are_not_kept():
    assert Beams(planar_array(4, 4, 0.1), FREQUENCY_HZ, *SIZE, table_bytes=1000).size == 0
    assert Beams(planar_array(4, 4, 0.1), FREQUENCY_HZ, 9, 24).size == 8 * 16 * 9 * 24 // 2


def test_mirror_order_of_a_line():
    assert mirror_order([[0], [1], [2.0]]).tolist() == [2, 1, 0]
    assert mirror_order([[0], [1], [2.1]]) is None
