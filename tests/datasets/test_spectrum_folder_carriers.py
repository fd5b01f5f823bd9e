"""The NeRF2 spectrum layout: one carrier for all rows, or that of each row; the run of each row."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from spectrum_records import assert_same, make_record

from wrf_mi.core import InputError
from wrf_mi.datasets import read_spectrum_folder, write_spectrum_folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_spectrum_folder(tmp_path / "made-up", make_record())


@pytest.mark.parametrize(
    "text",
    ["frequency_hz: [915e6, 2.4e9]", "frequencies_hz: [915e6, 2.4e9]", "frequency_hz: 915e6\ncarrier_hz: 868e6"],
)
def test_several_carriers_are_refused(folder: Path, text: str):
    with (folder / "gateway_info.yml").open("a") as file:
        file.write(f"{text}\n")
    with pytest.raises(
        InputError, match=r"gateway_info.yml: .*several carriers.*column frequency_hz, or make a folder for each"
    ):
        read_spectrum_folder(folder)


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


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1,2,3,0", r"row 2: frequency_hz is 0; give the carrier in Hz"),
        ("1,2,3,-1", r"row 2: frequency_hz is -1"),
        ("1,2,3,nan", r"row 2: frequency_hz is 'nan'; give a finite"),
        ("1,2,3", "row 2: 3 fields, but the header has 4"),
        ("1,2,3,many", "row 2: frequency_hz is 'many'; give a finite number"),
    ],
)
def test_wrong_carriers_of_rows_are_refused(folder: Path, row: str, message: str):
    rows = ["1,2,3,9e8", row, *["1,2,3,9e8"] * 10]
    (folder / "tx_pos.csv").write_text("\n".join(["x,y,z,frequency_hz", *rows]) + "\n")
    with pytest.raises(InputError, match=message):
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
