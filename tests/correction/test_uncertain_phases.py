"""Materials by channels of uncertain phases: moments, derivatives, and a scene whose planes cannot be resolved."""

import correction_rooms
import numpy as np
import pytest
from correction_rooms import TRUE_MATERIALS, channels, stated_scene
from scipy.integrate import quad
from scipy.special import i0e, i1e

from wrf_mi.core import InputError
from wrf_mi.correction import CorrectionOptions
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.state import ScenePosterior
from wrf_mi.correction.uncertain_phases import UncertainPhases, moments
from wrf_mi.datasets import make_splits
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.surfaces import scene_surfaces

HZ = 28e9
OFF_M = 0.012  # errors of planes, more than a wavelength of 10.7 mm
SHIFT_SD_M = 0.002  # so small a stated error that no plane can be found
QUADRATURE = 1e-9
GRADIENT = 0.02
"""Relative: gains are of single precision, and differences are over a thousandth."""


def test_moments_are_those_of_von_mises_phases():
    """Against float64 quadrature, for paths of several concentrations in two rows."""
    rng = np.random.default_rng(0)
    concentration, row = np.array([0.3, 2.0, 11.0]), np.array([0, 0, 1])
    gain, wave = rng.normal(size=3) + 1j * rng.normal(size=3), np.exp(2j * np.pi * rng.random((3, 4)))
    found = moments(gain, i1e(concentration) / i0e(concentration), wave, row, 2)
    mean, covariance = np.zeros((2, 4), complex), np.zeros((2, 4, 4), complex)
    for path, kappa in enumerate(concentration):
        density = [
            quad(lambda x, n=n, k=kappa: np.exp(k * (np.cos(x) - 1)) * np.cos(n * x), -np.pi, np.pi)[0] for n in (0, 1)
        ]
        first = density[1] / density[0]
        mean[row[path]] += first * gain[path] * wave[path]
        outer = np.abs(gain[path]) ** 2 * np.outer(wave[path], wave[path].conj())
        covariance[row[path]] += (1 - first**2) * outer
    np.testing.assert_allclose(found.mean, mean, rtol=QUADRATURE)
    np.testing.assert_allclose(found.covariance, covariance, rtol=QUADRATURE)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Channels in a room at 28 GHz, and its scan without materials, whose planes are off."""
    folder, patch = tmp_path_factory.mktemp("far"), pytest.MonkeyPatch()
    patch.setattr(correction_rooms, "CARRIER_HZ", HZ)
    base = open_scene(stated_scene(folder / "base", TRUE_MATERIALS), HZ)
    shift = OFF_M * np.where(np.arange(len(scene_surfaces(base).normal)) % 2, 1, -1)
    true = write_corrected_scene(folder / "true", base, {SHIFT: shift})
    record = channels(true, 90, snr_db=30)
    patch.undo()
    return record, stated_scene(folder / "stated")


OPTIONS = CorrectionOptions(("materials", "planes", "phases"), shift_sd_m=SHIFT_SD_M, steps=4, rays=1 << 14, depth=2)


@pytest.mark.parametrize("certain", [False, True])
def test_gradient_is_that_of_differences(room, certain):
    """Where reflections have no mean by the priors of planes, and where phases are almost certain."""
    record, stated = room
    misfit = Misfit(record, np.arange(40), Prepared(open_scene(stated, HZ)), OPTIONS)
    fit = UncertainPhases(ScenePosterior(misfit, OPTIONS, lambda what, share: None))
    assert np.median(fit.resultant) < 0.01
    if certain:
        fit.resultant[:] = 0.9
    state = fit.posterior.start("materials")
    free = fit.free(state)
    information, slope = fit._normal(state.vector, free)
    for column in np.argsort(-np.abs(slope))[:6]:
        cost = []
        for step in (1e-3, -1e-3):
            beside = state.vector.copy()
            beside[free[column]] += step
            cost.append(-np.nansum(fit.scores(beside)))
        assert (cost[0] - cost[1]) / 2e-3 == pytest.approx(slope[column], rel=GRADIENT)
    assert (np.diag(information) >= 0).all()


def test_materials_are_found_where_planes_are_not(room):
    """Logarithms of permittivities are off by less than half of what those of the rules are."""
    record, stated = room
    split = make_splits(record, "official")[0]
    found = correct_scene(stated, record, split, OPTIONS)
    assert found.kept == "materials+phases"
    slabs = found.misfit.sides[0].slabs
    fitted = slabs.fitted(found.misfit.named(found.vector)).permittivity
    rules = slabs.fitted(found.misfit.named(found.misfit.start)).permittivity
    known = {name.partition("/")[0]: place for place, name in enumerate(slabs.names)}
    true = Prepared(open_scene(stated_scene(stated.parent / "named", TRUE_MATERIALS), HZ)).tables("surface").slabs
    expected = dict(zip((name.partition("/")[0] for name in true.names), true.permittivity, strict=True))
    errors = [
        np.mean([abs(np.log(values[known[name]] / expected[name])) for name in expected if name != "board"])
        for values in (rules, fitted)
    ]
    assert errors[1] < errors[0] / 2
    assert (found.deviation[found.misfit.plane_entries] == 0).all()


def test_phases_without_what_makes_them_uncertain_are_refused():
    with pytest.raises(InputError, match="phases needs materials, and planes or frame"):
        CorrectionOptions(("materials", "phases"))
