"""Sums over paths compared with the tracer: trial residuals and derivatives of channels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, channels, stated_scene

from wrf_mi.correction.misfit import Misfit, search_options
from wrf_mi.correction.options import CorrectionOptions
from wrf_mi.correction.path_sum import PathSum
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.material_parameters import SURFACE, name_of
from wrf_mi.tracing.plane_parameters import SHIFT, TILT

ROUNDING = 1e-5
"""Single precision of the tracer's residuals and parameters, k d of 1e3 rad."""


@pytest.fixture(scope="module")
def misfit(tmp_path_factory: pytest.TempPathFactory) -> Misfit:
    scene = stated_scene(tmp_path_factory.mktemp("room") / "scene")
    record = channels(scene, 24)
    observed = record.observation.copy()
    observed[0, 3] = np.nan
    record, options = replace(record, observation=observed), CorrectionOptions(depth=2, rays=8192, faint=0.0)
    opened = open_scene(scene, CARRIER_HZ)
    return Misfit(record, np.arange(16), opened, search_options(options), options.changes)


def moved(misfit: Misfit, shift_m: float = 4e-3, tilt_rad: float = 1e-3) -> np.ndarray:
    vector, rng = misfit.start.copy(), np.random.default_rng(0)
    for name, size in ((SHIFT, shift_m), (TILT, tilt_rad)):
        part = misfit.parts[name]
        vector[part] += rng.normal(0, size, part.stop - part.start)
    return vector


def test_residuals_are_those_of_the_tracer(misfit: Misfit) -> None:
    vector = moved(misfit)
    np.testing.assert_allclose(PathSum(misfit, vector).residual(vector), misfit.residual(vector), atol=ROUNDING)


@pytest.mark.parametrize("accepted", [False, True])
def test_trials_of_one_plane_and_its_material_follow_the_tracer(misfit: Misfit, accepted: bool) -> None:
    """To second order in 1 cm: the error is below 5 % of the change, before and after the trial is accepted."""
    vector = moved(misfit)
    trials, there = PathSum(misfit, vector), vector.copy()
    there[misfit.parts[SHIFT].start + 2] += 0.01
    there[misfit.parts[TILT].start + 5] += 3e-3
    slab = next(k for k, name in enumerate(misfit.sides[0].slabs.names) if name.endswith("/2"))
    there[misfit.parts[name_of(SURFACE, "permittivity")].start + slab] += 0.7
    if accepted:
        trials.accept(there)
    expected, before = misfit.residual(there), misfit.residual(vector)
    change = np.nanmax(np.abs(expected - before))
    assert change > 0.05
    np.testing.assert_allclose(trials.residual(there), expected, atol=0.05 * change)


@pytest.mark.parametrize("trial", [False, True])
def test_derivatives_are_those_of_the_tracer(misfit: Misfit, trial: bool) -> None:
    """By planes and materials, to the change of gains with the angle, which sums of paths leave out."""
    vector = moved(misfit)
    trials, there = PathSum(misfit, vector), vector.copy()
    if trial:
        there[misfit.parts[SHIFT].start + 2] += 2e-3
    columns = np.arange(len(vector))
    expected, found = misfit.jacobian(there, columns), trials.jacobian(there, columns)
    for name, part in misfit.parts.items():
        np.testing.assert_allclose(
            found[..., part], expected[..., part], atol=0.03 * np.abs(expected[..., part]).max(), err_msg=name
        )
    assert (found[3] == 0).all()
