"""Footprints end at three standard deviations: lists of tiles are short, and the error has a bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_fields import BATCH, COUNT, POSE, RECEIVER, SIZE, Float64, fields

from wrf_mi.core.angles import pixel_directions
from wrf_mi.gaussians import oracle
from wrf_mi.gaussians.footprint import depth_order, project
from wrf_mi.gaussians.footprint_constants import CUTOFF
from wrf_mi.gaussians.tiles import build_lists, perception_plane

pytestmark = pytest.mark.all_threads


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

    Removal of Gaussian i changes a pixel by w_i T_i (S_i - B_i), where the signal B_i of those behind is at most the
    largest |S|, as their weights add up to less than one.
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
