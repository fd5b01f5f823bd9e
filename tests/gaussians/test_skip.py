"""Skipped parts of predictions: each bound on the error holds, and each switch skips something."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_fields import BATCH, COUNT, POSE, RECEIVER, SIZE, Float64, fields, image

from wrf_mi.core.angles import pixel_directions
from wrf_mi.gaussians import oracle
from wrf_mi.gaussians.footprint import depth_order, project
from wrf_mi.gaussians.footprint_constants import CUTOFF
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.skip import Skip, negligible, signal_bounds
from wrf_mi.gaussians.tiles import build_lists, perception_plane

pytestmark = pytest.mark.all_threads

ROUNDING = 1e-12
"""Float64 sums of some tens of numbers near one."""


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32),
    st.booleans(),
    st.sampled_from([0.0, 1e-3, 0.03, 0.3]),
    st.sampled_from([0.0, 1e-3, 0.03, 0.3]),
)
def test_skips_stay_within_their_bounds(seed: int, product: bool, contribution: float, rest: float) -> None:
    gaussians = fields(seed, product)
    skip = Skip(contribution=contribution, early_stop_tolerance=rest)
    error = np.abs(image(gaussians, skip) - image(gaussians, Skip()))
    assert error.max() <= skip.error + ROUNDING


def walled(product: bool) -> tuple[Gaussians, Any]:
    """Gaussians whose nearer half covers the whole sphere, several times over, and which these are, [batch * n]."""
    gaussians = fields(3, product, 0.99, 0.999)
    depth = project(gaussians, POSE).depth
    n, far = gaussians.count, np.argsort(depth.numpy())[COUNT // 2 :]
    front = np.ones(BATCH * n, bool)
    for b in range(BATCH):
        front[b * n + far] = False
    wall = dr.mask_t(Float64)(front)
    gaussians.scale = [dr.select(wall, 40.0, s) for s in gaussians.scale]
    if product:
        assert gaussians.attenuation is not None
        gaussians.attenuation = [0.02 * d for d in gaussians.attenuation]
    return gaussians, wall


@pytest.mark.parametrize("product", [False, True])
def test_early_stop_evaluates_nothing_behind_an_opaque_wall(product: bool) -> None:
    """Opacities and attenuations that are not numbers do not reach the image from there."""
    gaussians, wall = walled(product)
    exact, early = image(gaussians, Skip()), image(gaussians, Skip(early_stop_tolerance=1e-3))
    assert 0 < np.abs(exact - early).max() <= 1e-3
    if product:
        assert gaussians.attenuation is not None
        gaussians.attenuation = [dr.select(wall, d, np.nan) for d in gaussians.attenuation]
    else:
        gaussians.opacity = dr.select(wall, gaussians.opacity, np.nan)
    assert np.isnan(image(gaussians, Skip())).all()
    np.testing.assert_array_equal(image(gaussians, Skip(early_stop_tolerance=1e-3)), early)


@pytest.mark.parametrize("product", [False, True])
@pytest.mark.parametrize("skip", [Skip(early_stop_tolerance=1e-3), Skip(contribution=1e-3)])
def test_skips_keep_signals_that_are_not_finite(product: bool, skip: Skip) -> None:
    """Their effect has no bound, so neither skip applies."""
    gaussians, wall = walled(product)
    gaussians.signal = [dr.select(wall, s, np.nan) for s in gaussians.signal]
    exact = np.isfinite(image(gaussians, Skip()))
    assert not exact.any()
    np.testing.assert_array_equal(np.isfinite(image(gaussians, skip)), exact)


def test_early_stop_refuses_gradients() -> None:
    gaussians = fields(0, False)
    dr.enable_grad(gaussians.signal)
    with pytest.raises(ValueError, match="give no gradients"):
        image(gaussians, Skip(early_stop_tolerance=1e-3))


@pytest.mark.parametrize("product", [False, True])
def test_negligible_gaussians_are_found(product: bool) -> None:
    """Gaussians that neither send nor hide are left out, however many; the others stay."""
    gaussians = fields(5, product)
    idle = np.arange(BATCH * COUNT) % 4 == 1
    mask = dr.mask_t(Float64)(idle)
    gaussians.signal = [dr.select(mask, 1e-6, s) for s in gaussians.signal]
    if product:
        assert gaussians.attenuation is not None
        gaussians.attenuation = [
            dr.select(mask, v, d) for v, d in zip((1 - 1e-6, 0), gaussians.attenuation, strict=True)
        ]
    else:
        gaussians.opacity = dr.select(mask, 1e-6, gaussians.opacity)
    footprints = project(gaussians, POSE)
    order = depth_order(footprints.depth, gaussians.position)
    _, beyond = signal_bounds(gaussians.signal, footprints.visible, order, BATCH, product)
    found = negligible(gaussians.signal, beyond, BATCH, 1e-3, gaussians.blending).numpy()
    assert found[idle].all()
    assert found[~idle].mean() < 0.2


def test_signal_bounds_match_numpy() -> None:
    gaussians = fields(6, False)
    footprints = project(gaussians, POSE)
    order = depth_order(footprints.depth, gaussians.position)
    strength = np.hypot(*(s.numpy() for s in gaussians.signal)) * footprints.visible.numpy()
    for product, reduce in ((False, np.max), (True, np.sum)):
        own, beyond = (a.numpy() for a in signal_bounds(gaussians.signal, footprints.visible, order, BATCH, product))
        for b in range(BATCH):
            there = b * COUNT + order.numpy()
            for k, i in enumerate(there):
                np.testing.assert_allclose(own[i], reduce(strength[there[k:]]), rtol=1e-9)
                np.testing.assert_allclose(beyond[i], reduce(np.append(strength[there[k + 1 :]], 0)), rtol=1e-9)


def test_lists_hold_only_gaussians_near_the_tile() -> None:
    gaussians = fields(1, False)
    footprints = project(gaussians, POSE)
    order = depth_order(footprints.depth, gaussians.position)
    length = build_lists(footprints, order, perception_plane(*SIZE, Float64), BATCH).length
    assert length.numpy().mean() < 0.7 * COUNT


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32))
def test_cut_off_stays_within_its_bound(seed: int) -> None:
    """Footprints end at three standard deviations, where their weight is at most exp(-4.5) of the opacity.

    Taking a weight away from a pixel changes it by less than weight * (|S| + M), `wrf_mi.gaussians.skip`.
    """
    gaussians, n = fields(seed, False), COUNT
    with pytest.MonkeyPatch.context() as patch:
        images = []
        for cutoff in (CUTOFF, 9.0):
            patch.setattr(oracle, "CUTOFF", cutoff)
            images.append(_oracle(gaussians))
    strength = np.hypot(*(s.numpy()[:n] for s in gaussians.signal))
    bound = np.exp(-0.5 * CUTOFF**2) * (gaussians.opacity.numpy()[:n] * (strength + strength.max())).sum()
    error = np.abs(images[0] - images[1]).max()
    assert 0 < error <= bound


def _oracle(gaussians: Any) -> np.ndarray:
    own = slice(0, COUNT)

    def stack(parts: list[Any]) -> np.ndarray:
        return np.stack([p.numpy()[own] for p in parts], axis=1)

    return oracle.render(
        stack(gaussians.position),
        stack(gaussians.scale),
        stack(gaussians.rotation),
        stack(gaussians.signal) @ np.array([1, 1j]),
        RECEIVER,
        pixel_directions(*SIZE),
        opacity=gaussians.opacity.numpy()[own],
    )
