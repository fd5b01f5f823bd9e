"""Density control between two steps."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit
from scipy.stats import kstest

from wrf_mi.backend.device import to_float
from wrf_mi.core import rotation_matrix
from wrf_mi.gaussians.initial import LEAST_OPACITY, RESET_OPACITY, SPLIT_SHRINK, DensityChange, adapt, reset_opacity
from wrf_mi.training.loop import FitState

FLOAT32_EPS = 1e-6
"""Relative rounding of one or two float32 operations, with room."""
SMALLEST_P = 1e-3
"""Level of the tests on drawn samples. The seeds are fixed: a pass stays a pass."""


def random_parameters(n: int, seed: int = 0, opacity: bool = True, **log_scale: Any) -> dict[str, np.ndarray]:
    rng, rows = np.random.default_rng(seed), {"position": 3, "log_scale": 3, "rotation": 4, "signal": 2}
    parameters = {name: rng.standard_normal((count, n)) for name, count in rows.items()}
    parameters["log_scale"] = parameters["log_scale"] / 2 - 2  # some are cloned and some split
    if opacity:
        parameters["opacity"] = rng.uniform(-3, 3, (1, n))
    return {name: values.astype(np.float32) for name, values in (parameters | log_scale).items()}


def one_round(parameters: dict[str, np.ndarray], view_gradient_norm: Any, **changes: Any) -> DensityChange:
    n = parameters["position"].shape[1]
    arguments = {"distance_m": np.ones(n), "rng": np.random.default_rng(1), "max_gaussians": 10 * n}
    return adapt(parameters, np.asarray(view_gradient_norm, float), **({"growth_fraction": 0.25} | arguments | changes))


def counts(change: DensityChange, n: int) -> tuple[int, int, int]:
    """Numbers of cloned, split and removed Gaussians: both parts of a split one are fresh, one of a clone is."""
    alive = len(np.unique(change.source))
    grown, fresh = len(change.source) - alive, int(change.fresh.sum())
    return 2 * grown - fresh, fresh - grown, n - alive


def test_small_gaussians_are_cloned_and_large_ones_split():
    log_scale = np.full((3, 8), np.log(0.01))
    log_scale[1, 5] = np.log(0.5)  # one axis is enough
    parameters = random_parameters(8, log_scale=log_scale)
    change = one_round(parameters, [1, 9, 2, 3, 4, 8, 5, 6])
    assert counts(change, 8) == (1, 1, 0)
    # The two largest gradients, 1 and 5, have copies behind the old ones.
    np.testing.assert_array_equal(change.source, [0, 1, 2, 3, 4, 5, 6, 7, 1, 5])
    # The original of a clone is kept; both parts of a split Gaussian are new.
    np.testing.assert_array_equal(np.flatnonzero(change.fresh), [5, 8, 9])
    for name, values in change.parameters.items():
        for part, old in ((1, 1), (8, 1), (5, 5), (9, 5)):
            before, after = parameters[name][:, old].astype(float), values[:, part].astype(float)
            if name == "opacity":  # two of these let through what one of the old let through
                np.testing.assert_allclose((1 - expit(after)) ** 2, 1 - expit(before), rtol=FLOAT32_EPS)
            elif name == "position" and old == 5:
                assert not np.array_equal(after, before)
            elif name == "log_scale" and old == 5:
                np.testing.assert_allclose(np.exp(before - after), SPLIT_SHRINK, rtol=FLOAT32_EPS)
            else:
                np.testing.assert_array_equal(after, before)


def test_angular_size_decides_between_clone_and_split():
    """The same Gaussian is split near the receiver and cloned far from it."""
    parameters = random_parameters(2, log_scale=np.full((3, 2), np.log(0.2)))
    change = one_round(parameters, [1.0, 1.0], distance_m=np.array([1.0, 10.0]), growth_fraction=1.0)
    assert counts(change, 2) == (1, 1, 0)
    np.testing.assert_array_equal(np.flatnonzero(change.fresh), [0, 2, 3])


def test_split_positions_are_drawn_from_the_gaussian():
    """In the Gaussian's own axes the parts lie as its density: each coordinate over its scale is standard normal."""
    scales = np.array([0.3, 1.0, 3.0])
    parameters = random_parameters(400, log_scale=np.log(scales)[:, None] + np.zeros(400))
    change = one_round(parameters, np.ones(400), growth_fraction=1.0)
    assert counts(change, 400) == (0, 400, 0)
    shift = (change.parameters["position"] - parameters["position"][:, change.source]).T
    axes = rotation_matrix(parameters["rotation"][:, change.source].T)
    for coordinate in (np.einsum("nij,ni->nj", axes, shift) / scales).T:
        assert kstest(coordinate, "norm").pvalue > SMALLEST_P


def test_transparent_and_unseen_gaussians_are_pruned():
    parameters = random_parameters(5)
    parameters["opacity"][0] = [0, logit(LEAST_OPACITY) - 0.1, logit(LEAST_OPACITY) + 0.1, 0, 0]
    change = one_round(parameters, [1, 1, 1, 0, 1], growth_fraction=0.0)
    np.testing.assert_array_equal(change.source, [0, 2, 4])
    # Without opacities (product blending) only those that no pixel saw go.
    change = one_round(random_parameters(5, opacity=False), [1, 1, 1, 0, 1], growth_fraction=0.0)
    np.testing.assert_array_equal(change.source, [0, 1, 2, 4])


@pytest.mark.parametrize("opacity", [True, False])
def test_pruning_keeps_at_least_one_gaussian(opacity):
    parameters = random_parameters(4, opacity=opacity)
    if opacity:
        parameters["opacity"][0] = [-20, -19, -18, -19]
    change = one_round(parameters, np.zeros(4))
    assert change.parameters["position"].shape == (3, 1)
    assert change.source[0] == (2 if opacity else 0)


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 30), st.integers(1, 40), st.floats(0, 1), st.integers(0, 1000), st.booleans())
def test_invariants_of_a_density_round(n, max_gaussians, growth_fraction, seed, opacity):
    parameters = random_parameters(n, seed, opacity)
    before = {name: values.copy() for name, values in parameters.items()}
    rng = np.random.default_rng(seed)
    view_gradient_norm, distance = rng.uniform(0, 1, n) * rng.integers(0, 2, n), rng.uniform(0.5, 5, n)
    limits = {"max_gaussians": max_gaussians, "growth_fraction": growth_fraction}
    change = one_round(parameters, view_gradient_norm, distance_m=distance, **limits)
    count = len(change.source)
    assert count >= 1
    # Growth ends at the most; a field that is larger to begin with is not cut.
    cloned, split, pruned = counts(change, n)
    assert count <= max(max_gaussians, n - pruned)
    assert min(cloned, split) >= 0
    assert cloned + split <= round(growth_fraction * (n - pruned))
    for name, values in change.parameters.items():
        assert values.shape == (before[name].shape[0], count)
        assert values.dtype == np.float32
        np.testing.assert_array_equal(parameters[name], before[name])  # the old set is left as it was
        # What is left is as it was; only the opacity of a clone's original has changed.
        old = ~change.fresh
        if name == "opacity":
            old &= np.bincount(change.source, minlength=n)[change.source] == 1
        np.testing.assert_array_equal(values[:, old], before[name][:, change.source[old]])


def test_opacity_reset():
    before = np.float32([[-9.0, logit(RESET_OPACITY), 0.0, 5.0]])
    after = reset_opacity(before)
    np.testing.assert_allclose(after, [[-9.0, *[logit(RESET_OPACITY)] * 3]], rtol=FLOAT32_EPS)
    assert after.dtype == np.float32


def adam_step(state: FitState) -> None:
    dr.backward(sum(dr.sum(dr.square(p.array + 1)) for p in state.adam.values()))
    state.adam.step()


def trained_state(n: int) -> tuple[FitState, dict[str, np.ndarray]]:
    """A state after three steps with gradients that are not zero, a network's weight among its parameters."""
    log_scale = np.full((3, n), np.log(1e-3))
    log_scale[:, 4:5] = 0.0  # large enough to be split
    state = FitState({"net.bias": np.zeros((4, 1), np.float32)} | random_parameters(n, log_scale=log_scale))
    state.adam.set_learning_rate(0.1)
    for _ in range(3):
        adam_step(state)
    state.mean = {name: mi.TensorXf(values + 7) for name, values in state.params().items()}
    state.view_gradient_norm, state.view_gradient_steps = to_float(np.arange(n)), 3
    return state, state.params()


def test_density_round_keeps_momentum_of_old_gaussians():
    n = 6
    state, before = trained_state(n)
    first, second, count = state.moments()
    assert count == 3
    assert all(m.any() and v.any() for m, v in zip(first.values(), second.values(), strict=True))
    of_gaussians = {name: values for name, values in before.items() if name != "net.bias"}
    change = one_round(of_gaussians, [0, 1, 2, 3, 9, 8], growth_fraction=0.4)
    assert counts(change, n) == (1, 1, 1)
    mean = state.mean_params()
    state.change_density(change)
    assert state.gaussians == 7
    new_first, new_second, new_count = state.moments()
    new_mean = state.mean_params()
    assert new_count == 3  # Adam's bias correction goes on for all
    for name, values in change.parameters.items():
        np.testing.assert_array_equal(state.params()[name], values)
        for new, old in ((new_first, first), (new_second, second)):
            assert not new[name][:, change.fresh].any()
            np.testing.assert_array_equal(new[name][:, ~change.fresh], old[name][:, change.source[~change.fresh]])
        new = change.fresh.copy()
        if name == "opacity":  # that of the clone's original has changed with the clone's
            new |= np.bincount(change.source, minlength=n)[change.source] == 2
            assert new.sum() == change.fresh.sum() + 1
        np.testing.assert_array_equal(new_mean[name][:, new], values[:, new])
        np.testing.assert_array_equal(new_mean[name][:, ~new], mean[name][:, change.source[~new]])
    for new, old in ((new_first, first), (new_second, second), (state.params(), before), (new_mean, mean)):
        np.testing.assert_array_equal(new["net.bias"], old["net.bias"])
    assert state.view_gradient_steps == 0
    np.testing.assert_array_equal(state.view_gradient_norm.numpy(), np.zeros(7))


def test_training_step_works_after_a_density_round():
    state, _ = trained_state(5)
    parameters = state.params()
    of_gaussians = {name: parameters[name] for name in random_parameters(1)}
    state.change_density(one_round(of_gaussians, np.ones(5), growth_fraction=1.0))
    state.adam.set_learning_rate(0.1)
    before = state.params()
    adam_step(state)
    assert all((values != before[name]).all() for name, values in state.params().items())


def test_opacity_reset_clears_only_its_momentum():
    state, before = trained_state(5)  # opacity is the last parameter: the step count must not come from it
    first, _, _ = state.moments()
    state.set_param("opacity", reset_opacity(before["opacity"]))
    new_first, new_second, count = state.moments()
    assert count == 3
    assert not new_first["opacity"].any()
    assert not new_second["opacity"].any()
    np.testing.assert_array_equal(new_first["signal"], first["signal"])
    np.testing.assert_allclose(state.params()["opacity"].max(), logit(RESET_OPACITY), rtol=FLOAT32_EPS)
    assert {int(t[0]) for _, _, _, (t, _, _, _) in state.adam.state.values()} == {3}


def test_state_round_trips_through_arrays():
    state, _ = trained_state(4)
    arrays = state.arrays()
    again = FitState.from_arrays(arrays).arrays()
    assert set(again) == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)


def test_best_parameters_are_not_modified_later():
    """Dr.Jit gives memory of an array that is summed to in place to the next one of that size."""
    state, _ = trained_state(4)
    state.keep_best(1.0)
    for _ in range(3):
        state.view_gradient_norm += to_float(np.ones(4))
        dr.eval(state.view_gradient_norm)
    assert state.best is not None
    np.testing.assert_array_equal(state.best["view_gradient_norm"], np.arange(4))
