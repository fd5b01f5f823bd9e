"""What `wrf-mi bench stress` runs at full size, here with a case or two of each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from wrf_mi.backend import init

init()

from wrf_mi.report import bench_stress, stress_fields  # noqa: E402
from wrf_mi.report.bench_stress import worst_of  # noqa: E402
from wrf_mi.report.stress_fields import HARD, Field, image, made, reference  # noqa: E402


@pytest.mark.parametrize("name", HARD)
def test_images_of_hard_fields(name: str) -> None:
    for seed in range(2):
        field = HARD[name](np.random.default_rng(seed))
        for blending in stress_fields.BLENDINGS:
            truth, clear = reference(field, blending, (30, 60))
            found = image(field, blending, (30, 60))
            assert np.isfinite(found).all()
            assert np.linalg.norm((found - truth)[clear]) <= bench_stress.IMAGE * np.linalg.norm(truth)
            assert clear.mean() > 0.9


def test_derivatives_of_hard_fields() -> None:
    names = ("each axis of 1e-6 to 1e3 m", "needles, 1e6 to 1", "exact ties in depth", "opacity 0, 1 and 1 - 1e-7")
    for row in bench_stress.gradients(1, names):
        worst, bound = worst_of(row)
        assert worst <= bound, row


def test_ties_are_ties_in_both() -> None:
    """Permuted and mirrored offsets have the same distance; which is in front is settled by position alone."""
    field = HARD["exact ties in depth"](np.random.default_rng(5))
    opaque = replace(field, opacity=np.ones(len(field.opacity)), scale_m=0 * field.scale_m + 0.5)
    truth, clear = reference(opaque, "alpha", (30, 60))
    assert len(np.unique(np.abs(truth[clear]).round(3))) > 10
    np.testing.assert_allclose(image(opaque, "alpha", (30, 60))[clear], truth[clear], atol=1e-5)


def test_an_image_of_nothing_is_dark() -> None:
    for blending in stress_fields.BLENDINGS:
        found = image(made(0, np.random.default_rng(0)), blending, (3, 5))
        assert found.shape == (3, 5)
        assert not found.any()


def test_one_pixel() -> None:
    for seed in range(5):
        field = made(40, np.random.default_rng(seed))
        for blending in stress_fields.BLENDINGS:
            truth, clear = reference(field, blending, (1, 1))
            np.testing.assert_allclose(image(field, blending, (1, 1))[clear], truth[clear], rtol=1e-4)


def test_phases_and_losses() -> None:
    for row in [*bench_stress.phases(), *bench_stress.losses(3)]:
        worst, bound = worst_of(row)
        assert worst <= bound, row
    # The same lengths in float32 would miss the bound: it is one that can be missed.
    assert float(bench_stress.phases()[0]["value"].split()[-2]) > bench_stress.PHASE


def test_fits_end_finite_or_say_where_not() -> None:
    value = bench_stress.fits(4)["value"]
    assert value.endswith(" 0 did neither")
    assert "4 ended finite" not in value


def test_an_error_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def off(field: Field, blending: str, size: tuple[int, int]) -> np.ndarray:
        return image(field, blending, size) * 1.001

    monkeypatch.setattr(bench_stress, "image", off)
    worst, bound = worst_of(bench_stress._images("random", lambda rng: made(20, rng), 2, bench_stress.IMAGE))
    assert worst == pytest.approx(1e-3, rel=0.05)
    assert worst > bound
