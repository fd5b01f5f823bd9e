"""NeRF2's layout of signal strengths: what is read, and every way in which a folder can be wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from changed_folders import remove, text, write

from wrf_mi.datasets import load, make_splits, read_nerf2_ble

GATEWAYS = "gateway1: [1.0, 2.0, 3.0]\ngateway2: [4, 5, 6]\n"
POSITIONS = "x,y,z\n0.5,1.5,1\n0.25,1.75,1\n1,2,1.5\n1.25,2,1\n"
POWERS = "gateway1,gateway2\n-54.25,-100\n-60,-61\n-100,-100\n-100,-70.5\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "gateway_position.yml").write_text(GATEWAYS)
    (tmp_path / "tx_pos.csv").write_text(POSITIONS)
    (tmp_path / "gateway_rssi.csv").write_text(POWERS)
    (tmp_path / "train_index.txt").write_text("3\n0\n")
    (tmp_path / "test_index.txt").write_text("1\n")
    return tmp_path


def test_reads_a_folder(folder: Path) -> None:
    record = load(folder)
    assert (record.task, record.source) == ("rssi", str(folder))
    assert [one.name for one in record.receivers] == ["gateway1", "gateway2"]
    np.testing.assert_array_equal(record.receivers[1].position_m, [4, 5, 6])
    np.testing.assert_array_equal(record.receivers[1].to_world, np.eye(3))
    np.testing.assert_array_equal(record.tx_pos_m, [[0.5, 1.5, 1], [0.25, 1.75, 1], [1, 2, 1.5], [1.25, 2, 1]])
    nan = np.nan
    np.testing.assert_array_equal(record.observation, [[-54.25, -60, nan, nan], [nan, -61, nan, -70.5]])
    assert record.observation.dtype == np.float32
    assert record.official is not None
    assert [part.tolist() for part in record.official] == [[3, 0], [1]]  # NeRF2 counts these from 0
    np.testing.assert_array_equal(record.scored, record.observation)


def test_rows_that_no_gateway_received_are_in_no_split(folder: Path) -> None:
    (folder / "train_index.txt").unlink()
    (folder / "test_index.txt").unlink()
    record = read_nerf2_ble(folder)
    assert record.official is None
    (split,) = make_splits(record, "trajectory")
    assert (split.all_train.tolist(), split.test.tolist()) == ([0, 1], [3])


SWAPPED = "\n".join(",".join(reversed(line.split(","))) for line in POWERS.splitlines())


def renamed(content: str, *names: tuple[str, str]) -> str:
    for old, new in names:
        content = content.replace(old, new)
    return content


@pytest.mark.parametrize(
    ("gateways", "powers", "positions", "gateway_order", "axes"),
    [
        (GATEWAYS, SWAPPED, POSITIONS, [0, 1], [0, 1, 2]),
        (GATEWAYS, renamed(POWERS, ("gateway1,gateway2", "0,b")), POSITIONS, [0, 1], [0, 1, 2]),
        (GATEWAYS, renamed(POWERS, ("gateway1,gateway2", "dBm,dBm")), POSITIONS, [0, 1], [0, 1, 2]),
        (GATEWAYS, POWERS, renamed(POSITIONS, ("x,y,z", "east,north,up")), [0, 1], [0, 1, 2]),
        (GATEWAYS, POWERS, renamed(POSITIONS, ("x,y,z", "y,x,z")), [0, 1], [1, 0, 2]),
        # Headers as pandas numbers them. Of gateways with such names one says nothing of the order, all of them do.
        *(
            (
                renamed(GATEWAYS, *zip(("gateway1", "gateway2"), names, strict=True)),
                renamed(POWERS, ("gateway1,gateway2", "0,1")),
                renamed(POSITIONS, ("x,y,z", "0,1,2")),
                order,
                [0, 1, 2],
            )
            for names, order in ((("gateway1", "gateway2"), [0, 1]), (("1", "2"), [0, 1]), (("1", "0"), [1, 0]))
        ),
    ],
)
def test_columns_are_assigned_by_name_or_else_by_order(
    gateways: str, powers: str, positions: str, gateway_order: list[int], axes: list[int], folder: Path
) -> None:
    plain = read_nerf2_ble(folder)
    for name, content in ((YML, gateways), (RSSI, powers), (POS, positions)):
        (folder / name).write_text(content)
    record = read_nerf2_ble(folder)
    np.testing.assert_array_equal(record.observation, plain.observation[gateway_order])
    np.testing.assert_array_equal(record.tx_pos_m, plain.tx_pos_m[:, axes])


def test_blank_lines_are_skipped(folder: Path) -> None:
    plain = read_nerf2_ble(folder)
    for name in ("gateway_rssi.csv", "tx_pos.csv"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(["", lines[0], "", lines[1], "  ", *lines[2:], "", ""]))
    record = read_nerf2_ble(folder)
    np.testing.assert_array_equal(record.observation, plain.observation)
    np.testing.assert_array_equal(record.tx_pos_m, plain.tx_pos_m)


YML, POS, RSSI = "gateway_position.yml", "tx_pos.csv", "gateway_rssi.csv"


def one_row(folder: Path) -> None:
    for name in (POS, RSSI):
        (folder / name).write_text("\n".join((folder / name).read_text().splitlines()[:2]))
    (folder / RSSI).write_text("gateway1,gateway2\n-50,-60\n")


WRONG = {  # each is refused, see test_faults.py
    "no gateways file": (remove(YML), YML, "missing"),
    "no positions file": (remove(POS), POS, "missing"),
    "no powers file": (remove(RSSI), RSSI, "missing"),
    "empty gateways": (write(YML, ""), YML, "no gateway in it"),
    "gateways not YAML": (write(YML, "a: ["), YML, "not YAML"),
    "gateway in the plane": (text(YML, ", 3.0", ""), YML, r"gateway1: position is \[1.0, 2.0\]; give a list of 3"),
    "gateway of words": (text(YML, "3.0", "high"), YML, "gateway1: position"),
    "date that is none": (text(YML, r"\[4, 5, 6\]", "2021-99-99"), YML, "month must be in 1..12.*line 2, column 11"),
    "gateway of 400 digits": (text(YML, "3.0", "9" * 400), YML, "no int .*too large to convert.*line 1, column 22"),
    "gateway too far": (text(YML, "3.0", "1.0e+39"), YML, "gateway1: position is .*; give a list of 3 finite numbers"),
    "deep YAML": (write(YML, "a: " + "[" * 1000), YML, "not YAML"),
    "gateway of two lines": (
        write(YML, '"gate\\nway": [1, 2, 3]\n'),
        YML,
        r"gateway 'gate\\nway' does not go into one line; call it gateway1",
    ),
    "two coordinates": (text(POS, "x,y,z", "x,y"), POS, "row 1: 3 fields, but the header has 2"),
    "four coordinates": (write(POS, "a,b,c,d\n1,2,3,4\n"), POS, "line 1: header 'a,b,c,d' has 4 columns"),
    "position not finite": (text(POS, "0.25", "nan"), POS, "row 2: x is 'nan'"),
    "positions without header": (text(POS, "x,y,z\n", ""), POS, "line 1: '0.5,1.5,1' is a row of numbers"),
    "positions too large": (text(POS, "0.25", "-1e39"), POS, "row 2: x is '-1e39'; give a finite number of single"),
    "header of other numbers": (text(RSSI, "gateway1,gateway2", "1,0"), RSSI, "line 1: '1,0' is a row of numbers"),
    "powers without header": (text(RSSI, "gateway1,gateway2\n", ""), RSSI, "line 1: '-54.25,-100' is a row of numbers"),
    "rows differ": (text(POS, "1.25,2,1\n", ""), RSSI, "4 rows, but tx_pos.csv has 3"),
    "column too many": (
        write(RSSI, "gateway1,gateway2,gateway3\n1,2,3\n"),
        RSSI,
        "3 columns, but gateway_position.yml has 2 gateways",
    ),
    "other gateway": (text(RSSI, "gateway2", "gateway9"), RSSI, "line 1: no column gateway2"),
    "power of words": (text(RSSI, "-61", "weak"), RSSI, "row 2: gateway2 is 'weak'"),
    "power of words in a numbered column": (
        lambda folder: (folder / RSSI).write_text("0,1\n-50,-60\n\n-50,weak\n") and None,
        RSSI,
        r"row 2: column 1 \(gateway2\) is 'weak'",
    ),
    "power too large": (
        text(RSSI, "-61", "1e39"),
        RSSI,
        "row 2: gateway2 is '1e39'; give a finite number of single pre",
    ),
    "power missing": (text(RSSI, "-61", ""), RSSI, "row 2: gateway2 is ''"),
    "one row": (one_row, POS, "1 row; give 2 at least"),
    "index out of range": (text("train_index.txt", "3", "4"), "train_index.txt", "row 4 is out of range.*rows 0 to 3"),
    "index of 5000 digits": (
        text("train_index.txt", "3", "9" * 5000),
        "train_index.txt",
        "line 1: '9+' has more than 18 digits; correct it",
    ),
    "index in both": (text("test_index.txt", "1", "3"), "test_index.txt", "row 3 is in train_index.txt as well"),
    "one index file": (remove("test_index.txt"), "test_index.txt", "missing"),
}
