"""Observations of instruments are the same for NumPy and Dr.Jit arrays."""

import mitsuba as mi
import numpy as np
import pytest

from wrf_mi.receivers.scaling import LEAST_POWER, SILENCE, arrives, minmax_scale, scaled, strength_db

EXACT = 1e-12  # A few operations in float64
POWER = np.array([0.0, SILENCE, 1.01 * SILENCE, 1e-15, 1e-3])
FLOOR = 1e-12


def test_strength_is_the_floor_up_to_silence_or_nan_without_a_floor() -> None:
    expected = 10 * np.log10([FLOOR, FLOOR, 1.01 * SILENCE + LEAST_POWER, 1e-15 + LEAST_POWER, 1e-3 + LEAST_POWER])
    of_numpy = strength_db(POWER, FLOOR, LEAST_POWER)
    np.testing.assert_allclose(of_numpy, expected, rtol=EXACT)
    np.testing.assert_allclose(strength_db(mi.Float64(POWER), FLOOR, LEAST_POWER).numpy(), of_numpy, rtol=EXACT)
    assert arrives(of_numpy, FLOOR).tolist() == [False, False, True, True, True]
    assert np.isnan(strength_db(POWER)).tolist() == [True, False, False, False, False]


@pytest.mark.parametrize("shape", [(2, 3, 5), (1, 1, 1)])
def test_scaling_of_numpy_and_drjit_images_agree(shape: tuple[int, int, int]) -> None:
    images = np.random.default_rng(0).uniform(2, 5, shape)
    images[0] = 1.5  # without contrast
    flat = scaled(mi.Float64(images.ravel()), shape[1] * shape[2]).numpy()
    np.testing.assert_allclose(flat.reshape(shape), minmax_scale(images), atol=EXACT)
    grey_images = np.array([[[1.0, 3], [2, 5]], [[7, 7], [7, 7]]])
    np.testing.assert_allclose(minmax_scale(grey_images), [[[0.0, 0.5], [0.25, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
