"""Mitsuba integrator compared with splatting and with volprim_rf_basic."""

from contextlib import contextmanager
from functools import partial

import mitsuba as mi
import numpy as np
import pytest
from wrf_mi_bench import traced as bench_traced
from wrf_mi_bench.timing import Within, interleaved, ratio

from wrf_mi.backend.device import to_float

pytestmark = pytest.mark.all_threads


@pytest.mark.parametrize("seed", range(6))
def test_traced_equals_splatted_for_small_gaussians(seed):
    """Gaussians of up to 2 degrees and axes up to 2 : 1, one on the zenith, one on the seam; random poses."""
    for blending in bench_traced.BLENDINGS:
        gaussians, receiver = bench_traced.random_field(seed, blending)
        traced, splatted = (f(gaussians, receiver) for f in (bench_traced.traced, bench_traced.splatted))
        differences = bench_traced.difference(traced, splatted)
        assert differences["ssim"] >= bench_traced.LOWEST_SSIM
        assert differences["magnitude_error"] <= bench_traced.LARGEST_ERROR
        assert differences["complex_error"] <= bench_traced.LARGEST_ERROR


def test_difference_grows_with_the_order_of_the_neglected_terms():
    """The difference is of second order in the size of round Gaussians, of first order in that of others.

    Projection neglects the tilt against the line of sight, of first order in the size and zero for round Gaussians, and
    the extent in depth, of second order (`wrf_mi_plugins.ray_response`). The overlap is the same at both sizes.
    """
    errors = {}
    for size, count in ((1.0, 1000), (2.0, 300)):
        for axes in (1.0, 2.0):
            differences = bench_traced.against_splatted(2, size_deg=size, ratio=axes, count=count)
            errors[size, axes] = np.mean([each["complex_error"] for each in differences])
    # Pixels whose edge moved, by half the order more, are on both.
    assert errors[2.0, 1.0] / errors[1.0, 1.0] > 1.8
    assert 1.5 < errors[2.0, 2.0] / errors[1.0, 2.0] < 2.5
    assert errors[1.0, 2.0] > 2 * errors[1.0, 1.0]


@pytest.mark.slow
@pytest.mark.parametrize("size_deg", [1.0, 2.0])
def test_integrator_is_as_fast_as_volprim_rf_basic(size_deg):
    """10,000 Gaussians, 360 x 90 directions, hits found anew: not slower than ``volprim_rf_basic``.

    Updates of the scenes, in which Mitsuba builds its BVHs, do not count.
    """
    gaussians, receiver = bench_traced.random_field(0, "alpha", 10_000, size_deg, opacity=0.1)
    scene = bench_traced.scene_of(gaussians, receiver)
    params = mi.traverse(scene)
    data = params["gaussians.data"].numpy().copy()  # an update of the scene frees the memory
    stock = bench_traced.StockRenderer(receiver, 90, 360)
    stock.field(gaussians)

    @contextmanager
    def changed():
        params["gaussians.data"] = to_float(data)
        params.update()
        yield

    theirs = Within(stock.render, bench_traced.rgb_variant)
    times = interleaved({"ours": Within(partial(mi.render, scene), changed), "theirs": theirs}, 9, 1)
    assert ratio(times["theirs"], times["ours"]).value >= 1, times
