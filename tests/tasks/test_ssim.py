"""Structural similarity and the spectrum loss against scikit-image and finite differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from changed_folders import DATA, needs
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import on_device, to_float
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import InputError
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.losses import spectrum_loss, ssim
from wrf_mi.tasks.spectrum import SCORED_TOGETHER

LARGEST = 1e15  # largest pixel whose fourth power does not overflow float32
SINGLE = 1e-5  # required of the float32 form on every image
DOUBLE = 1e-12  # float64 sums of 49 pixels and at most 32,400 windows
DIFFERENCES = 1e-6
"""Relative; central differences of step 1e-5 in float64 leave about (1e-5)^2 times the third derivative / C2."""


def reference(prediction, truth):
    return np.array([structural_similarity(t, p, data_range=1.0) for p, t in zip(prediction, truth, strict=True)])


def ours(prediction, truth, float_type=None):
    float_type = float_type or mi.Float
    return np.array(ssim(on_device(prediction, float_type), on_device(truth, float_type), *prediction.shape))


def test_many_images_are_scored_in_parts():
    rng = np.random.default_rng(2)
    prediction, truth = rng.random((2, 2 * SCORED_TOGETHER + 3, 9, 12), np.float32)
    assert TASKS["spectrum"].training_score(prediction, truth) == pytest.approx(
        reference(prediction, truth), abs=SINGLE
    )
    assert TASKS["spectrum"].training_score(prediction[:0], truth[:0]).shape == (0,)


def smooth(rng, shape):
    b, h, w = shape
    row, column = np.mgrid[:h, :w]
    f = rng.uniform(0.01, 0.1, (b, 2, 1, 1))
    return 0.5 + 0.5 * np.sin(f[:, 0] * row + f[:, 1] * column + rng.uniform(0, 6, (b, 1, 1)))


def pairs(shape):
    """Image pairs by name: easy ones, and flat, dark and bright ones where float32 cancels."""
    rng = np.random.default_rng(1)
    noise, flat = rng.random(shape), np.ones(shape)
    return {
        "random": (noise, rng.random(shape)),
        "smooth": (smooth(rng, shape), smooth(rng, shape)),
        "near": (smooth(rng, shape), smooth(rng, shape) * 0.5 + 0.01 * noise),
        "constant": (0.3 * flat, 0.7 * flat),
        "same": (noise, noise),
        "dark flat": (0.02 + 1e-4 * noise, 0.02 + 1e-4 * rng.random(shape)),
        "bright flat": (0.98 + 1e-3 * noise, 0.98 + 1e-3 * rng.random(shape)),
        "zero": (0 * flat, noise),
        "beyond the range": (3 * noise - 1, rng.random(shape)),
        "nearly flat": (0.5 + 1e-6 * noise, 0.4 + 1e-6 * rng.random(shape)),
        "of 0 to 1000": (1e3 * noise, 1e3 * rng.random(shape)),
        "of 0 to 1e15": (LARGEST * noise, rng.random(shape)),
    }


@pytest.mark.parametrize("name", pairs((1, 7, 7)))
@pytest.mark.parametrize("shape", [(3, 20, 33), (1, 90, 360), (2, 7, 7)])
def test_equals_scikit_image(name, shape):
    prediction, truth = pairs(shape)[name]
    expected = reference(prediction, truth)
    assert ours(prediction, truth) == pytest.approx(expected, abs=SINGLE)
    assert ours(prediction, truth, Float64) == pytest.approx(expected, abs=DOUBLE)


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from([7, 11]), st.sampled_from([7, 12]), st.floats(0, 1), st.floats(1e-4, 1), st.integers(0, 2**32 - 1)
)
def test_equals_scikit_image_at_any_level_and_contrast(height, width, level, contrast, seed):
    rng = np.random.default_rng(seed)
    prediction = level + contrast * rng.random((2, height, width))
    truth = level + contrast * rng.random((2, height, width))
    assert ours(prediction, truth) == pytest.approx(reference(prediction, truth), abs=SINGLE)


@needs("rfid-lab")
def test_equals_scikit_image_on_real_spectra():
    folder = DATA / "rfid-lab" / "spectrum"
    images = np.stack([np.asarray(Image.open(folder / f"{i:05d}.png"), float) / 255 for i in range(1, 11)])
    truth = np.roll(images, 1, axis=0)
    assert ours(images, truth) == pytest.approx(reference(images, truth), abs=SINGLE)


def loss_of(prediction, truth, eta=0.2):
    batch, height, width = prediction.shape
    loss, _ = spectrum_loss(Float64(prediction.ravel()), Float64(truth.ravel()), batch, height, width, eta)
    return loss[0]


@pytest.mark.gradcheck
@pytest.mark.parametrize("eta", [0.2, 1.0])
@pytest.mark.parametrize("shape", [(2, 9, 14), (1, 7, 7)])
def test_gradient_equals_finite_differences(shape, eta):
    rng, step = np.random.default_rng(2), 1e-5
    prediction, truth = rng.random(shape), rng.random(shape)
    variable = Float64(prediction.ravel())
    dr.enable_grad(variable)
    loss, _ = spectrum_loss(variable, Float64(truth.ravel()), *(*shape, eta))
    dr.backward(loss)
    expected = np.zeros(shape)
    for index in np.ndindex(shape):
        nudge = np.zeros(shape)
        nudge[index] = step
        high, low = loss_of(prediction + nudge, truth, eta), loss_of(prediction - nudge, truth, eta)
        expected[index] = (high - low) / (2 * step)
    gradient = np.array(dr.grad(variable)).reshape(shape)
    assert gradient == pytest.approx(expected, abs=DIFFERENCES * np.abs(expected).max())


@pytest.mark.gradcheck
def test_forward_and_reverse_derivatives_of_each_image_agree():
    shape, rng = (3, 12, 10), np.random.default_rng(3)
    truth, direction = Float64(rng.random(np.prod(shape))), rng.standard_normal(np.prod(shape))
    weights, variable = np.array([1.0, -2.0, 0.5]), Float64(rng.random(np.prod(shape)))
    dr.enable_grad(variable)
    dr.set_grad(variable, Float64(direction))
    similarity = ssim(variable, truth, *shape)
    dr.forward_to(similarity)
    forward = np.array(dr.grad(similarity)) @ weights
    variable = dr.detach(variable)
    dr.enable_grad(variable)
    dr.backward(dr.sum(ssim(variable, truth, *shape) * Float64(weights)))
    assert np.array(dr.grad(variable)) @ direction == pytest.approx(forward, rel=DOUBLE * 1e2)


@pytest.mark.parametrize("eta", [0.2, 1.0])
@pytest.mark.parametrize("name", pairs((1, 7, 7)))
def test_loss_and_gradient_of_float32_are_those_of_float64(name, eta):
    """Single precision must not drown the gradient where the variances are small."""
    shape, values, gradients = (1, 16, 16), [], []
    prediction, truth = (image.astype(np.float32) for image in pairs(shape)[name])
    for float_type in (mi.Float, Float64):
        variable = on_device(prediction, float_type)
        dr.enable_grad(variable)
        loss = spectrum_loss(variable, on_device(truth, float_type), *shape, eta)[0]
        dr.backward(loss)
        values.append(dr.detach(loss)[0])
        gradients.append(np.array(dr.grad(variable)))
    assert values[0] == pytest.approx(values[1], rel=SINGLE, abs=SINGLE)
    # Derivatives by 1,000 times less than those of the mean absolute error do not matter.
    least = 1e-3 / np.sqrt(np.prod(shape))
    assert np.linalg.norm(gradients[0] - gradients[1]) < 1e-3 * max(np.linalg.norm(gradients[1]), least)


def test_loss_equals_its_formula():
    shape, rng = (2, 10, 11), np.random.default_rng(4)
    prediction, truth = rng.random(shape), rng.random(shape)
    error, light = np.abs(prediction - truth), truth - truth.min(axis=(1, 2), keepdims=True)
    by_light = (light * error).sum(axis=(1, 2)) / light.sum(axis=(1, 2))
    difference = (error.mean() + by_light.mean()) / 2
    expected = 0.8 * difference + 0.2 * (1 - reference(prediction, truth).mean())
    assert loss_of(prediction, truth) == pytest.approx(expected, abs=DOUBLE)
    _, similarity = spectrum_loss(Float64(prediction.ravel()), Float64(truth.ravel()), *shape)
    assert np.array(similarity) == pytest.approx(reference(prediction, truth), abs=DOUBLE)


def test_loss_of_spectra_without_light_is_that_of_their_pixels():
    prediction, truth = np.full((1, 8, 9), 0.3), np.full((1, 8, 9), 0.1)
    expected = 0.8 * 0.5 * 0.2 + 0.2 * (1 - reference(prediction, truth).mean())
    assert loss_of(prediction, truth) == pytest.approx(expected, abs=DOUBLE)


def test_frozen_loss_equals_plain_loss():
    shape = (2, 12, 13)

    def step(prediction, stack, choice):
        i = dr.arange(mi.UInt32, int(np.prod(shape)))
        truth = dr.gather(mi.Float, stack, choice * (12 * 13) + i)
        variable = mi.Float(prediction)
        dr.enable_grad(variable)
        loss, _ = spectrum_loss(variable, truth, *shape)
        dr.backward(loss)
        return loss, dr.grad(variable)

    frozen = dr.freeze(step)
    rng = np.random.default_rng(5)
    stack = to_float(rng.random(4 * 12 * 13))
    for k in range(3):
        prediction = to_float(rng.random(np.prod(shape)))
        choice = dr.opaque(mi.UInt32, k)
        for a, b in zip(frozen(prediction, stack, choice), step(prediction, stack, choice), strict=True):
            assert np.array(a) == pytest.approx(np.array(b), rel=1e-6)


def test_small_images_and_arrays_of_another_size_or_type_are_refused():
    small = dr.zeros(mi.Float, 120)
    for truth, shape, message in (
        (small, (1, 6, 20), "at least 7 x 7"),
        (small, (1, 20, 6), "at least 7 x 7"),
        (dr.zeros(mi.Float, 99), (1, 10, 10), "truth has 99 values"),
        (dr.zeros(Float64, 100), (1, 10, 10), "convert"),
    ):
        with pytest.raises(InputError, match=message):
            ssim(dr.zeros(mi.Float, int(np.prod(shape))), truth, *shape)
