"""The NeRF2 spectrum layout: what is read, what is written, and every way in which a folder can be wrong."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from changed_folders import DATA, append, needs, remove, text, write
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from spectrum_records import assert_same, make_record

from wrf_mi.core import Antenna, InputError
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import read_spectrum_folder, write_spectrum_folder

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
    (tmp_path / "tx_pos.csv").write_bytes(b"x,y,z\r\n0.1,0.2,0.3\r\n-1,2,3\r\n4e-1,5,6\r\n")
    (tmp_path / "gateway_info.yml").write_text(
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
    assert record.official is not None
    assert [part.tolist() for part in record.official] == [[2, 0], [1]]
    assert record.folds is None
    np.testing.assert_array_equal(record.receivers[0].position_m, [5, 0.26, 0])


@pytest.mark.parametrize("gateways", [1, 3])
@pytest.mark.parametrize(("height", "width"), [(5, 8), (1, 1), (40, 13)])
def test_written_record_is_read_again(tmp_path: Path, gateways: int, height: int, width: int):
    record = make_record(4, gateways, height, width)
    assert_same(read_spectrum_folder(write_spectrum_folder(tmp_path / "a", record)), record)


def test_sixteen_bits_keep_sixteen_bits(tmp_path: Path):
    record = make_record(4)
    finer = replace(record, observation=record.observation * np.float32(0.7))
    read = read_spectrum_folder(write_spectrum_folder(tmp_path / "a", finer, bits=16))
    half_a_level = 0.51 / 65535  # rounding, and a little for float32
    np.testing.assert_allclose(read.observation, finer.observation, rtol=0, atol=half_a_level)


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(float, (2, 3), elements=st.floats(-1e6, 1e6)))
def test_positions_survive_exactly(tmp_path_factory: pytest.TempPathFactory, positions: np.ndarray):
    record = replace(make_record(2), tx_pos_m=positions, official=None, folds=None)
    read = read_spectrum_folder(write_spectrum_folder(tmp_path_factory.mktemp("p") / "a", record))
    np.testing.assert_array_equal(read.tx_pos_m, positions)
    assert read.official is None


def test_carrier_and_array_are_optional(folder: Path, tmp_path: Path):
    record = read_spectrum_folder(folder)
    assert (record.frequencies_hz, record.receivers[0].array_m) == (None, None)
    elements = np.random.default_rng(3).normal(size=(5, 3))
    told = replace(record, frequencies_hz=np.array([915.25e6])).with_array(elements)
    read = read_spectrum_folder(write_spectrum_folder(tmp_path / "told", told))
    assert_same(read, told)
    np.testing.assert_array_equal(read.frequencies_hz, [915.25e6])
    np.testing.assert_array_equal(read.receivers[0].array_m, elements)
    with (folder / "gateway_info.yml").open("a") as file:
        file.write("frequency_hz: 920e6\narray: {rows: 2, columns: 3, spacing_m: 0.16}\n")
    read = read_spectrum_folder(folder)
    np.testing.assert_array_equal(read.frequencies_hz, [920e6])
    np.testing.assert_array_equal(read.receivers[0].array_m, planar_array(2, 3, 0.16))
    assert [r.name for r in read.receivers] == ["gateway1"]


def image(name: str, pixels: np.ndarray):
    return lambda folder: Image.fromarray(pixels).save(folder / name)


def cut(name: str):
    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return change


GREY = np.zeros((5, 8), np.uint8)
SEVERAL = "several carriers.*column frequency_hz, or make a folder for each"
ANTENNA = "gateway9:\n  position: [0, 0, 0]\n  orientation: [0, 0, 0, 1]\n  antenna: "
WRONG = {  # each is refused, see test_faults.py
    "no poses": (remove("gateway_info.yml"), "gateway_info.yml", "missing"),
    "no positions file": (remove("tx_pos.csv"), "tx_pos.csv", "missing"),
    "one index file": (remove("test_index.txt"), "test_index.txt", "missing"),
    "image missing": (
        remove("spectrum/00007.png"),
        "00007.png",
        r"row 7: missing \(11 images for 12 rows",
    ),
    "image too many": (image("spectrum/00013.png", GREY), "00013.png", "13 images for 12 rows"),
    "image of another size": (image("spectrum/00003.png", GREY[:, :7]), "00003.png", "row 3: 7 x 5 pixels"),
    "image cut short": (cut("spectrum/00004.png"), "00004.png", "row 4: unreadable"),
    "no image at all": (write("spectrum/00005.png", "hello"), "00005.png", "row 5: unreadable"),
    "colour image": (image("spectrum/00006.png", np.zeros((5, 8, 3), np.uint8)), "00006.png", "row 6: image mode RGB"),
    "position missing": (text("tx_pos.csv", r"^[^,x]+,.*\n", ""), "00012.png", "12 images for 11 rows"),
    "NaN position": (text("tx_pos.csv", r"^[^,x]+,", "nan,"), "tx_pos.csv", "row 1: x is 'nan'"),
    "infinite position": (text("tx_pos.csv", r"^[^,x]+,", "-inf,"), "tx_pos.csv", "row 1: x is '-inf'; give a finite"),
    "position of words": (text("tx_pos.csv", r"^[^,x]+,", "here,"), "tx_pos.csv", "row 1: x is 'here'; give a finite"),
    "position of two numbers": (text("tx_pos.csv", r"^[^,x]+,", ""), "tx_pos.csv", "row 1: 2 fields, but"),
    "position of one number": (text("tx_pos.csv", r"^[^,x]+,[^\n]*", "5"), "tx_pos.csv", "row 1: 1 field, but"),
    "position of four numbers": (text("tx_pos.csv", r"^[^,x]+,", "1,2,"), "tx_pos.csv", "row 1: 4 fields, but"),
    "no header": (text("tx_pos.csv", r"^x,y,z\n", ""), "tx_pos.csv", "line 1: header"),
    "no rows": (write("tx_pos.csv", "x,y,z\n"), "tx_pos.csv", "no rows below the header"),
    "empty positions file": (write("tx_pos.csv", ""), "tx_pos.csv", "empty; give a header"),
    "not text": (write("tx_pos.csv", b"\xff\xfe\x00"), "tx_pos.csv", "cannot be read"),
    "not YAML": (write("gateway_info.yml", "a: [1\nb: }"), "gateway_info.yml", "not YAML"),
    "no receiver": (write("gateway_info.yml", "dataset_name: a"), "gateway_info.yml", "no receiver"),
    "YAML list": (write("gateway_info.yml", "- 1"), "gateway_info.yml", "no receiver"),
    "receiver that climbs": (text("gateway_info.yml", "gateway1", "../up"), "gateway_info.yml", "cannot name a folder"),
    "quaternion not unit": (text("gateway_info.yml", "0.8", "0.9"), "gateway_info.yml", "gateway1: quaternion of norm"),
    "quaternion of three": (text("gateway_info.yml", "0.6, ", ""), "gateway_info.yml", "gateway1: orientation is"),
    "NaN receiver": (text("gateway_info.yml", r"position: \[", "position: [.nan, "), "gateway_info.yml", "position is"),
    "row zero": (text("train_index.txt", r"^\d+", "00000"), "train_index.txt", "line 1: row 0 is out of range"),
    "row beyond the end": (text("test_index.txt", r"^\d+", "00013"), "test_index.txt", "line 1: row 13 is out of"),
    "row of words": (text("test_index.txt", r"^\d+", "12a"), "test_index.txt", "line 1: '12a' is not a whole number"),
    "negative row": (text("test_index.txt", r"^\d+", "-1"), "test_index.txt", "line 1: '-1' is not a whole number"),
    "no test rows": (write("test_index.txt", "\n"), "test_index.txt", "no rows"),
    "row twice": (text("test_index.txt", r"^(\d+)\n\d+", r"\1\n\1"), "test_index.txt", "line 2: row .* line 1 already"),
    "fold missing": (text("blocked_folds.txt", r"^0\n", ""), "blocked_folds.txt", "11 folds for 12 rows"),
    "fold of words": (text("blocked_folds.txt", r"^1", "one"), "blocked_folds.txt", "line 2: 'one' is not"),
    "fold without rows": (text("blocked_folds.txt", r"^2", "4"), "blocked_folds.txt", "fold 3 has no row"),
    "fold far away": (text("blocked_folds.txt", r"^2", "9" * 15), "blocked_folds.txt", "fold 3 has no row"),
    "one fold": (write("blocked_folds.txt", "0\n" * 12), "blocked_folds.txt", "one fold only"),
    **{
        line: (append("gateway_info.yml", line), "gateway_info.yml", message)
        for line, message in (
            ("frequency_hz: 0", "frequency_hz is 0; give the carrier in Hz"),
            ("frequency_hz: .inf", "frequency_hz is inf"),
            ("frequency_hz: fast", "frequency_hz is 'fast'"),
            ("frequency_hz: [1, x]", r"frequency_hz is \[1, 'x'\]"),
            ("array: 16", "array is '16'; give rows, columns and spacing_m, or elements_m"),
            ("array: {rows: 4, columns: 4}", "array is .*; give rows, columns and spacing_m"),
            ("array: {rows: 4.5, columns: 4, spacing_m: 1}", "array is"),
            ("array: {rows: 0, columns: 4, spacing_m: 1}", "array is"),
            ("array: {rows: 4, columns: 4, spacing_m: .nan}", "array is"),
            ("array: {elements_m: [[0, 1], [0, 2]]}", "array is"),
            ("array: {elements_m: [[0, 1, .nan]]}", "array is"),
            ("array: {elements_m: []}", "array is"),
            ("frequency_hz: [915e6, 2.4e9]", SEVERAL),
            ("frequencies_hz: [915e6, 2.4e9]", SEVERAL),
            ("frequency_hz: 915e6\ncarrier_hz: 868e6", SEVERAL),
            ("tx_antenna: {frame: array}", "tx_antenna is .*; give some of pattern, polarization"),
            (f"{ANTENNA}V", "gateway9: antenna is 'V'; give some of pattern, polarization, frame"),
            (f"{ANTENNA}{{polarisation: V}}", "gateway9: antenna is .*; give some of pattern, polarization, frame"),
            (f"{ANTENNA}{{polarization: vertical}}", "polarization is 'vertical'; choose from V, H"),
            (f"{ANTENNA}{{pattern: tr38901}}", "state frame array"),
        )
    },
    **{
        f"carrier {row}": (
            write("tx_pos.csv", "\n".join(["x,y,z,frequency_hz", "1,2,3,9e8", row, *["1,2,3,9e8"] * 10])),
            "tx_pos.csv",
            message,
        )
        for row, message in (
            ("1,2,3,0", "row 2: frequency_hz is 0; give the carrier in Hz"),
            ("1,2,3,-1", "row 2: frequency_hz is -1"),
            ("1,2,3,nan", "row 2: frequency_hz is 'nan'; give a finite"),
            ("1,2,3", "row 2: 3 fields, but the header has 4"),
            ("1,2,3,many", "row 2: frequency_hz is 'many'; give a finite number"),
        )
    },
}


@pytest.mark.parametrize(("w", "unit"), [("0.8005", True), ("0.8025", False)])
def test_quaternions_within_the_tolerance_are_accepted(folder: Path, w: str, unit: bool):
    """Norms 1.0004 and 1.0020, on both sides of the tolerance."""
    text("gateway_info.yml", "0.8", w)(folder)
    if unit:
        assert len(read_spectrum_folder(folder).receivers) == 1
    else:
        with pytest.raises(InputError, match=r"norm 1\.002"):
            read_spectrum_folder(folder)


def test_overlap_of_training_and_test_rows(folder: Path):
    row = (folder / "train_index.txt").read_text().split()[0]
    with (folder / "test_index.txt").open("a") as file:
        file.write(f"{row}\n")
    with pytest.raises(InputError, match=rf"test_index.txt: row {int(row)} is in train_index.txt as well"):
        read_spectrum_folder(folder)


def test_several_gateways_need_a_folder_each(tmp_path: Path):
    folder = write_spectrum_folder(tmp_path / "a", make_record(gateways=2))
    (folder / "spectrum" / "gateway2").rename(folder / "spectrum" / "other")
    with pytest.raises(InputError, match="gateway2: missing folder"):
        read_spectrum_folder(folder)


def test_not_a_folder(tmp_path: Path):
    with pytest.raises(InputError, match="not a folder"):
        read_spectrum_folder(tmp_path / "nothing")


def test_nothing_is_written_over_or_left_half_written(folder: Path):
    with pytest.raises(InputError, match="exists"):
        write_spectrum_folder(folder, make_record())
    broken = replace(make_record(), official=(np.array([0]), None))
    with pytest.raises(TypeError):
        write_spectrum_folder(folder.parent / "other", broken)
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    powers = make_record().observation[:, :, 0, 0]
    with pytest.raises(InputError, match="no spectra within"):
        write_spectrum_folder(folder.parent / "other", replace(make_record(), task="rssi", observation=powers))
    other = make_record(rows=4)
    assert_same(read_spectrum_folder(write_spectrum_folder(folder, other, replace=True)), other)
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


@needs("rfid-lab")
def test_the_real_data_are_read_quickly():
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        record = read_spectrum_folder(Path(DATA, "rfid-lab"))
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < READ_SECONDS
    assert record.observation.shape == (1, 200, 90, 360)
    spectra = record.observation[0]
    assert (spectra.min(axis=(1, 2)) == 0).all()
    assert (spectra.max(axis=(1, 2)) == 1).all()
    assert record.official is not None
    assert [len(part) for part in record.official] == [160, 40]
    assert np.bincount(record.folds).tolist() == [77, 16, 19, 50, 38]


def test_antennas_are_read_and_written(tmp_path: Path):
    record = make_record(4, gateways=2)
    antennas = (Antenna("dipole", "H"), Antenna("tr38901", "V", "array"))
    told = replace(
        record,
        receivers=tuple(replace(one, antenna=a) for one, a in zip(record.receivers, antennas, strict=True)),
        tx_antenna=Antenna("hw_dipole", "H"),
    )
    read = read_spectrum_folder(write_spectrum_folder(tmp_path / "told", told))
    assert tuple(one.antenna for one in read.receivers) == antennas
    assert read.tx_antenna == told.tx_antenna
    plain = read_spectrum_folder(write_spectrum_folder(tmp_path / "plain", record))
    assert {one.antenna for one in plain.receivers} | {plain.tx_antenna} == {Antenna()}


@pytest.mark.parametrize("name", ["array", "tx_antenna"])
def test_reserved_receiver_names_are_not_written(tmp_path: Path, name: str):
    record = make_record(4)
    named = replace(record, receivers=(replace(record.receivers[0], name=name),))
    with pytest.raises(InputError, match=f"a receiver is named '{name}'"):
        write_spectrum_folder(tmp_path / "a", named)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("change", [{"truth": "observation"}, {"tx_heading_rad": "folds"}])
def test_attributes_beyond_the_layout_are_not_written(tmp_path: Path, change: dict[str, str]):
    record = make_record(4)
    ((name, other),) = change.items()
    with pytest.raises(InputError, match=f"has {name}, which this layout does not state; set Record.{name} to"):
        write_spectrum_folder(tmp_path / "a", replace(record, **{name: getattr(record, other)}))
    assert not (tmp_path / "a").exists()


def test_several_carriers_of_receivers_are_refused_and_equal_ones_are_one(tmp_path: Path):
    folder = write_spectrum_folder(tmp_path / "two", make_record(4, gateways=2))
    info = yaml.safe_load((folder / "gateway_info.yml").read_text())
    for name in ("gateway1", "gateway2"):
        info[name]["frequency_hz"] = 915e6
    (folder / "gateway_info.yml").write_text(yaml.safe_dump(info))
    np.testing.assert_array_equal(read_spectrum_folder(folder).frequencies_hz, [915e6])
    info["gateway2"]["frequency_hz"] = 2.44e9
    (folder / "gateway_info.yml").write_text(yaml.safe_dump(info))
    with pytest.raises(
        InputError, match=r"gateway1: frequency_hz of 9.15e\+08 and gateway2: frequency_hz of 2.44e\+09"
    ):
        read_spectrum_folder(folder)


def test_several_carriers_are_not_written(tmp_path: Path):
    record = replace(make_record(4), frequencies_hz=np.array([915e6, 2.4e9]))
    with pytest.raises(
        InputError, match=r"2 carriers for all rows, and gateway_info\.yml states one; give that of each row"
    ):
        write_spectrum_folder(tmp_path / "a", record)
    assert not (tmp_path / "a").exists()


def test_the_carrier_of_each_row_is_kept(tmp_path: Path):
    carriers = np.array([915e6, 2.44e9, 915e6, 5.1e9])
    folder = write_spectrum_folder(tmp_path / "a", make_record(4).at_carriers(carriers))
    again = read_spectrum_folder(folder)
    np.testing.assert_array_equal(again.carriers_hz, carriers)
    assert again.frequencies_hz is None
    assert_same(again, make_record(4))
    (folder / "tx_pos.csv").write_text("x,y,z,frequency_hz\n" + "1,2,3,868e6\n" * 4)
    one = read_spectrum_folder(folder)
    np.testing.assert_array_equal(one.frequencies_hz, [868e6])
    assert one.carriers_hz is None
    with (folder / "gateway_info.yml").open("a") as file:
        file.write("frequency_hz: 868e6\n")
    with pytest.raises(InputError, match=r"tx_pos.csv: line 1: column frequency_hz, but gateway_info.yml states a car"):
        read_spectrum_folder(folder)


@pytest.mark.parametrize("several", [True, False])
def test_the_run_of_each_row_is_kept(tmp_path: Path, several: bool):
    runs = np.array(["day 1", "day 1", "2", "with, comma"])
    record = replace(make_record(4), runs=runs)
    if several:
        record = record.at_carriers(np.array([915e6, 2.44e9, 915e6, 5.1e9]))
    folder = write_spectrum_folder(tmp_path / "a", record)
    header = (folder / "tx_pos.csv").read_text().splitlines()[0]
    assert header == ("x,y,z,frequency_hz,run" if several else "x,y,z,run")
    again = read_spectrum_folder(folder)
    assert again.runs is not None
    assert again.runs.tolist() == runs.tolist()
    np.testing.assert_array_equal(again.carriers_hz, record.carriers_hz)
    assert_same(again, record)


def test_wrong_runs_are_refused(tmp_path: Path):
    folder = write_spectrum_folder(tmp_path / "a", make_record(4))
    assert read_spectrum_folder(folder).runs is None
    for content, message in (
        ("x,y,z,run\n1,2,3,a\n1,2,3, \n1,2,3,b\n1,2,3,b\n", "row 2: run is empty; give the name or number"),
        ("x,y,z,run,frequency_hz\n" + "1,2,3,a,9e8\n" * 4, "line 1: header is 'x,y,z,run,frequency_hz'; it must be"),
    ):
        (folder / "tx_pos.csv").write_text(content)
        with pytest.raises(InputError, match=rf"tx_pos\.csv: {message}"):
            read_spectrum_folder(folder)
    for run in ("", " a", "two\nlines"):
        record = replace(make_record(4), runs=np.array(["a", run, "a", "b"]))
        with pytest.raises(InputError, match=r"row 1: run .* does not fit into a field; give a text of one line"):
            write_spectrum_folder(tmp_path / "b", record)
        assert not (tmp_path / "b").exists()
