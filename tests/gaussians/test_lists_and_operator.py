"""Tile lists, their cut-off and pruning, and the sparse operator that they become."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_fields import BATCH, COUNT, POSE, RECEIVER, SIZE, device_gaussians, fields, oracle_image
from made_spectra import RECEIVERS, spectra_predictor, true_field
from made_spectra import SIZE as SPECTRUM_SIZE
from scipy.special import logit
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.backend.device import to_tensor
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import InputError, Receiver, unit_vectors
from wrf_mi.gaussians import FIELDS, Gaussians, random_gaussians, tiles
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.footprint import CUTOFF, depth_order, project, ranked_order
from wrf_mi.gaussians.initial import LEAST_OPACITY, adapt
from wrf_mi.gaussians.operator import BLOCK, PixelOperator, pixel_weights
from wrf_mi.gaussians.parameters import gaussians_in_parts
from wrf_mi.gaussians.tiles import TileLists, build_lists, perception_plane
from wrf_mi.training import evaluator
from wrf_mi.training.step import device_pose

pytestmark = pytest.mark.all_threads
ROUNDING = 1e-5
"""Float32: matrix products add in another order for another number of columns; the same formula else."""


def gaussians(batch: int, count: int, size: float) -> Gaussians:
    rng, total = np.random.default_rng(3), batch * count
    position, rotation = rng.normal(0, 2, (3, count)), rng.normal(size=(4, total))
    signal = rng.normal(size=total) + 1j * rng.normal(size=total)
    arrays = {"position": position, "rotation": rotation, "signal": signal, "opacity": rng.uniform(0, 0.9, total)}
    return device_gaussians(mi.Float, batch, scale=np.full((3, total), size), **arrays)


def members(lists: TileLists, n: int) -> list[list[int]]:
    index, length = lists.index.numpy(), lists.length.numpy()
    start = lists.begin(dr.arange(mi.UInt32, len(length)), n).numpy()
    return [index[a : a + b].tolist() for a, b in zip(start, length, strict=True)]


@pytest.mark.parametrize("size", [0.02, 0.4])
def test_counted_lists_equal_allocated_lists(monkeypatch, size):
    """A plane whose last tiles stick out, three transmitters, Gaussians below the horizon and across the seam."""
    batch, count, pose, plane = 3, 60, device_pose(RECEIVERS[0]), perception_plane(23, 61, mi.Float)
    field = gaussians(batch, count, size)
    footprints = project(field, pose)
    order = depth_order(footprints.depth, field.position)
    reserved = build_lists(footprints, order, plane, batch)
    monkeypatch.setattr(tiles, "RESERVED", 0)
    counted = build_lists(footprints, order, plane, batch)
    assert reserved.start is None
    assert counted.start is not None
    assert members(counted, count) == members(reserved, count)
    assert dr.width(counted.index) == int(counted.length.numpy().sum()) < dr.width(reserved.index)


def test_operator_is_the_same_with_counted_lists(monkeypatch):
    """Its strips are planes of a row of tiles each."""
    field, pose, plane = gaussians(1, 60, 0.3), device_pose(RECEIVERS[0]), perception_plane(23, 61, mi.Float)
    weights = pixel_weights(field, pose, plane).toarray()
    monkeypatch.setattr(tiles, "RESERVED", 0)
    np.testing.assert_array_equal(pixel_weights(field, pose, plane).toarray(), weights)
    assert weights.any()


def test_more_entries_than_32_bits_count_are_refused():
    """Refused before anything is reserved."""
    with pytest.raises(InputError, match="splatting: 4294967296 entries"):
        tiles.check_entries(2**32)
    assert tiles.check_entries(2**32 - 1) == 2**32 - 1


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+", "factorised"])
@pytest.mark.parametrize("batch", [1, 2])
def test_networks_in_chunks_equal_networks_at_once(model, batch):
    field, rng = FIELDS[model](), np.random.default_rng(0)
    weights = field.init(random_gaussians([RECEIVERS[0]], 23, rng), rng)
    params, tx = {name: to_tensor(values) for name, values in weights.items()}, to_tensor(rng.normal(size=(3, batch)))
    expected, parts = vars(field.gaussians(params, tx)), vars(gaussians_in_parts(field, params, tx, 7 * batch))
    assert parts["position"][0].numpy().shape == (23,)
    for name, values in expected.items():
        if name == "batch" or values is None:
            assert parts[name] == values
        else:
            np.testing.assert_allclose(np.array(parts[name]), np.array(values), rtol=ROUNDING, atol=ROUNDING)


def test_predictions_of_many_gaussians_equal_recorded_ones(monkeypatch):
    """Above a number of Gaussians nothing is recorded, networks run in chunks and lists are counted."""
    field, params = true_field("wrf-gs+")
    tx = np.random.default_rng(5).uniform(-1, 1, (3, 3))
    recorded = spectra_predictor(field, params, RECEIVERS, *SPECTRUM_SIZE)
    expected = recorded(tx)
    monkeypatch.setattr(evaluator, "CHUNK_SIZE", 1)
    monkeypatch.setattr(tiles, "RESERVED", 0)
    parts = spectra_predictor(field, params, RECEIVERS, *SPECTRUM_SIZE)
    np.testing.assert_allclose(parts(tx), expected, atol=ROUNDING)
    evaluators: tuple[Any, Any] = parts.evaluate, recorded.evaluate
    assert not evaluators[0].recordings
    assert all(recording.frozen.n_recordings > 0 for recording in evaluators[1].recordings.values())


GEOMETRY = ("position", "scale", "rotation")


def test_lists_hold_only_gaussians_near_the_tile():
    gaussians = fields(1)
    footprints = project(gaussians, POSE)
    order = depth_order(footprints.depth, gaussians.position)
    length = build_lists(footprints, order, perception_plane(*SIZE, Float64), BATCH).length
    assert length.numpy().mean() < 0.7 * COUNT


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32))
def test_cut_off_stays_within_its_bound(seed):
    """Footprints end at three standard deviations, where their weight is at most exp(-4.5) of the opacity.

    Removal of Gaussian i changes a pixel by w_i T_i (S_i - B_i), where the signal B_i of those behind is at most the
    largest |S|, as their weights add up to less than one.
    """
    gaussians, images = fields(seed), []
    with pytest.MonkeyPatch.context() as patch:
        for cutoff in (CUTOFF, 9.0):
            patch.setattr(oracle, "CUTOFF", cutoff)
            images.append(oracle_image(gaussians, RECEIVER, SIZE))
    strength = np.hypot(*(s.numpy()[:COUNT] for s in gaussians.signal))
    bound = np.exp(-0.5 * CUTOFF**2) * (gaussians.opacity.numpy()[:COUNT] * (strength + strength.max())).sum()
    assert 0 < np.abs(images[0] - images[1]).max() <= bound


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32))
def test_faint_gaussians_are_pruned_within_the_bound_of_their_opacities(seed):
    """The bound is that of the cut-off with the whole weight of each pruned Gaussian, at most its opacity."""
    gaussians, ones = fields(seed), np.ones(COUNT)
    opacity = 10.0 ** np.random.default_rng(seed).uniform(-4, 0, COUNT)
    geometry = {name: np.stack([p.numpy()[:COUNT] for p in getattr(gaussians, name)]) for name in GEOMETRY}
    parameters = geometry | {"log_scale": np.log(geometry["scale"]), "opacity": logit(opacity[None])}
    kept_indices = adapt(parameters, ones, ones, np.random.default_rng(0), 0.0, COUNT).source
    pruned = np.setdiff1d(np.arange(COUNT), kept_indices)
    assert len(pruned) == (opacity < LEAST_OPACITY).sum()
    strength = np.hypot(*(s.numpy()[:COUNT] for s in gaussians.signal))
    bound = (opacity[pruned] * (strength[pruned] + strength.max())).sum()
    every, few = (
        oracle_image(gaussians, RECEIVER, SIZE, n, opacity=opacity[n]) for n in (np.arange(COUNT), kept_indices)
    )
    assert 0 < np.abs(every - few).max() <= bound


@given(st.integers(1, 40), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_counted_order_is_the_sorted_one(count, seed):
    """With ties in all keys; the GPU counts where a function is recorded."""
    rng = np.random.default_rng(seed)
    depth, *position = (Float64(rng.integers(0, 3, count).astype(float)) for _ in range(4))
    np.testing.assert_array_equal(ranked_order([depth, *position]).numpy(), depth_order(depth, position).numpy())


SINGLE = 1e-5
"""Relative L2 error in float32: the weights are the same numbers, a sum of some hundred terms in another order."""
DOUBLE = 1e-12
"""The same arithmetic in another order."""
ARRAY = Receiver("r", np.array([5.0, 0.26, 0]), np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602]))
SIZES = [(90, 360), (23, 61)]


def hard(product: bool, float_type: Any, n: int = 40, seed: int = 0) -> tuple[Gaussians, np.ndarray]:
    """Gaussians on the seam, on the zenith, below the horizon, around the receiver, needles, and others at random."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, n), np.arcsin(rng.uniform(-0.2, 1, n))
    distance, scale = rng.uniform(1, 8, n), rng.uniform(0.05, 0.6, (3, n))
    azimuth[:3], elevation[:3] = (0.0, 1e-4, 2 * np.pi - 0.01), (0.3, 0.0, 0.6)
    elevation[3:6] = np.pi / 2, 1.55, -0.1
    # The receiver inside: one that has no footprint, one that covers all in front of it.
    distance[6:8], scale[:, 7] = (0.03, 0.4), 3.0
    scale[:, 8] = 0.002, 0.002, 2.0
    position = ARRAY.position_m + (unit_vectors(azimuth, elevation) * distance[:, None]) @ ARRAY.to_world.T
    rotation = rng.standard_normal((4, n))
    signal = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    delta = np.sqrt(rng.uniform(0, 1, n)) * 0.99 * np.exp(1j * rng.uniform(-np.pi, np.pi, n))
    opacity = rng.uniform(0.01, 0.99, n)
    blending: dict[str, Any] = {"attenuation": delta} if product else {"opacity": opacity}
    arrays: dict[str, Any] = {"position": position.T, "scale": scale, "rotation": rotation, "signal": signal}
    return device_gaussians(float_type, **arrays, **blending), signal


def operator_of(gaussians: Gaussians, size: tuple[int, int], float_type: Any = mi.Float) -> PixelOperator:
    plane = perception_plane(*size, float_type)
    return PixelOperator(pixel_weights(gaussians, device_pose(ARRAY, float_type), plane), *size)


def splatted(gaussians: Gaussians, size: tuple[int, int], float_type: Any) -> np.ndarray:
    re, im = splat(gaussians, device_pose(ARRAY, float_type), perception_plane(*size, float_type))
    return re.numpy() + 1j * im.numpy()


def error(image: Any, expected: Any) -> float:
    return float(np.linalg.norm(np.asarray(image) - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("product", "floats", "kind"),
    [
        (True, mi.Float, np.complex64),
        (False, mi.Float, np.float32),
        (True, Float64, np.complex128),
        (False, Float64, np.float64),
    ],
)
def test_weights_times_signals_equal_blending(product, size, floats, kind):
    gaussians, signal = hard(product, floats)
    operator, direct = operator_of(gaussians, size, floats), splatted(gaussians, size, floats)
    assert operator.weights.dtype == kind
    tolerance = SINGLE if floats is mi.Float else DOUBLE
    assert error(operator.field(signal[None])[0], direct) < tolerance
    spectrum = operator.magnitude(np.stack([signal, 2 * signal]))
    assert error(spectrum[1].ravel(), 2 * np.abs(direct)) < tolerance


@pytest.mark.parametrize("product", [True, False])
def test_weights_match_the_oracle(product):
    gaussians, signal = hard(product, Float64)
    weights = operator_of(gaussians, (45, 120), Float64).weights
    assert error(weights @ signal, oracle_image(gaussians, ARRAY, (45, 120)).ravel()) < DOUBLE


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**31), st.booleans(), st.sampled_from([(1, 1), (1, 40), (12, 1), (5, 23)]))
def test_any_field_and_size(seed, product, size):
    gaussians, signal = hard(product, Float64, n=12, seed=seed)
    weights, direct = operator_of(gaussians, size, Float64).weights, splatted(gaussians, size, Float64)
    np.testing.assert_allclose(weights @ signal, direct, atol=1e-12 * np.abs(signal).sum())


def test_operator_without_visible_gaussians_is_zero():
    """Far below the horizon: no weights, and dark."""
    gaussians, signal = hard(False, mi.Float)
    below = ARRAY.position_m - 90 * ARRAY.to_world[:, 2]
    gaussians.position = [mi.Float([float(c)] * 40) for c in below]
    operator = operator_of(gaussians, SIZES[1])
    assert operator.weights.nnz == 0
    assert not operator.magnitude(signal[None]).any()


@pytest.mark.parametrize("product", [True, False])
def test_no_gaussians(product):
    """All pruned: dark as well."""
    blending: dict[str, Any] = {"attenuation": np.zeros(0, complex)} if product else {"opacity": np.zeros(0)}
    rows: dict[str, Any] = {"position": np.zeros((3, 0)), "scale": np.zeros((3, 0)), "rotation": np.zeros((4, 0))}
    operator = operator_of(device_gaussians(mi.Float, signal=np.zeros(0, complex), **rows, **blending), SIZES[1])
    assert operator.weights.shape == (23 * 61, 0)
    assert not operator.magnitude(np.zeros((2, 0), np.complex64)).any()


def test_batches_and_factors():
    """More transmitters than a block, one by one and together, through factors and without; all linear."""
    operator, rng = operator_of(hard(True, mi.Float)[0], SIZES[1]), np.random.default_rng(1)
    factors, c = (
        (rng.standard_normal((n, 5)) + 1j * rng.standard_normal((n, 5))).astype(np.complex64)
        for n in (40, 2 * BLOCK + 3)
    )
    signals = c @ factors.T
    together = operator.magnitude(signals, dark=1e-3)
    alone = np.concatenate([operator.magnitude(row[None], dark=1e-3) for row in signals])
    assert error(together, alone) < SINGLE
    assert error(operator.composed(factors).magnitude(c, dark=1e-3), together) < SINGLE
    a, b = signals[:1], signals[1:2]
    mixed = operator.field(2 * a - 3j * b)
    assert error(mixed, 2 * operator.field(a) - 3j * operator.field(b)) < SINGLE


def test_operator_refuses_excess_memory_and_several_transmitters():
    gaussians, _ = hard(False, mi.Float)
    with pytest.raises(MemoryError, match="weights of 40 Gaussians take more than 0 MB"):
        pixel_weights(gaussians, device_pose(ARRAY, mi.Float), perception_plane(23, 61, mi.Float), 1000)
    gaussians.batch = 2
    with pytest.raises(ValueError, match="for 2 transmitters; give those of one"):
        operator_of(gaussians, SIZES[1])
