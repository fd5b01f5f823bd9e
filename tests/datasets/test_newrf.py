"""The NeWRF rooms: the layout, its conversion from the authors' pickles, and pickles that mean harm."""

import os
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import DATA, needs, refusal
from scipy.constants import speed_of_light

from wrf_mi.core import InputError
from wrf_mi.datasets import load, make_splits, read_newrf
from wrf_mi.datasets.newrf import KEYS, arrays_sha256, convert_newrf, read_pickled_table

PICKLES = Path(__file__).parent / "data"
PICKLE = (PICKLES / "newrf_protocol5.pkl").read_bytes()
NO_TABLE = "not the pickle of a table of numbers.*; fetch it again"
ROUNDING = 1e-15
"""Sums of some tens of gains below 0.02 in float64, in another order."""


def room(rows: int = 10) -> dict[str, Any]:
    rng = np.random.default_rng(2)
    return {
        "tx_pos": np.array([1.0, 2, 3]),
        "rx_pos": rng.normal(size=(rows, 3)),
        "frequency_hz": np.float64(2.4e9),
        "csi": rng.normal(size=rows) + 1j * rng.normal(size=rows),
    }


def test_the_moving_receiver_is_the_records_transmitter(tmp_path: Path):
    arrays = room(11)
    np.savez(tmp_path / "hall.npz", **arrays)
    record = read_newrf(tmp_path / "hall.npz")
    assert (record.name, record.task.name) == ("hall", "csi")
    np.testing.assert_array_equal(record.tx_pos_m, arrays["rx_pos"])
    (receiver,) = record.receivers
    np.testing.assert_array_equal(receiver.position_m, [1, 2, 3])
    np.testing.assert_array_equal(receiver.to_world, np.eye(3))
    assert record.observation.dtype == np.complex64
    np.testing.assert_array_equal(record.observation, arrays["csi"].astype(np.complex64)[None, :, None])
    np.testing.assert_array_equal(record.frequencies_hz, [2.4e9])
    assert [part.tolist() for part in record.official] == [list(range(9)), [9, 10]]
    assert load(tmp_path).source == load(str(tmp_path / "hall.npz")).source == str(tmp_path / "hall.npz")


def changed(**arrays: Any) -> dict[str, Any]:
    return room() | arrays


def with_value(key: str, at: Any, value: float) -> dict[str, Any]:
    values = room()[key]
    values[at] = value
    return changed(**{key: values})


WRONG = {  # each is refused, see test_faults.py
    "array missing": ({k: v for k, v in room().items() if k != "csi"}, "no array .*csi.*; a room needs tx_pos"),
    "positions of two numbers": (changed(rx_pos=np.zeros((10, 2))), r"rx_pos has shape \[10, 2\], expected \[10, 3\]"),
    "another number of rows": (changed(csi=np.zeros(9, complex)), r"csi has shape \[9\], expected \[10\]"),
    "NaN position": (with_value("rx_pos", (3, 1), np.nan), "rx_pos, row 4: not finite"),
    "infinite channel": (with_value("csi", 7, np.inf), "csi, row 8: not finite"),
    "real channel": (changed(csi=np.zeros(10)), "csi holds float64; give complex numbers"),
    "no frequency": (changed(frequency_hz=np.float64(0)), "frequency_hz is 0.0; give the carrier in Hz"),
    "two frequencies": (changed(frequency_hz=np.ones(2)), r"frequency_hz has shape \[2\], expected \[\]"),
    "too few rows": (room(4), "rx_pos has 4 rows"),
}


def test_damaged_and_missing_files_are_refused(tmp_path: Path):
    refusal(read_newrf, tmp_path / "hall.npz", r"hall\.npz: missing")
    refusal(read_newrf, tmp_path, r"one room in \.npz is read at a time, found none")
    (tmp_path / "hall.npz").write_text("")
    refusal(read_newrf, tmp_path, r"hall\.npz: not readable")
    np.savez(tmp_path / "hall.npz", **changed(csi=np.array([None] * 10)))
    refusal(read_newrf, tmp_path, "not readable")
    np.savez(tmp_path / "attic.npz", **room())
    refusal(load, tmp_path, r"found attic\.npz, hall\.npz; give the file itself")


def drawn() -> dict[str, np.ndarray]:
    """What ``data/newrf_protocol*.pkl`` hold.

    They were written by pandas 1.5.3 and NumPy 1.23.5, the authors' versions, from these draws: a MATLAB structure with
    the fields of their ``simulator/main.m``, the third of six receivers left empty, passed through the steps of their
    ``simulator/mat2pkl.py``; protocol 5 as pandas chooses on Python 3.8 or later, and protocol 4.
    """
    rng = np.random.default_rng(0)
    gains, positions, points, direct = [], [], [], []
    for i in (0, 1, 3, 4, 5):
        gains.append((rng.normal(size=(1, 1 + i)) + 1j * rng.normal(size=(1, 1 + i)))[0])
        positions.append(rng.normal(size=(3, 1))[:, 0])
        points.append(rng.normal(size=(3, 1 + i)).T)
        direct.append(i % 2 == 1)
    return {
        "tx_pos": np.array([-1.5, 0, 1.7]),
        "rx_pos": np.stack(positions),
        "frequency_hz": np.array(2.412e9),
        "csi": np.array([g.sum() for g in gains]),
        "line_of_sight": np.array(direct),
        "path_offsets": np.array([0, 1, 3, 7, 12, 18]),
        "path_gain": np.concatenate(gains),
        "path_last_point": np.concatenate(points),
    }


@pytest.mark.parametrize("protocol", [4, 5])
def test_the_authors_pickle_is_converted(protocol: int):
    arrays, expected = convert_newrf(PICKLES / f"newrf_protocol{protocol}.pkl"), drawn()
    assert tuple(arrays) == KEYS
    for key in KEYS:
        assert arrays[key].dtype == expected[key].dtype
        np.testing.assert_array_equal(arrays[key], expected[key], err_msg=key)
    assert arrays_sha256(arrays) == arrays_sha256(expected)


def test_the_hash_is_of_names_types_shapes_and_values():
    arrays = drawn()
    csi, gain = arrays["csi"], arrays["path_gain"]
    others = [{"csi": csi.astype(np.complex64)}, {"csi": csi[::-1]}, {"csi": csi[:, None]}, {"csi": csi * (1 + 1e-15)}]
    hashes = {arrays_sha256(arrays | other) for other in ({}, *others, {"path_gain": csi, "csi": gain})}
    assert len(hashes) == 6
    assert arrays_sha256(arrays | {"csi": np.asfortranarray(csi).astype(">c16")}) in hashes


class Harm:
    """Runs a command when it is unpickled by other means."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return os.system, (f"touch '{self.target}'",)


def test_nothing_that_a_pickle_names_is_run(tmp_path: Path):
    touched = tmp_path / "touched"
    harm = pickle.dumps(Harm(touched))
    pickle.loads(harm)
    assert touched.exists(), "the test's harm does no harm"
    touched.unlink()
    (tmp_path / "bad.pkl").write_bytes(harm)
    refusal(convert_newrf, tmp_path / "bad.pkl", r"bad\.pkl: not the pickle of a table of numbers")
    assert not touched.exists()
    # Ahead of the authors' own table, made and thrown away (0 pops it).
    ahead = pickletools.optimize(pickle.dumps(Harm(touched), protocol=2))[2:-1]
    frame = 11  # bytes of its head: protocol and the length of a frame
    (tmp_path / "both.pkl").write_bytes(PICKLE[:2] + ahead + b"0" + PICKLE[frame:])
    refusal(convert_newrf, tmp_path / "both.pkl", r"both\.pkl: not the pickle of a table .*\(names posix\.system\)")
    assert not touched.exists()


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        *((read_pickled_table, b, NO_TABLE) for b in (b"", b"\x80\x05.", b"no pickle", pickle.dumps({"_mgr": 1}))),
        (convert_newrf, PICKLE.replace(b"RxChanPerRay", b"SomethingNew"), "no column RxChanPerRay; give a data set"),
        (convert_newrf, b"\x80\x02Nr\xff\xff\xff\x7f.", NO_TABLE),  # object 2147483647 of a list
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, read: Any, content: bytes, message: str):
    """Content that may end the process in a child process."""
    (tmp_path / "bad.pkl").write_bytes(content)
    refusal(read, tmp_path / "bad.pkl", message)


def test_a_pickle_that_is_cut_or_changed_is_refused_or_gives_other_arrays(tmp_path: Path):
    expected = drawn()
    rng = np.random.default_rng(4)
    for trial in range(4):
        content = bytearray(PICKLE)
        if trial % 2:
            content[rng.integers(len(content))] ^= int(rng.integers(1, 256))
        else:
            del content[rng.integers(len(content)) :]
        (tmp_path / "bad.pkl").write_bytes(content)
        try:
            arrays = convert_newrf(tmp_path / "bad.pkl")
        except InputError:
            continue
        same = all(np.array_equal(arrays[key], expected[key]) for key in KEYS)
        assert (arrays_sha256(arrays) == arrays_sha256(expected)) == same


@needs("newrf")
@pytest.mark.parametrize(("name", "rows", "held_out"), [("conference", 433, 86), ("office", 1907, 381)])
def test_the_real_data(name: str, rows: int, held_out: int):
    record = load(f"newrf-{name}")
    assert (record.name, record.observation.shape) == (f"newrf-{name}", (1, rows, 1))
    (split,) = make_splits(record, "official")
    assert split.test.tolist() == list(range(rows - held_out, rows))
    # What the file says of its paths holds: their sum is the channel, and the direct path has the distance's loss.
    with np.load(Path(DATA, "newrf", f"{name}.npz")) as arrays:
        gain, start = arrays["path_gain"], arrays["path_offsets"][:-1]
        np.testing.assert_allclose(np.add.reduceat(gain, start), arrays["csi"], atol=ROUNDING)
        np.testing.assert_allclose(record.observation[0, :, 0], arrays["csi"], rtol=1e-6)
        direct = arrays["line_of_sight"]
    distance = np.linalg.norm(record.tx_pos_m - record.receivers[0].position_m, axis=1)[direct]
    loss = speed_of_light / record.frequencies_hz[0] / (4 * np.pi * distance)
    np.testing.assert_allclose(np.abs(gain[start[direct]]), loss, rtol=1e-9)
