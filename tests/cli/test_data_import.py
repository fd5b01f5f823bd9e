"""``wrf-mi data import``: what it prints, and public data sets by single commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calling import call, contents, refused
from changed_folders import DATA, needs

pytest.importorskip("pandas")

TABLE = "PCI,latitude,longitude,device,rsrp\n" + "\n".join(
    f"{cell},{36.001 + 0.0005 * np.sin(k):.8f},{-78.9385 + 0.0005 * np.cos(k):.8f},Samsung,{-90 - k % 30 - step}"
    for k in range(40)
    for step, cell in enumerate("ABC")
)
"""A drive test of three cells, in the form of the campus of ``duke-cbrs``."""


def test_import_states_columns_assumptions_and_the_next_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive.csv").write_text(TABLE)
    folder = tmp_path / "campus"
    status, out, err = call(["data", "import", tmp_path / "drive.csv", "--out", folder], capsys)
    assert (status, err) == (0, "")
    for line in (
        r"PCI        id                         120",
        "latitude   lat             EPSG:4326  120",
        "device     kept, not used             120",
    ):
        assert line in out
    assert "projected to metres east and north" in out
    assert "by reciprocity" in out
    assert f"{folder}: no fault, no suspicion\nnext: wrf-mi train {folder}\n" in out
    assert {"import.yml", "plan.png"} < contents(folder)
    refused(["data", "import", tmp_path / "drive.csv", "--out", folder], "campus: exists; remove it", capsys)
    status, out, _ = call(["data", "import", tmp_path / "drive.csv", "--out", folder, "--replace", "--json"], capsys)
    values = json.loads(out)
    assert (status, values["summary"]["rows"], values["check"]["ok"]) == (0, 40, True)


def test_bad_options_end_with_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "drive.csv").write_text(TABLE)
    command = ["data", "import", tmp_path / "drive.csv", "--out", tmp_path / "campus"]
    refused([*command, "--not-heard", "never"], "--not-heard never: give numbers in dBm, or none", capsys)
    refused([*command, "--columns", "place=PCI"], "--columns: 'place' is not understood", capsys)
    refused([*command, "--crs", "moon"], "--crs: 'moon' is no coordinate reference system", capsys)
    refused(["data", "import", tmp_path / "none.csv", "--out", tmp_path / "x"], r"none\.csv: missing", capsys)
    assert contents(tmp_path) == {"drive.csv"}


@needs("wifi-office")
def test_wifi_office_imports_by_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Grid indices of 0.6 m, -200 dBm and 100 m of range where nothing was heard, access points at unknown places."""
    train, test = (DATA / "wifi-office" / f"database_office_{part}.csv" for part in ("train", "test"))
    folder, run = tmp_path / "office", tmp_path / "run"
    status, out, _ = call(["data", "import", train, "--test", test, "--pitch-m", 0.6, "--out", folder], capsys)
    assert status == 0
    assert "-200 is not heard: 659 readings are empty fields" in out
    assert "100000 is no rtt" in out
    assert "split: 81 training and 27 test rows" in out
    assert call(["train", folder, "--model", "idw", "--out", run], capsys)[0] == 0
    error_db = json.loads((run / "metrics.json").read_text())["abs_error_db"]["median"]
    assert error_db == pytest.approx(1.9, abs=0.1)
