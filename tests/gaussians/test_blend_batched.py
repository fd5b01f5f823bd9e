"""Batched blending of transmitters that share one geometry against blending with repeated geometry."""

from typing import Any

import drjit as dr
import numpy as np
import pytest
from made_fields import SIZE, Float64

from wrf_mi.core import Receiver
from wrf_mi.gaussians import Encoding, Factorised, Gaussians, WrfGs, WrfGsPlus, random_gaussians, tiles
from wrf_mi.gaussians.blend import GROUP, group_size, splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

pytestmark = pytest.mark.all_threads

Tensor64 = dr.tensor_t(Float64)
TOLERANCE = 1e-12
"""Float64 sums of 60 Gaussians, and of as many pixels, in another order."""
RECEIVER = Receiver("gateway1", np.array([5.0, 0.3, 0.0]), np.array([0.0, 0.6, 0.0, 0.8]))
ENCODING = Encoding(2, 4.0, 2, 1.0)
FIELDS: dict[str, Any] = {
    "wrf-gs": WrfGs(ENCODING, layers=2, width=16, signal_widths=(16, 8)),
    "wrf-gs+": WrfGsPlus(ENCODING, layers=2, width=16, skip=1, static_geometry=True),
    "factorised": Factorised(ENCODING, terms=4, layers=1, width=16),
}


def drawn(name: str, batch: int) -> tuple[dict[str, Any], Any]:
    rng = np.random.default_rng(0)
    weights = FIELDS[name].init(random_gaussians([RECEIVER], 60, rng, size_deg=12.0), rng)
    weights["rotation"] = rng.standard_normal(weights["rotation"].shape)
    weights["log_scale"] = weights["log_scale"] + rng.normal(0, 0.3, weights["log_scale"].shape)
    params = {key: Tensor64(np.asarray(value, float)) for key, value in weights.items()}
    return params, Tensor64(rng.standard_normal((3, batch)))


@pytest.mark.gradcheck
@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("batch", [2, 5, 8])
def test_shared_geometry_equals_repeated_geometry(name, batch):
    """Spectra, and derivatives by every parameter; batches of half a group, of a prime number, of two groups."""
    plane, rng = perception_plane(*SIZE, Float64), np.random.default_rng(3)
    weight = [Float64(rng.standard_normal(batch * plane.pixels)) for _ in range(2)]
    images, slopes = [], []
    for repeated in (False, True):
        params, tx_pos = drawn(name, batch)
        dr.enable_grad(params)
        gaussians: Gaussians = FIELDS[name].gaussians(params, tx_pos)
        assert gaussians.shared
        gaussians = gaussians.spread() if repeated else gaussians
        assert gaussians.shared != repeated
        re, im = splat(gaussians, device_pose(RECEIVER, Float64), plane)
        dr.backward(dr.sum(re * weight[0] + im * weight[1]))
        images.append(np.concatenate([re.numpy(), im.numpy()]))
        slopes.append({key: dr.grad(p).numpy().copy() for key, p in params.items()})
    np.testing.assert_allclose(*images, atol=TOLERANCE * np.abs(images[1]).max())
    for key, expected in slopes[1].items():
        np.testing.assert_allclose(slopes[0][key], expected, atol=TOLERANCE * np.abs(expected).max(), err_msg=key)
        assert expected.any(), key


def test_counted_lists_give_the_same_image(monkeypatch):
    """Counted lists of large fields serve all groups of transmitters."""
    plane, images = perception_plane(*SIZE, Float64), []
    params, tx_pos = drawn("factorised", 8)
    gaussians = FIELDS["factorised"].gaussians(params, tx_pos)
    for reserved in (tiles.RESERVED, 1):
        monkeypatch.setattr(tiles, "RESERVED", reserved)
        images.append(splat(gaussians, device_pose(RECEIVER, Float64), plane)[0].numpy())
    np.testing.assert_array_equal(*images)
    assert images[0].any()


def test_group_size_divides_the_batch():
    sizes = [group_size(batch) for batch in range(1, 13)]
    assert sizes == [1, 2, 3, 4, 1, 3, 1, 4, 3, 2, 1, 4]
    assert max(sizes) == GROUP
