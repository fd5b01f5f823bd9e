"""Arrays that are not ideal, patterns, headings and what an instrument stores, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_channel import made, receivers

from wrf_mi.core import InputError, pixel_directions, rotation_matrix, unit_vectors
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import Array, Pattern, array_response, element_signals, instrument_report
from wrf_mi.receivers.heading import bearing_harmonics, body_directions, relative_bearing_rad
from wrf_mi.receivers.physical_array import real_harmonics

FREQUENCY_HZ = 920e6
ELEMENTS = planar_array(3, 4, 0.16)
EXACT = 1e-12
"""Products of a few numbers of size one in float64."""

YAW = np.array([0, 0, np.sin(0.2), np.cos(0.2)])
"""By 0.4 rad about +z."""


def test_the_ideal_array_is_an_array_without_faults():
    u = pixel_directions(6, 20)
    ideal = Array(ELEMENTS, FREQUENCY_HZ)
    np.testing.assert_allclose(ideal.response(u), array_response(ELEMENTS, u, FREQUENCY_HZ), atol=EXACT)
    paths = made()
    expected = element_signals(paths, receivers(), ELEMENTS, FREQUENCY_HZ)
    np.testing.assert_allclose(ideal.of_paths(paths, receivers()), expected, rtol=1e-9)


def test_gains_pattern_and_mount_of_plane_waves():
    """A mount by 0.4 rad: a wave from azimuth 1 comes from 0.6 in the array's own frame."""
    gain = np.exp(1j * np.arange(12)) * np.linspace(0.5, 2, 12)
    array = Array(ELEMENTS, FREQUENCY_HZ, gain, Pattern(1.5), YAW)
    seen, own = unit_vectors([1.0, 2.0], [0.5, 1.2]), unit_vectors([0.6, 1.6], [0.5, 1.2])
    expected = array_response(ELEMENTS, own, FREQUENCY_HZ) * gain * (np.sin([0.5, 1.2]) ** 1.5)[:, None]
    np.testing.assert_allclose(array.response(seen), expected, atol=EXACT)
    amplitude = np.array([[1, 2j], [0, 1 + 1j]])
    np.testing.assert_allclose(array.signals(amplitude, seen), amplitude @ expected, atol=EXACT)
    np.testing.assert_allclose(array.power(expected), np.square(np.abs(expected)).mean(axis=1), atol=EXACT)
    # The processor knows nothing of it: its image is that of the ideal array.
    ideal = Array(ELEMENTS, FREQUENCY_HZ).image(expected, 9, 36)
    np.testing.assert_array_equal(array.image(expected, 9, 36), ideal)


def test_traced_paths_from_afar_are_plane_waves():
    """Unfolded lengths of 100 km and more: what is left of the near field is k p^2 / (2 d) = 1e-5 rad."""
    paths = made()
    far = replace(paths, length_m=paths.length_m + 1e5)
    poses = receivers()
    tilted = np.array([0.1, -0.3, 0.2, np.sqrt(1 - 0.14)])
    array = Array(ELEMENTS, FREQUENCY_HZ, np.linspace(1, 2, 12) * 1j, Pattern(2.0), tilted)
    found = array.of_paths(far, poses)
    expected = np.zeros_like(found)
    wavenumber = 2 * np.pi * FREQUENCY_HZ / 299792458
    for p in range(len(far)):
        local = poses[far.rx[p]].to_world.T @ far.arrival[p]
        wave = far.gain[p] * np.exp(-1j * wavenumber * far.length_m[p]) * array.response(local)
        expected[far.rx[p], far.tx[p]] += wave
    np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())


def test_cosine_pattern_and_harmonics():
    u = unit_vectors(0.3, [-0.5, 0.0, 0.7, np.pi / 2])
    np.testing.assert_allclose(Pattern(2.0)(u), [0, 0, np.sin(0.7) ** 2, 1], atol=EXACT)
    np.testing.assert_array_equal(Pattern()(u), np.ones(4))
    x, y, z = u.T
    first = np.sqrt(3 / (4 * np.pi)) * np.stack([-y, z, -x], axis=1)
    np.testing.assert_allclose(real_harmonics(u, 1)[:, 1:], first, atol=EXACT)
    a, b = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.0, -0.6])
    np.testing.assert_allclose(Pattern(coefficients=np.stack([a, b]))(u), np.exp(first @ (a + 1j * b)), atol=EXACT)


def test_instrument_stores_whole_levels_cut_off():
    image = np.array([[2.0, 3.0, 4.0], [2.5, 3.999, 2.001]])
    expected = np.array([[0, 127, 255], [63, 254, 0]]) / 255
    np.testing.assert_array_equal(instrument_report(image), expected)
    np.testing.assert_allclose(instrument_report(image, bits=None), (image - 2) / 2, atol=EXACT)
    random = np.random.default_rng(0).random((200, 5, 6)) * 10 ** np.random.default_rng(1).uniform(-9, 9, (200, 1, 1))
    stored = instrument_report(random) * 255
    np.testing.assert_allclose(stored, np.rint(stored), atol=1e-9)
    assert (stored.max(axis=(1, 2)) == 255).all()


def test_heading_turns_directions_into_the_devices_frame():
    """Heading +y: what leaves towards +y leaves straight ahead, and +x lies to the right."""
    np.testing.assert_allclose(body_directions([0, 1.0, 0], np.pi / 2), [1, 0, 0], atol=EXACT)
    np.testing.assert_allclose(body_directions([1.0, 0, 0], np.pi / 2), [0, -1, 0], atol=EXACT)
    u, heading = unit_vectors([0.1, 2.0], [0.3, -0.4]), np.array([1.1, -4.0])
    for own, psi, world in zip(body_directions(u, heading), heading, u, strict=True):
        turn = rotation_matrix([0, 0, np.sin(psi / 2), np.cos(psi / 2)])
        np.testing.assert_allclose(turn @ own, world, atol=EXACT)
    bearing = relative_bearing_rad([[1.0, 1, 5], [1, 1, 5]], [np.pi / 2, -3.0], [1, 4, 0])
    np.testing.assert_allclose(bearing, [0, np.pi / 2 + 3.0 - 2 * np.pi], atol=EXACT)
    np.testing.assert_allclose(bearing_harmonics([np.pi / 2], 2), [[0, -1, 1, 0]], atol=EXACT)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"elements_m": np.zeros((4, 2))}, "give finite"),
        ({"frequency_hz": 0.0}, "carrier"),
        ({"gain": np.ones(3)}, "a finite one for each of 12"),
        ({"mount_xyzw": np.array([0, 0, 0, 2.0])}, "length one"),
    ],
)
def test_arrays_that_are_none_are_refused(wrong: dict, message: str):
    with pytest.raises(InputError, match=message):
        Array(**({"elements_m": ELEMENTS, "frequency_hz": FREQUENCY_HZ} | wrong))
    with pytest.raises(InputError, match="exponent -1"):
        Pattern(-1.0)
    with pytest.raises(InputError, match="degree from 1"):
        Pattern(coefficients=np.zeros((2, 4)))
