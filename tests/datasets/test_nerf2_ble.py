"""NeRF2's layout of signal strengths: what is read, and every way in which a folder can be wrong."""

from pathlib import Path

import numpy as np
import pytest
from changed_folders import remove, replaced, rewritten, text

from wrf_mi.datasets import load, make_splits, read_nerf2_ble

GATEWAYS = "gateway1: [1.0, 2.0, 3.0]\ngateway2: [4, 5, 6]\n"
POSITIONS = "x,y,z\n0.5,1.5,1\n0.25,1.75,1\n1,2,1.5\n1.25,2,1\n"
POWERS = "gateway1,gateway2\n-54.25,-100\n-60,-61\n-100,-100\n-100,-70.5\n"


YML, POS, RSSI = "gateway_position.yml", "tx_pos.csv", "gateway_rssi.csv"
INDICES = {"train_index.txt": "3\n0\n", "test_index.txt": "1\n"}


def write_correct(folder: Path) -> Path:
    for name, content in {YML: GATEWAYS, POS: POSITIONS, RSSI: POWERS, **INDICES}.items():
        (folder / name).write_text(content)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_correct(tmp_path)


def test_reads_a_folder(folder: Path) -> None:
    record = load(folder)
    assert (record.task.name, record.source) == ("rssi", str(folder))
    assert [receiver.name for receiver in record.receivers] == ["gateway1", "gateway2"]
    np.testing.assert_array_equal(record.receivers[1].position_m, [4, 5, 6])
    np.testing.assert_array_equal(record.receivers[1].to_world, np.eye(3))
    np.testing.assert_array_equal(record.tx_pos_m, [[0.5, 1.5, 1], [0.25, 1.75, 1], [1, 2, 1.5], [1.25, 2, 1]])
    nan = np.nan
    np.testing.assert_array_equal(record.observation, [[-54.25, -60, nan, nan], [nan, -61, nan, -70.5]])
    assert record.observation.dtype == np.float32
    assert [part.tolist() for part in record.official] == [[3, 0], [1]]  # NeRF2 counts these from 0
    np.testing.assert_array_equal(record.scored, record.observation)
    for name in INDICES:
        (folder / name).unlink()
    record = read_nerf2_ble(folder)
    assert record.official is None
    # Rows that no gateway received are in no split.
    (split,) = make_splits(record, "trajectory")
    assert (split.all_train.tolist(), split.test.tolist()) == ([0, 1], [3])


SWAPPED = "\n".join(",".join(reversed(line.split(","))) for line in POWERS.splitlines())
NUMBERED = POWERS.replace("gateway1,gateway2", "0,1")


def gateways(first: str, second: str) -> str:
    return GATEWAYS.replace("gateway1", first).replace("gateway2", second)


def with_blank_lines(table: str) -> str:
    header, first, *rows = table.splitlines()
    return "\n".join(["", header, "", first, "  ", *rows, "", ""])


@pytest.mark.parametrize(
    ("changes", "order", "axes"),
    [
        ({RSSI: SWAPPED}, [0, 1], [0, 1, 2]),
        ({RSSI: POWERS.replace("gateway1,gateway2", "0,b")}, [0, 1], [0, 1, 2]),
        ({RSSI: POWERS.replace("gateway1,gateway2", "dBm,dBm")}, [0, 1], [0, 1, 2]),
        ({POS: POSITIONS.replace("x,y,z", "east,north,up")}, [0, 1], [0, 1, 2]),
        ({POS: POSITIONS.replace("x,y,z", "y,x,z")}, [0, 1], [1, 0, 2]),
        # Headers as pandas numbers them. Of gateways with such names one says nothing of the order, all of them do.
        ({POS: POSITIONS.replace("x,y,z", "0,1,2"), RSSI: NUMBERED}, [0, 1], [0, 1, 2]),
        ({YML: gateways("1", "2"), RSSI: NUMBERED}, [0, 1], [0, 1, 2]),
        ({YML: gateways("1", "0"), RSSI: NUMBERED}, [1, 0], [0, 1, 2]),
        ({POS: with_blank_lines(POSITIONS), RSSI: with_blank_lines(POWERS)}, [0, 1], [0, 1, 2]),
    ],
)
def test_columns_are_assigned_by_name_or_order(changes: dict, order: list[int], axes: list[int], folder: Path) -> None:
    plain = read_nerf2_ble(folder)
    for name, content in changes.items():
        (folder / name).write_text(content)
    record = read_nerf2_ble(folder)
    np.testing.assert_array_equal(record.observation, plain.observation[order])
    np.testing.assert_array_equal(record.tx_pos_m, plain.tx_pos_m[:, axes])


def one_row(folder: Path) -> None:
    (folder / POS).write_text("x,y,z\n0.5,1.5,1\n")
    (folder / RSSI).write_text("gateway1,gateway2\n-50,-60\n")


WRONG = {  # each is refused, see test_faults.py
    "no gateways file": (remove(YML), YML, "missing"),
    "no positions file": (remove(POS), POS, "missing"),
    "no powers file": (remove(RSSI), RSSI, "missing"),
    "empty gateways": rewritten(YML, "", "no gateway in it"),
    "gateway in the plane": replaced(YML, ", 3.0", "", r"gateway1: position is \[1.0, 2.0\]; give a list of 3"),
    "date that is none": replaced(YML, r"\[4, 5, 6\]", "2021-99-99", "month must be in 1..12.*line 2, column 11"),
    "gateway of 400 digits": replaced(YML, "3.0", "9" * 400, "no int .*too large to convert.*line 1, column 22"),
    "gateway too far": replaced(YML, "3.0", "1.0e+39", "gateway1: position is .*; give a list of 3 finite numbers"),
    "gateway of two lines": rewritten(YML, '"gate\\nway": [1, 2, 3]\n', r"'gate\\nway' does not .*; call it gateway1"),
    "two coordinates": replaced(POS, "x,y,z", "x,y", "row 1: 3 fields, but the header has 2"),
    "four coordinates": rewritten(POS, "a,b,c,d\n1,2,3,4\n", "line 1: header 'a,b,c,d' has 4 columns"),
    "position not finite": replaced(POS, "0.25", "nan", "row 2: x is 'nan'"),
    "positions without header": replaced(POS, "x,y,z\n", "", "line 1: '0.5,1.5,1' is a row of numbers"),
    "header of other numbers": replaced(RSSI, "gateway1,gateway2", "1,0", "line 1: '1,0' is a row of numbers"),
    "powers without header": replaced(RSSI, "gateway1,gateway2\n", "", "line 1: '-54.25,-100' is a row of numbers"),
    "rows differ": (text(POS, "1.25,2,1\n", ""), RSSI, "4 rows, but tx_pos.csv has 3"),
    "column too many": rewritten(RSSI, "a,b,c\n1,2,3\n", "3 columns, but gateway_position.yml has 2 gateways"),
    "other gateway": replaced(RSSI, "gateway2", "gateway9", "line 1: no column gateway2"),
    "power of words": replaced(RSSI, "-61", "weak", "row 2: gateway2 is 'weak'"),
    "power too large": replaced(RSSI, "-61", "1e39", "row 2: gateway2 is '1e39'; give a finite number of single pre"),
    "one row": (one_row, POS, "1 row; give 2 at least"),
    "index of 5000 digits": replaced("train_index.txt", "3", "9" * 5000, "1: '9+' has more than 18 digits; correct it"),
    "index in both": replaced("test_index.txt", "1", "3", "row 3 is in train_index.txt as well"),
    "one index file": (remove("test_index.txt"), "test_index.txt", "missing"),
}
