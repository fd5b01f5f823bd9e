"""``wrf-mi data check``: lines, JSON and exit statuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from calling import call, refused
from made_flat import write_flat


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    return write_flat(tmp_path / "flat")


def strengths_without_sign(folder: Path) -> None:
    for name in ("calibration_df.csv", "test_robot_df.csv"):
        header, *rows = (folder / name).read_text().splitlines()
        rows = [
            ",".join(field.removeprefix("-") if k > 3 else field for k, field in enumerate(row.split(",")))
            for row in rows
        ]
        (folder / name).write_text("\n".join([header, *rows]))


def test_correct_data(flat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(["data", "check", flat], capsys) == (0, f"{flat}: no fault, no suspicion\n", "")
    assert call(["data", "check", flat, "--strict"], capsys)[0] == 0
    status, out, err = call(["data", "check", flat, "--json"], capsys)
    assert (status, err) == (0, "")
    assert json.loads(out) == {
        "dataset": str(flat),
        "ok": True,
        "source": str(flat),
        "task": "rssi",
        "rows": 30,
        "faults": [],
        "suspicions": [],
        "notes": [],
    }


def test_faults_end_with_status_2(flat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    anchors = (flat / "anchors.csv").read_text().replace("2.3", "high")
    (flat / "anchors.csv").write_text(anchors)
    rows = (flat / "calibration_df.csv").read_text().splitlines()
    rows[4] = "1,2"
    (flat / "calibration_df.csv").write_text("\n".join(rows))
    (flat / "test_robot_df.csv").unlink()
    for options in ([], ["--strict"], ["--json"]):
        status, out, err = call(["data", "check", flat, *options], capsys)
        assert (status, err) == (2, "")
        found = json.loads(out)["faults"] if options == ["--json"] else out.splitlines()[:-1]
        assert len(found) == 3, out
    status, out, _ = call(["data", "check", flat], capsys)
    assert sorted(out.splitlines()[:-1]) == [
        "fault: anchors.csv, row 2: z is 'high'; give a finite number, or leave it empty",
        "fault: calibration_df.csv, row 4: 2 fields, but the header has 6; correct or remove the row",
        "fault: test_robot_df.csv: missing; give a file that exists, or complete its folder",
    ]
    assert out.splitlines()[-1] == f"{flat}: 3 faults; suspicions are looked for when there is none"


def test_suspicions_end_with_status_1_if_asked(flat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    strengths_without_sign(flat)
    status, out, err = call(["data", "check", flat], capsys)
    assert (status, err) == (0, "")
    first, last = out.splitlines()
    assert first.startswith("suspicion strengths: signal strengths in training rows and test rows of anchor1, anchor2")
    assert last == f"{flat}: no fault, 1 suspicion"
    assert call(["data", "check", flat, "--strict"], capsys)[0] == 1
    assert call(["data", "check", flat, "--strict", "--ignore", "strengths"], capsys)[0] == 0
    found = json.loads(call(["data", "check", flat, "--json", "--strict"], capsys)[1])
    assert [one["name"] for one in found["suspicions"]] == ["strengths"]
    refused(["data", "check", flat, "--ignore", "strength"], "suspicion 'strength': unknown; known are", capsys)


def test_data_sets_that_do_not_exist(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    refused(["data", "check", "nowhere"], "neither a folder nor known", capsys)
    refused(["data", "check", "rfid-lab"], "wrf-mi data fetch rfid-lab", capsys)
    (tmp_path / "empty").mkdir()
    status, out, _ = call(["data", "check", tmp_path / "empty"], capsys)
    assert status == 2
    assert "empty: an empty folder; a data set is a folder with receivers.csv" in out
    shutil.rmtree(tmp_path / "empty")
