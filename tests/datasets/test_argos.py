"""Captures of many-antenna base stations: a known channel is found again; what is wrong with a file is told."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import error_line, refusal

from wrf_mi.datasets import load, make_splits, read_argos
from wrf_mi.datasets.argos import SUBCARRIERS

h5py = pytest.importorskip("h5py")

FRAMES, USERS, ANTENNAS, TAPS = 4, 3, 5, 6
# IEEE 802.11's long training symbol at subcarriers -32..31, as RENEWLab's generate_sequence.py lists it.
LTS = [0] * 6 + [1, 1, -1, -1, 1, 1, -1, 1, -1, 1, 1, 1, 1, 1, 1, -1, -1, 1, 1, -1, 1, -1, 1, 1, 1, 1]
LTS += [0, 1, -1, -1, 1, 1, -1, 1, -1, 1, -1, -1, -1, -1, -1, 1, 1, -1, -1, 1, -1, 1, -1, 1, 1, 1, 1] + [0] * 5
SYMBOL = np.fft.ifft(np.fft.ifftshift(LTS))
NOISE = 20.0
"""Standard deviation of the noise in each of I and Q, in steps of the 16-bit converter."""
DEVIATIONS = 6.0
"""Of the estimate's error at most: 3,120 values at 6 standard deviations fail once in 1e8."""


def taps() -> np.ndarray:
    """Impulse responses [frames, users, antennas, taps], strongest of them well below the converter's full scale."""
    rng = np.random.default_rng(7)
    parts = rng.standard_normal((2, FRAMES, USERS, ANTENNAS, TAPS)) * 0.5 ** np.arange(TAPS)
    return (parts[0] + 1j * parts[1]) * 0.25


def truth() -> np.ndarray:
    """What the channel is at subcarriers -26..-1, 1..26."""
    return np.fft.fft(taps(), 64, axis=-1)[..., SUBCARRIERS % 64]


def received(sent: np.ndarray, slot: int, start: int) -> np.ndarray:
    """16-bit samples [frames, users, antennas, slot, 2] of a sequence that begins at ``start`` of each slot."""
    rng = np.random.default_rng(8)
    channel = taps()
    samples = np.zeros((*channel.shape[:3], slot), complex)
    for tap in range(TAPS):
        samples[..., start + tap : start + tap + len(sent)] += channel[..., tap, None] * sent
    both = np.stack([samples.real, samples.imag], axis=-1) * 2**15
    return np.rint(both + NOISE * rng.standard_normal(both.shape)).astype(np.int16)


def write(path: Path, values: np.ndarray, attributes: dict[str, Any], group: str = "/") -> Path:
    """A capture, without the attributes that are None."""
    with h5py.File(path, "w") as file:
        place = file.require_group(group)
        place.create_dataset("Pilot_Samples", data=values)
        place.attrs.update({key: value for key, value in attributes.items() if value is not None})
    return path


ARGOS = {"num_mob_ant": USERS, "samples_per_user": 224, "frame_length": 20000, "measured_noise": 1}


def argos(path: Path, **changes: Any) -> Path:
    """The layout of ArgosV2: two symbols at 47 after a guard of 32, and a slot of noise after the users'."""
    samples = received(np.concatenate([SYMBOL[-32:], SYMBOL, SYMBOL]), 224, 15)
    noise = np.full_like(samples[:, :1], 3)
    every = np.concatenate([samples, noise], axis=1).swapaxes(1, 2)
    return write(path, every.reshape(FRAMES, ANTENNAS, -1, 2), ARGOS | changes)


SOUNDER = {"PREFIX_LEN": 82, "POSTFIX_LEN": 68, "CP_LEN": [16], "FFT_SIZE": 64, "FREQ": 3.6e9, "RATE": 5e6}
SOUNDER |= {"PILOT_SEQ_TYPE": np.array([b"lts"])}


def sounder(path: Path, symbols: int = 4, group: str = "Data", cells: int = 1, **changes: Any) -> Path:
    """The layout of RENEW's sounder: as many symbols as fit between prefix and postfix, each after its guard."""
    samples = received(np.tile(np.concatenate([SYMBOL[-16:], SYMBOL]), symbols), 150 + 80 * symbols, 82)
    values = samples.reshape(FRAMES, 1, USERS, ANTENNAS, -1)
    values = np.concatenate([np.roll(values, k, axis=0) for k in reversed(range(cells))], axis=1)
    return write(path, values, SOUNDER | changes, group)


def assert_found(record: Any, symbols: int, frames: Any = slice(None)) -> None:
    expected = truth()[frames].reshape(-1, ANTENNAS, 52)
    read_channels = np.concatenate([record.uplink, record.observation[0]], axis=-1)
    assert read_channels.shape == expected.shape
    # A bin adds 64 samples of noise; rounding to whole steps adds 1/12 to its variance.
    deviation = np.sqrt(64 * 2 * (NOISE**2 + 1 / 12) / symbols) / 2**15
    error = np.abs(read_channels - expected)
    assert error.max() < DEVIATIONS * deviation
    assert error.std() > deviation / 10  # so that the bound means something
    assert np.abs(expected).mean() > 20 * deviation


def test_a_known_channel_is_found_in_the_layout_of_argos(tmp_path: Path) -> None:
    record = load(argos(tmp_path / "trace.hdf5"))
    assert (record.name, record.task.name, len(record)) == ("trace", "csi", FRAMES * USERS)
    assert record.observation.shape == (1, FRAMES * USERS, ANTENNAS, 26)
    assert record.observation.dtype == np.complex64
    assert np.isnan(record.tx_pos_m).all()
    assert record.frequencies_hz is None
    assert_found(record, symbols=2)
    assert_found(load(tmp_path), symbols=2)
    (split,) = make_splits(record, "trajectory")
    assert split.test.tolist() == [10, 11]


@pytest.mark.parametrize("group", ["/", "Data"])
@pytest.mark.parametrize("symbols", [1, 4])
def test_a_known_channel_is_found_in_the_layout_of_the_sounder(tmp_path: Path, group: str, symbols: int) -> None:
    record = load(sounder(tmp_path / "trace.h5", symbols, group))
    assert_found(record, symbols)
    spacing = 5e6 / 64
    np.testing.assert_allclose(record.uplink_hz[[0, -1]], [3.6e9 - 26 * spacing, 3.6e9 - spacing])
    np.testing.assert_allclose(record.frequencies_hz[[0, -1]], [3.6e9 + spacing, 3.6e9 + 26 * spacing])


def test_frames_and_cells_can_be_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = sounder(tmp_path / "trace.hdf5", cells=2)
    refusal(read_argos, path, "2 cells; give cell, 0 to 1")
    refusal(read_argos, path, "no cell 2; it has 0 to 1", cell=2)
    error_line(read_argos, path, "select none of 4", cell=1, frames=slice(9, None))
    assert_found(read_argos(path, cell=1), 4)
    assert_found(read_argos(path, cell=1, frames=slice(1, None, 2)), 4, slice(1, None, 2))
    monkeypatch.setattr("wrf_mi.datasets.argos.CHUNK_SIZE", 1)  # frame by frame
    assert_found(read_argos(path, cell=1), 4)


def test_frames_that_were_not_captured_are_in_no_split(tmp_path: Path) -> None:
    path = sounder(tmp_path / "trace.hdf5")
    with h5py.File(path, "r+") as file:
        values = file["Data/Pilot_Samples"]
        values[2] = np.zeros_like(values[2])
    record = read_argos(path)
    (split,) = make_splits(record, "trajectory")
    assert sorted([*split.all_train, *split.test]) == [0, 1, 2, 3, 4, 5, 9, 10, 11]
    assert np.isnan(record.uplink[6:9]).all()


def no_pilots(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["Other"] = np.arange(3)


def unreadable_attribute(path: Path) -> None:
    """HDF5 has times, NumPy has none like them."""
    sounder(path)
    with h5py.File(path, "r+") as file:
        space = h5py.h5s.create(h5py.h5s.SCALAR)
        h5py.h5a.create(file["Data"].id, b"STARTED", h5py.h5t.UNIX_D32LE, space)


def samples(*shape: int, dtype: Any = np.int16, attributes: dict[str, Any] = SOUNDER) -> Callable[[Path], object]:
    return lambda path: write(path, np.zeros(shape, dtype), attributes)


def one_sample(path: Path) -> None:
    write(path, np.random.default_rng(2).integers(-9, 9, (1, 1, 1, 2, 800)).astype(np.int16), SOUNDER)


def of_pilots(kind: Any) -> Callable[[Path], object]:
    return partial(sounder, PILOT_SEQ_TYPE=kind)


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "not HDF5": (lambda path: path.write_text("no HDF5"), "not readable as HDF5"),
    "missing": (lambda path: None, "missing; give a capture"),
    "no pilots": (no_pilots, "neither /Pilot_Samples nor /Data/Pilot_Samples in it"),
    "floats": (samples(2, 3, 4, 2, dtype=float, attributes={}), "holds float64"),
    "no users": (partial(argos, num_mob_ant=None), "attribute num_mob_ant is missing"),
    "too many users": (partial(argos, num_mob_ant=9), "9 users have 224 samples each"),
    "many users": (partial(argos, num_mob_ant=np.full(500, -1)), r"mob_ant is array\(\[-1, -1,.*\.\.\.; it must state"),
    "short slots": (partial(argos, samples_per_user=100), "at 47, 111 do not fit in slots of 100"),
    "no prefix": (partial(sounder, PREFIX_LEN=None), "attribute PREFIX_LEN is missing"),
    "long prefix": (partial(sounder, PREFIX_LEN=450), "do not fit in slots of 470 samples; correct"),
    "other pilots": (of_pilots(np.array([b"zadoff-chu"])), "'zadoff-chu' of 64 samples"),
    "attribute of a time": (unreadable_attribute, r"attribute cannot be read \(.*; write it again as a number or as"),
    "empty word of pilots": (of_pilots(np.array([b""], "S3")), "attribute PILOT_SEQ_TYPE is empty; it must be lts"),
    "pilots not UTF-8": (of_pilots(np.array([b"\xff\xfe"])), r"pilots .*xff.* of 64"),
    "longer symbols": (partial(sounder, FFT_SIZE=2048), "of 2048 samples; the long training symbol"),
    "half a pair": (samples(2, 1, 1, 2, 301), "301 numbers a slot, which are no pairs"),
    "one sample": (one_sample, "1 of 1 samples hold a"),
    "silence": (samples(3, 1, 1, 2, 800), "0 of 3 samples hold a sig"),
}


@pytest.mark.parametrize("case", WRONG)
def test_bad_captures_are_refused_with_one_line(tmp_path: Path, case: str) -> None:
    make, message = WRONG[case]
    make(tmp_path / "trace.hdf5")
    assert refusal(read_argos, tmp_path / "trace.hdf5", message).startswith(f"{tmp_path / 'trace.hdf5'}: ")


def test_several_captures_or_no_h5py_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    argos(tmp_path / "a.hdf5")
    argos(tmp_path / "b.h5")
    refusal(load, tmp_path, r"one capture in HDF5 is read at a time, found a.hdf5, b.h5")
    monkeypatch.setitem(sys.modules, "h5py", None)
    refusal(load, tmp_path / "a.hdf5", r"reading HDF5 needs h5py; install it: pip install '\.\[argos\]'")
