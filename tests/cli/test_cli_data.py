"""``wrf-mi data check`` and ``data import``: lines, JSON and exit statuses, and public data sets by single commands."""

import json
from pathlib import Path

import numpy as np
import pytest
from calling import contents
from changed_folders import DATA, needs
from commands import Command
from made_flat import write_flat


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    return write_flat(tmp_path / "flat")


def test_correct_data(flat: Path, command: Command) -> None:
    assert command(["data", "check", flat]) == (0, f"{flat}: no fault, no suspicion\n", "")
    command.done(["data", "check", flat, "--strict"])
    status, out, err = command(["data", "check", flat, "--json"])
    assert (status, err) == (0, "")
    summary = {"dataset": str(flat), "ok": True, "source": str(flat), "task": "rssi", "rows": 30}
    assert json.loads(out) == summary | {"faults": [], "suspicions": [], "notes": []}


def test_faults_end_with_status_2(flat: Path, command: Command) -> None:
    anchors = (flat / "anchors.csv").read_text().replace("2.3", "high")
    (flat / "anchors.csv").write_text(anchors)
    rows = (flat / "calibration_df.csv").read_text().splitlines()
    rows[4] = "1,2"
    (flat / "calibration_df.csv").write_text("\n".join(rows))
    (flat / "test_robot_df.csv").unlink()
    for options in (["--json"], ["--strict"], []):
        status, out, err = command(["data", "check", flat, *options])
        assert (status, err) == (2, "")
        assert len(json.loads(out)["faults"] if options == ["--json"] else out.splitlines()[:-1]) == 3, out
    *faults, last = out.splitlines()
    assert sorted(faults) == [
        "fault: anchors.csv, row 2: z is 'high'; give a finite number, or leave it empty",
        "fault: calibration_df.csv, row 4: 2 fields, but the header has 6; correct or remove the row",
        "fault: test_robot_df.csv: missing; give a file that exists, or complete its folder",
    ]
    assert last == f"{flat}: 3 faults; correct them, then check again for suspicions"


def test_suspicions_end_with_status_1_if_asked(flat: Path, command: Command) -> None:
    for name in ("calibration_df.csv", "test_robot_df.csv"):  # strengths without their sign
        header, *rows = (flat / name).read_text().splitlines()
        fields = [row.split(",") for row in rows]
        rows = [",".join([*row[:4], *(field.removeprefix("-") for field in row[4:])]) for row in fields]
        (flat / name).write_text("\n".join([header, *rows]))
    status, out, err = command(["data", "check", flat])
    assert (status, err) == (0, "")
    first, last = out.splitlines()
    assert first.startswith("suspicion strengths: no signal strength of anchor1, anchor2 is below 0 dBm: ")
    assert last == f"{flat}: no fault, 1 suspicion"
    status, out, _ = command(["data", "check", flat, "--strict", "--json"])
    assert (status, [suspicion["name"] for suspicion in json.loads(out)["suspicions"]]) == (1, ["strengths"])
    command.done(["data", "check", flat, "--strict", "--ignore", "strengths"])
    command.refused(["data", "check", flat, "--ignore", "strength"], "suspicion 'strength': unknown; known are")


def test_data_sets_that_do_not_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    command.refused(["data", "check", "nowhere"], "neither a folder nor known")
    command.refused(["data", "check", tmp_path / "nowhere"], "no such folder")
    command.refused(["data", "check", "rfid-lab"], "wrf-mi data fetch rfid-lab")
    (tmp_path / "empty").mkdir()
    status, out, _ = command(["data", "check", tmp_path / "empty"])
    assert status == 2
    assert "empty: an empty folder; a data set is a folder with receivers.csv" in out


TABLE = "PCI,latitude,longitude,device,rsrp\n" + "\n".join(
    f"{cell},{36.001 + 0.0005 * np.sin(k):.8f},{-78.9385 + 0.0005 * np.cos(k):.8f},Samsung,{-90 - k % 30 - step}"
    for k in range(40)
    for step, cell in enumerate("ABC")
)
"""A drive test of three cells, in the form of the campus of ``duke-cbrs``."""


@pytest.fixture
def importing(tmp_path: Path) -> list[object]:
    pytest.importorskip("pandas")
    (tmp_path / "drive.csv").write_text(TABLE)
    return ["data", "import", tmp_path / "drive.csv", "--out", tmp_path / "campus"]


def test_import_states_columns_assumptions_and_the_next_command(importing, tmp_path, command):
    folder = tmp_path / "campus"
    status, out, err = command(importing)
    assert (status, err) == (0, "")
    for line in (
        "PCI        id                  120",
        "latitude   lat      EPSG:4326  120",
        "device     run                 120",
        "projected to metres east and north",
        "by reciprocity",
        f"{folder}: no fault, no suspicion\nnext: wrf-mi train {folder} [--scene SCENE] --out RUN\n",
    ):
        assert line in out
    assert {"import.yml", "plan.png"} < contents(folder)
    command.refused(importing, "campus: exists; remove it")
    values = command.json([*importing, "--replace"])
    assert (values["summary"]["rows"], values["check"]["ok"]) == (40, True)


def test_bad_options_end_with_status_2(importing: list[object], tmp_path: Path, command: Command) -> None:
    command.refused([*importing, "--not-heard", "never"], "--not-heard never: give numbers in dBm, or none")
    command.refused([*importing, "--columns", "place=PCI"], "--columns: 'place' is not understood")
    command.refused([*importing, "--crs", "moon"], "--crs: 'moon' is no coordinate reference system")
    command.refused(["data", "import", tmp_path / "none.csv", "--out", tmp_path / "x"], r"none\.csv: missing")
    assert contents(tmp_path) == {"drive.csv"}


@needs("wifi-office")
def test_wifi_office_imports_by_one_command(tmp_path: Path, command: Command) -> None:
    """Grid indices of 0.6 m, -200 dBm where nothing was heard, access points at unknown places."""
    train, test = (DATA / "wifi-office" / f"database_office_{part}.csv" for part in ("train", "test"))
    folder, run = tmp_path / "office", tmp_path / "run"
    out = command.done(["data", "import", train, "--test", test, "--pitch", 0.6, "--out", folder])
    assert "-200 is not heard: 659 readings are empty fields" in out
    assert "split: 81 training and 27 test rows" in out
    command.done(["train", folder, "--model", "idw", "--out", run])
    error_db = json.loads((run / "metrics.json").read_text())["abs_error_db"]["median"]
    assert error_db == pytest.approx(2.0, abs=0.2)
