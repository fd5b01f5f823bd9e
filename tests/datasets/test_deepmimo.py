"""Scenarios of DeepMIMO 4: channels against the package's own, the record, what is refused, and the command.

``data/deepmimo_channels.npz`` holds the channels that the package, version 4.0.5, computed from the scenario of
`made_scenarios.write_scenario` with each entry of `CHOSEN`; where the package is installed, it computes them again.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import Change, refusal, remove, write
from commands import Command
from made_scenarios import CARRIER_HZ, CHOSEN, package_channels, package_dataset, params, write_scenario
from scipy.constants import speed_of_light

from wrf_mi.core import Antenna
from wrf_mi.core.array_files import write_arrays
from wrf_mi.datasets import load, make_splits, read_deepmimo
from wrf_mi.datasets.deepmimo import CHANNEL_PARAMS, PARAMS
from wrf_mi.receivers.array import array_response

STORED = Path(__file__).parent / "data" / "deepmimo_channels.npz"
SINGLE = 2e-5
"""Relative to a user's largest coefficient. The package computes angles, patterns and responses in float32 and sums in
complex64: of 2,000 users the median differs by 4e-7, and up to 4e-5 where paths cancel out or leave along a dipole."""
SINGLE_PHASE = 1e-4
"""Likewise for uneven subcarriers, for which the package computes the phases 2 pi k B tau / N, up to 250 rad here, in
float32: to 1.5e-5 rad."""


def scenario(folder: Path, **options: Any) -> Path:
    return write_scenario(folder / "street", **options)


def three_axes(observation: np.ndarray) -> np.ndarray:
    """Channels of a receiver [n, m, k]."""
    return observation if observation.ndim == 3 else observation[:, None]


def assert_close(ours: np.ndarray, package: np.ndarray, tolerance: float) -> None:
    """Equal channels; those of users without a path are NaN, and the package's 0."""
    ours, silent = three_axes(ours), ~np.abs(package).any(axis=(1, 2))
    assert silent.any()
    np.testing.assert_array_equal(np.isnan(ours).all(axis=(1, 2)), silent)
    scale = np.abs(package[~silent]).max(axis=(1, 2), keepdims=True)
    np.testing.assert_array_less(np.abs(ours[~silent] - package[~silent]) / scale, tolerance)


@pytest.mark.parametrize("name", CHOSEN)
@pytest.mark.parametrize("suffix", [".npz", ".mat", ".npy"])
def test_channels_equal_stored_ones_of_the_package(tmp_path: Path, name: str, suffix: str) -> None:
    folder = scenario(tmp_path, suffix=suffix)
    with np.load(STORED) as stored:
        assert_close(read_deepmimo(folder, params=CHOSEN[name]).observation[0], stored[name], SINGLE)


@pytest.mark.parametrize("name", CHOSEN)
def test_package_computes_the_stored_channels(tmp_path: Path, name: str) -> None:
    channels = package_channels(package_dataset(scenario(tmp_path)), CHOSEN[name])
    with np.load(STORED) as stored:
        np.testing.assert_allclose(channels, stored[name], atol=SINGLE * np.abs(channels).max(), rtol=0)


@pytest.mark.parametrize("selected", [[0, 21, 42, 63], [0, 1, 5, 63]])
def test_channels_of_stations_and_sets_of_users_equal_those_of_the_package(tmp_path: Path, selected: list[int]) -> None:
    folder = scenario(tmp_path, stations=2, users=(60, 30))
    chosen = {**CHOSEN["array"], "ofdm": {**CHOSEN["array"]["ofdm"], "selected_subcarriers": selected}}
    record = read_deepmimo(folder, params={**chosen, "base_stations": "all"})
    dataset = package_dataset(folder)  # ordered by set of users, then by base station
    tolerance = SINGLE if len(set(np.diff(selected))) == 1 else SINGLE_PHASE
    for index in range(2):
        pairs = [dataset[2 * k + index] for k in range(2)]
        assert_close(record.observation[index], np.concatenate([package_channels(p, chosen) for p in pairs]), tolerance)
        np.testing.assert_array_equal(record.tx_pos_m, np.concatenate([pair.rx_pos for pair in pairs]))
        np.testing.assert_array_equal(record.receivers[index].position_m, pairs[0].tx_pos[0])


def test_record_has_users_base_station_and_subcarriers(tmp_path: Path) -> None:
    folder = scenario(tmp_path, users=(11,))
    record = load(folder)
    assert (record.name, record.task.name, record.source) == ("street", "csi", str(folder))
    assert record.observation.shape == (1, 11, 1)
    assert record.observation.dtype == np.complex64
    assert np.isnan(record.observation[0, 0]).all()
    np.testing.assert_array_equal(record.frequencies_hz, [CARRIER_HZ])
    (receiver,) = record.receivers
    assert (receiver.name, receiver.antenna, receiver.array_m) == ("bs0", Antenna(), None)
    np.testing.assert_array_equal(receiver.position_m, [0, 5, 20])
    assert [len(rows) for rows in record.official] == [8, 2]
    np.testing.assert_array_equal(np.sort(np.concatenate(record.official)), np.arange(1, 11))  # user 0 has no path
    (folder / "train_index.txt").write_text("5\n3\n")
    (folder / "test_index.txt").write_text("7\n")
    (split,) = make_splits(load(folder), "official")
    assert (split.all_train.tolist(), split.test.tolist()) == ([3, 5], [7])


def test_parameters_in_the_folder_are_those_of_the_call(tmp_path: Path) -> None:
    folder = scenario(tmp_path, stations=3)
    chosen = {**CHOSEN["array"], "base_stations": [2, 0]}
    (folder / CHANNEL_PARAMS).write_text(json.dumps(chosen))
    record = load(folder)
    assert [receiver.name for receiver in record.receivers] == ["bs2", "bs0"]
    chosen["ofdm"] = chosen["ofdm"] | {"selected_subcarriers": np.array([0, 21, 42, 63])}  # as DeepMIMO's own users do
    np.testing.assert_array_equal(record.observation, read_deepmimo(folder, params=chosen).observation)
    assert record.receivers[0].antenna == Antenna("hw_dipole", frame="array")
    assert record.tx_antenna == Antenna("hw_dipole")
    np.testing.assert_array_equal(record.frequencies_hz, CARRIER_HZ + 20e6 / 64 * np.array([0, 21, 42, 63]))


def test_array_of_the_record_explains_the_phases_of_its_elements(tmp_path: Path) -> None:
    """One path: the coefficients of the elements are those of a plane wave at `Receiver.array_m`."""
    folder = scenario(tmp_path, paths=1, users=(6,))
    record = read_deepmimo(folder, params=CHOSEN["array"])
    receiver = record.receivers[0]
    with np.load(folder / "aod_az_t000_tx000_r001.npz") as az, np.load(folder / "aod_el_t000_tx000_r001.npz") as el:
        azimuth, zenith = np.radians(az["aod_az"][1:, 0], dtype=float), np.radians(el["aod_el"][1:, 0], dtype=float)
    world = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=1)
    waves = array_response(receiver.array_m, world @ receiver.to_world, CARRIER_HZ)
    ratio = record.observation[0, 1:, :, 0] / record.observation[0, 1:, :1, 0]
    np.testing.assert_allclose(ratio, waves, atol=SINGLE)


def test_carrier_phase_is_added_where_asked(tmp_path: Path) -> None:
    folder = scenario(tmp_path, paths=1)
    with np.load(folder / "delay_t000_tx000_r001.npz") as stored:
        delay = stored["delay"].astype(float)
    plain, added = (read_deepmimo(folder, params={"add_carrier_phase": a}).observation[0, 1:] for a in (False, True))
    turned = plain * np.exp(-2j * np.pi * np.remainder(CARRIER_HZ * delay[1:], 1))
    np.testing.assert_allclose(added, turned, rtol=SINGLE)


def test_path_without_delay_has_its_power_and_phase(tmp_path: Path) -> None:
    folder = scenario(tmp_path, paths=1, users=(4,))
    for key, value in {"delay": 0.0, "power": -20.0, "phase": 90.0}.items():
        write_arrays(folder / f"{key}_t000_tx000_r001.npz", {key: [[np.nan], *[[value]] * 3]})
    np.testing.assert_allclose(read_deepmimo(folder).observation[0, 1:], 0.1j, atol=1e-8)


def test_amplitude_and_phase_follow_one_convention(tmp_path: Path) -> None:
    """A line of sight as stored: gain lambda / (4 pi d) exp(-j 2 pi f d / c) at every subcarrier."""
    folder = scenario(tmp_path, paths=1, users=(4,))
    frequencies, distance = CARRIER_HZ + 1e5 * np.arange(4), np.array([np.nan, 10, 20, 30.0])[:, None]
    wavelength = speed_of_light / CARRIER_HZ
    stored = {
        "power": 20 * np.log10(wavelength / (4 * np.pi * distance)),
        "phase": -360 * np.remainder(distance / wavelength, 1),
        "delay": distance / speed_of_light,
    }
    for key, values in stored.items():
        np.savez(folder / f"{key}_t000_tx000_r001.npz", **{key: values})
    ofdm = {"bandwidth": 6.4e6, "subcarriers": 64, "selected_subcarriers": [0, 1, 2, 3]}
    record = read_deepmimo(folder, params={"ofdm": ofdm})
    np.testing.assert_allclose(record.frequencies_hz, frequencies)
    d = distance[1:]
    expected = wavelength / (4 * np.pi * d) * np.exp(-2j * np.pi * frequencies * d / speed_of_light)
    np.testing.assert_allclose(record.observation[0, 1:], expected, rtol=SINGLE)


def edited(**changes: Any) -> Change:
    return write(PARAMS, json.dumps(params() | changes))


def stored(key: str, values: Any, name: str = "") -> Change:
    return lambda folder: np.savez(folder / f"{key}_t000_tx000_r001.npz", **{name or key: values})


NO_STATION = {"txrx_set_1": params()["txrx_sets"]["txrx_set_1"]}
NO_USERS = {"txrx_set_0": params()["txrx_sets"]["txrx_set_0"]}
WORDS = {"txrx_set_0": {"is_tx": True, "id": 0, "num_points": "two"}}
SEVERAL = r"base stations, 0 to .; choose in channel_params\.yml, base_stations: \[0\] or base_stations: all"
WRONG: dict[str, tuple[Change, str]] = {
    "matrix missing": (remove("delay_t000_tx000_r001.npz"), r"delay_t000_tx000_r001: no \.mat, \.npz, \.npy file"),
    "damaged matrix": (write("power_t000_tx000_r001.npz", "no zip"), r"power_t000_tx000_r001\.npz: not readable"),
    "other array in the file": (stored("phase", np.zeros((10, 5)), "angle"), r"phase_t0.*1\.npz: no array phase"),
    "pickled objects": (stored("phase", np.full((10, 5), None)), "not readable"),
    "other number of users": (stored("power", np.zeros((9, 5))), r"power_.* has shape \[9, 5\], expected \[10, 5\]"),
    "other number of paths": (stored("aod_el", np.zeros((10, 4))), r"aod_el_.* shape \[10, 4\], expected \[10, 5\]"),
    "two positions of a base station": (stored("tx_pos", np.zeros((2, 3))), r"tx_pos_.* has shape \[2, 3\]"),
    "NaN position": (stored("rx_pos", np.full((10, 3), np.nan)), "rx_pos_.* not finite"),
    "NaN phase": (stored("phase", np.full((10, 5), np.nan)), r"user 1 \(from 0\) of t000_tx000_r001: power, phase"),
    "infinite power": (stored("power", np.full((10, 5), np.inf)), "user 0 .* is not finite"),
    "no paths": (stored("power", np.full((10, 5), np.nan)), r"0 of 10 users have a path to the base stations \[0\]"),
    "negative delay": (stored("delay", np.full((10, 5), -1e-8)), "user 1 .* or its delay is negative"),
    "delay beyond the symbol": (stored("delay", np.full((10, 5), 1e-3)), "a delay of 0.001 s, and .* 5.12e-05 s"),
    "other version": (edited(version="3.2.9"), "version '3.2.9' of DeepMIMO"),
    "parameters of another program": (write(PARAMS, "[1, 2]"), "scene is missing; give a scenario of DeepMIMO 4"),
    "dynamic": (edited(scene={"num_scenes": 4}), "dynamic scenario of 4 scenes; give the folder of one scene"),
    "no carrier": (edited(rt_params={}), "frequency is None; give the carrier in Hz"),
    "no sets": (edited(txrx_sets=None), "txrx_sets is missing"),
    "no base station": (edited(txrx_sets=NO_STATION), r"no base station \(is_tx\) in txrx_sets"),
    "no users": (edited(txrx_sets=NO_USERS), "no set of users"),
    "points of words": (edited(txrx_sets=NO_STATION | WORDS), "num_points is 'two'; give a whole number"),
    "several base stations": (edited(txrx_sets=params(3)["txrx_sets"]), f"3 {SEVERAL}"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_scenario_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    folder = scenario(tmp_path)
    change, message = WRONG[case]
    change(folder)
    assert refusal(load, folder, message).startswith(str(folder))


def test_scenario_before_version_4_and_users_who_differ_are_refused(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "params.mat").write_bytes(b"")
    assert "before version 4" in refusal(load, tmp_path / "old", "fetch it in version 4")
    folder = scenario(tmp_path, stations=2)
    np.savez(folder / "rx_pos_t000_tx001_r001.npz", rx_pos=np.ones((10, 3)))
    (folder / CHANNEL_PARAMS).write_text("base_stations: all")
    refusal(load, folder, "users of base station 1 are at other positions than those of 0; choose one")


def test_command_summarises_and_trains_on_a_scenario(tmp_path: Path, command: Command) -> None:
    folder = scenario(tmp_path, stations=2, users=(60,))
    command.refused(["data", "info", folder], r"2 base stations, 0 to 1; choose in channel_params\.yml")
    (folder / CHANNEL_PARAMS).write_text("base_stations: all\nofdm: {bandwidth: 10e6, selected_subcarriers: [0, 256]}")
    summary = command.json(["data", "info", folder])
    assert (summary["task"], summary["rows"], summary["observation"]) == ("csi", 60, [2])
    assert summary["receivers"] == {"bs0": 59, "bs1": 59}
    np.testing.assert_allclose(summary["frequencies_hz"], [CARRIER_HZ, CARRIER_HZ + 5e6])
    metrics = command.json(["train", folder, "--model", "kriging", "--out", tmp_path / "run"])
    assert (metrics["task"], metrics["n_test"]) == ("csi", 12)
    assert set(metrics["receivers"]) == {"bs0", "bs1"}
    assert np.isfinite(metrics["cea_db"]["median"])
    assert command.json(["evaluate", tmp_path / "run"])["cea_db"] == metrics["cea_db"]
