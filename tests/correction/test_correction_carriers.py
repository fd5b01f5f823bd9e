"""Corrections by rows of several carriers, and surfaces that stay known to fits whose paths do not meet them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, TRUE_MATERIALS, channels, stated_scene

from wrf_mi.core import Antenna, Record
from wrf_mi.correction import CorrectionOptions, write_page
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.state import ABSENT, ABSENT_VALUES, ScenePosterior, State, material_places
from wrf_mi.datasets import make_splits
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.scene_parameters import EXPONENT, SURFACE, name_of
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.tracer import RayTracer

CARRIERS_HZ = (1.2e9, 2.4e9, 5.8e9)
OPTIONS = CorrectionOptions(("materials", "gain"), depth=2, rays=4096, steps=6)
ROUNDING_DB = 2e-3
"""Of reports in single precision: 8e-6 of 100 dB, and conductivities as float32."""


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
    stated = stated_scene(folder / "stated")
    found = correct_scene(stated, record, make_splits(record, "frequency:1")[0], OPTIONS)
    write_page(found, folder / "corrected")
    return found, record, folder


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
    vertical = Record("made-up", "rssi", record.tx_pos_m[rows], record.receivers, np.zeros((1, 20)), frequencies_hz=hz)
    horizontal = replace(vertical, tx_antenna=Antenna("dipole", "H"))
    powers = RayTracer(scene, instrument_of(horizontal), TRACE)(vertical.tx_pos_m).astype(np.float32)
    for stated, below in ((horizontal, True), (vertical, False)):
        misfit = Misfit(replace(stated, observation=powers), rows, Prepared(open_scene(scene, CARRIER_HZ)), OPTIONS)
        assert (np.abs(misfit.residual(misfit.start)).max() < ROUNDING_DB) == below


def test_paths_are_searched_once_for_all_carriers(truth, searches):
    """Of positions that are partly the same at all carriers."""
    scene, record = truth
    record = replace(record, tx_pos_m=record.tx_pos_m[np.arange(len(record)) % 14])
    misfit = Misfit(record, np.arange(len(record)), Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    assert len(misfit.sides) == len(CARRIERS_HZ)
    assert searches == [14]


def test_derivatives_by_exponents_are_those_of_finite_differences(truth):
    """To 1 % of the largest, or the rounding of float32 reports over the step."""
    (scene, record), step = truth, 0.02
    misfit = Misfit(record, np.arange(50), Prepared(open_scene(scene, 2.4e9)), OPTIONS)
    part = misfit.parts[name_of(SURFACE, EXPONENT)]
    columns = np.arange(part.start, part.stop)
    slopes = misfit.jacobian(misfit.start, columns).columns
    for place, column in enumerate(columns):
        way = np.eye(1, len(misfit.start), column)[0] * step
        expected = (misfit.residual(misfit.start + way) - misfit.residual(misfit.start - way)) / (2 * step)
        np.testing.assert_allclose(slopes[place], expected, atol=4e-4 + 0.01 * np.abs(expected).max())
    assert np.abs(slopes).max() > 0.1  # dB: exponents are felt


def test_a_carrier_without_rows_is_predicted_better(corrected):
    """Powers at 2.4 GHz, traced in the scene that rows at 1.2 and 5.8 GHz corrected."""
    found, record, folder = corrected
    assert found.kept == "materials+gain"
    test = make_splits(record, "frequency:1")[0].test
    instrument = instrument_of(replace(record, carriers_hz=None, frequencies_hz=np.array([CARRIERS_HZ[1]])))
    stated, new = (
        np.std(RayTracer(folder / name, instrument, TRACE)(record.tx_pos_m[test])[0] - record.observation[0, test])
        for name in ("stated", "corrected")
    )
    # Of some hundred rows; with seeds 0 to 4 of the positions it is 0.10 to 0.40.
    assert new < 0.5 * stated


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
    slab = next(k for k, name in enumerate(first.misfit.sides[0].slabs.names) if name.startswith("wall_01"))
    vector = first.stated.copy()
    vector[material_places(first.misfit, slab)] = ABSENT_VALUES
    state = State(first, "materials", vector, vector, {first.misfit.sides[0].slabs.names[slab]: ABSENT})
    second = fit(0, (first.misfit.planes, first.misfit.slabs))
    assert not second.misfit.counts()[1][slab]
    over = state.at(second)
    assert over.absent() == state.absent() != frozenset()
    np.testing.assert_array_equal(over.vector, vector)
