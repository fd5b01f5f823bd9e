"""Carriers of sectors and of rows, and measured antenna patterns: traces, traced fields and Sionna RT agree."""

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from box_room import FREQUENCY_HZ, THICKNESS_M, receiver, transmitters
from double_precision import Tensor64
from wrf_mi_bench.sionna_reference import sionna_paths

from wrf_mi.backend.device import Recorded
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Antenna, InputError
from wrf_mi.core.antenna import boresight_orientation
from wrf_mi.datasets import read_ble_folder
from wrf_mi.estimators.checks import check_parts
from wrf_mi.estimators.model import Problem
from wrf_mi.estimators.ray_tracing import MODEL, TracingSettings
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import RayTracer, TraceOptions, load_trace, open_scene, recompute, save_trace, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions, trace_fields
from wrf_mi.tracing.search import chains as search_module
from wrf_mi.tracing.sionna.materials import CONSTANTS, at_frequency
from wrf_mi.tracing.sionna.path_solver import sionna_pattern

POWER_DB = 0.01  # Gains and lengths of Sionna RT are in single precision
SINGLE = 2e-6  # Of the strongest path: constants of materials and gains in single precision
SECTORS = {"cell:A": (200, 8, 3.56e9), "cell B": (20, 0, 3.69e9), "c": (110, 15, 0.92e9)}
"""Azimuth and downtilt in degrees, carrier in Hz: the last below the range of ITU-R P.2040 for the room's materials."""
OPTIONS = TraceOptions(depth=2, transmission=False, rays=30_000)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cells")
    receivers = ["id,x,y,z,azimuth_deg,downtilt_deg,frequency_hz,pattern"]
    receivers += [f"{name},3.{k},2.2,1.6,{a},{d},{hz},tr38901" for k, (name, (a, d, hz)) in enumerate(SECTORS.items())]
    places = np.random.default_rng(3).uniform([0.4, 0.4, 0.5], [5.0, 4.0, 2.2], (4, 3)).round(3)
    rows = [f"x,y,z,{','.join(f'rssi_{name}' for name in SECTORS)}", *(f"{x},{y},{z},-5,-6,-7" for x, y, z in places)]
    for name, lines in (("receivers", receivers), ("train", rows), ("test", rows)):
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return read_ble_folder(folder)


def close(gains, expected):
    np.testing.assert_allclose(gains, expected, rtol=0, atol=SINGLE * np.abs(expected).max())


def test_power_of_sectors_is_that_of_sionna_rt(shoebox_xml, record):
    """Yaw and pitch of the device, carrier of the scene."""
    power_db, expected = RayTracer(shoebox_xml, instrument_of(record), OPTIONS)(record.tx_pos_m[:4]), []
    for sector, (azimuth, downtilt, hz) in zip(record.receivers, SECTORS.values(), strict=True):
        scene, turn_rad = open_scene(shoebox_xml, hz), np.radians([azimuth, downtilt, 0])
        to: Any = sector.position_m, OPTIONS, "V", "tr38901", turn_rad
        row, gain, *_ = sionna_paths(scene, record.tx_pos_m[:4], *to)
        expected.append(10 * np.log10(np.bincount(row, np.square(np.abs(gain)))))
    np.testing.assert_allclose(power_db, expected, atol=POWER_DB)
    assert np.ptp(power_db, axis=0).min() > 1  # sectors differ


def test_receivers_of_one_trace_are_those_of_scenes_at_their_carriers(shoebox_xml, record, tmp_path):
    traced = trace_paths(open_scene(shoebox_xml, 2e9), record.tx_pos_m, record.receivers, OPTIONS)
    stored = load_trace(save_trace(tmp_path / "paths.npz", traced))
    assert [sector.frequency_hz for sector in stored.receivers] == [hz for *_, hz in SECTORS.values()]
    for number, sector in enumerate(record.receivers):
        scene, plain = open_scene(shoebox_xml, SECTORS[sector.name][2]), replace(sector, frequency_hz=None)
        alone = trace_paths(scene, record.tx_pos_m, plain, OPTIONS).paths
        close(stored.paths.gain[stored.paths.rx == number], alone.gain)
    close(recompute(stored, open_scene(shoebox_xml, 3e9)).paths.gain, stored.paths.gain)


def test_a_scene_is_left_as_it_was(shoebox_xml):
    scene = open_scene(shoebox_xml, 0.92e9)

    def state(scene):
        materials = scene.radio_materials.values()
        return [float(scene.frequency[0]), *(float(getattr(m, name)[0]) for m in materials for name in CONSTANTS)]

    before = state(scene)
    with at_frequency(scene, 3.6e9):
        assert state(scene) == state(open_scene(shoebox_xml, 3.6e9))
    assert state(scene) == before
    with pytest.raises(InputError, match="not known at"), at_frequency(scene, 0.1e9):
        pass
    assert state(scene) == before


def test_a_traced_field_has_the_carrier_of_its_receiver(shoebox_xml, record):
    shared, options, tx = Prepared(open_scene(shoebox_xml, 3.6e9)), TracedOptions(OPTIONS), record.tx_pos_m[:4]
    for sector in record.receivers[:2]:
        field = TracedField(shared.scene, tx, sector, options, prepared=shared)
        assert field.frequency_hz == sector.frequency_hz
        plain = replace(sector, frequency_hz=None)
        alone = TracedField(open_scene(shoebox_xml, SECTORS[sector.name][2]), tx, plain, options)
        close(*(np.stack([part.numpy() for part in each({}).gain]) for each in (field, alone)))


def test_carriers_of_receivers_are_checked(shoebox_xml, record):
    first, *others = record.receivers
    unstated = replace(record, receivers=(replace(first, frequency_hz=None), *others))
    twice = replace(record, carriers_hz=np.full(len(record), 1e9))
    for wrong, message in (
        (unstated, "some receivers have no positive"),
        (twice, "state the carriers of receivers or of"),
    ):
        with pytest.raises(InputError, match=message):
            check_parts(wrong)
    low = replace(record, receivers=(replace(first, frequency_hz=0.1e9), *others))
    with pytest.raises(InputError, match=r"not known at 0\.1 GHz"):
        MODEL.check(Problem(low, TracingSettings(), 0, str(shoebox_xml)), [])


LOW_HZ, MIDDLE_HZ, HIGH_HZ = CARRIERS_HZ = 1.2e9, 2.4e9, 5.8e9
FIELD_OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)
FIELD = TracedOptions(FIELD_OPTIONS)
PLACE = {LOW_HZ: [0, 1, 2, 3], MIDDLE_HZ: [5, 1, 1], HIGH_HZ: [4, 3, 1, 0, 6]}
"""Transmitters of each carrier: some at several, one of them twice."""


@pytest.fixture
def middle(box_xml):
    return open_scene(box_xml, MIDDLE_HZ, THICKNESS_M)


def rows():
    """Positions [n, 3], headings [n] and carriers [n] of the rows, in a random order."""
    place, carrier = np.concatenate(list(PLACE.values())), np.repeat(list(PLACE), [len(p) for p in PLACE.values()])
    order = np.random.default_rng(0).permutation(len(place))
    return transmitters(7)[place[order]], np.linspace(-2, 2, len(place)), carrier[order]


def response(field, parameters):
    """Sum of all paths of each transmitter, with phases."""
    paths = field(parameters)
    gain = paths.gain[0].numpy() + 1j * paths.gain[1].numpy()
    phase = np.exp(-2j * np.pi * field.frequency_hz / 299792458 * paths.length_m.numpy())
    return (gain * phase).reshape(len(field), -1).sum(axis=1)


def test_a_trace_at_another_carrier_compiles_nothing_anew(box_xml):
    """Carrier and constants of materials are no literals of the kernels."""

    def kernels(carrier_hz):  # the next scene has the numbers of this one's objects, which are freed
        scene = open_scene(box_xml, carrier_hz, THICKNESS_M)
        search_module._kept.clear()  # rays are shot at each
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            trace_paths(scene, transmitters(5), receiver(), FIELD_OPTIONS)
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    assert kernels(LOW_HZ) == kernels(MIDDLE_HZ) == kernels(HIGH_HZ)


@pytest.mark.parametrize("faint", [0.0, 0.1])
def test_fields_are_those_of_a_search_for_each_carrier(faint, middle, searches):
    """Positions, headings, faint paths left out and lengths; the search is of each distinct position, once."""
    options, (tx, heading, carriers) = TracedOptions(FIELD_OPTIONS, pattern_degree=1, faint=faint), rows()
    pattern = {"pattern.transmitter": Tensor64(np.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.3]]))}
    fields = trace_fields(tx, receiver(), options, Prepared(middle), heading, carriers)
    assert searches == [7]
    assert [field.frequency_hz for field in fields] == list(CARRIERS_HZ)
    for field, hz in zip(fields, CARRIERS_HZ, strict=True):
        at = carriers == hz
        alone = TracedField(middle, tx[at], receiver(), options, heading[at], frequency_hz=hz)
        np.testing.assert_array_equal(field.exists, alone.exists)
        close(response(field, pattern), response(alone, pattern))
    assert len(searches) == 4


def test_fields_are_those_of_scenes_at_each_carrier(box_xml, middle):
    """Materials follow the laws of ITU-R P.2040 from the carrier of the search."""
    tx, heading, carriers = rows()
    for field in trace_fields(tx, receiver(), FIELD, Prepared(middle), heading, carriers):
        at, scene = carriers == field.frequency_hz, open_scene(box_xml, field.frequency_hz, THICKNESS_M)
        close(response(field, {}), response(TracedField(scene, tx[at], receiver(), FIELD, heading[at]), {}))


def test_moved_receivers_are_searched_as_by_refresh(middle, searches):
    """Moved by 4 cm, more than a quarter of a wavelength at two carriers: one search from there and one as stated."""
    (tx, _, carriers), moved = rows(), {"receiver.array.position": Tensor64([0.0, 0.04, 0.0])}
    fields = trace_fields(tx, receiver(), FIELD, Prepared(middle), None, carriers, parameters=moved)
    assert len(searches) == 2
    for field, hz in zip(fields, CARRIERS_HZ, strict=True):
        alone = TracedField(middle, tx[carriers == hz], receiver(), FIELD, frequency_hz=hz)
        assert alone.refresh(moved) == (hz != LOW_HZ)
        np.testing.assert_array_equal(field.searched_at_m, alone.searched_at_m)
        assert (field.searched_at_m == receiver().position_m).all() == (hz == LOW_HZ)
        np.testing.assert_array_equal(response(field, moved), response(alone, moved))
        assert not field.refresh(moved)


def test_rows_without_carriers_have_that_of_the_scene(box):
    tx = transmitters(3)
    [field] = trace_fields(tx, receiver(), FIELD, Prepared(box))
    assert field.frequency_hz == pytest.approx(FREQUENCY_HZ)
    np.testing.assert_array_equal(response(field, {}), response(TracedField(box, tx, receiver(), FIELD), {}))


def test_wrong_positions_are_refused(box):
    for wrong in ([[1.0, 2.0]], [[1.0, 2.0, np.nan]]):
        with pytest.raises(ValueError, match="tx_pos_m has shape"):
            trace_fields(wrong, receiver(), TracedOptions(FIELD_OPTIONS), Prepared(box))


AGREE = 1e-4  # of the strongest path: Sionna RT in single precision, angles of a table among them
SLOPE = 1e-5  # Relative: central differences in float64
OF_PATTERNS = TraceOptions(depth=2, rays=4096)
TURN_DEG = (30, 50, -70)


@pytest.fixture(scope="module")
def patterns(tmp_path_factory: pytest.TempPathFactory) -> list[Antenna]:
    """Two lobes of random spherical harmonics with phase and one without, in a smaller table."""
    folder, rng, antennas = tmp_path_factory.mktemp("patterns"), np.random.default_rng(4), []
    for number, step in enumerate((5, 5, 10)):
        theta, phi = (np.ravel(a) for a in np.meshgrid(np.arange(0, 180.1, step), np.arange(0, 360, step)))
        t, p = np.radians(theta), np.radians(phi)
        unit = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])
        gain, phase = (scale * rng.normal(size=3) @ unit for scale in (4, 60))
        columns = [theta, phi, gain - 6, phase][: 3 + (number < 2)]
        header = ",".join(("theta", "phi", "gain_db", "phase")[: len(columns)])
        file = folder / f"{number}.csv"
        np.savetxt(file, np.stack(columns, axis=-1), delimiter=",", header=header, comments="")
        antennas.append(Antenna(str(file), "VH"[number % 2], "array"))
    return antennas


def gains(field: TracedField, paths: Any) -> np.ndarray[Any, Any]:
    real, imaginary = (part.numpy() for part in paths.gain)
    return (real + 1j * imaginary)[field.exists]


def test_traced_fields_are_those_of_sionna_rt(box, patterns, tmp_path):
    """With phases at both ends, and whichever end the search started from."""
    tx_antenna = replace(patterns[1], frame="world")
    for rx_antenna in (patterns[0], patterns[2]):
        array, tx = replace(receiver(TURN_DEG), antenna=rx_antenna), transmitters(5)
        traced = trace_paths(box, tx, array, OF_PATTERNS, tx_antenna=tx_antenna)
        field = TracedField(box, tx, array, TracedOptions(OF_PATTERNS, tx_antenna=tx_antenna), traced=traced)
        largest = np.abs(traced.paths.gain).max()
        np.testing.assert_allclose(gains(field, field({})), traced.paths.gain, atol=AGREE * largest)
        other = replace(traced, from_receivers=not traced.from_receivers)
        np.testing.assert_allclose(recompute(other, box).paths.gain, traced.paths.gain, atol=AGREE * largest)
        stored = load_trace(save_trace(tmp_path / "paths.npz", traced))
        assert (stored.receivers[0].antenna, stored.tx_antenna) == (rx_antenna, tx_antenna)


def test_gains_are_those_of_sionna_rts_solver(box, patterns):
    """Of a registered pattern, whose conjugate Sionna RT takes at the receiver; phases included."""
    from sionna.rt import register_antenna_pattern
    from sionna.rt.antenna_pattern import AntennaPattern

    class Measured(AntennaPattern):
        def __init__(self, *, polarization: str) -> None:
            self.patterns = [sionna_pattern(replace(patterns[0], polarization=polarization), receives=True)]

    register_antenna_pattern("measured", Measured)
    pose = replace(receiver(), orientation_xyzw=boresight_orientation(0.7, 0.2), antenna=patterns[0])
    options, [tx_m] = replace(OF_PATTERNS, rays=30_000, transmission=False), transmitters(1)
    paths = trace_paths(box, tx_m, pose, options).paths
    turned: dict[str, Any] = {"pattern": "measured", "turn_rad": (0.7, 0.2, 0)}
    _, expected, length_m, _ = sionna_paths(box, tx_m, pose.position_m, options, **turned)
    of_length, of_expected = np.argsort(paths.length_m), np.argsort(length_m)
    np.testing.assert_allclose(paths.gain[of_length], expected[of_expected], atol=AGREE * np.abs(expected).max())


def test_recordings_read_tables_at_each_call(box, patterns):
    """A function that was recorded with one table gives the paths of another one, and its derivatives."""
    poses = [replace(receiver(TURN_DEG), antenna=replace(each, polarization="V")) for each in patterns[:2]]
    first, second = (TracedField(box, transmitters(5), pose, TracedOptions(OF_PATTERNS)) for pose in poses)
    assert first.form == second.form
    present = [first]
    recorded = Recorded(lambda: present[0]({}).gain, lambda: present[0].arrays)
    for present[0] in (first, second, first, second):
        expected = np.stack([part.numpy() for part in present[0]({}).gain])
        np.testing.assert_allclose(np.stack([part.numpy() for part in recorded()]), expected, rtol=0, atol=1e-15)
    assert recorded.frozen.n_recordings < 4  # the others are replayed
    difference = np.abs(gains(first, first({})) - gains(second, second({})))
    assert difference.max() > 0.1 * np.abs(gains(first, first({}))).max()


def test_gains_follow_turns_of_the_receiver(box, patterns):
    """Derivatives of coherent sums by the rotation of the receiver are finite differences."""
    pose = replace(receiver(TURN_DEG), antenna=patterns[0])
    field = TracedField(box, transmitters(5), pose, TracedOptions(OF_PATTERNS))
    weights = Float64(np.random.default_rng(5).normal(size=dr.width(field.chains.exists)))

    def total(turn: Any) -> Any:
        re, im = field({"receiver.array.turn": turn}).gain
        return dr.sum(weights * (re + 2 * im))

    turn = Tensor64([0.01, -0.02, 0.03])
    dr.enable_grad(turn)
    dr.backward(total(turn))
    for axis in range(3):
        up, down = (float(total(Tensor64(turn.numpy() + sign * 1e-5 * np.eye(3)[axis]))[0]) for sign in (1, -1))
        assert turn.grad.numpy()[axis] == pytest.approx((up - down) / 2e-5, rel=SLOPE)
