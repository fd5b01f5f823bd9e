"""All faults of a data set are collected; without collection the first one ends reading, as before."""

import itertools
import pickle
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_ble_folder as ble
import test_nerf2_ble as nerf2_ble
import test_nerf2_csi as nerf2_csi
import test_newrf as newrf
import test_spectrum_folder as spectra
from changed_folders import DATA, Change, needs, refusal, text, write
from spectrum_records import make_record

from wrf_mi.core import DataFault, InputError
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.datasets.faults import attempt, collect_faults, recoverable, refuse, stop_at_faults


def write_newrf(folder: Path) -> None:
    np.savez(folder / "hall.npz", **newrf.room())


def write_spectra(folder: Path) -> None:
    write_spectrum_folder(folder, make_record(), replace=True)


def newrf_case(arrays: dict[str, Any], message: str) -> tuple[Change, str, str]:
    return lambda folder: np.savez(folder / "hall.npz", **arrays), "hall.npz", message


LAYOUTS: dict[str, tuple[Callable[[Path], object], Mapping[str, tuple[Change, str, str]]]] = {
    "spectra": (write_spectra, spectra.WRONG),
    "ble": (ble.write_correct, ble.WRONG),
    "nerf2-ble": (nerf2_ble.write_correct, nerf2_ble.WRONG),
    "nerf2-csi": (nerf2_csi.write_correct, nerf2_csi.WRONG),
    "newrf": (write_newrf, {name: newrf_case(*case) for name, case in newrf.WRONG.items()}),
}
"""For each layout what writes a correct folder, and changes of it with the file and the message of the fault."""
CASES = [(layout, case) for layout, (_, cases) in LAYOUTS.items() for case in cases]


def made(folder: Path, layout: str, *cases: str) -> Path:
    """A folder of a layout with some changes."""
    folder.mkdir(parents=True)
    content, changes = LAYOUTS[layout]
    content(folder)
    for case in cases:
        changes[case][0](folder)
    return folder


def lines(folder: Path) -> list[str]:
    record, faults = collect_faults(lambda: load(folder))
    assert (record is None) == bool(faults)
    return [str(fault) for fault in faults]


@pytest.mark.filterwarnings("error")  # a number that overflows on its way is refused without a warning
@pytest.mark.parametrize(("layout", "case"), CASES)
def test_wrong_data_are_refused_in_one_line_that_collection_finds(layout: str, case: str, tmp_path: Path) -> None:
    folder = made(tmp_path / "data", layout, case)
    _, file, message = LAYOUTS[layout][1][case]
    line = refusal(load, folder, message)
    assert Path(line.partition(": ")[0]).name == file
    fault_lines = lines(folder)
    first = line.partition(" (")[0]  # what stands in brackets may be another library's message
    assert any(line.startswith(first) for line in fault_lines)
    assert len(set(fault_lines)) == len(fault_lines)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_any_two_faults_are_collected_without_another_error(layout: str, tmp_path: Path) -> None:
    """Placeholders of what could not be read break no later step."""
    cases = list(LAYOUTS[layout][1])
    rng = np.random.default_rng(0)
    pairs = list(itertools.combinations(cases, 2))
    for number, pair in enumerate(rng.permutation(pairs)[:80].tolist()):
        try:
            folder = made(tmp_path / str(number), layout, *pair)
        except (AssertionError, FileNotFoundError, IndexError, ValueError):
            continue  # the first change leaves nothing for the second
        try:
            load(folder)
            correct = True  # the second change corrects the first
        except InputError:
            correct = False
        assert (lines(folder) == []) == correct, pair


def test_faults_of_all_files_are_collected(tmp_path: Path) -> None:
    folder = made(tmp_path / "data", "spectra")
    text("gateway_info.yml", "0.8", "0.9")(folder)
    rows = (folder / "tx_pos.csv").read_text().splitlines()
    rows[2], rows[5] = "nan,1,far", "1,2"
    (folder / "tx_pos.csv").write_text("\n".join(rows))
    (folder / "spectrum" / "00003.png").unlink()
    write("spectrum/00004.png", "hello")(folder)
    write("spectrum/00099.png", "hello")(folder)
    (folder / "train_index.txt").write_text("1\n1\n99\nx\n5\n")
    (folder / "test_index.txt").write_text("2\n5\n")
    write("blocked_folds.txt", "0\none\n")(folder)
    record, faults = collect_faults(lambda: load(folder))
    assert record is None
    data_faults = [(fault.file.name, fault.place, fault.row) for fault in faults if isinstance(fault, DataFault)]
    expected = [
        *(("tx_pos.csv", f"row {row}", row) for row in (5, 2, 2)),  # number of fields, x and z
        *((f"0000{row}.png", f"row {row}", row) for row in (3, 4)),
        *(("train_index.txt", f"line {line}", None) for line in (2, 3, 4)),
        *((name, "", None) for name in ("gateway_info.yml", "00099.png", "test_index.txt")),
        *(("blocked_folds.txt", place, None) for place in ("line 2", "", "")),  # number of lines, and a single fold
    ]
    assert sorted(data_faults, key=str) == sorted(expected, key=str)
    assert len(faults) == len(data_faults)


def test_every_faulty_field_is_collected_once(tmp_path: Path) -> None:
    folder = made(tmp_path / "data", "ble")
    (folder / "anchors.csv").write_text("id,x,y,z,pattern\n3,1.5,2,2.5,star\n1,far,-1,2,\n")
    header = "x,y,rssi_1,rssi_3,count_1,count_3\n"
    train = "0,0,-50,-60,2,3\nb,c,d,-61,1,many\n1,1,,-60,4,1\n1,1\n2,2,-50,,0,0\n"
    (folder / ble.TRAIN_FILE).write_text(header + train)
    (folder / ble.TEST_FILE).write_text(header + "0,0,-50,-60,2,3\n")
    assert sorted(line.partition(f"{folder}/")[2] for line in lines(folder)) == [
        "anchors.csv: row 1: antenna: pattern is 'star'; choose from iso, dipole, hw_dipole, tr38901, or a file *.csv, "
        "*.msi, *.pln",
        "anchors.csv: row 2: x is 'far'; give a finite number, or leave it empty",
        f"{ble.TRAIN_FILE}: row 2: count_3 is 'many'; give a finite number, or leave it empty",
        f"{ble.TRAIN_FILE}: row 2: rssi_1 is 'd'; give a finite number, or leave it empty",
        f"{ble.TRAIN_FILE}: row 2: x is 'b'; give a finite number",
        f"{ble.TRAIN_FILE}: row 2: y is 'c'; give a finite number",
        f"{ble.TRAIN_FILE}: row 3: count_1 is '4', but rssi_1 is empty; leave it empty, too",
        f"{ble.TRAIN_FILE}: row 4: 2 fields, but the header has 6; correct or remove the row",
        f"{ble.TRAIN_FILE}: row 5: count_1 is '0', where rssi_1 is known; give the number of readings, 1 to a million",
    ]


@pytest.mark.parametrize(
    ("rows", "count", "message"),
    [
        ("{header}\n1,2\n3\n", 4, "; correct or remove the row"),
        ("x,y,rssi_1,rssi_3,count_1\n1,2,-50,-60,7\n", 2, ": line 1: no column count_3; .* in both files, or none"),
    ],
)
def test_faults_of_columns_are_the_only_ones(rows: str, count: int, message: str, tmp_path: Path) -> None:
    folder = made(tmp_path / "data", "ble")
    for name in (ble.TRAIN_FILE, ble.TEST_FILE):
        (folder / name).write_text(rows.format(header=(folder / name).read_text().splitlines()[0]))
    fault_lines = lines(folder)
    assert [bool(re.search(message, line)) for line in fault_lines] == [True] * count


@needs("flat-ble")
def test_correct_data_have_no_faults() -> None:
    record, faults = collect_faults(lambda: load(DATA / "flat-ble"))
    assert faults == []
    np.testing.assert_array_equal(record.observation, load(DATA / "flat-ble").observation)


def test_parts_without_a_value_are_skipped() -> None:
    def wrong() -> int:
        raise DataFault("a.csv", "wrong; correct it", row=3)

    def later(*parts: Any) -> None:
        raise AssertionError("a part was read that needs one without a value")

    def read() -> None:
        first = attempt(wrong)
        attempt(later, first)
        attempt(later, [first])
        with recoverable():
            later(first.value)
        refuse(DataFault("b.csv", "wrong, too; correct it"))
        stop_at_faults()
        later()

    faults = [str(fault) for fault in collect_faults(read)[1]]
    assert faults == ["a.csv: row 3: wrong; correct it", "b.csv: wrong, too; correct it"]
    refusal(attempt, wrong, r"a\.csv: row 3")
    refusal(refuse, DataFault("b.csv", "wrong; correct it"), r"b\.csv: wrong")
    stop_at_faults()


def test_faults_pass_between_processes() -> None:
    fault = DataFault(Path("a.png"), "wrong; correct it", row=3, file_per_row=True)
    again = pickle.loads(pickle.dumps(fault))
    assert (str(again), again.row, again.kind) == (str(fault), 3, (".", "correct it"))
