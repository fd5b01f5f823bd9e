"""A fit is used again only where settings, rows, seed, data, files and versions are those that it was made with."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wrf_mi_bench import bench, methods, tables
from wrf_mi_bench import budget as bench_budget
from wrf_mi_bench.budget import Budget, budgets
from wrf_mi_bench.methods import Place, field_run
from wrf_mi_bench.table_plan import PARTS, Row

from wrf_mi.core import InputError, Record
from wrf_mi.runs import fit_key
from wrf_mi.runs.fit_key import content_digest, scene_files


def other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fit_key.versions
    monkeypatch.setattr(fit_key, "versions", lambda: before() | {"drjit": "0.1"})


@pytest.fixture
def place(one_gateway: Record, tmp_path: Path) -> Place:
    return Place(one_gateway, Path("none"), tmp_path / "fits", rows=9, steps=10)


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


def with_data(place: Place, **changes: Any) -> Place:
    return replace(place, record=replace(place.record, **changes))


def one_pixel(place: Place) -> Place:
    observation = place.record.observation.copy()
    observation[0, 0, 3, 5] += 1e-3
    return with_data(place, observation=observation)


CHANGES: dict[str, Callable[[Place], Place]] = {
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
def test_field_of_other_settings_rows_or_data_is_fitted_anew(change: str, place: Place, trained: list[Path]) -> None:
    field_run(place, "wrf-gs", 7)
    field_run(CHANGES[change](place), "wrf-gs", 7)
    assert len(set(trained)) == 2


def test_field_of_other_versions_is_fitted_anew(
    place: Place, trained: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    field_run(place, "wrf-gs", 7)
    other_versions(monkeypatch)
    field_run(place, "wrf-gs", 7)
    assert len(set(trained)) == 2


def test_same_field_is_used_again_and_logged(
    place: Place, trained: list[Path], caplog: pytest.LogCaptureFixture
) -> None:
    first = field_run(place, "wrf-gs", 7)
    assert "used again" not in caplog.text
    with caplog.at_level(logging.INFO):
        # Where the data were read from does not count.
        assert field_run(with_data(place, source="elsewhere"), "wrf-gs", 7) == first
    assert trained == [first.folder]
    assert f"{first.folder}: the same fit was finished before; used again" in caplog.text


def test_stopped_field_is_fitted_from_the_start(place: Place, trained: list[Path]) -> None:
    folder = field_run(place, "wrf-gs", 7).folder
    (folder / "metrics.json").rename(folder / "left")
    assert field_run(place, "wrf-gs", 7).folder == folder
    assert trained == [folder, folder]
    assert not (folder / "left").exists()


def test_budgets_of_other_seeds_or_schedules_are_fitted_anew(
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


def test_digest_tells_values_apart() -> None:
    values: list[Any] = [
        "a", "b", 1, 1.0, True, None, (), ("a",), ("a", "b"), "a\n'b'", {"a": 1}, {"a": 2}, {"b": 1}, [("a", 1)],
        np.zeros(2), np.zeros(2, np.float32), np.zeros((1, 2)), np.zeros((2, 1)), np.array([0, 1.0]),
    ]  # fmt: skip
    assert len({content_digest(value) for value in values}) == len(values)
    assert content_digest({"a": 1, "b": 2}) == content_digest({"b": 2, "a": 1})
    assert content_digest(np.arange(6).reshape(2, 3).T) == content_digest(np.arange(6).reshape(2, 3).T.copy())
    with pytest.raises(TypeError, match="object has no digest"):
        content_digest(object())


def test_digest_of_a_folder_is_that_of_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    named = '<scene><shape type="ply"><string name="filename" value="{}"/></shape></scene>'
    (tmp_path / "scene" / "scene.xml").write_text(named.format("meshes/wall.ply"))
    (tmp_path / "scene" / "meshes" / "wall.ply").write_text("ply")
    copy = shutil.copytree(tmp_path / "scene", tmp_path / "copy")
    assert content_digest(copy) == content_digest(tmp_path / "scene")
    before = content_digest(scene_files(copy / "scene.xml"))
    (copy / "meshes" / "wall.ply").write_text("ply2")
    assert content_digest(copy) != content_digest(tmp_path / "scene")
    assert content_digest(scene_files(copy / "scene.xml")) != before
    (copy / "beside.xml").write_text(named.format("floor.ply"))
    (copy / "floor.ply").write_text("ply")
    before = content_digest(scene_files(copy / "beside.xml"))
    (copy / "floor.ply").write_text("ply2")
    assert content_digest(scene_files(copy / "beside.xml")) != before
    for name in ("beside.xml", "floor.ply"):
        (copy / name).unlink()
    (copy / "meshes" / "wall.ply").write_text("ply")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "meshes").symlink_to(copy / "meshes")
    before = content_digest(tmp_path / "linked")
    (copy / "meshes" / "wall.ply").write_text("ply3")
    assert content_digest(tmp_path / "linked") != before
    (copy / "meshes" / "wall.ply").write_text("ply")
    (copy / "meshes" / "wall.ply").rename(copy / "meshes" / "door.ply")
    assert content_digest(copy) != content_digest(tmp_path / "scene")
    assert scene_files("laboratory") == []
    with pytest.raises(InputError, match="no such file or folder"):
        content_digest(tmp_path / "none")


@pytest.mark.parametrize("name", ["wrf-gs-official", "flat-ble"])
def test_cases_of_bench_have_a_folder_for_data_and_versions(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_rows_of_tables_are_run_anew_for_other_data_or_versions(
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

    monkeypatch.setattr(tables, "run_module", run)
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
