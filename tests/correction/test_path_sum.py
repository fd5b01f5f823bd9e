"""Sums over paths compared with the tracer: trial residuals and derivatives of channels and strengths."""

from dataclasses import replace

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, channels, stated_scene

from wrf_mi.core.arrays import planar_array
from wrf_mi.correction import default_options, path_sum
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.options import GAIN, MATERIALS, PLANES, CorrectionOptions
from wrf_mi.correction.path_sum import PathSum
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT, SURFACE, TILT, name_of
from wrf_mi.tracing.paths.solve import Prepared

ROUNDING = 1e-5
"""Single precision of the tracer's residuals and parameters, k d of 1e3 rad."""
SAME_SUM = 1e-9
"""Sums over the same paths in double precision, beside other paths that are unchanged."""
DECIBEL = 1e-4
"""Single precision of strengths of -100 dB and of logarithms of materials."""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The stated room, opened, and channels in it."""
    scene = stated_scene(tmp_path_factory.mktemp("room") / "scene")
    return Prepared(open_scene(scene, CARRIER_HZ)), channels(scene, 24)


@pytest.fixture(scope="module")
def misfit(room):
    prepared, record = room
    observed = record.observation.copy()
    observed[0, 3] = np.nan
    options = CorrectionOptions(depth=2, rays=8192, faint=0.0)
    return Misfit(replace(record, observation=observed), np.arange(16), prepared, options)


def moved(misfit: Misfit, shift_m: float = 4e-3, tilt_rad: float = 1e-3) -> np.ndarray:
    vector, rng = misfit.start.copy(), np.random.default_rng(0)
    for name, size in ((SHIFT, shift_m), (TILT, tilt_rad)):
        span = misfit.slices[name]
        vector[span] += rng.normal(0, size, span.stop - span.start)
    return vector


@pytest.mark.parametrize("accepted", [False, True])
def test_trials_of_one_plane_and_its_material_follow_the_tracer(misfit, accepted):
    """To second order in 1 cm: the error is below 5 % of the change, before and after the trial is accepted."""
    vector = moved(misfit)
    trials, changed_vector, before = PathSum(misfit, vector), vector.copy(), misfit.residual(vector)
    np.testing.assert_allclose(trials.residual(vector), before, atol=ROUNDING)
    changed_vector[misfit.slices[SHIFT].start + 2] += 0.01
    changed_vector[misfit.slices[TILT].start + 5] += 3e-3
    slab = next(k for k, name in enumerate(misfit.traced_fields[0].slabs.names) if name.endswith("/2"))
    changed_vector[misfit.slices[name_of(SURFACE, "permittivity")].start + slab] += 0.7
    if accepted:
        trials.accept(changed_vector)
    expected = misfit.residual(changed_vector)
    change = np.nanmax(np.abs(expected - before))
    assert change > 0.05
    np.testing.assert_allclose(trials.residual(changed_vector), expected, atol=0.05 * change)


def test_trials_together_are_those_of_each(misfit, strengths, monkeypatch):
    """Of vectors that change different planes, materials and gains, or nothing, in parts of few vectors and in one."""
    vector = moved(misfit)
    vectors = np.tile(vector, (5, 1))
    for number, step_m in enumerate((0.0, 0.0, 0.01, -0.02)):
        vectors[number, misfit.slices[SHIFT].start + number] += step_m
    vectors[1:4, misfit.slices[name_of(SURFACE, "permittivity")].start] += 0.9
    pair = np.stack(changed(strengths))
    for trials, several in ((PathSum(misfit, vector), vectors), (PathSum(strengths, pair[0]), pair)):
        expected = [np.square(trials.residual(trial)).mean(axis=1) for trial in several]
        assert not np.array_equal(expected[0], expected[1], equal_nan=True)
        for together in (1, 1 << 20):
            monkeypatch.setattr(path_sum, "TOGETHER", together)
            np.testing.assert_allclose(trials.mean_squares(several), expected, rtol=SAME_SUM)


def derivatives_agree(misfit: Misfit, vector: np.ndarray, there: np.ndarray, share: float, floor: float = 0.0) -> None:
    """Those of sums over paths and of the tracer, to a share of the largest one of each parameter."""
    columns = np.arange(len(vector))
    jacobians = misfit.jacobian(there, columns), PathSum(misfit, vector).jacobian(there, columns)
    expected, computed = (
        np.stack([jacobian.at(row) for row in range(len(misfit.observed))], 1) for jacobian in jacobians
    )
    for name, span in misfit.slices.items():
        most = np.abs(expected[span]).max()
        np.testing.assert_allclose(computed[span], expected[span], atol=share * most + floor, err_msg=name)
    assert (computed[:, ~np.isfinite(misfit.observed).all(axis=1)] == 0).all()


@pytest.mark.parametrize("step_m", [0.0, 2e-3])
def test_derivatives_are_those_of_the_tracer(misfit, step_m):
    """By planes and materials, to the change of gains with the angle, which sums of paths leave out."""
    vector = moved(misfit)
    changed_vector = vector.copy()
    changed_vector[misfit.slices[SHIFT].start + 2] += step_m
    assert not np.isfinite(misfit.observed[3]).all()
    derivatives_agree(misfit, vector, changed_vector, 0.03)


@pytest.fixture(scope="module")
def strengths(room):
    """Strengths in dB of three receivers, of which one has no row."""
    prepared, record = room
    power = 10 * np.log10(np.square(np.abs(record.observation)).mean(axis=-1)).astype(np.float32)
    observed = np.concatenate([power + 1, np.full_like(power, np.nan), power - 2])
    observed[0, 3] = np.nan
    first = record.receivers[0]
    shifts = {"first": [0, 0, 0], "silent": [0.1, 0, 0], "third": [0.3, 0.2, 0]}
    receivers = tuple(replace(first, name=name, position_m=first.position_m + by) for name, by in shifts.items())
    carrier_hz = np.array([CARRIER_HZ])
    record = replace(record, task="rssi", observation=observed, receivers=receivers, frequencies_hz=carrier_hz)
    options = replace(default_options(record), rays=8192, groups=(MATERIALS, GAIN))
    return Misfit(record, np.arange(16), prepared, options)


def changed(misfit: Misfit) -> tuple[np.ndarray, np.ndarray]:
    """A vector of other materials and gains, and one with one more material and gain that differ."""
    vector = changed_material(misfit)
    changed_vector = vector.copy()
    changed_vector[misfit.slices[name_of(SURFACE, "permittivity")].start + 2] += 0.7
    changed_vector[misfit.slices[misfit.traced_fields[1].gain_name].start] += 0.4
    return vector, changed_vector


def test_strengths_and_their_derivatives_are_those_of_the_tracer(strengths):
    """A receiver without rows has a parameter and is not traced."""
    vector, changed_vector = changed(strengths)
    trials, louder = PathSum(strengths, vector), vector.copy()
    louder[strengths.slices[strengths.traced_fields[1].gain_name].start] += 0.4
    for tried in (vector, changed_vector, louder):
        np.testing.assert_allclose(trials.residual(tried), strengths.residual(tried), atol=DECIBEL)
    assert np.nanmax(np.abs(strengths.residual(changed_vector) - strengths.residual(vector))) > 1
    trials.accept(changed_vector)
    np.testing.assert_allclose(trials.residual(vector), strengths.residual(vector), atol=DECIBEL)
    derivatives_agree(strengths, vector, changed_vector, 0.01, DECIBEL)
    assert [receiver.name for receiver in strengths.receivers] == ["first", "third"]
    assert "receiver.silent.gain" in strengths.slices
    assert np.isnan(strengths.residual(strengths.start)[16:32]).all()


@pytest.fixture(scope="module", params=[True, False], ids=["planes", "materials"])
def spectra(request, room):
    """Spectra of two arrays at two carriers."""
    prepared, record = room
    first = replace(record.receivers[0], array_m=planar_array(3, 2, 0.03))
    second = replace(first, name="second", position_m=np.add(first.position_m, [0.3, 0.2, 0]))
    observed = np.random.default_rng(0).random((2, 24, 9, 36)).astype(np.float32)
    carriers_hz = np.where(np.arange(24) % 3, CARRIER_HZ, 1.5 * CARRIER_HZ)
    kinds = {"task": "spectrum", "receivers": (first, second), "frequencies_hz": None, "carriers_hz": carriers_hz}
    groups = (MATERIALS, PLANES) if request.param else (MATERIALS,)
    options = CorrectionOptions(groups, depth=2, rays=8192, faint=0.0)
    return Misfit(replace(record, observation=observed, **kinds), np.arange(16), prepared, options)


def test_spectra_are_those_of_the_tracer(spectra):
    """Materials exactly; the planes' shifts to second order and to the change of the angle of arrival."""
    assert PathSum.serves(spectra)
    vector, changed_vector = spectra.start.copy(), spectra.start.copy()
    changed_vector[spectra.slices[name_of(SURFACE, "permittivity")].start + 2] += 0.7
    trials = PathSum(spectra, vector)
    for tried in (vector, changed_vector):
        np.testing.assert_allclose(trials.residual(tried), spectra.residual(tried), atol=10 * ROUNDING)
    assert np.abs(spectra.residual(changed_vector) - spectra.residual(vector)).max() > 0.05
    trials.accept(changed_vector)
    np.testing.assert_allclose(trials.residual(vector), spectra.residual(vector), atol=10 * ROUNDING)
    if SHIFT in spectra.slices:
        changed_vector[spectra.slices[SHIFT].start + 2] += 0.003
        expected, before = spectra.residual(changed_vector), spectra.residual(vector)
        np.testing.assert_allclose(
            trials.residual(changed_vector), expected, atol=0.05 * np.abs(expected - before).max()
        )


def test_derivatives_of_spectra_are_those_of_the_tracer(spectra):
    vector = moved(spectra) if SHIFT in spectra.slices else changed_material(spectra)
    derivatives_agree(spectra, vector, vector, 0.05, DECIBEL)


def test_rows_that_no_changed_path_reaches_are_kept(spectra):
    """A material that some rows meet changes their observations, all others stay as they are."""
    trials, vector = PathSum(spectra, spectra.start), spectra.start.copy()
    slabs = np.arange(len(spectra.traced_fields[0].slabs.names))
    paths = spectra.paths
    met = [np.unique(paths.row[(paths.slab == slab).any(axis=1)]) for slab in slabs]
    slab = next(slab for slab in slabs if 0 < len(met[slab]) < len(spectra.observed))
    vector[spectra.slices[name_of(SURFACE, "permittivity")].start + slab] += 0.7
    change = trials.residual(vector) - trials.residual(spectra.start)
    np.testing.assert_allclose(trials.residual(vector), spectra.residual(vector), atol=10 * ROUNDING)
    np.testing.assert_array_equal(np.flatnonzero(change.any(axis=1)), met[slab])


def changed_material(misfit: Misfit) -> np.ndarray:
    return misfit.start + np.random.default_rng(1).normal(0, 0.05, len(misfit.start))


@pytest.mark.parametrize("group", ["pose", "planes"])
def test_a_sum_over_paths_does_not_serve_what_it_cannot_follow(room, strengths, group):
    options = replace(default_options(strengths.record), rays=8192, groups=(MATERIALS, group))
    assert PathSum.serves(strengths)
    assert not PathSum.serves(Misfit(strengths.record, np.arange(16), room[0], options))


def test_channels_of_an_array_are_scored_by_row(room):
    """Two antennas at one place have the accuracy of one."""
    prepared, single = room
    single = replace(single, observation=single.observation * np.linspace(1.01, 1.2, len(single))[:, None])
    pair = replace(single.with_array(np.zeros((2, 3))), observation=single.observation[:, :, None].repeat(2, axis=2))
    options = CorrectionOptions(depth=1, rays=4096, faint=0.0)
    fits = [Misfit(record, np.arange(12), prepared, options) for record in (single, pair)]
    scores = [fit.scores(fit.start) for fit in fits]
    assert np.ptp(scores[0]) > 1
    np.testing.assert_allclose(scores[1], scores[0], atol=DECIBEL)
