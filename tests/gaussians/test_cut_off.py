"""Gaussians end at three standard deviations and are pruned where they are faint: short lists, a bounded error."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_fields import BATCH, COUNT, POSE, RECEIVER, SIZE, Float64, fields, oracle_image
from scipy.special import logit
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.gaussians.footprint import CUTOFF, depth_order, project, ranked_order
from wrf_mi.gaussians.initial import LEAST_OPACITY, adapt
from wrf_mi.gaussians.tiles import build_lists, perception_plane

pytestmark = pytest.mark.all_threads
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
    kept = adapt(parameters, ones, ones, np.random.default_rng(0), 0.0, COUNT).source
    pruned = np.setdiff1d(np.arange(COUNT), kept)
    assert len(pruned) == (opacity < LEAST_OPACITY).sum()
    strength = np.hypot(*(s.numpy()[:COUNT] for s in gaussians.signal))
    bound = (opacity[pruned] * (strength[pruned] + strength.max())).sum()
    every, few = (oracle_image(gaussians, RECEIVER, SIZE, n, opacity=opacity[n]) for n in (np.arange(COUNT), kept))
    assert 0 < np.abs(every - few).max() <= bound


@given(st.integers(1, 40), st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_counted_order_is_the_sorted_one(count, seed):
    """With ties in all keys; the GPU counts where a function is recorded."""
    rng = np.random.default_rng(seed)
    depth, *position = (Float64(rng.integers(0, 3, count).astype(float)) for _ in range(4))
    np.testing.assert_array_equal(ranked_order([depth, *position]).numpy(), depth_order(depth, position).numpy())
