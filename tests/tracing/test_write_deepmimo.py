"""Traced paths as scenarios of DeepMIMO: read back by this package and by deepmimo itself."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from made_scenarios import package_channels, package_dataset
from scipy.constants import speed_of_light
from traced_rooms import FREQUENCY_HZ, THICKNESS_M, inside, receiver

from wrf_mi.core import InputError
from wrf_mi.datasets import load, read_deepmimo
from wrf_mi.receivers.channel import csi
from wrf_mi.tracing import TraceOptions, load_trace, open_scene, trace_paths, write_deepmimo

OFDM = {"bandwidth": 20e6, "subcarriers": 64, "selected_subcarriers": [0, 21, 42, 63]}
FREQUENCIES_HZ = FREQUENCY_HZ + np.array(OFDM["selected_subcarriers"]) * 20e6 / 64
SINGLE = 1e-6
"""Relative to the sum of a user's amplitudes: phases are stored in float32, to 1.3e-7 rad, powers to 4e-6 dB."""
PACKAGE = 5e-6  # Likewise for the package, which computes in float32 from there
ANGLE_DEG = 2e-5  # Spacing of float32 at 180
DELAY = 1e-7  # Relative spacing of float32
CODES = {1: "1", 2: "3", 4: "4", 8: "2"}


@pytest.fixture(scope="module")
def traced(divided_xml):
    """All kinds of path from five users to two base stations."""
    options = TraceOptions(diffraction=True, scattering=True, scattering_coefficient=0.3, depth=3, rays=1 << 9)
    stations = [receiver(p, f"roof{k}") for k, p in enumerate(inside(2, 2))]
    trace_result = trace_paths(open_scene(divided_xml, FREQUENCY_HZ, THICKNESS_M), inside(5), stations, options)
    assert set(np.unique(trace_result.paths.interactions)) == {0, 1, 2, 4, 8}
    return trace_result


@pytest.fixture(scope="module")
def scenario(traced, tmp_path_factory):
    return write_deepmimo(tmp_path_factory.mktemp("scenarios") / "shoebox", traced)


def ordered(paths, user, station):
    """Paths of a pair as they are written: the line of sight, then by falling power."""
    of = np.flatnonzero((paths.tx == user) & (paths.rx == station) & (paths.gain != 0))
    return of[np.lexsort((-np.abs(paths.gain[of]), paths.bounces[of] > 0))]


def amplitudes(paths):
    """Sum of the amplitudes of all paths of each pair [n_rx, n_tx, 1]."""
    total = np.zeros((paths.n_rx, paths.n_tx))
    np.add.at(total, (paths.rx, paths.tx), np.abs(paths.gain))
    return total[..., None]


def test_channels_read_back_are_those_of_the_paths(traced, scenario):
    record = read_deepmimo(scenario, params={"base_stations": "all", "ofdm": OFDM})
    error = np.abs(record.observation - csi(traced.paths, FREQUENCIES_HZ)) / amplitudes(traced.paths)
    assert error.max() < SINGLE
    np.testing.assert_allclose(record.tx_pos_m, traced.tx_pos_m, rtol=DELAY)
    np.testing.assert_allclose(record.frequencies_hz, FREQUENCIES_HZ)
    for read, station in zip(record.receivers, traced.receivers, strict=True):
        np.testing.assert_allclose(read.position_m, station.position_m, rtol=DELAY)


def test_package_computes_the_channels_of_the_paths(traced, scenario):
    most = int(np.bincount(traced.paths.tx + 5 * traced.paths.rx).max())
    dataset, expected = package_dataset(scenario, max_paths=most), csi(traced.paths, FREQUENCIES_HZ)
    channels = [package_channels(dataset[k], {"ofdm": OFDM}, num_paths=most)[:, 0] for k in range(2)]
    assert (np.abs(channels - expected) / amplitudes(traced.paths)).max() < PACKAGE


def test_package_reads_angles_delays_interactions_and_positions(traced, scenario):
    paths, dataset = traced.paths, package_dataset(scenario, max_paths=10**6)
    for station in range(2):
        np.testing.assert_allclose(dataset[station].tx_pos[0], traced.receivers[station].position_m, rtol=DELAY)
        np.testing.assert_allclose(dataset[station].rx_pos, traced.tx_pos_m, rtol=DELAY)
    for station, user in product(range(2), range(5)):
        read, of = dataset[station], ordered(paths, user, station)
        assert read.num_paths[user] == len(of)
        first = np.arange(len(of))
        np.testing.assert_allclose(read.delay[user, first], paths.length_m[of] / speed_of_light, rtol=DELAY)
        np.testing.assert_allclose(read.power[user, first], 20 * np.log10(np.abs(paths.gain[of])), rtol=DELAY)
        for kind, directions in (("aod", paths.arrival[of]), ("aoa", paths.departure[of])):
            azimuth = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
            np.testing.assert_allclose(read[f"{kind}_az"][user, first], azimuth, atol=ANGLE_DEG)
            zenith = np.degrees(np.arccos(directions[:, 2]))
            np.testing.assert_allclose(read[f"{kind}_el"][user, first], zenith, atol=ANGLE_DEG)
        for place, path in enumerate(of):
            count = paths.bounces[path]
            kinds = paths.interactions[path, :count][::-1]
            assert int(read.inter[user, place]) == int("".join(CODES[kind] for kind in kinds) or 0)
            points = read.inter_pos[user, place]
            np.testing.assert_allclose(points[:count], paths.vertices_m[path, :count][::-1], atol=1e-6)
            assert np.isnan(points[count:]).all()
        assert read.los[user] == (0 in paths.bounces[of])


def test_users_without_a_path_and_long_chains_of_interactions(traced, tmp_path):
    """Twelve interactions need codes of twelve digits; a user whom only other users' paths remain of is NaN."""
    paths = traced.paths.select(traced.paths.tx != 3)
    shape = len(paths), 12
    met = {"interactions": np.full(shape, 4, np.uint8), "objects": np.zeros(shape, np.int32)}
    wide = replace(paths, **met, vertices_m=np.ones((*shape, 3)))
    folder = write_deepmimo(tmp_path / "deep", replace(traced, paths=wide))
    record = read_deepmimo(folder, params={"base_stations": [0]})
    np.testing.assert_array_equal(np.isnan(record.observation[0, :, 0]), np.arange(5) == 3)
    with np.load(folder / "inter_t000_tx000_r001.npz") as stored:
        codes = stored["inter"]
    assert len(codes) == 5
    assert (codes[np.isfinite(codes)] == 444444444444).all()


def test_more_paths_than_deepmimo_reads_are_warned_of(traced, tmp_path, caplog):
    write_deepmimo(tmp_path / "all", traced)
    (warning,) = caplog.messages
    assert "of which DeepMIMO uses 25 by default; load with max_paths=" in warning


def test_what_cannot_be_written_is_refused(traced, tmp_path):
    (tmp_path / "there").mkdir()
    capital = "'Street' as name of a scenario, which deepmimo.load turns into lower case; choose small"
    none = {"paths": traced.paths.select(np.zeros(len(traced.paths), bool))}
    for name, changes, message in (
        *(("Street", {}, capital), ("a:b", {}, "choose small letters")),
        ("there", {}, "exists; remove it, choose another folder, or give --replace"),
        ("none", none, "no path from 5 users to 2 base stations"),
        ("two", {"carriers_hz": np.array([1e9, 2e9, 1e9, 1e9, 1e9])}, "several carriers"),
    ):
        with pytest.raises(InputError, match=message) as error:
            write_deepmimo(tmp_path / name, replace(traced, **changes))
        assert "\n" not in str(error.value)
    assert {path.name for path in tmp_path.iterdir()} == {"there"}


def test_command_writes_the_traced_paths(room, flat_folder, tmp_path, command):
    asked = [
        "trace",
        flat_folder,
        "--scene",
        room,
        "--depth",
        "1",
        "--rays",
        "1024",
        "--json",
        "--out",
        tmp_path / "run",
    ]
    command.refused([*asked, "--deepmimo", tmp_path / "Flat"], "choose small letters")
    asked += ["--deepmimo", tmp_path / "flat"]
    message = "--deepmimo has no effect beside --calibrate, which trains in one process and stores no paths"
    command.refused([*asked, "--calibrate", "gain"], message)
    assert not (tmp_path / "run").exists()
    command.done(asked)
    traced = load_trace(tmp_path / "run" / "paths.npz")
    record = read_deepmimo(tmp_path / "flat", params={"base_stations": "all"})
    expected = csi(traced.paths, [traced.frequency_hz])
    np.testing.assert_allclose(record.observation, expected, atol=SINGLE * np.abs(expected).max())
    users = json.loads((tmp_path / "flat" / "params.json").read_text())["txrx_sets"]["txrx_set_1"]
    assert users["num_points"] == len(record) == len(load(flat_folder))
