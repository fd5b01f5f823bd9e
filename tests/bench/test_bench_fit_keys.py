"""Keys of cases and table rows: what is measured again and what is used again."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wrf_mi_bench import bench, sources, tables
from wrf_mi_bench.table_plan import PARTS, Row


def other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    before = sources.versions
    monkeypatch.setattr(sources, "versions", lambda: before() | {"drjit": "0.1"})


@pytest.mark.parametrize("name", ["wrf-gs+-paper", "flat-plan"])
def test_case_folder_depends_on_data_and_versions(name, tmp_path, monkeypatch):
    data = tmp_path / "data"
    monkeypatch.setattr(bench, "dataset_files", lambda dataset: [data])
    data.mkdir()
    folders = [bench.case_folder(tmp_path, name)]
    assert bench.case_folder(tmp_path, name) == folders[0]
    (data / "rows.csv").write_text("1")
    folders.append(bench.case_folder(tmp_path, name))
    other_versions(monkeypatch)
    folders.append(bench.case_folder(tmp_path, name))
    if name in bench.CASES:
        other = replace(bench.CASES[name], arguments=(*bench.CASES[name].arguments, "--seed", "3"))
        monkeypatch.setattr(bench, "CASES", {name: other})
        folders.append(bench.case_folder(tmp_path, name))
    assert len(set(folders)) == len(folders)
    assert all(folder.name.startswith(f"{name}-") for folder in folders)


def test_rows_of_tables_are_run_again_for_other_data_or_versions(tmp_path, monkeypatch, capsys):
    row = Row(next(part for part in PARTS if part.dataset == "flat-ble"), "idw", 1.0, 0)
    data, asked = tmp_path / "data", []
    data.mkdir()
    monkeypatch.setattr(tables, "dataset_files", lambda dataset: [data])

    def run(module: str, arguments: list[str]) -> tuple[int, str]:
        folder = Path(arguments[-1])
        asked.append(folder)
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text(json.dumps(dict.fromkeys(tables.KEPT, 1)))
        return 0, ""

    class Scored:
        score, metrics = np.ones((1, 3)), dict.fromkeys(tables.KEPT, 1)

    monkeypatch.setattr(bench, "run_module", run)
    monkeypatch.setattr(tables, "read_run", lambda folder: Scored)
    first = tables.measure(tmp_path, row)
    assert tables.measure(tmp_path, row)["data"] == first["data"]
    assert len(asked) == 1
    assert f"{row.name}: finished before in {asked[0]}" in capsys.readouterr().err
    (data / "rows.csv").write_text("1")
    assert tables.measure(tmp_path, row)["data"] != first["data"]
    other_versions(monkeypatch)
    tables.measure(tmp_path, row)
    assert len(set(asked)) == 3
