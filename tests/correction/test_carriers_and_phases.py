"""Scene corrections at several carriers, and from spectra whose phases are uncertain."""

from dataclasses import replace
from pathlib import Path

import correction_rooms
import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, TRUE_MATERIALS, channels, stated_scene
from scipy.integrate import quad
from scipy.special import i0e, i1e

from wrf_mi.core import Antenna, InputError, Record
from wrf_mi.correction import CorrectionOptions, write_page
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.state import ABSENT, ABSENT_VALUES, ScenePosterior, State, material_places
from wrf_mi.correction.uncertain_phases import UncertainPhases, moments
from wrf_mi.datasets import make_splits
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.scene_parameters import EXPONENT, SHIFT, SURFACE, name_of
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.tracer import RayTracer

CARRIERS_HZ = (1.2e9, 2.4e9, 5.8e9)
OPTIONS = CorrectionOptions(("materials", "gain"), depth=2, rays=4096, steps=6)
ROUNDING_DB = 2e-3
"""Of observations in single precision: 8e-6 of 100 dB, and conductivities as float32."""


TRACE = TraceOptions(transmission=True, depth=2, rays=4096)


def strengths(scene: Path, count: int) -> Record:
    """Received powers in dB at positions of their own at each carrier."""
    base = channels(scene, count)
    each = len(base) // len(CARRIERS_HZ)
    record = replace(base, task="rssi", observation=np.zeros((1, len(base)), np.float32), official=None)
    powers = []
    for carrier_hz, places in zip(CARRIERS_HZ, base.tx_pos_m[: 3 * each].reshape(3, each, 3), strict=True):
        instrument = instrument_of(replace(record, frequencies_hz=np.array([carrier_hz])))
        powers.append(RayTracer(scene, instrument, TRACE)(places).astype(np.float32))
    observed = np.concatenate(powers, axis=1)
    carriers_hz = np.repeat(CARRIERS_HZ, each)
    return Record("bands", "rssi", base.tx_pos_m[: 3 * each], base.receivers, observed, carriers_hz=carriers_hz)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """The room as it is, and strengths in it."""
    scene = stated_scene(tmp_path_factory.mktemp("bands") / "true", TRUE_MATERIALS)
    return scene, strengths(scene, 60)


@pytest.fixture(scope="module")
def corrected(truth, tmp_path_factory):
    """The lowest and the highest carrier correct the stated materials."""
    folder = tmp_path_factory.mktemp("corrected")
    record = strengths(truth[0], 300)
    uncorrected_scene = stated_scene(folder / "stated")
    correction = correct_scene(uncorrected_scene, record, make_splits(record, "frequency:1")[0], OPTIONS)
    write_page(correction, folder / "corrected")
    return correction, record, folder


def test_residuals_are_those_of_each_carrier_alone(truth):
    """In the order of the rows, whatever the order of carriers; materials at another carrier follow ITU-R P.2040."""
    scene, record = truth
    rows = np.random.default_rng(0).permutation(len(record))[:24]
    together = Misfit(record, rows, Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    residual = together.residual(together.start)
    assert together.several_carriers
    np.testing.assert_allclose(residual, 0, atol=ROUNDING_DB)
    for carrier_hz in CARRIERS_HZ:
        which = np.flatnonzero(record.carriers_hz[rows] == carrier_hz)
        alone = replace(record, carriers_hz=None, frequencies_hz=np.array([carrier_hz]))
        single = Misfit(alone, rows[which], Prepared(open_scene(scene, carrier_hz)), OPTIONS)
        assert not single.several_carriers
        np.testing.assert_allclose(residual[which], single.residual(single.start), atol=ROUNDING_DB)


def test_antennas_of_transmitters_are_those_of_the_record(truth):
    """Of horizontal dipoles, with which paths of vertical antennas have other powers."""
    scene, record = truth
    rows, hz = np.arange(20), np.array([CARRIER_HZ])
    silent = np.zeros((1, 20), np.float32)
    vertical = Record("made-up", "rssi", record.tx_pos_m[rows], record.receivers, silent, frequencies_hz=hz)
    horizontal = replace(vertical, tx_antenna=Antenna("dipole", "H"))
    powers = RayTracer(scene, instrument_of(horizontal), TRACE)(vertical.tx_pos_m).astype(np.float32)
    for antenna_record, below in ((horizontal, True), (vertical, False)):
        misfit = Misfit(
            replace(antenna_record, observation=powers), rows, Prepared(open_scene(scene, CARRIER_HZ)), OPTIONS
        )
        assert (np.abs(misfit.residual(misfit.start)).max() < ROUNDING_DB) == below


def test_paths_are_searched_once_for_all_carriers(truth, searches):
    """Of positions that are partly the same at all carriers."""
    scene, record = truth
    record = replace(record, tx_pos_m=record.tx_pos_m[np.arange(len(record)) % 14])
    misfit = Misfit(record, np.arange(len(record)), Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    assert len(misfit.traced_fields) == len(CARRIERS_HZ)
    assert searches == [14]


def test_derivatives_by_exponents_are_those_of_finite_differences(truth):
    """To 1 % of the largest, or the rounding of float32 observations over the step."""
    (scene, record), step = truth, 0.02
    misfit = Misfit(record, np.arange(50), Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    span = misfit.slices[name_of(SURFACE, EXPONENT)]
    columns = np.arange(span.start, span.stop)
    slopes = misfit.jacobian(misfit.start, columns).columns
    for place, column in enumerate(columns):
        way = np.eye(1, len(misfit.start), column)[0] * step
        expected = (misfit.residual(misfit.start + way) - misfit.residual(misfit.start - way)) / (2 * step)
        np.testing.assert_allclose(slopes[place], expected, atol=4e-4 + 0.01 * np.abs(expected).max())
    assert np.abs(slopes).max() > 0.1  # dB: exponents are felt


def test_a_carrier_without_rows_is_predicted_better(corrected):
    """Powers at 2.4 GHz, traced in the scene that rows at 1.2 and 5.8 GHz corrected."""
    correction, record, folder = corrected
    assert correction.kept == "materials+gain"
    test = make_splits(record, "frequency:1")[0].test
    instrument = instrument_of(replace(record, carriers_hz=None, frequencies_hz=np.array([CARRIERS_HZ[1]])))
    stated_std, new = (
        np.std(RayTracer(folder / name, instrument, TRACE)(record.tx_pos_m[test])[0] - record.observation[0, test])
        for name in ("stated", "corrected")
    )
    # Of some hundred rows; with seeds 0 to 4 of the positions it is 0.10 to 0.40.
    assert new < 0.5 * stated_std


def test_the_folder_states_laws_of_conductivities(corrected):
    """Sionna RT's file holds the conductivity at a training carrier; other carriers follow the exponent."""
    *_, folder = corrected
    laws = read_scene_folder(folder / "corrected").materials.laws
    assert laws
    assert {carrier for _, carrier in laws.values()} == {5.8e9}
    name, (exponent, _) = max(laws.items(), key=lambda item: item[1][0])
    assert exponent > 0.1
    low, high = (open_scene(folder / "corrected", hz).radio_materials[name].conductivity[0] for hz in (1.2e9, 4.8e9))
    assert high / low == pytest.approx(4**exponent, rel=1e-5)


def test_an_absent_surface_that_no_path_meets_stays_absent(tmp_path):
    """Of direct paths alone, as in a scene from which the surface is gone."""
    scene = stated_scene(tmp_path / "scene")
    opened, options = open_scene(scene, CARRIER_HZ), CorrectionOptions(("materials",), depth=1, rays=4096)
    record = channels(scene, 24)

    def fit(reflections, surfaces):
        how = replace(options, reflections=reflections)
        misfit = Misfit(record, np.arange(12), Prepared(opened), how, surfaces=surfaces)
        return ScenePosterior(misfit, options, lambda what, share: None)

    none = np.zeros(0, np.int64)
    first = fit(1, (none, none))
    slab = next(k for k, name in enumerate(first.misfit.traced_fields[0].slabs.names) if name.startswith("wall_01"))
    vector = first.stated.copy()
    vector[material_places(first.misfit, slab)] = ABSENT_VALUES
    state = State(first, "materials", vector, vector, {first.misfit.traced_fields[0].slabs.names[slab]: ABSENT})
    second = fit(0, (first.misfit.planes, first.misfit.slabs))
    assert not second.misfit.counts()[1][slab]
    over = state.at(second)
    assert over.absent() == state.absent() != frozenset()
    np.testing.assert_array_equal(over.vector, vector)


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
    computed = moments(gain, i1e(concentration) / i0e(concentration), wave, row, 2)
    mean, covariance = np.zeros((2, 4), complex), np.zeros((2, 4, 4), complex)
    for path, kappa in enumerate(concentration):
        density = [
            quad(lambda x, n=n, k=kappa: np.exp(k * (np.cos(x) - 1)) * np.cos(n * x), -np.pi, np.pi)[0] for n in (0, 1)
        ]
        first = density[1] / density[0]
        mean[row[path]] += first * gain[path] * wave[path]
        outer = np.abs(gain[path]) ** 2 * np.outer(wave[path], wave[path].conj())
        covariance[row[path]] += (1 - first**2) * outer
    np.testing.assert_allclose(computed.mean, mean, rtol=QUADRATURE)
    np.testing.assert_allclose(computed.covariance, covariance, rtol=QUADRATURE)


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


WITH_PHASES = CorrectionOptions(
    ("materials", "planes", "phases"), shift_sd_m=SHIFT_SD_M, steps=4, rays=1 << 14, depth=2
)


@pytest.mark.parametrize("certain", [False, True])
def test_gradient_is_that_of_differences(room, certain):
    """Where reflections have no mean by the priors of planes, and where phases are almost certain."""
    record, uncorrected_scene = room
    misfit = Misfit(record, np.arange(40), Prepared(open_scene(uncorrected_scene, HZ)), WITH_PHASES)
    fit = UncertainPhases(ScenePosterior(misfit, WITH_PHASES, lambda what, share: None))
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
    record, uncorrected_scene = room
    split = make_splits(record, "official")[0]
    correction = correct_scene(uncorrected_scene, record, split, WITH_PHASES)
    assert correction.kept == "materials+phases"
    slabs = correction.misfit.traced_fields[0].slabs
    fitted = slabs.fitted(correction.misfit.named(correction.vector)).permittivity
    rules = slabs.fitted(correction.misfit.named(correction.misfit.start)).permittivity
    slab_index = {name.partition("/")[0]: place for place, name in enumerate(slabs.names)}
    true = (
        Prepared(open_scene(stated_scene(uncorrected_scene.parent / "named", TRUE_MATERIALS), HZ))
        .tables("surface")
        .slabs
    )
    expected = dict(zip((name.partition("/")[0] for name in true.names), true.permittivity, strict=True))
    errors = [
        np.mean([abs(np.log(values[slab_index[name]] / expected[name])) for name in expected if name != "board"])
        for values in (rules, fitted)
    ]
    assert errors[1] < errors[0] / 2
    assert (correction.deviation[correction.misfit.plane_entries] == 0).all()


def test_phases_without_what_makes_them_uncertain_are_refused():
    with pytest.raises(InputError, match="phases needs materials, and planes or frame"):
        CorrectionOptions(("materials", "phases"))
