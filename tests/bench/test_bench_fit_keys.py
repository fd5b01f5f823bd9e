"""Keys of fits and cases of the benchmarks: what is fitted again and what is used again."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wrf_mi_bench import bench, methods, tables
from wrf_mi_bench import budget as bench_budget
from wrf_mi_bench.budget import Budget, budgets
from wrf_mi_bench.methods import MethodInput, field_run
from wrf_mi_bench.table_plan import PARTS, Row

from wrf_mi.core import InputError, Record
from wrf_mi.runs import fit_key


def other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fit_key.versions
    monkeypatch.setattr(fit_key, "versions", lambda: before() | {"drjit": "0.1"})


@pytest.fixture
def place(one_gateway: Record, tmp_path: Path) -> MethodInput:
    return MethodInput(one_gateway, Path("none"), tmp_path / "fits", rows=9, steps=10)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders that fields were fitted into."""
    folders: list[Path] = []

    def train(record: Record, folder: Path, model: str, settings: Any, n_train: int) -> None:
        folder.mkdir(parents=True)
        (folder / "metrics.json").write_text("{}")
        folders.append(folder)

    monkeypatch.setattr(methods, "train", train)
    return folders


def with_data(place: MethodInput, **changes: Any) -> MethodInput:
    return replace(place, record=replace(place.record, **changes))


def one_pixel(place: MethodInput) -> MethodInput:
    observation = place.record.observation.copy()
    observation[0, 0, 3, 5] += 1e-3
    return with_data(place, observation=observation)


CHANGES: dict[str, Callable[[MethodInput], MethodInput]] = {
    "steps": lambda place: replace(place, steps=11),
    "rows": lambda place: replace(place, rows=8),
    "seed": lambda place: replace(place, seed=1),
    "a pixel": one_pixel,
    "a position": lambda place: with_data(place, tx_pos_m=place.record.tx_pos_m + 1e-6),
    "a pose": lambda place: with_data(
        place, receivers=(replace(place.record.receivers[0], position_m=np.array([1.0, 2.0, 3.0])),)
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_field_of_other_settings_rows_or_data_is_fitted_again(
    change: str, place: MethodInput, trained: list[Path]
) -> None:
    field_run(place, "wrf-gs", 7)
    field_run(CHANGES[change](place), "wrf-gs", 7)
    assert len(set(trained)) == 2


def test_field_of_other_versions_is_fitted_again(
    place: MethodInput, trained: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    field_run(place, "wrf-gs", 7)
    other_versions(monkeypatch)
    field_run(place, "wrf-gs", 7)
    assert len(set(trained)) == 2


def test_same_field_is_used_again_and_logged(
    place: MethodInput, trained: list[Path], caplog: pytest.LogCaptureFixture
) -> None:
    first = field_run(place, "wrf-gs", 7)
    assert "used again" not in caplog.text
    with caplog.at_level(logging.INFO):
        # Where the data were read from does not count.
        assert field_run(with_data(place, source="elsewhere"), "wrf-gs", 7) == first
    assert trained == [first.folder]
    assert f"{first.folder}: the same fit was finished before; used again" in caplog.text


def test_stopped_field_is_fitted_from_the_start(place: MethodInput, trained: list[Path]) -> None:
    folder = field_run(place, "wrf-gs", 7).folder
    (folder / "metrics.json").rename(folder / "left")
    assert field_run(place, "wrf-gs", 7).folder == folder
    assert trained == [folder, folder]
    assert not (folder / "left").exists()


def test_budgets_of_other_seeds_or_schedules_are_fitted_again(
    one_gateway: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = []

    def train(record: Record, folder: Path, model: str, settings: Any) -> None:
        folders.append(folder)
        raise InputError("far enough")

    monkeypatch.setattr(bench_budget, "train", train)
    for seed, schedule in ((0, ["steps=10"]), (1, ["steps=10"]), (0, ["steps=11"]), (0, ["steps=10"])):
        with pytest.raises(InputError, match="far enough"):
            budgets(one_gateway, tmp_path, schedule, seed, {"best": Budget((), None)})
    assert len(set(folders[:3])) == 3
    assert folders[3] == folders[0]


@pytest.mark.parametrize("name", ["wrf-gs-official", "flat-ble"])
def test_case_folder_depends_on_data_and_versions(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_rows_of_tables_are_run_again_for_other_data_or_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
