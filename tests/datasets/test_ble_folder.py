"""The layout of the BLE signal-strength data: what is read, and every way in which a folder can be wrong."""

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changed_folders import DATA, Change, error_line, needs, refusal, remove, replaced, rewritten, text
from made_flat import write_flat
from spectrum_records import assert_same

from wrf_mi.core import Antenna
from wrf_mi.datasets import load, make_splits, read_ble_folder, write_ble_folder
from wrf_mi.datasets.spectrum_folder import read_spectrum_folder, write_spectrum_folder

FLOAT32 = 1e-5
"""Rounding of powers of tens of dBm to float32."""

ANCHORS = "id,x,y,z\n3,1.5,2,2.5\n1,0,-1,2\n"
TRAINING = """,ts,x,heading,y,rssi_1,rssi_3
0,1.6e18,0.5,3.1,1.5,-54.25,-60
1,1.6e18,0.25,-40.5,1.75,,-61.5
2,1.6e18,1,0,2,,
3,1.6e18,1.25,0,2,-70,nan
"""
TEST = "ts,x,y,heading,rssi_3,rssi_1\n1.6e18,2,3,0.5,-80,-81\n"
TRAIN_FILE, TEST_FILE = "calibration_df.csv", "test_robot_df.csv"
nan = np.nan


def write_correct(folder: Path) -> Path:
    for name, content in (("anchors.csv", ANCHORS), (TRAIN_FILE, TRAINING), (TEST_FILE, TEST)):
        (folder / name).write_text(content)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_correct(tmp_path)


def test_reads_a_folder(folder: Path):
    record = read_ble_folder(folder, "made-up")
    assert (record.name, record.task.name, record.source) == ("made-up", "rssi", str(folder))
    assert [r.name for r in record.receivers] == ["anchor3", "anchor1"]
    np.testing.assert_array_equal(record.receivers[0].position_m, [1.5, 2, 2.5])
    np.testing.assert_array_equal(record.receivers[0].to_world, np.eye(3))
    np.testing.assert_array_equal(record.tx_pos_m.T, [[0.5, 0.25, 1, 1.25, 2], [1.5, 1.75, 2, 2, 3], [1.3] * 5])
    assert record.observation.dtype == np.float32
    np.testing.assert_array_equal(record.observation, [[-60, -61.5, nan, nan, -80], [-54.25, nan, nan, -70, -81]])
    np.testing.assert_array_equal(record.tx_heading_rad, [3.1, -40.5, 0, 0, 0.5])
    assert [part.tolist() for part in record.official] == [[0, 1, 2, 3], [4]]
    np.testing.assert_array_equal(record.frequencies_hz, [2.44e9])
    assert load(folder).task.name == "rssi"
    refusal(read_ble_folder, folder / "nothing", r"not a folder; give one that holds receivers\.csv")
    # Rows that no anchor received are in no split.
    (split,) = make_splits(record, "official")
    assert (split.all_train.tolist(), split.test.tolist()) == ([0, 1, 3], [4])


def test_heights_are_those_of_the_rows_and_the_default_is_logged(folder: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.INFO, "wrf_mi"):
        plain = read_ble_folder(folder)
        assert caplog.messages == [f"{folder}: no column z; all transmitters are taken to be 1.3 m above the floor"]
        caplog.clear()
        heights("0.25", "2.5")(folder)
        record = read_ble_folder(folder)
        assert caplog.messages == []
    np.testing.assert_array_equal(record.tx_pos_m[:, 2], [0.25, 0.25, 0.25, 0.25, 2.5])
    np.testing.assert_array_equal(record.tx_pos_m[:, :2], plain.tx_pos_m[:, :2])
    # Headings are optional.
    for name in (TRAIN_FILE, TEST_FILE):
        text(name, "heading", "yaw")(folder)
    assert read_ble_folder(folder).tx_heading_rad is None


def test_anchors_have_numbers_or_names(folder: Path):
    (folder / "anchors.csv").write_text('id,x,y,z\n"hall, upper",1,2,2.5\n4e10,0,-1,2\n07,3,3,3\nKüche,0,0,1\n')
    header = 'rssi_4e10, rssi_Küche ,y,x,rssi_7.0,"rssi_hall, upper"'
    (folder / TRAIN_FILE).write_text(f"{header}\n-1,-2,0,0,-3,-4\n")
    (folder / TEST_FILE).write_text(f"{header}\n-5,-6,0,0,-7,-8\n")
    record = read_ble_folder(folder)
    assert [r.name for r in record.receivers] == ["hall, upper", "4e10", "anchor7", "Küche"]
    np.testing.assert_array_equal(record.observation, [[-4, -8], [-1, -5], [-3, -7], [-2, -6]])


def add_columns(file: Path, **columns: list[str]) -> None:
    header, *rows = file.read_text().splitlines()
    rows = [",".join(fields) for fields in zip(rows, *columns.values(), strict=True)]
    file.write_text("\n".join([",".join([header, *columns]), *rows]) + "\n")


def heights(training: str, test: str) -> Change:
    """Add a column z with one text for each file."""

    def change(folder: Path) -> None:
        add_columns(folder / TRAIN_FILE, z=[training] * 4)
        add_columns(folder / TEST_FILE, z=[test])

    return change


TWO = r"2 columns rssi_\*, but anchors.csv has"
WRONG: dict[str, tuple[Change, str, str]] = {  # each is refused, see test_faults.py
    "no anchors file": (remove("anchors.csv"), "anchors.csv", "missing"),
    "no training rows file": (remove(TRAIN_FILE), TRAIN_FILE, "missing"),
    "no test rows file": (remove(TEST_FILE), TEST_FILE, "missing"),
    "empty file": rewritten(TEST_FILE, "", "empty"),
    "header alone": rewritten(TRAIN_FILE, TRAINING.splitlines()[0], "no rows below the header"),
    "no header": replaced(TEST_FILE, r"^ts.*\n", "1,2,3,4,5,6\n", "line 1: header '1,2,3,4,5,6' has no col"),
    "no column x": replaced(TRAIN_FILE, ",x,", ",X,", "line 1: header .* has no column x;"),
    "heading of test rows alone": replaced(TRAIN_FILE, "heading", "yaw", r"1: no column heading, but test_robot_df"),
    "height of the training rows alone": (
        text(TRAIN_FILE, "ts", "z"),
        TEST_FILE,
        r"1: no column z, but calibration_df\.csv has one; give it in both files or in neither",
    ),
    "empty height": (heights("", "1"), TRAIN_FILE, "row 1: z is ''"),
    "column twice": replaced(TRAIN_FILE, "ts", "x", "has twice the column x"),
    "no z of anchors": replaced("anchors.csv", "z", "height", "no column z"),
    "NaN position": replaced(TRAIN_FILE, "0.25", "nan", "row 2: x is 'nan'; give a finite number$"),
    "NaN heading": replaced(TRAIN_FILE, "-40.5", "nan", "row 2: heading is 'nan'"),
    "power of words": replaced(TRAIN_FILE, "-54.25", "weak", "row 1: rssi_1 is 'weak'; .*leave it empty"),
    "field missing": replaced(TRAIN_FILE, ",-60$", "", "row 1: 6 fields, but the header has 7"),
    "quote left open": replaced(TRAIN_FILE, "^1,", '"1,', "not a CSV file"),
    "anchor too few": (text("anchors.csv", "^1,.*\n", ""), TRAIN_FILE, rf"{TWO} 1 anchors \(rssi_1 belongs to none\)"),
    "anchor too many": (text("anchors.csv", "^1", "7,0,0,0\n1"), TRAIN_FILE, rf"{TWO} 3 anchors \(rssi_7 is missing\)"),
    "anchor with another id": replaced(TEST_FILE, "rssi_3", "rssi_2", r"rssi_2 belongs to none"),
    "column of an anchor twice": replaced(TRAIN_FILE, "^,ts", "rssi_01,ts", "rssi_01 and rssi_1 name one"),
    "anchor twice": replaced("anchors.csv", "^1", "3", "row 2: id '3' gives the name anchor3, as row 1"),
    "anchor with the name of a number": replaced("anchors.csv", "^1", "anchor3", "row 2: id 'anchor3' gi"),
    "anchor without an id": replaced("anchors.csv", "^1", " ", "row 2: id ' ' is empty"),
    "anchor of pandas without an id": replaced("anchors.csv", "^1", "nan", "row 2: id 'nan' is pandas"),
    "anchor with a tab in it": replaced("anchors.csv", "^1", "a\tb", "row 2: id .* does not go into one"),
    "no ids": replaced("anchors.csv", "id", "number", "has no column id"),
    "anchor without y": replaced("anchors.csv", "-1", "nan", "row 2: y is empty; give x and y"),
}


@needs("flat-ble")
def test_the_real_data():
    record = load("flat-ble")
    assert record.observation.shape == (6, 4823)
    assert [len(part) for part in record.official] == [4104, 719]
    # As NumPy reads the file.
    table = np.genfromtxt(Path(DATA, "flat-ble", TRAIN_FILE), delimiter=",", skip_header=1)
    np.testing.assert_allclose(record.observation[:, :4104], table[:, 5:].T, atol=FLOAT32)
    np.testing.assert_array_equal(record.tx_pos_m[:4104, :2], table[:, [2, 4]])
    missing = np.isnan(record.observation)
    assert missing.sum(axis=1).tolist() == [162, 267, 253, 444, 591, 630]
    assert not missing.all(axis=0).any()
    assert min(len(split.test) for split in make_splits(record, "blocked")) > 400
    # Its runs are its two files.
    (split,), (official,) = (make_splits(record, rule, validation_fraction=0) for rule in ("other-run:1", "official"))
    np.testing.assert_array_equal(split.test, official.test)
    np.testing.assert_array_equal(split.all_train, official.all_train)
    assert (set(record.runs[split.train]), set(record.runs[split.test])) == ({"calibration"}, {"test"})


def with_columns(folder: Path, **columns: list[str]) -> Path:
    add_columns(folder / "anchors.csv", **columns)
    return folder


def test_antennas_are_read(tmp_path: Path):
    plain = read_ble_folder(write_flat(tmp_path / "plain"))
    assert {receiver.antenna for receiver in plain.receivers} | {plain.tx_antenna} == {Antenna()}
    columns = {"pattern": ["dipole", ""], "polarization": ["", "H"], "tx_polarization": ["H", "H"]}
    record = read_ble_folder(with_columns(write_flat(tmp_path / "own"), **columns))
    assert [receiver.antenna for receiver in record.receivers] == [Antenna("dipole"), Antenna("iso", "H")]
    assert record.tx_antenna == Antenna("iso", "H")


def test_patterns_are_files_of_the_folder(tmp_path: Path):
    """By paths relative to it, in strengths and spectra; folders that are written hold copies."""
    folder, pattern = (
        write_flat(tmp_path / "own"),
        "theta,phi,gain_db\n"
        + "".join(f"{theta},{phi},{-1 - (theta > 90)}\n" for theta in range(0, 181, 30) for phi in range(0, 360, 60)),
    )
    (folder / "antennas").mkdir()
    (folder / "antennas" / "a.csv").write_text(pattern)
    record = read_ble_folder(with_columns(folder, pattern=["antennas/a.csv", ""], tx_pattern=["antennas/a.csv"] * 2))
    assert (record.receivers[0].antenna.pattern, record.tx_antenna.frame) == (str(folder / "antennas/a.csv"), "world")
    assert record.receivers[0].antenna.measured.peak_dbi == -1
    copied = read_ble_folder(write_ble_folder(tmp_path / "copy", record))
    shutil.rmtree(folder)
    black = np.zeros((2, len(copied), 3, 6), np.float32)
    images = replace(copied, task="spectrum", observation=black, n_readings=None, std=None)
    unstated = {"tx_heading_rad": None, "official": None, "runs": None}
    spectra = read_spectrum_folder(write_spectrum_folder(tmp_path / "spectra", replace(images, **unstated)))
    for again in (copied, spectra):
        for antenna, first in zip(antennas_of(again), antennas_of(record), strict=True):
            assert replace(antenna, pattern="iso", digest="") == replace(first, pattern="iso", digest="")
            assert antenna.digest == first.digest


def antennas_of(record):
    return [record.tx_antenna, *(receiver.antenna for receiver in record.receivers)]


WRONG |= {
    f"antenna: {message}": (lambda folder, columns=columns: with_columns(folder, **columns), "anchors.csv", message)  # type: ignore[misc]
    for columns, message in (
        ({"pattern": ["iso", "horn"]}, "row 2: antenna: pattern is 'horn'; choose from"),
        ({"polarization": ["vertical", "V"]}, "row 1: antenna: polarization is 'vertical'; choose from V, H"),
        ({"pattern": ["none.msi", "iso"]}, r"row 1: antenna: .*/none\.msi: no such file or folder; restore it"),
        ({"tx_pattern": ["dipole", "iso"]}, "row 2: tx_pattern or tx_polarization differs from row 1"),
    )
}


def with_noise(folder: Path) -> Path:
    """State readings and noise of all that the anchors of ``folder`` received."""
    stds = {"std_1": ["0.5", "", "", "0.25"], "std_3": ["1.5", "2", "", ""]}
    add_columns(folder / TRAIN_FILE, count_1=["4", "", "0", "9"], count_3=["2", "1", "", "nan"], **stds)
    add_columns(folder / TEST_FILE, count_1=["3"], count_3=["16"], std_1=["1"], std_3=["1"])
    return folder


def test_readings_noise_and_precision_are_read_where_something_was_received(folder: Path):
    plain = read_ble_folder(folder)
    assert (plain.n_readings, plain.std, plain.precision(np.arange(5))) == (None, None, None)
    record = read_ble_folder(with_noise(folder))
    np.testing.assert_array_equal(record.n_readings, [[2, 1, 0, 0, 16], [4, 0, 0, 9, 3]])
    np.testing.assert_array_equal(record.std, [[1.5, 2, nan, nan, 1], [0.5, nan, nan, 0.25, 1]])
    np.testing.assert_array_equal(record.observation, plain.observation)
    # The median of 1.5, 2, 0.5 and 0.25 is 1; rows that were not received, and the test row, do not count.
    expected = [[1.5**-2, 2**-2, 1, 1], [0.5**-2, 1, 1, 0.25**-2]]
    np.testing.assert_allclose(record.precision(np.arange(4)), expected)
    of_means = replace(record, std=None)
    np.testing.assert_array_equal(of_means.precision(np.arange(4)), [[2, 1, 1, 1], [4, 1, 1, 9]])


WRONG_NOISE = {
    "readings of one anchor": ("count_3", "number", TRAIN_FILE, r"line 1: no column count_3; give one for every anch"),
    "half a reading": ("4,2,0.5", "4,2.5,0.5", TRAIN_FILE, r"row 1: count_3 is '2\.5', .*number of readings, 1 to"),
    "more readings than there are": ("4,2,0.5", "4,1e30,0.5", TRAIN_FILE, "row 1: count_3 is .1e30., .*1 to a million"),
    "no reading": ("4,2,0.5", "4,0,0.5", TRAIN_FILE, "row 1: count_3 is '0', where rssi_3 is known"),
    "no noise": ("4,2,0.5", "4,2,0", TRAIN_FILE, r"row 1: std_1 is '0', where rssi_1 is known; give the noise in dB"),
    "readings of nothing": ("0,,,", "5,,,", TRAIN_FILE, "row 3: count_1 is '5', but rssi_1 is empty; leave it empty"),
}


def noise_changed(old: str, new: str, name: str, message: str) -> tuple[Change, str, str]:
    return lambda folder: text(name, old, new)(with_noise(folder)), name, message


WRONG |= {f"noise: {name}": noise_changed(*case) for name, case in WRONG_NOISE.items()}


WRONG["noise: in one file"] = (
    lambda folder: (with_noise(folder) / TEST_FILE).write_text(TEST),
    TEST_FILE,
    "line 1: no column count_3; .* in both files, or none",
)


def test_written_record_is_read_again(folder: Path, tmp_path: Path):
    original = read_ble_folder(with_noise(with_columns(folder, pattern=["", "dipole"], tx_polarization=["H", "H"])))
    names = ("hall, upper", "anchorage")
    named = tuple(replace(receiver, name=name) for receiver, name in zip(original.receivers, names, strict=True))
    for record in (original, replace(original, receivers=named, n_readings=None, tx_heading_rad=None)):
        again = read_ble_folder(write_ble_folder(tmp_path / record.receivers[0].name, record), original.name)
        assert_same(again, record)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"official": (np.arange(4), np.arange(4))}, "each row must be in one part of the official split"),
        ({"frequencies_hz": None}, r"its carrier is not known; set Record\.frequencies_hz"),
        ({"folds": np.zeros(5, int)}, "has folds, which this layout does not state; set Record.folds to None"),
        ({"tx_pos_m": np.full((5, 3), nan)}, "a position, heading or signal strength is not finite"),
        ({"first": {"name": "anchor03"}}, r"receiver 'anchor03' would be read as another; rename it"),
        ({"first": {"name": "a\tb"}}, r"the name of receiver .* does not go into one line; rename it"),
        ({"first": {"array_m": np.zeros((1, 3))}}, "receiver anchor3: it states no array"),
    ],
)
def test_attributes_beyond_the_layout_are_not_written(folder: Path, change: dict, message: str, tmp_path: Path):
    record = read_ble_folder(folder)
    if "first" in change:
        change = {"receivers": (replace(record.receivers[0], **change["first"]), record.receivers[1])}
    error_line(write_ble_folder, tmp_path / "new", replace(record, **change), message)
    assert not (tmp_path / "new").exists()


def test_the_run_of_each_row_is_read_and_written(folder: Path, tmp_path: Path):
    assert read_ble_folder(folder).runs is None
    text(TEST_FILE, "ts", "run")(folder)
    refusal(read_ble_folder, folder, rf"{TRAIN_FILE}: line 1: no column run, but {TEST_FILE} has one")
    text(TRAIN_FILE, ",ts", ",run")(folder)
    text(TRAIN_FILE, "^1,1.6e18", '1,"second, late"')(folder)
    record = read_ble_folder(folder)
    assert record.runs.tolist() == ["1.6e18", "second, late", "1.6e18", "1.6e18", "1.6e18"]
    again = read_ble_folder(write_ble_folder(tmp_path / "again", record))
    np.testing.assert_array_equal(again.runs, record.runs)
    text(TRAIN_FILE, "second, late", "")(folder)
    refusal(read_ble_folder, folder, rf"{TRAIN_FILE}: row 2: run is empty; give the name or number of the run")


def test_the_carrier_of_each_row_is_read_and_written(folder: Path, tmp_path: Path):
    record, carriers = read_ble_folder(folder), np.array([2.402e9, 2.426e9, 2.48e9, 2.402e9, 2.48e9])
    for carrier_record in (record.at_carriers(carriers), record.at_carrier(868e6), record):
        again = read_ble_folder(write_ble_folder(tmp_path / "again", carrier_record, replace=True))
        np.testing.assert_equal(again.carriers_hz, carrier_record.carriers_hz)
        np.testing.assert_equal(again.frequencies_hz, carrier_record.frequencies_hz)
    text(TEST_FILE, "ts", "frequency_hz")(folder)
    refusal(read_ble_folder, folder, rf"{TRAIN_FILE}: line 1: no column frequency_hz, but {TEST_FILE} has one")
    text(TRAIN_FILE, ",ts", ",frequency_hz")(folder)
    text(TRAIN_FILE, "^1,1.6e18", "1,0")(folder)
    refusal(read_ble_folder, folder, rf"{TRAIN_FILE}: row 2: frequency_hz is 0; give the carrier")
