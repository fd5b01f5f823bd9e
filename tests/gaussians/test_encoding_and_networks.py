"""Positional encoding against its closed form, and the two fields' networks against the paper's description."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import expit

from wrf_mi.backend.device import to_tensor
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Receiver
from wrf_mi.gaussians import FIELDS, Encoding, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.network import dense, dense_of_pairs, encode, encoded_size, init_layer, linear, unambiguous_scale

FLOAT64_TOLERANCE = 1e-9
"""Ten octaves of a coordinate up to 100 m: sin(2^9 pi 100) in NumPy itself is good to 160,000 * 2e-16 = 4e-11."""
FLOAT32_TOLERANCE = 1e-6
"""A turn in float32, |t| <= 1/2, is exact once whole turns are off; what is left is the rounding of 2 pi t and sine."""
PRODUCT_TOLERANCE = 1e-12
"""Float64 sums of 143 terms in another order."""
SPREAD_TOLERANCE = 0.05
"""Deviation of 8,000 or more drawn weights: its own relative deviation is below 1 %."""

RECEIVER = Receiver("gateway1", np.array([5.0, 0.3, 0.0]), np.array([0.0, 0.6, 0.0, 0.8]))


def doubles(values: np.ndarray) -> Any:
    return to_tensor(values, Float64)


def paper_encoding(t: np.ndarray, octaves: int) -> np.ndarray:
    """gamma(t) of the paper for coordinates [3, n] in float64: all sines, then all cosines."""
    angle = np.concatenate([2.0**k * np.pi * t for k in range(octaves)])
    return np.concatenate([np.sin(angle), np.cos(angle)])


@settings(deadline=None, max_examples=12)
@given(
    arrays(np.float64, st.tuples(st.just(3), st.integers(1, 9)), elements=st.floats(-100, 100)),
    st.integers(1, 10),
    st.floats(0.1, 20),
)
def test_encoding_matches_the_formula_of_the_paper(points, octaves, scale_m):
    encoded = encode(doubles(points), octaves, scale_m).numpy()
    assert encoded.shape == (encoded_size(octaves), points.shape[1])
    # The tolerance grows with the number of turns, whose rounding NumPy's sine sees.
    expected = paper_encoding(points / scale_m, octaves)
    np.testing.assert_allclose(encoded, expected, atol=FLOAT64_TOLERANCE * max(1.0, 1.0 / scale_m))


@settings(deadline=None, max_examples=12)
@given(
    arrays(np.float64, 3, elements=st.floats(0, 60)),
    arrays(np.float64, 3, elements=st.floats(-100, 100)),
    st.integers(0, 2),
    st.integers(1, 10),
)
def test_unambiguous_scale_separates_all_positions(extent_m, origin_m, axis, octaves):
    """Two of a room's positions a multiple of two metres apart are one at 1 m a unit, whatever the octaves."""
    twins = np.stack([origin_m, origin_m])
    twins[1, axis] += 2.0 * np.floor(extent_m[axis] / 2.0)
    scale = unambiguous_scale(np.stack([origin_m, origin_m + extent_m]), 1.0)
    alike, apart = (np.ptp(encode(doubles(twins.T), octaves, unit).numpy(), axis=1).max() for unit in (1.0, scale))
    assert alike < FLOAT64_TOLERANCE
    # Here no period is longer than 64 m, of which twins are 1/32 apart or more: a chord of 2 sin(pi / 32), or 1/sqrt(2)
    # of it in the sine or the cosine.
    assert apart > np.sqrt(2) * np.sin(np.pi / 32) * 0.99 or extent_m[axis] < 2.0
    assert scale == 1.0 or scale <= extent_m.max()


def test_encoding_in_float32_is_accurate_at_large_distances():
    """At 100 m the tenth octave has 25,600 whole turns: taken off exactly, they cost no digit."""
    points = np.float32(np.random.default_rng(0).uniform(90, 100, (3, 500)))
    encoded = encode(to_tensor(points), 10, 1.0).numpy()
    np.testing.assert_allclose(encoded, paper_encoding(points.astype(float), 10), atol=FLOAT32_TOLERANCE)
    assert encode(to_tensor(points), 0, 1.0).shape == (0, 500)


@pytest.mark.gradcheck
def test_gradient_of_the_encoding():
    """Removing whole turns leaves the derivative as it is: d sin(2^k pi x / s) / dx = 2^k pi / s cos."""
    x = np.random.default_rng(1).uniform(-5, 5, (3, 7))
    points = doubles(x)
    dr.enable_grad(points)
    dr.backward(dr.sum(encode(points, 4, 2.0).array))
    angle = np.pi / 2 * np.multiply.outer(2.0 ** np.arange(4), x)
    expected = (2.0 ** np.arange(4)[:, None, None] * np.pi / 2 * (np.cos(angle) - np.sin(angle))).sum(0)
    np.testing.assert_allclose(dr.grad(points).numpy(), expected, rtol=FLOAT64_TOLERANCE)


def test_position_encoding_does_not_move_gaussians():
    points = doubles(np.ones((3, 2)))
    dr.enable_grad(points)
    assert not dr.grad_enabled(Encoding().position(points))
    assert dr.grad_enabled(Encoding().transmitter(points))


def draw_layer(inputs: dict[str, int], outputs: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    rng = np.random.default_rng(5)
    weights = {key: value.astype(float) for key, value in init_layer("layer", inputs, outputs, rng).items()}
    weights["layer.bias"] = rng.standard_normal((outputs, 1))
    return weights, {key: doubles(value) for key, value in weights.items()}


@pytest.mark.parametrize("with_hidden", [False, True])
def test_layer_in_parts_equals_layer_of_the_concatenation(with_hidden):
    sizes = {"position": 60, "transmitter": 60} | ({"hidden": 23} if with_hidden else {})
    weights, params = draw_layer(sizes, 11)
    n, batch, rng = 5, 3, np.random.default_rng(6)
    x, y, h = rng.random((60, n)), rng.random((60, batch)), rng.random((23, batch * n))
    hidden = doubles(h) if with_hidden else None
    out = dense_of_pairs(params, "layer", {"position": doubles(x)}, {"transmitter": doubles(y)}, hidden).numpy()
    matrix = np.concatenate([weights[f"layer.{part}"] for part in sizes], axis=1)
    pairs = np.concatenate([np.tile(x, batch), np.repeat(y, n, axis=1), *([h] if with_hidden else [])])
    np.testing.assert_allclose(out, np.maximum(matrix @ pairs + weights["layer.bias"], 0), rtol=PRODUCT_TOLERANCE)


def test_linear_and_dense():
    weights, params = draw_layer({"hidden": 9}, 4)
    x = np.random.default_rng(7).standard_normal((9, 6))
    out = linear(params, "layer", doubles(x)).numpy()
    np.testing.assert_allclose(out, weights["layer.hidden"] @ x + weights["layer.bias"], rtol=PRODUCT_TOLERANCE)
    np.testing.assert_array_equal(dense(params, "layer", doubles(x)).numpy(), np.maximum(out, 0))


@pytest.mark.gradcheck
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("with_hidden", [False, True])
def test_gradient_of_a_hidden_layer_matches_its_parts(batch, with_hidden):
    """The derivative that sums rows against the one of Dr.Jit, of the same sum written out."""
    n, rng = 5, np.random.default_rng(11)
    _, params = draw_layer({"position": 4, "transmitter": 3} | ({"hidden": 2} if with_hidden else {}), 7)
    x, y, h = (doubles(rng.standard_normal(shape)) for shape in ((4, n), (3, batch), (2, batch * n)))
    inputs = {**params, "x": x, "y": y} | ({"h": h} if with_hidden else {})
    weight = doubles(rng.standard_normal((7, batch * n)))

    def slopes(layer: Callable[[], Any]) -> list[np.ndarray]:
        dr.enable_grad(inputs)
        dr.clear_grad(inputs)
        dr.backward(dr.sum(layer() * weight))
        return [dr.grad(p).numpy().copy() for p in inputs.values()]

    def written_out() -> Any:
        of_gaussians: Any = dr.reshape(params["layer.position"] @ x, (7, 1, n))
        of_transmitters: Any = dr.reshape(params["layer.transmitter"] @ y + params["layer.bias"], (7, batch, 1))
        total: Any = dr.reshape(of_gaussians + of_transmitters, (7, batch * n))
        return dr.maximum(total + params["layer.hidden"] @ h if with_hidden else total, 0)

    hidden = h if with_hidden else None
    fused = slopes(lambda: dense_of_pairs(params, "layer", {"position": x}, {"transmitter": y}, hidden))
    for ours, expected in zip(fused, slopes(written_out), strict=True):
        assert np.abs(expected).max() > 0
        np.testing.assert_allclose(ours, expected, rtol=PRODUCT_TOLERANCE, atol=PRODUCT_TOLERANCE)


def test_initial_weights_have_the_deviation_of_he_et_al():
    """Normal weights of deviation sqrt(2 / inputs), the inputs of all parts together; zero bias."""
    weights = init_layer("layer", {"hidden": 256, "position": 60, "transmitter": 60}, 256, np.random.default_rng(8))
    for part in ("hidden", "position", "transmitter"):
        assert weights[f"layer.{part}"].std() == pytest.approx(np.sqrt(2 / 376), rel=SPREAD_TOLERANCE)
    assert not weights["layer.bias"].any()


def start(model: Any, n: int = 20, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return model.init(random_gaussians([RECEIVER], n, rng), rng)


PAPER_LAYERS = {
    "wrf-gs": {"attenuation.0.position": (128, 60), "attenuation.delta.hidden": (2, 128)}
    | {f"attenuation.{i}.hidden": (128, 128) for i in range(1, 8)}
    | {"signal.0.feature": (128, 128), "signal.0.transmitter": (128, 60)}
    | {"signal.1.hidden": (64, 128), "signal.out.hidden": (2, 64)},
    "wrf-gs+": {f"deform.{i}.hidden": (256, 256) for i in range(1, 8)}
    | {f"deform.{i}.{part}": (256, 60) for i in (0, 4) for part in ("position", "transmitter")}
    | {f"deform.{head}.hidden": (rows, 256) for head, rows in (("signal", 2), ("rotation", 4), ("scale", 3))},
}
"""Section IV-B: eight layers of 128 see the centre; 128 and 64 see features and transmitter (L = 9: 60 each).
Section V-A: eight layers of 256, the input again at the fifth; three heads without activation."""


@pytest.mark.parametrize("model", PAPER_LAYERS)
def test_fields_have_the_layers_of_the_paper(model):
    weights = start(FIELDS[model]())
    shapes = {name: values.shape for name, values in weights.items() if "." in name and "bias" not in name}
    assert shapes == PAPER_LAYERS[model]
    assert set(FIELDS[model]().per_gaussian) == {name for name in weights if "." not in name}


@pytest.mark.parametrize("model", FIELDS)
def test_every_weight_has_a_bias_and_a_gradient(model):
    """No matrix is left out of the network: each one's gradient differs from zero."""
    field, weights = FIELDS[model](), start(FIELDS[model](), seed=3)
    layers = {name.rsplit(".", 1)[0] for name in weights if "." in name}
    assert {f"{layer}.bias" for layer in layers} <= set(weights)
    params = {name: doubles(values.astype(float)) for name, values in weights.items()}
    dr.enable_grad(params)
    g = field.gaussians(params, doubles(np.random.default_rng(4).standard_normal((3, 2))))
    outputs = [*g.position, *g.scale, *g.rotation, *g.signal, *(g.attenuation or [g.opacity])]
    rng = np.random.default_rng(2)
    dr.backward(sum(dr.sum(a * Float64(rng.standard_normal(dr.width(a)))) for a in outputs))
    assert [name for name, p in params.items() if not dr.grad(p).numpy().any()] == []


def reference_network(weights: dict[str, np.ndarray], parts: dict[str, np.ndarray]) -> dict[str, Any]:
    """WRF-GS+'s deformation network as the paper words it, on concatenated inputs."""
    hidden = np.empty(0)
    for i in range(8):
        inputs = ({"hidden": hidden} if i else {}) | (parts if i in (0, 4) else {})
        matrix = np.concatenate([weights[f"deform.{i}.{part}"] for part in inputs], axis=1)
        hidden = np.maximum(matrix @ np.concatenate(list(inputs.values())) + weights[f"deform.{i}.bias"], 0)
    heads = ("signal", "rotation", "scale")
    return {head: weights[f"deform.{head}.hidden"] @ hidden + weights[f"deform.{head}.bias"] for head in heads}


def test_wrf_gs_plus_adds_offsets_of_its_network():
    """Signal = static + offset; rotation likewise before it is normalised; scale in its logarithm, bounded."""
    field, n, batch = WrfGsPlus(width=40), 3, 2
    weights = {name: values.astype(float) for name, values in start(field, n).items()}
    tx = np.random.default_rng(9).standard_normal((3, batch))
    g = field.gaussians({k: doubles(v) for k, v in weights.items()}, doubles(tx))
    position, transmitter = paper_encoding(weights["position"], 10), paper_encoding(tx, 10)
    pairs = {"position": np.tile(position, batch), "transmitter": np.repeat(transmitter, n, axis=1)}
    offsets = reference_network(weights, pairs)
    offsets["scale"] = offsets["scale"] / np.sqrt(1 + offsets["scale"] ** 2)
    for name, static, rows in (
        ("signal", "signal", g.signal),
        ("rotation", "rotation", g.rotation),
        ("scale", "log_scale", [dr.log(s) for s in g.scale]),
    ):
        expected = np.tile(weights[static], batch) + offsets[name]
        np.testing.assert_allclose(np.array(rows), expected, atol=1e-8, err_msg=name)
    np.testing.assert_allclose(g.opacity.numpy(), np.tile(expit(weights["opacity"][0]), batch), rtol=PRODUCT_TOLERANCE)


def test_attenuation_stays_below_one():
    """Complex delta, |delta| < 1 whatever the network says, nearly transparent at the start, free in phase."""
    field, weights = WrfGs(), start(WrfGs(), 200)

    def delta(head_gain: float, tensor: Any = doubles) -> np.ndarray:
        gained = weights | {"attenuation.delta.hidden": weights["attenuation.delta.hidden"] * np.float32(head_gain)}
        params = {k: tensor(v.astype(float)) for k, v in gained.items()}
        re, im = field.gaussians(params, tensor(np.zeros((3, 1)))).attenuation
        return re.numpy() + 1j * im.numpy()

    # z = 2 where the network says nothing: 2 / sqrt(5).
    np.testing.assert_allclose(delta(0.0), 2 / np.sqrt(5), rtol=PRODUCT_TOLERANCE)
    wild = np.concatenate([delta(300.0), delta(-300.0)])
    assert (np.abs(wild) < 1).all()
    assert np.abs(wild).max() > 0.99
    for part in (wild.real, wild.imag):
        assert part.min() < 0 < part.max()
    assert np.abs(delta(300.0, mi.TensorXf)).max() < 1 + FLOAT32_TOLERANCE


@pytest.mark.parametrize("model", FIELDS)
def test_signals_are_signed(model):
    """Real and imaginary parts of either sign: nothing clamps what is to interfere."""
    weights = start(FIELDS[model](), 100)
    params = {k: to_tensor(v) for k, v in weights.items()}
    for part in FIELDS[model]().gaussians(params, to_tensor(np.zeros((3, 1), np.float32))).signal:
        assert part.numpy().min() < 0 < part.numpy().max()


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+"])
def test_field_without_transmitter_octaves_is_constant(model):
    """Zero octaves leave the transmitter out: all its positions see the same field."""
    field = FIELDS[model](encoding=Encoding(tx_octaves=0))
    params = {k: to_tensor(v) for k, v in start(field, 5).items()}
    assert not any("transmitter" in name for name in params)
    g = field.gaussians(params, to_tensor(np.random.default_rng(1).random((3, 2)).astype(np.float32)))
    for part in g.signal:
        np.testing.assert_array_equal(part.numpy()[:5], part.numpy()[5:])
