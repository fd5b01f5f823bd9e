"""Tables of every method: what is planned, that rows are stored one by one, and what the tables say."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from documents import CHECKOUT, marked
from wrf_mi_bench import bench, sources, table_pages, tables
from wrf_mi_bench.bench import BenchFailed
from wrf_mi_bench.table_pages import LEAST, Points, front, front_table, fronts, pareto_figure, points_of, read_points
from wrf_mi_bench.table_plan import PARTS, QUICK_PARTS, Row, TablePart, plan

from wrf_mi.apps.table.entries import QUANTILES, Entry, read_entries, write_entry
from wrf_mi.core import InputError
from wrf_mi.models import MODELS
from wrf_mi.scene.correction_data import FILE as CORRECTION
from wrf_mi.tracing import open_scene

PAPER = {
    "spectrum": {"wrf-gs+", "wrf-gs", "nerf2", "vae", "dcgan", "ray-tracing"},
    "rssi": {"wrf-gs+", "wrf-gs", "nerf2", "mri"},
    "csi": {"wrf-gs+", "wrf-gs", "nerf2", "fire", "r2f2", "optml"},
}


def part_of(dataset: str) -> TablePart:
    return next(part for part in PARTS if part.dataset == dataset)


PUBLISHED = {("uplink", "r2f2"): "8.57", ("uplink", "fire"): "15.29"}


def made_row(row: Row, median: float, **more: Any) -> Entry:
    block = {"median": median, "mean": median, "p10": median - 1, "p90": median + 1}
    facts: dict[str, Any] = {
        **{"label": row.entry.label, "share": row.share, "seed": row.seed, "command": row.command},
        **{"method": row.method, "task": row.part.task, "dataset": row.part.dataset, "split": row.part.split},
        **{"date": "2026-01-01", "versions": tables.package_versions(), "n_train": 10, "n_test": 5},
        **{"train_seconds": 3.0, "ms_per_sample": 1.25, "peak_memory_mb": 400.0},
        **{"reference": {"uplink": block | {"median": -7.0}}, "score": block},
        "quantiles": [median - 1 + 0.02 * i for i in range(QUANTILES)],
    }
    return Entry(**facts | more)


def stub_results(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries of runs that took 3 s, whatever their folders hold."""

    def entry(run: object, predictions: str, **facts: Any) -> Entry:
        return Entry(**{"task": "rssi", "score": {}, "train_seconds": 3.0, **facts})

    monkeypatch.setattr(tables, "read_run", lambda folder: None)
    monkeypatch.setattr(tables, "predictions_digest", lambda run: "")
    monkeypatch.setattr(tables, "entry_of", entry)


def test_every_method_of_the_paper_is_planned_for_its_task():
    rows = plan()
    for task, names in PAPER.items():
        assert names <= {row.method for row in rows if row.part.task == task and row.share == 1}
    assert {row.entry.model for row in rows} <= set(MODELS)


def test_names_are_unique_and_whole_tables_come_first():
    rows = plan()
    assert len({row.name for row in rows}) == len(rows)
    first = [row.share == 1 and row.seed == 0 for row in rows]
    assert first == sorted(first, reverse=True)
    assert {row.part.dataset for row in plan(quick=True)} == {part.dataset for part in QUICK_PARTS}


def test_arguments_contain_scene_share_and_seed():
    scene = ["--scene", "x", "--material", "y"]
    words = " ".join(Row(part_of("flat-ble"), "ray-tracing", 0.3, 2).arguments(scene))
    assert words.startswith("train flat-ble ")
    for option in (" ".join(scene), "--n-train 0.3", "--seed 2"):
        assert option in words
    assert "--n-train" not in Row(part_of("flat-ble"), "mri", 1.0, 0).arguments([])


@pytest.fixture
def short_plan(monkeypatch):
    part = part_of("traced-csi-flat")
    rows = [Row(part, "fire", 1.0, 0), Row(part, "r2f2", 1.0, 0), Row(part, "fire", 0.1, 0)]
    for module in (tables, table_pages):
        monkeypatch.setattr(module, "plan", lambda quick=False: rows)
    return rows


def test_row_is_stored_when_done_and_not_measured_twice(short_plan, monkeypatch, tmp_path):
    asked = []

    def measure(runs, row):
        asked.append(row.name)
        if row.method == "r2f2" and len(asked) < 4:
            raise BenchFailed("r2f2 stumbled")
        return made_row(row, 5.0 if row.share == 1 else 4.0)

    monkeypatch.setattr(tables, "measure", measure)
    with pytest.raises(BenchFailed, match=r"1 rows did not finish: .*: r2f2 stumbled"):
        tables.tables(tmp_path / "table", tmp_path / "runs")
    stored = {path.stem for path in (tmp_path / "table").glob("*.json")}
    assert stored == {row.name for row in short_plan if row.method == "fire"}
    tables.tables(tmp_path / "table", tmp_path / "runs")
    assert asked == [row.name for row in short_plan] + [short_plan[1].name]
    assert len(tables.tables(tmp_path / "table", tmp_path / "runs")) == 3
    assert len(asked) == 4


def test_rows_of_other_data_or_commands_are_measured_again_and_of_other_versions_reported(
    short_plan, monkeypatch, tmp_path, capsys
):
    data, asked = tmp_path / "data", []
    data.mkdir()
    monkeypatch.setattr(tables, "dataset_files", lambda name: [data])

    def measure(runs, row):
        asked.append(row.name)
        return made_row(row, 5.0, data=tables.content_digest([data]))

    def change(row, **changes):
        path = tmp_path / "table" / f"{row.name}.json"
        stored = {**json.loads(path.read_text()), **changes}
        path.write_text(json.dumps({key: value for key, value in stored.items() if value is not None}))

    monkeypatch.setattr(tables, "measure", measure)
    for _ in range(2):
        tables.tables(tmp_path / "table", tmp_path / "runs")
        assert asked == [row.name for row in short_plan]
    assert "stored rows" not in capsys.readouterr().err
    older: tuple[dict[str, Any], ...] = {"data": "other"}, {"versions": {"numpy": "0.1"}}, {"data": None}
    for row, changes in zip(short_plan, older, strict=True):
        change(row, **changes)
    tables.tables(tmp_path / "table", tmp_path / "runs")
    assert asked[3:] == [short_plan[0].name]
    err = capsys.readouterr().err
    assert "1 of 2 stored rows were measured by other versions of packages and are kept" in err
    assert "1 of 2 stored rows do not state their data and are kept" in err
    change(short_plan[0], command=short_plan[0].command.replace("--model fire", "--model fire --set steps=1"))
    tables.tables(tmp_path / "table", tmp_path / "runs")
    assert asked[4:] == [short_plan[0].name]


def test_scenes_are_made_once_and_can_be_opened(flat_folder, monkeypatch, tmp_path):
    monkeypatch.setattr(tables, "data_folder", lambda name: flat_folder)
    for name in ("flat-ble", "rfid-lab"):
        path = tables.scene_of(part_of(name), tmp_path)
        assert len(open_scene(path, 2.4e9).objects) > 0
        before = {file: file.stat().st_mtime_ns for file in Path(path).rglob("*")}
        assert tables.scene_of(part_of(name), tmp_path) == path
        assert {file: file.stat().st_mtime_ns for file in Path(path).rglob("*")} == before


def test_runs_of_rows_are_used_again_but_for_other_data_or_versions(tmp_path, monkeypatch, capsys):
    row, data, asked = Row(part_of("flat-ble"), "idw", 1.0, 0), tmp_path / "data", []
    data.mkdir()

    def run(module, arguments):
        asked.append(Path(arguments[-1]))
        asked[-1].mkdir(parents=True)
        (asked[-1] / "metrics.json").write_text("{}")
        return 0, ""

    monkeypatch.setattr(tables, "dataset_files", lambda dataset: [data])
    monkeypatch.setattr(bench, "run_module", run)
    stub_results(monkeypatch)
    first = tables.measure(tmp_path, row)
    assert tables.measure(tmp_path, row).data == first.data
    assert len(asked) == 1
    assert f"{row.name}: finished before in {asked[0]}" in capsys.readouterr().err
    (data / "rows.csv").write_text("1")
    assert tables.measure(tmp_path, row).data != first.data
    versions = sources.versions() | {"drjit": "0.1"}
    monkeypatch.setattr(sources, "versions", lambda: versions)
    tables.measure(tmp_path, row)
    assert len(set(asked)) == 3


def test_no_row_begins_after_the_time_limit(short_plan, monkeypatch, tmp_path):
    monkeypatch.setattr(tables, "measure", lambda runs, row: pytest.fail("begun"))
    assert tables.tables(tmp_path / "table", tmp_path / "runs", most_s=-1.0) == {}


def test_the_best_method_comes_first_and_the_reference_last(short_plan, tmp_path):
    fire, r2f2, few = short_plan
    for row, median in ((fire, 5.0), (r2f2, 6.5), (few, 9.0)):
        write_entry(tmp_path, made_row(row, median))
    (tmp_path / "published.yml").write_text("figures: [{method: R2F2, key: r2f2, table: uplink, figure: '8.57'}]")
    table_pages.write_tables(tmp_path)
    text = (tmp_path / "README.md").read_text()
    order = [text.index(cell) for cell in ("| R2F2 | **6.50**", "| FIRE | **5.00**", "| FIRE | **9.00**", "**-7.00**")]
    assert order == sorted(order)
    assert "8.57" in text  # the paper's figure, in a column of its own that says so
    assert (tmp_path / "csi-traced-csi-flat-official.png").stat().st_size > 5000


def test_damaged_row_is_reported(tmp_path):
    (tmp_path / "a-seed0.json").write_text('{"method": ')
    with pytest.raises(InputError, match=r"a-seed0\.json: not readable .*restore it, or delete it"):
        read_entries(tmp_path)


def test_missing_data_sets_are_skipped(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tables, "available", lambda part: False)
    assert tables.tables(tmp_path / "table", tmp_path / "runs") == {}
    assert "flat-ble is not on this machine" in capsys.readouterr().err


def test_overview_has_a_line_per_method_with_the_mean_over_seeds(monkeypatch):
    flat, office = (part for part in PARTS if part.dataset.startswith("traced-csi-"))
    rows = [
        Row(flat, "fire", 1.0, 0),
        Row(flat, "fire", 1.0, 1),
        Row(flat, "fire", 0.1, 0),
        Row(office, "fire", 1.0, 0),
    ]
    rows += [Row(flat, "r2f2", 1.0, 0)]
    monkeypatch.setattr(table_pages, "plan", lambda quick=False: rows)
    medians = (5.0, 7.0, 100.0, 3.0, 9.5)
    stored = {row.name: made_row(row, median) for row, median in zip(rows, medians, strict=True)}
    lines = table_pages.overview("uplink", stored, PUBLISHED).splitlines()
    assert lines[0] == "| CEA (dB) | traced-csi-flat | traced-csi-office | paper, other data |"
    assert lines[2:] == ["| R2F2 | **9.50** |  | 8.57 |", "| FIRE | 6.00 | **3.00** | 15.29 |"]
    assert table_pages.overview("rssi", stored, PUBLISHED) == ""


def test_rows_of_data_as_they_were_made_before_are_marked(monkeypatch, tmp_path):
    """Of data that are made here; measured ones stay as they are, whether or not their rows state a digest."""
    parts = [part_of(name) for name in ("traced-csi-flat", "flat-ble")]
    rows = [Row(part, method, 1.0, 0) for part in parts for method in ("wrf-gs", "wrf-gs+", "kriging")]
    monkeypatch.setattr(table_pages, "plan", lambda quick=False: rows)
    run_facts = [{"date": "2026-01-02", "data": "new"}, {"date": "2026-01-01", "data": "old"}, {"date": "2026-01-01"}]
    stored = {row.name: made_row(row, 5.0, **facts) for row, facts in zip(rows, run_facts * 2, strict=True)}
    remade, measured = (table_pages.part_table(part, table_pages.grouped(part, stored), PUBLISHED) for part in parts)
    labels = [line.split("|")[2].strip() for line in remade.splitlines()[2:5]]
    assert labels == ["WRF-GS", "WRF-GS+ †", "kriging, from positions †"]
    assert "†" not in measured
    assert table_pages.overview("uplink", stored, PUBLISHED).count("†") == 2
    assert "†" not in table_pages.overview("rssi", stored, PUBLISHED)


@pytest.mark.parametrize("name", table_pages.IN_RESULTS)
def test_results_page_shows_the_stored_overviews(name):
    place = CHECKOUT / "benchmarks" / "table"
    overview = table_pages.overview(name, read_entries(place), table_pages.published(place))
    assert marked("docs/results.md", name).strip() == overview


def test_a_corrected_scene_is_made_once_and_its_time_counts(flat_folder, monkeypatch, tmp_path):
    monkeypatch.setattr(tables, "data_folder", lambda name: flat_folder)
    monkeypatch.setattr(tables, "_data_digest", lambda name: "digest")
    calls = []

    def run_command(words, folder, resumes=True):
        calls.append(words)
        folder.mkdir(parents=True)
        (folder / CORRECTION).write_text(json.dumps({"seconds": 40.0}))
        return 50.0

    monkeypatch.setattr(tables, "run_command", run_command)
    stub_results(monkeypatch)
    part = part_of("flat-ble")
    row = Row(part, "ray-tracing-corrected", 1.0, 0)
    assert "--scene {flat, corrected}" in row.command
    for _ in range(2):
        assert tables.measure(tmp_path, row).train_seconds == 43
    assert [words[0] for words in calls] == ["correct", "train", "train"]  # the run is not finished: no metrics
    scene = tables.scene_of(part, tmp_path / "scenes")
    assert calls[0] == ["correct", "flat-ble", "--scene", str(scene), "--split", "official", "--seed", "0"]
    assert Path(calls[1][calls[1].index("--scene") + 1]).name.startswith("corrected-flat-ble-")


RFID = next(part for part in PARTS if part.dataset == "rfid-lab" and part.split == "official")
POINTS: Points = {
    "slow": {"score": 0.99, "ms_per_sample": 10, "train_seconds": 0},
    "fast": {"score": 0.70, "ms_per_sample": 1, "train_seconds": 9},
    "middle": {"score": 0.90, "ms_per_sample": 3, "train_seconds": 5},
    "beaten": {"score": 0.80, "ms_per_sample": 5, "train_seconds": 7},
}


def test_front_holds_the_pareto_optimal_methods_from_cheap_to_costly():
    assert front(POINTS, "ms_per_sample", True) == ["fast", "middle", "slow"]
    assert front(POINTS, "train_seconds", True) == ["slow"]
    assert front(POINTS, "ms_per_sample", False) == ["fast"]
    # As good in one and better in the other is better.
    even = {name: {"score": score, "ms": ms} for name, score, ms in (("a", 0.2, 1), ("b", 0.1, 1), ("c", 0.1, 2))}
    assert front(even, "ms", False) == ["b"]


def test_points_are_means_of_medians_over_seeds_of_all_training_rows():
    rows = [Row(RFID, "vae", 1.0, 0), Row(RFID, "vae", 1.0, 1), Row(RFID, "vae", 1.0, 2), Row(RFID, "kriging", 0.1, 0)]
    stored = {
        row.name: made_row(row, 0.1 * k, ms_per_sample=10.0**k, train_seconds=2.0 * k) for k, row in enumerate(rows)
    }
    assert points_of(RFID, stored) == {
        "vae": {"score": pytest.approx(0.1), "ms_per_sample": 10.0, "train_seconds": 2.0}
    }


def test_text_and_picture_show_both_fronts():
    rows = fronts({RFID: POINTS})
    assert [row["what"] for row in rows] == ["rfid-lab, SSIM, prediction of a sample", "rfid-lab, SSIM, training"]
    assert rows[0]["value"] == "fast 0.700 (1 ms), middle 0.900 (3 ms), slow 0.990 (10 ms)"
    assert rows[1]["value"] == "slow 0.990 (0 s)"
    assert front_table(rows).splitlines()[2:] == [f"| rfid-lab, SSIM | {rows[0]['value']} |"]
    figure = pareto_figure({RFID: POINTS, PARTS[1]: POINTS})
    assert len(figure.axes) == 4
    assert {axes.get_xscale() for axes in figure.axes} == {"log"}
    assert [text.get_text() for text in figure.legends[0].texts] == list(POINTS)
    (step,) = figure.axes[0].lines
    assert np.asarray(step.get_data())[:, -1].tolist() == [10, 0.99]
    # A method without training lies at the left end.
    assert np.asarray(figure.axes[1].lines[0].get_xdata())[0] == LEAST


def test_missing_rows_are_reported(tmp_path):
    with pytest.raises(InputError, match="no entries; call it in a checkout that has them, or run wrf-mi bench"):
        read_points(tmp_path)
