"""NeRF2's layout of channels: what is read, what is written, and every way in which a folder can be wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from changed_folders import Change, refusal, rewritten
from spectrum_records import assert_same

from wrf_mi.datasets import load, make_splits, read_nerf2_csi, write_nerf2_csi

SAMPLES, ANTENNAS, HALF = 6, 3, 4
PLACES = [[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [1.0, 0.0, 1.0]]
FLOAT64 = 1e-12
ASKED_HZ = 2.4e9 + 1e6 * np.arange(2.0 * HALF)


def channels(samples: int = SAMPLES, subcarriers: int = 2 * HALF) -> np.ndarray:
    rng = np.random.default_rng(5)
    parts = rng.standard_normal((2, samples, ANTENNAS, subcarriers))
    return parts[0] + 1j * parts[1]


def write_correct(folder: Path) -> Path:
    np.save(folder / "csidata.npy", channels())
    station()(folder)
    (folder / "train_index.txt").write_text("5\n0\n3\n1\n")
    (folder / "test_index.txt").write_text("4\n2\n")
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_correct(tmp_path)


def test_reads_a_folder(folder: Path) -> None:
    record = load(folder)
    expected = channels().astype(np.complex64)
    assert (record.task.name, record.source, len(record)) == ("csi", str(folder), SAMPLES)
    np.testing.assert_array_equal(record.uplink, expected[..., :HALF])
    np.testing.assert_array_equal(record.observation, expected[None, ..., HALF:])
    assert record.observation.dtype == np.complex64
    assert np.isnan(record.tx_pos_m).all()
    assert record.tx_pos_m.shape == (SAMPLES, 3)
    assert not record.has_positions
    assert [part.tolist() for part in record.official] == [[5, 0, 3, 1], [4, 2]]  # NeRF2 counts these from 0
    np.testing.assert_allclose(record.receivers[0].position_m, [0.5, 0, 1])
    np.testing.assert_allclose(record.receivers[0].array_m, [[-0.5, 0, 0], [0.0, 0, 0], [0.5, 0, 0]])
    assert record.frequencies_hz is None
    assert record.uplink_hz is None
    np.testing.assert_array_equal(record.scored, record.observation)


def test_splits_without_positions(folder: Path) -> None:
    record = read_nerf2_csi(folder)
    (official,) = make_splits(record, "official")
    assert official.test.tolist() == [2, 4]
    (random,) = make_splits(record, "random", seed=3, n_train=4)
    assert (len(random.all_train), len(random.test)) == (4, 1)
    (trajectory,) = make_splits(record, "trajectory", n_train=0.5)
    assert trajectory.test.tolist() == [5]
    for rule in ("blocked", "blocked:1"):
        refusal(make_splits, record, rule, "blocks need the position of every row.*use the split random or trajectory")
    blocked = make_splits(replace(record, folds=np.arange(SAMPLES) % 2), "blocked")
    assert [split.test.tolist() for split in blocked] == [[0, 2, 4], [1, 3, 5]]


def test_written_record_is_read_again(folder: Path, tmp_path: Path) -> None:
    plain = replace(read_nerf2_csi(folder), uplink_hz=ASKED_HZ[:HALF], frequencies_hz=ASKED_HZ[HALF:])
    turned = replace(plain.receivers[0], orientation_xyzw=np.array([0.5, 0.5, 0.5, 0.5]))
    tx_pos_m = np.random.default_rng(1).uniform(size=(SAMPLES, 3))
    full = replace(plain, receivers=(turned,), tx_pos_m=tx_pos_m, truth=(plain.observation * 2).astype(np.complex64))
    for record, name in ((plain, "plain"), (full, "full")):
        back = load(write_nerf2_csi(tmp_path / name, record, extra={"note.txt": "x"}))
        # Elements are kept in the world's frame.
        np.testing.assert_allclose(back.receivers[0].array_m, record.receivers[0].array_m, atol=FLOAT64)
        same_array = replace(back.receivers[0], array_m=record.receivers[0].array_m)
        assert_same(replace(back, receivers=(same_array,)), record, "name")
        assert (tmp_path / name / "note.txt").read_text() == "x"
    refusal(write_nerf2_csi, tmp_path / "full", full, "exists")
    for change, message in (
        ({"folds": np.zeros(SAMPLES, np.int64)}, "has folds, which this layout does not state; set"),
        ({"runs": np.full(SAMPLES, "day 1")}, "has runs, which this layout does not state; set"),
        ({"uplink": None}, r"cannot be written as csidata\.npy; it needs one receiver with array_m"),
    ):
        refusal(write_nerf2_csi, tmp_path / "new", replace(full, **change), message)
        assert not (tmp_path / "new").exists()


def save(values: Any, name: str = "csidata.npy") -> Change:
    return lambda folder: np.save(folder / name, values)


def station(**changes: Any) -> Change:
    def change(folder: Path) -> None:
        (folder / "base-station.yml").write_text(yaml.safe_dump({"base_station": PLACES} | changes))

    return change


def with_value(value: complex) -> np.ndarray:
    values = channels()
    values[4, 1, 6] = value
    return values


CSI, YML, TRUTH = "csidata.npy", "base-station.yml", "downlink_truth.npy"
WRONG: dict[str, tuple[Change, str, str]] = {  # each is refused, see test_faults.py
    "no channels": (lambda folder: (folder / CSI).unlink(), CSI, "missing"),
    "no station": (lambda folder: (folder / YML).unlink(), YML, "missing"),
    "damaged": rewritten(CSI, "no array", "not readable .*; write it again"),
    "pickled": (save(np.array([{}], object)), CSI, "not readable .*; write it again"),
    "real": (save(channels().real), CSI, "holds float64; give complex numbers"),
    "two axes": (save(channels()[0]), CSI, r"shape \[3, 8\]; give complex numbers \[samples, antennas, subcarriers\]"),
    "nothing": (save(channels()[:0]), CSI, r"shape \[0, 3, 8\]"),
    "odd": (save(channels(subcarriers=7)), CSI, "7 subcarriers do not halve into uplink and downlink"),
    "one sample": (save(channels(samples=1)), CSI, "1 sample; give 2 at least"),
    "complex NaN": (save(with_value(complex(np.nan, 1))), CSI, r"sample 4, antenna 1, subcarrier 6 \(from 0\).*finite"),
    "beyond single precision": (save(with_value(1e300)), CSI, r"sample 4, antenna 1.*1e\+300.* too large for single"),
    "station empty": rewritten(YML, "", "base_station is None; give x, y, z in metres of each antenna"),
    "station of 400 digits": rewritten(YML, f"a:\n- [0, 0, {'9' * 400}]\n", "no int .*too large.*line 2, column 10"),
    "station in the plane": (station(base_station=[[0, 1]]), YML, "base_station is"),
    "station fewer": (station(base_station=PLACES[:2]), YML, "2 positions in base_station, but csidata.npy has 3 ante"),
    "orientation": (station(orientation=[1.0, 1, 0, 0]), YML, "quaternion of norm 1.414"),
    "frequency too high": (station(frequencies_hz=[1e39] * 8), YML, "frequencies_hz is"),
    "frequencies differ": (station(frequencies_hz=[1e9] * 7), YML, "7 frequencies_hz, but csidata.npy has 8 subcarri"),
    "positions fewer": rewritten("tx_pos.csv", "x,y,z\n1,2,3\n", "1 rows, but csidata.npy has 6 samples"),
    "truth of another shape": (save(channels(), TRUTH), TRUTH, r"shape \[6, 3, 8\], expected \[6, 3, 4\]"),
    "index out of range": rewritten("train_index.txt", "6\n", "row 6 is out of range; csidata.npy has"),
}
