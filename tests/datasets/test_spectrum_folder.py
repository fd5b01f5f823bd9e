"""The NeRF2 spectrum layout: what is read, what is written, and every way in which a folder can be wrong."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import DATA, append, needs, refusal, remove, replaced, rewritten, text, write
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from spectrum_records import assert_same, make_record

from wrf_mi.core import Antenna, InputError, Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import read_spectrum_folder, write_spectrum_folder

YML, POS = "gateway_info.yml", "tx_pos.csv"
READ_SECONDS = 0.5
"""Reading 200 images of 90 x 360 may take this long; it takes 0.1 s on two slow cores."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_spectrum_folder(tmp_path / "made-up", make_record())


def test_reads_a_folder_written_by_hand(tmp_path: Path):
    """As the authors' release writes it: CRLF, comment, no line end after the last line."""
    (tmp_path / "spectrum").mkdir()
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    for row in range(3):
        Image.fromarray(grey + row).save(tmp_path / "spectrum" / f"{row + 1:05d}.png")
    (tmp_path / POS).write_bytes(b"x,y,z\r\n0.1,0.2,0.3\r\n-1,2,3\r\n4e-1,5,6\r\n")
    (tmp_path / YML).write_text(
        "dataset_name: s23\ngateway1:\n  position: [5.0, 0.26, 0]\n"
        "  orientation:  [ 0.51291602, -0.48674136, -0.48674136,  0.51291602]  # quaternion"
    )
    (tmp_path / "train_index.txt").write_text("00003\n00001\n")
    (tmp_path / "test_index.txt").write_text("00002\n")
    record = read_spectrum_folder(tmp_path)
    assert record.observation.shape == (1, 3, 3, 4)
    assert record.observation.dtype == np.float32
    np.testing.assert_array_equal(record.observation[0, 2], ((grey + 2) / 255).astype(np.float32))
    np.testing.assert_array_equal(record.tx_pos_m, [[0.1, 0.2, 0.3], [-1, 2, 3], [0.4, 5, 6]])
    assert [part.tolist() for part in record.official] == [[2, 0], [1]]
    assert record.folds is None
    np.testing.assert_array_equal(record.receivers[0].position_m, [5, 0.26, 0])


def again(folder: Path, record: Record) -> Record:
    """The record as it is read after it was written."""
    return read_spectrum_folder(write_spectrum_folder(folder, record))


ONE, TWO = make_record(4), make_record(4, gateways=2)
CARRIERS_HZ = np.array([915e6, 2.44e9, 915e6, 5.1e9])
RUNS = np.array(["day 1", "day 1", "2", "with, comma"])
DIRECTED = zip(TWO.receivers, (Antenna("dipole", "H"), Antenna("tr38901", "V", "array")), strict=True)
ANTENNAS: dict[str, Any] = {"receivers": tuple(replace(one, antenna=own) for one, own in DIRECTED)}


@pytest.mark.parametrize(
    ("record", "columns"),
    [
        *((make_record(4, gateways, *size), "") for gateways in (1, 3) for size in ((5, 8), (1, 1), (40, 13))),
        (replace(TWO, **ANTENNAS, tx_antenna=Antenna("hw_dipole", "H")), ""),
        (ONE.at_carriers(CARRIERS_HZ), ",frequency_hz"),
        (replace(ONE, runs=RUNS), ",run"),
        (replace(ONE, runs=RUNS).at_carriers(CARRIERS_HZ), ",frequency_hz,run"),
    ],
)
def test_written_record_is_read_again(tmp_path: Path, record: Record, columns: str):
    assert_same(again(tmp_path / "made-up", record), record)
    assert (tmp_path / "made-up" / POS).read_text().splitlines()[0] == f"x,y,z{columns}"


def test_sixteen_bits_keep_sixteen_bits(tmp_path: Path):
    record = make_record(4)
    finer = record.observation * np.float32(0.7)
    read = read_spectrum_folder(write_spectrum_folder(tmp_path / "a", replace(record, observation=finer), bits=16))
    # Half a level: rounding, and a little for float32.
    np.testing.assert_allclose(read.observation, finer, rtol=0, atol=0.51 / 65535)


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(float, (2, 3), elements=st.floats(-1e6, 1e6)))
def test_positions_survive_exactly(tmp_path_factory: pytest.TempPathFactory, positions: np.ndarray):
    record = replace(make_record(2), tx_pos_m=positions, official=None, folds=None)
    assert_same(again(tmp_path_factory.mktemp("p") / "made-up", record), record)


def test_carrier_and_array_are_optional(folder: Path, tmp_path: Path):
    record = read_spectrum_folder(folder)
    assert (record.frequencies_hz, record.receivers[0].array_m) == (None, None)
    elements = np.random.default_rng(3).normal(size=(5, 3))
    told = replace(record, frequencies_hz=np.array([915.25e6])).with_array(elements)
    assert_same(again(tmp_path / "told" / "made-up", told), told)
    append(YML, "frequency_hz: 920e6\narray: {rows: 2, columns: 3, spacing_m: 0.16}")(folder)
    told = replace(record, frequencies_hz=np.array([920e6])).with_array(planar_array(2, 3, 0.16))
    assert_same(read_spectrum_folder(folder), told)


def image(name: str, pixels: np.ndarray):
    return lambda folder: Image.fromarray(pixels).save(folder / name)


def cut(name: str):
    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return change


def overlap(folder: Path) -> None:
    append("test_index.txt", (folder / "train_index.txt").read_text().split()[0])(folder)


GREY = np.zeros((5, 8), np.uint8)
ANTENNA = "gateway9:\n  position: [0, 0, 0]\n  orientation: [0, 0, 0, 1]\n  antenna: "
WRONG = {  # each is refused, see test_faults.py
    "no poses": (remove(YML), YML, "missing"),
    "no positions file": (remove(POS), POS, "missing"),
    "one index file": (remove("test_index.txt"), "test_index.txt", "missing"),
    "image missing": (remove("spectrum/00007.png"), "00007.png", r"row 7: missing \(11 images for 12 rows"),
    "image too many": (image("spectrum/00013.png", GREY), "00013.png", "13 images for 12 rows"),
    "image of another size": (image("spectrum/00003.png", GREY[:, :7]), "00003.png", "row 3: 7 x 5 pixels"),
    "image cut short": (cut("spectrum/00004.png"), "00004.png", "row 4: unreadable"),
    "no image at all": (write("spectrum/00005.png", "hello"), "00005.png", "row 5: unreadable"),
    "colour image": (image("spectrum/00006.png", np.zeros((5, 8, 3), np.uint8)), "00006.png", "row 6: image mode RGB"),
    "position missing": (text(POS, r"^[^,x]+,.*\n", ""), "00012.png", "12 images for 11 rows"),
    "NaN position": replaced(POS, r"^[^,x]+,", "nan,", "row 1: x is 'nan'"),
    "position of two numbers": replaced(POS, r"^[^,x]+,", "", "row 1: 2 fields, but"),
    "no header": replaced(POS, r"^x,y,z\n", "", "line 1: header"),
    "not YAML": rewritten(YML, "a: [1\nb: }", "not YAML"),
    "YAML list": rewritten(YML, "- 1", "no receiver"),
    "receiver that climbs": replaced(YML, "gateway1", "../up", "cannot name a folder"),
    "quaternion not unit": replaced(YML, "0.8", "0.9", "gateway1: quaternion of norm"),
    "quaternion of three": replaced(YML, "0.6, ", "", "gateway1: orientation is"),
    "NaN receiver": replaced(YML, r"position: \[", "position: [.nan, ", "position is"),
    "row zero": replaced("train_index.txt", r"^\d+", "00000", "line 1: row 0 is out of range"),
    "row beyond the end": replaced("test_index.txt", r"^\d+", "00013", "line 1: row 13 is out of"),
    "negative row": replaced("test_index.txt", r"^\d+", "-1", "line 1: '-1' is not a whole number"),
    "row twice": replaced("test_index.txt", r"^(\d+)\n\d+", r"\1\n\1", "line 2: row .* line 1 already"),
    "fold missing": replaced("blocked_folds.txt", r"^0\n", "", "11 folds for 12 rows"),
    "fold of words": replaced("blocked_folds.txt", r"^1", "one", "line 2: 'one' is not"),
    "fold without rows": replaced("blocked_folds.txt", r"^2", "4", "fold 3 has no row"),
    "one fold": rewritten("blocked_folds.txt", "0\n" * 12, "one fold only"),
    **{
        line: (append(YML, line), YML, message)
        for line, message in (
            ("frequency_hz: 0", "frequency_hz is 0; give the carrier in Hz"),
            ("frequency_hz: fast", "frequency_hz is 'fast'"),
            ("frequency_hz: [1, x]", r"frequency_hz is \[1, 'x'\]"),
            ("array: 16", "array is '16'; give rows, columns and spacing_m, or elements_m"),
            ("array: {rows: 0, columns: 4, spacing_m: 1}", "array is"),
            ("array: {elements_m: [[0, 1], [0, 2]]}", "array is"),
            (
                "frequency_hz: [915e6, 2.4e9]",
                r"frequency_hz is \[.*or those of rows in tx_pos\.csv, column frequency_hz",
            ),
            ("tx_antenna: {frame: array}", "tx_antenna is .*; give some of pattern, polarization"),
            (f"{ANTENNA}{{polarisation: V}}", "gateway9: antenna is .*; give some of pattern, polarization, frame"),
            (f"{ANTENNA}{{polarization: vertical}}", "polarization is 'vertical'; choose from V, H"),
            (f"{ANTENNA}{{pattern: tr38901}}", "state frame array"),
        )
    },
    **{
        f"carrier {row}": (
            write(POS, "\n".join(["x,y,z,frequency_hz", "1,2,3,9e8", row, *["1,2,3,9e8"] * 10])),
            POS,
            message,
        )
        for row, message in (
            ("1,2,3,0", "row 2: frequency_hz is 0; give the carrier in Hz"),
            ("1,2,3,nan", "row 2: frequency_hz is 'nan'; give a finite"),
        )
    },
    "quaternion beyond the tolerance": replaced(YML, "0.8", "0.8025", r"norm 1\.002"),
    "row of both parts": (overlap, "test_index.txt", r"row \d+ is in train_index.txt as well"),
    "empty run": rewritten(POS, "x,y,z,run\n1,2,3,a\n1,2,3, \n" + "1,2,3,b\n" * 10, "row 2: run is empty; give the"),
    "run before carrier": rewritten(POS, "x,y,z,run,frequency_hz\n" + "1,2,3,a,9e8\n" * 12, "header is .*; it must be"),
}


def test_several_gateways_need_a_folder_each_and_unit_quaternions(folder: Path, tmp_path: Path):
    text(YML, "0.8", "0.8005")(folder)  # norm 1.0004; 1.0020 is in WRONG
    assert len(read_spectrum_folder(folder).receivers) == 1
    folder = write_spectrum_folder(tmp_path / "a", make_record(gateways=2))
    (folder / "spectrum" / "gateway2").rename(folder / "spectrum" / "other")
    refusal(read_spectrum_folder, folder, "gateway2: missing folder")
    refusal(read_spectrum_folder, tmp_path / "nothing", "not a folder")


def test_nothing_is_written_over_or_left_half_written(folder: Path):
    refusal(write_spectrum_folder, folder, make_record(), "exists")
    with pytest.raises(TypeError):
        write_spectrum_folder(folder.parent / "other", replace(make_record(), official=(np.array([0]), None)))
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    other = make_record(rows=4)
    assert_same(read_spectrum_folder(write_spectrum_folder(folder, other, replace=True)), other)
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


@needs("rfid-lab")
def test_the_real_data_are_read_quickly():
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        record = read_spectrum_folder(DATA / "rfid-lab")
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < READ_SECONDS
    assert record.observation.shape == (1, 200, 90, 360)
    assert (record.observation.min(axis=(2, 3)) == 0).all()
    assert (record.observation.max(axis=(2, 3)) == 1).all()
    assert [len(part) for part in record.official] == [160, 40]
    assert np.bincount(record.folds).tolist() == [77, 16, 19, 50, 38]


def named(name: str) -> tuple[Receiver, ...]:
    return (replace(ONE.receivers[0], name=name),)


BEYOND: dict[str, tuple[dict[str, Any], str]] = {  # what the layout cannot state
    "receiver named array": ({"receivers": named("array")}, "a receiver is named 'array'"),
    "receiver named tx_antenna": ({"receivers": named("tx_antenna")}, "a receiver is named 'tx_antenna'"),
    "truth": ({"truth": ONE.observation}, "has truth, which this layout does not state; set Record.truth to"),
    "heading": ({"tx_heading_rad": ONE.folds}, "has tx_heading_rad, which .* not state; set Record.tx_heading_rad to"),
    "powers": ({"task": "rssi", "observation": ONE.observation[:, :, 0, 0]}, "no spectra within"),
    "carriers": ({"frequencies_hz": CARRIERS_HZ}, r"4 carriers for all rows, and gateway_info\.yml states one; give"),
    **{
        f"run {run!r}": (
            {"runs": np.array(["a", run, "a", "b"])},
            r"row 1: run .* does not fit into a field; give a te",
        )
        for run in ("", " a", "two\nlines")
    },
}


@pytest.mark.parametrize("case", BEYOND)
def test_attributes_beyond_the_layout_are_not_written(tmp_path: Path, case: str):
    changes, message = BEYOND[case]
    with pytest.raises(InputError, match=message):
        write_spectrum_folder(tmp_path / "a", replace(ONE, **changes))
    assert not (tmp_path / "a").exists()


def test_equal_carriers_of_rows_are_one(tmp_path: Path):
    folder = write_spectrum_folder(tmp_path / "made-up", ONE)
    (folder / POS).write_text("x,y,z,frequency_hz\n" + "1,2,3,868e6\n" * 4)
    record = read_spectrum_folder(folder)
    np.testing.assert_array_equal(record.frequencies_hz, [868e6])
    assert record.carriers_hz is None
    append(YML, "frequency_hz: 868e6")(folder)
    refusal(read_spectrum_folder, folder, r"tx_pos.csv: line 1: column frequency_hz, but gateway_info.yml states a car")


@pytest.mark.parametrize("columns", ["vx,vy,vz", "t"])
def test_columns_of_earlier_versions_are_not_read(tmp_path: Path, columns: str):
    folder, record = tmp_path / "made-up", make_record(4)
    write_spectrum_folder(folder, record)
    header, *rows = (folder / POS).read_text().splitlines()
    fields = ",-" * len(columns.split(","))
    (folder / POS).write_text("\n".join([f"{header},{columns}", *(row + fields for row in rows)]))
    assert_same(read_spectrum_folder(folder), record)
