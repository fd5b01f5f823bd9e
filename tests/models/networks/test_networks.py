"""Convolutions, the march along rays and the training of networks, against NumPy and finite differences."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.core import InputError
from wrf_mi.core.settings import with_settings
from wrf_mi.core.stored import from_arrays, to_arrays
from wrf_mi.estimators.networks.dcgan import (
    NORM_FLOOR,
    BatchShape,
    Convolution,
    InstanceNorm,
    coarser,
    finer,
    patches,
    resized,
    softplus,
)
from wrf_mi.estimators.networks.layers import Coordinates, Module
from wrf_mi.estimators.networks.nerf2_march import LEAK, Nerf2Network, Networks, constant_parts, look, march
from wrf_mi.estimators.networks.training import Network, NetworkSettings, NetworkTrainer
from wrf_mi.estimators.networks.vae import Vae, VaeSettings, elbo_loss, normal_divergence, pooled
from wrf_mi.tasks.conditions import channels_from, normalised_uplink
from wrf_mi.training.adam import NumericsError

pytestmark = pytest.mark.all_threads

EXACT = 1e-12  # some hundred float64 products of numbers around one

DIFFERENCE, GRADIENT_TOLERANCE = 1e-6, 1e-7
"""Step of central differences in float64, whose error is about its square plus 1e-16 / 1e-6, and ten times that error,
for derivatives around one."""


def doubles(values: np.ndarray) -> Any:
    """A float64 tensor."""
    return to_tensor(values, mi.Float64)


def assert_gradients(function: Callable[[list[Any]], Any], arrays: list[np.ndarray], rng: np.random.Generator) -> None:
    """Reverse derivatives of a scalar function of tensors equal central differences along random directions."""
    tensors = [doubles(a) for a in arrays]
    dr.enable_grad(tensors)
    dr.backward(function(tensors))
    for i, array in enumerate(arrays):
        direction = rng.standard_normal(array.shape)
        ahead, behind = (
            function([doubles(a + step * direction if k == i else a) for k, a in enumerate(arrays)])[0]
            for step in (DIFFERENCE, -DIFFERENCE)
        )
        slope = float(np.sum(dr.grad(tensors[i]).numpy() * direction))
        difference = (ahead - behind) / (2 * DIFFERENCE)
        assert slope == pytest.approx(difference, rel=GRADIENT_TOLERANCE, abs=GRADIENT_TOLERANCE)


def weighted(x: Any, weights: np.ndarray) -> Any:
    """A scalar with a different derivative by each element."""
    return dr.sum(x.array * doubles(weights).array)


@pytest.mark.gradcheck
@pytest.mark.parametrize("side", [2, 3])
def test_convolution_equals_its_sum_over_neighbours_and_has_its_gradient(side: int):
    """Outside are zeros above and below, and the columns of the other side at each."""
    rng = np.random.default_rng(0)
    c, out, b, h, w = 3, 2, 2, 4, 5
    images, kernel = rng.standard_normal((c, b, h, w)), rng.standard_normal((out, side, side, c))
    bias = np.array([[0.5], [-1]])
    wide = np.concatenate([images[..., -1:], images, images[..., :1]], axis=-1)
    wide, expected = np.pad(wide, [(0, 0), (0, 0), (1, 1), (0, 0)]), np.zeros((out, b, h, w))
    for down in range(side):
        for right in range(side):
            part = wide[:, :, down : down + h, right : right + w]
            expected += np.einsum("oc,cbhw->obhw", kernel[:, down, right], part)
    state = {"hidden": doubles(kernel.reshape(out, -1)), "bias": doubles(bias)}
    grid, flat = BatchShape(b, h, w), images.reshape(c, -1)
    result = Convolution(c, side, out, rng).with_state(state)(doubles(flat), grid)
    np.testing.assert_allclose(result.numpy(), expected.reshape(out, -1) + bias, atol=EXACT)
    weights = rng.standard_normal((side * side * c, grid.columns))
    assert_gradients(lambda x: weighted(patches(x[0], grid, side), weights), [flat], rng)


def test_finer_and_coarser_undo_each_other():
    rng = np.random.default_rng(2)
    grid = BatchShape(2, 3, 4)
    x = rng.standard_normal((8, grid.columns))
    fine, fine_grid = finer(doubles(x), grid)
    assert (fine_grid.height, fine_grid.width) == (6, 8)
    # Channel 1 of the four at position (1, 0): a row below, the same column.
    part = x.reshape(2, 2, 2, 2, 3, 4)[1, 0, 1]
    np.testing.assert_array_equal(fine.numpy().reshape(2, 2, 6, 8)[1, :, 1::2, 0::2], part)
    back, back_grid = coarser(fine, fine_grid)
    assert back_grid == grid
    np.testing.assert_array_equal(back.numpy(), x)


@pytest.mark.gradcheck
def test_gradients_of_layouts_and_normalisation():
    rng = np.random.default_rng(3)
    grid = BatchShape(2, 2, 4)
    x, scale, bias = (rng.standard_normal(shape) for shape in ((4, grid.columns), (4, 1), (4, 1)))
    weights = rng.standard_normal((1, 2 * 3 * 5))

    def function(tensors: list[Any]) -> Any:
        y = InstanceNorm(4).with_state({"scale": tensors[1], "bias": tensors[2]})(tensors[0], grid)
        y, fine = finer(y, grid)
        cut, _ = resized(y, fine, 3, 5)
        y, _ = coarser(y, fine)
        return weighted(cut, weights) + dr.sum(y.array * y.array * y.array)

    assert_gradients(function, [x, scale, bias], rng)
    norm = InstanceNorm(4).with_state({"scale": doubles(scale * 0 + 1), "bias": doubles(bias * 0)})
    each = x.reshape(4, 2, -1)
    expected = (each - each.mean(-1, keepdims=True)) / np.sqrt(each.var(-1, keepdims=True) + NORM_FLOOR)
    np.testing.assert_allclose(norm(doubles(x), grid).numpy().reshape(each.shape), expected, atol=EXACT)
    padded, grid = resized(doubles(np.ones((1, 4))), BatchShape(1, 2, 2), 3, 3)
    np.testing.assert_array_equal(padded.numpy().reshape(3, 3), [[1, 1, 0], [1, 1, 0], [0, 0, 0]])
    assert grid.pixels == 9


def test_coordinates_are_centred_and_stored():
    frame = Coordinates.of([[0, 0, 1], [2, 0, 1]])
    again = from_arrays(Coordinates, to_arrays(frame))
    features = again.features([[2, 0, 1]], octaves=1, scale_m=2.0).numpy()[:, 0]
    # A unit of plain coordinate; a half turn in two units of scale is 1 m.
    np.testing.assert_allclose(features, [1, 0, 0, 1, 0, 0, 0, 1, 1], atol=1e-6)


SMALL = Networks(layers=3, width=6, skip=1, point_octaves=1, view_octaves=1)
FREQUENCIES_HZ = np.array([9.0e8, 9.1e8])
SAMPLES, FAR_M = 3, 1.5


def network(rng: np.random.Generator) -> Nerf2Network:
    return Nerf2Network(SMALL, 2, len(FREQUENCIES_HZ), 1, rng)


def small_march(seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:
    """Weights, rays (directions, origin, constants) and conditions of two transmitters."""
    rng = np.random.default_rng(seed)
    weights = {k: v.astype(float) for k, v in network(rng).state().items() if k != "offset"}
    for name in weights:
        if name.endswith("bias"):
            weights[name] += rng.standard_normal(weights[name].shape) * 0.3
    directions = rng.standard_normal((3, 4))
    constants = constant_parts(2.0, 0.0, FAR_M, SAMPLES, FREQUENCIES_HZ)
    rays = {**constants, "origin": np.array([[0.2], [-0.2], [0.1]])}
    rays["direction"] = directions / np.linalg.norm(directions, axis=0)
    return weights, rays, rng.standard_normal((2, 2))


def marched(weights: dict[str, Any], rays: dict[str, np.ndarray], condition: np.ndarray) -> Any:
    module = network(np.random.default_rng(0)).with_state(weights | {"offset": None})
    views = look(module, {name: doubles(values) for name, values in rays.items()})
    return march(module, views, doubles(condition), SAMPLES)


def twin_of_march(w: dict[str, np.ndarray], rays: dict[str, np.ndarray], condition: np.ndarray) -> np.ndarray:
    """The sum along each ray, point by point, with the networks on concatenated inputs: [outputs, batch, rays]."""

    def relu(x: np.ndarray) -> np.ndarray:
        return np.maximum(x, 0)

    def encoded(p: np.ndarray, extent: float) -> np.ndarray:
        return np.concatenate([p / extent, np.sin(np.pi * p), np.cos(np.pi * p)])

    def strength(x: np.ndarray) -> np.ndarray:
        return np.where(x > 0, x, -LEAK * x)

    def phase(x: np.ndarray) -> np.ndarray:
        return 2 * np.pi / (1 + np.exp(-x))

    cell, k = FAR_M / SAMPLES, 2 * np.pi * FREQUENCIES_HZ / 299792458.0
    total = np.zeros((2, condition.shape[1], 4), complex)
    for ray in range(4):
        u = rays["direction"][:, ray]
        lost = np.zeros(2, complex)
        for s in range(SAMPLES):
            r = (s + 0.5) * cell
            x = encoded(np.array([0.2, -0.2, 0.1]) + r * u, 2.0)
            h = relu(w["attenuation.0.point"] @ x + w["attenuation.0.bias"][:, 0])
            h = relu(w["attenuation.1.hidden"] @ h + w["attenuation.1.point"] @ x + w["attenuation.1.bias"][:, 0])
            h = relu(w["attenuation.2.hidden"] @ h + w["attenuation.2.bias"][:, 0])
            a = w["attenuation.out.hidden"] @ h + w["attenuation.out.bias"][:, 0]
            feature = w["feature.hidden"] @ h + w["feature.bias"][:, 0]
            for b in range(condition.shape[1]):
                y = w["radiance.0.feature"] @ feature + w["radiance.0.view"] @ encoded(u, 1.0)
                y = relu(y + w["radiance.0.condition"] @ condition[:, b] + w["radiance.0.bias"][:, 0])
                y = relu(w["radiance.1.hidden"] @ y + w["radiance.1.bias"][:, 0])
                y = w["radiance.out.hidden"] @ y + w["radiance.out.bias"][:, 0]
                sent = strength(y[:2]) * np.exp(1j * phase(y[2:]))
                total[:, b, ray] += sent * cell / r * np.exp(-1j * k * r) * np.exp(-lost)
            lost += (strength(a[:2]) + 1j * phase(a[2:])) * cell
    return total


@pytest.mark.gradcheck
def test_march_equals_its_sum_point_by_point_and_has_its_gradient():
    """By every weight of both networks; kinks are further off than the step for this seed."""
    weights, rays, condition = small_march(5)
    re, im = marched({k: doubles(v) for k, v in weights.items()}, rays, condition)
    expected = twin_of_march(weights, rays, condition)
    np.testing.assert_allclose((re.numpy() + 1j * im.numpy()).reshape(expected.shape), expected, atol=EXACT)
    rng = np.random.default_rng(6)
    by_re, by_im = rng.standard_normal((2, 2 * 2 * 4))

    def function(tensors: list[Any]) -> Any:
        re, im = marched(dict(zip(weights, tensors, strict=True)), rays, condition)
        return dr.sum(re * doubles(by_re).array + im * doubles(by_im).array)

    assert_gradients(function, list(weights.values()), rng)


def test_normalisation_of_uplinks_is_undone_for_channels():
    rng = np.random.default_rng(7)
    uplink = rng.standard_normal((3, 2, 5)) + 1j * rng.standard_normal((3, 2, 5))
    features, divisor = normalised_uplink(uplink)
    turned = uplink * 3e-6 * np.exp(2j)
    np.testing.assert_allclose(normalised_uplink(turned)[0], features, atol=1e-6)
    np.testing.assert_allclose(channels_from(features, divisor, uplink.shape), uplink, atol=1e-6)
    assert np.square(features).sum(axis=1) == pytest.approx(5, rel=1e-6)
    with pytest.raises(InputError, match="row 1, antenna 0"):
        normalised_uplink(np.where(np.arange(3)[:, None, None] == 1, 0, uplink))


VAE = VaeSettings(latent=2, width=5, last=5, octaves=0)  # of four cells, three coordinates and six pixels


@pytest.mark.gradcheck
def test_gradients_of_the_evidence_bound():
    rng = np.random.default_rng(8)
    vae = Vae(VAE, 4, (2, 3), rng)
    weights = {path: rng.standard_normal(weight.shape) for path, weight in vae.state().items()}
    data = {name: doubles(rng.uniform(size=(n, 3))) for name, n in {"cells": 4, "where": 3, "pixels": 6}.items()}
    inputs = {"rows": mi.UInt32([2, 0])} | {name: doubles(rng.standard_normal((2, 2))) for name in ("noise", "prior")}

    def function(tensors: list[Any]) -> Any:
        return elbo_loss(vae.with_state(dict(zip(weights, tensors, strict=True))), data, inputs, VAE.latent)

    assert_gradients(function, list(weights.values()), rng)


def test_divergence_softplus_and_means_over_blocks_equal_their_formulas():
    """KL(N(m, v) || N(0, 1)) = (m^2 + v - 1 - log v) / 2."""
    divergence = normal_divergence(doubles(np.array([[0.7]])), doubles(np.log([[0.25]]))).array[0]
    assert divergence == pytest.approx((0.49 + 0.25 - 1 - np.log(0.25)) / 2, abs=EXACT)
    x = np.array([-800.0, -1, 0, 2, 800])
    np.testing.assert_allclose(softplus(doubles(x)).numpy(), np.logaddexp(0, x), atol=EXACT)
    image = np.arange(24.0).reshape(1, 4, 6)
    np.testing.assert_array_equal(pooled(image, 3)[0], image.reshape(2, 2, 3, 2).mean(axis=(1, 3)).ravel())


class Numbers(Module):
    """Numbers that start at zero."""

    def __init__(self, count: int) -> None:
        self.bias: Any = np.zeros(count, np.float32)


def quadratic(numbers: Numbers, data: Any, given: Any) -> Any:
    """Squared distance from some numbers, plus ``given``, which may not be finite."""
    return dr.sum(dr.square(numbers.bias.array - data)) + given


def trainer_of(goal: list[float], draw: Any, score: Any = None, *settings: str) -> NetworkTrainer:
    """Numbers that start at 0 and are to reach ``goal``; of samples 0 to 9 the last two validate."""
    rows = [np.arange(8)], [np.arange(10)]
    network = Network("x", Numbers(len(goal)), quadratic, to_float(goal), draw, *rows, score, "distance")
    steps = ("optimiser.warm_up=1", "optimiser.ema_decay=0", "log_every=1000", *settings)
    return NetworkTrainer(network, with_settings(NetworkSettings(), steps), (0,))


def test_a_non_finite_step_keeps_the_weights_and_is_reported():
    def draw(rows: Any, receiver: int, rng: np.random.Generator) -> Any:
        return dr.opaque(mi.Float, np.nan if trainer.state.step == 99 else 0.0)

    trainer = trainer_of([3, -2], draw, None, "steps=200", "optimiser.network=0.1")
    trainer.run(stop=lambda: trainer.state.step == 99)
    before = trainer.state.params()["bias"], trainer.state.mean_params()["bias"]
    np.testing.assert_allclose(before[1], [3, -2], atol=0.1)
    with pytest.raises(NumericsError, match=r"^step 100: not finite: loss"):
        trainer.run()
    np.testing.assert_array_equal(trainer.state.params()["bias"], before[0])
    np.testing.assert_array_equal(trainer.state.mean_params()["bias"], before[1])


def test_training_goes_on_from_the_best_validation_score_with_all_rows():
    """The validation score is best after a quarter of the steps; the last steps use all rows."""
    drawn = []

    def draw(rows: Any, receiver: int, rng: np.random.Generator) -> Any:
        drawn.append(int(rows.max()))
        return dr.opaque(mi.Float, 0)

    def score(numbers: Numbers) -> float:
        return abs(float(numbers.bias.numpy()[0]) - 1.0)

    settings = ("steps=120", "batch=8", "optimiser.network=0.05", f"holdout_steps_fraction={80 / 120}")
    trainer = trainer_of([4], draw, score, *settings, "validate_every=20")
    assert trainer.run()
    # Adam moves by about its rate a step: 1 after 20 steps.
    assert trainer.state.chosen == 20
    assert trainer.state.best_score == pytest.approx(0, abs=0.1)
    assert drawn[:80] == [7] * 80
    assert len(drawn) == 80 + 10, "as many more as led there, in proportion"
    assert max(drawn[80:]) == 9
    assert 1.1 < trainer.state.mean_params()["bias"][0] < 1.6


def test_loop_settings_out_of_range_are_refused():
    for wrong in ("steps=0", "optimiser.ema_decay=1", "holdout_steps_fraction=1.5", "validate_every=0", "batch=0"):
        with pytest.raises(InputError, match=r"^setting .* is out of range, choose"):
            with_settings(NetworkSettings(), [wrong])
