"""Reading of tables: separators, decimal marks, comments, encodings, formats and damaged lines."""

import importlib
from pathlib import Path

import numpy as np
import pytest
from changed_folders import error_line, refusal

from wrf_mi.apps.importing import files
from wrf_mi.apps.importing.files import joined, read_table
from wrf_mi.core import memory

pandas = pytest.importorskip("pandas")

NAMES = ["x", "y", "ap", "rssi"]
ROWS = [[1.5, 2.0, "AP a", -60.5], [1.5, 2.25, "AP b", np.nan], [3.0, -4.0, "AP a", -71.0]]
LINES = ["x,y,ap,rssi", "1.5,2.0,AP a,-60.5", "1.5,2.25,AP b,", "3.0,-4.0,AP a,-71"]
TEXT = "\n".join(LINES) + "\n"

FORMS = {
    "commas": TEXT.encode(),
    "tabs": TEXT.replace(",", "\t").encode(),
    "semicolons": TEXT.replace(",", ";").encode(),
    "decimal comma": TEXT.replace(",", ";").replace(".", ",").encode(),
    "mark of the byte order": b"\xef\xbb\xbf" + TEXT.encode(),
    "UTF-16": TEXT.encode("utf-16"),
    "comments": ("# made up\n\n" + "\n% again\n".join(LINES)).encode(),
    "header in a comment": ("# " + TEXT).encode(),
    "quotes": TEXT.replace("AP a", '"AP a"').encode(),
    "blanks after commas": TEXT.replace(",", ", ").encode(),
    "lines of Windows": TEXT.replace("\n", "\r\n").encode(),
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_of_text_hold_the_same_table(form: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(FORMS[form])
    table = read_table(tmp_path / "t.csv")
    expected = pandas.DataFrame(ROWS, columns=NAMES)
    pandas.testing.assert_frame_equal(table.frame, expected, check_dtype=False)
    assert table.numbers("rssi").dtype == np.float64


@pytest.mark.parametrize("suffix", ["parquet", "xlsx"])
def test_binary_formats_hold_the_same_table(suffix: str, tmp_path: Path) -> None:
    frame = pandas.DataFrame(ROWS, columns=NAMES)
    path = tmp_path / f"t.{suffix}"
    frame.to_parquet(path) if suffix == "parquet" else frame.to_excel(path, index=False)
    pandas.testing.assert_frame_equal(read_table(path).frame, frame, check_dtype=False)


def test_names_of_columns_may_lack_be_whole_numbers_or_in_code_page_1252(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("100,-60,100\n-71,100,-80\n")
    table = read_table(file)
    assert (table.has_header, list(table.frame.columns)) == (False, ["1", "2", "3"])
    np.testing.assert_array_equal(table.numbers("2"), [-60, 100])
    file.write_text("x,y,17,42\n0,1,-60,-70\n")
    assert list(read_table(file).frame.columns) == ["x", "y", "17", "42"]
    file.write_bytes("x;y;Küche\n1;2;-60\n".encode("cp1252"))
    table = read_table(file)
    assert "Küche" in table.frame
    assert "cp1252" in table.notes[0]


REFUSED = {
    "x,y,rssi\n1,2,-60\n1,2\n": r"line 3: 2 fields, but the first line has 3 \(x, y, rssi\); .*--columns x=X",
    "# c\nx,y,rssi\n1,2,-60,5\n": "line 3: 4 fields",
    "x,y,x\n1,2,3\n": "line 1: the header has twice the column x",
    "\n# nothing\n": "empty; give a row",
    "x,y,rssi\n": "no rows; give one",
}


@pytest.mark.parametrize("text", REFUSED)
def test_damaged_text_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text)
    refusal(read_table, tmp_path / "t.csv", REFUSED[text])


@pytest.mark.parametrize("name", ["t.csv", "t.parquet", "t.xlsx"])
def test_missing_and_damaged_files_are_refused(name: str, tmp_path: Path) -> None:
    refusal(read_table, tmp_path / name, rf"{name}: missing")
    (tmp_path / name).write_bytes(b"\x00\x81\x8d\xff" * 9)
    refusal(read_table, tmp_path / name, name)


def test_text_in_a_column_of_numbers_is_refused_with_its_file_and_row(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,rssi\n1,-60\n2,-61\n")
    (tmp_path / "b.csv").write_text("x,rssi\n1,-60\n2,weak\n")
    table = joined([read_table(tmp_path / name) for name in ("a.csv", "b.csv")])
    assert len(table) == 4
    refusal(table.numbers, "rssi", r"b\.csv: row 2: rssi is 'weak'; give a number")
    (tmp_path / "c.csv").write_text("x,rssi\n1,-60\n1e300,-61\n")
    message = r"c\.csv: row 2: x is '1e\+300'; give a number of single precision"
    refusal(read_table(tmp_path / "c.csv").numbers, "x", message)


def test_tables_beyond_memory_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "t.csv").write_text("x,y\n" + "1,2\n" * 6)
    monkeypatch.setattr(memory, "SMALL_BYTES", 0)
    for free_bytes, message in ((100, r"t\.csv takes"), (180, r"t\.csv: 6 rows of 2 columns")):
        monkeypatch.setattr(memory, "free_bytes", lambda free=free_bytes: free)
        refusal(read_table, tmp_path / "t.csv", message)


def test_missing_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(files, "import_module", absent)
    error_line(read_table, tmp_path / "t.csv", r"data import needs pandas: pip install '\.\[tables\]'")
    assert importlib.import_module("pandas") is pandas


@pytest.mark.parametrize("lines", [1, 3])
def test_lines_above_the_header_are_left_out(lines: int, tmp_path: Path) -> None:
    preamble = ["Survey-1.6,appRelease=2.85,model=Phone", "made by hand", "site A, floor 3"][:lines]
    (tmp_path / "t.csv").write_text("\n".join(preamble) + "\n" + TEXT)
    table = read_table(tmp_path / "t.csv")
    expected = pandas.DataFrame(ROWS, columns=NAMES)
    pandas.testing.assert_frame_equal(table.frame, expected, check_dtype=False)
    assert table.notes[0].endswith(f"{lines} lines above it are left out")


def test_rows_after_a_blank_line_are_of_the_same_table(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("x,y,ap,rssi\n1,2,a,-60\n\n1,2,hall,60\n\n")
    assert len(read_table(tmp_path / "t.csv").frame) == 2


def test_a_row_with_other_fields_is_no_preamble(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("1,2,-60,7\n" + "1,2,-60\n" * 5)
    error_line(read_table, tmp_path / "t.csv", "3 fields, but the first line has 4")


@pytest.mark.parametrize(("separator", "fields"), [("|", ["-65dBm", "-71 dBm"]), (",", ["-65 dBm", ""])])
def test_units_of_all_fields_stand_in_the_name(separator: str, fields: list[str], tmp_path: Path) -> None:
    rows = [separator.join(["x", "ap", "Strength", "Carrier", "Width"])]
    rows += [
        separator.join(["1.5", "a1", field, "2437MHz", width])
        for field, width in zip(fields, ("20MHz", "3 m"), strict=True)
    ]
    (tmp_path / "t.csv").write_text("\n".join(rows) + "\n")
    table = read_table(tmp_path / "t.csv")
    assert list(table.frame.columns) == ["x", "ap", "Strength (dBm)", "Carrier (MHz)", "Width"]
    np.testing.assert_array_equal(table.numbers("Strength (dBm)"), [-65, -71 if fields[1] else np.nan])
    assert table.numbers("Carrier (MHz)").tolist() == [2437, 2437]


def test_a_workbook_of_several_sheets_is_asked_for_one(tmp_path: Path) -> None:
    frame = pandas.DataFrame(ROWS, columns=NAMES)
    with pandas.ExcelWriter(tmp_path / "t.xlsx") as writer:
        frame.to_excel(writer, sheet_name="walk 1", index=False)
        frame[:2].to_excel(writer, sheet_name="walk 2", index=False)
        pandas.DataFrame().to_excel(writer, sheet_name="empty", index=False)
    assert len(read_table(tmp_path / "t.xlsx", "walk 2").frame) == 2
    error_line(
        read_table, tmp_path / "t.xlsx", r"several sheets \(walk 1 \(3 rows\), walk 2 \(2 rows\)\).*--sheet NAME"
    )
    error_line(read_table, tmp_path / "t.xlsx", "walk 3", "no sheet walk 3 with cells")


@pytest.mark.parametrize(
    ("name", "remedy"), [("old.xls", "save it as .*--columns x="), ("a.pcap", "export .*--columns x=")]
)
def test_other_formats_are_refused_with_their_conversion(name: str, remedy: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text('{"points": []}')
    error_line(read_table, tmp_path / name, rf"{name}: \.\w+ is not read as a table; .*{remedy}")
