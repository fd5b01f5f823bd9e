"""Signal strengths without headings, at heights that differ, of anchors with names: every step from file to picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calling import stored
from commands import Command, positions_file
from made_flat import NAMED_ANCHORS_M

from wrf_mi.datasets import load
from wrf_mi.datasets.folder_files import read_csv
from wrf_mi.models import Inputs
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.prediction_file import read_inputs, write_prediction_file

NAMES = list(NAMED_ANCHORS_M)
MODELS = ["kriging", "trees", "mri"]


@pytest.fixture(scope="module")
def runs(plain_flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, few = tmp_path_factory.mktemp("runs"), {"trees": ("trees=20",)}
    return {
        model: train(plain_flat_folder, model, out=folder / model, settings=few.get(model, ())).folder
        for model in MODELS
    }


@pytest.mark.parametrize("model", MODELS)
def test_models_work_without_headings(model: str, runs: dict[str, Path], tmp_path: Path, command: Command) -> None:
    run, before = runs[model], stored(runs[model])
    assert list(json.loads((run / "metrics.json").read_text())["receivers"]) == NAMES
    command.done(["evaluate", run])
    np.testing.assert_array_equal(stored(run)["prediction"], before["prediction"])
    found = command.predicted(run, positions_file(tmp_path / "tx.csv", before["tx_pos"]))
    assert found["receiver_name"].tolist() == NAMES
    np.testing.assert_allclose(found["prediction"], before["prediction"], atol=1e-4)
    if model != "mri":  # the others use the height
        found = command.predicted(run, positions_file(tmp_path / "tx.csv", [[0.6, 0.6, 0.3], [0.6, 0.6, 1.9]]))
        assert (np.abs(np.diff(found["prediction"], axis=1)) > 1e-3).any()


@pytest.mark.parametrize("model", ["mri", "kriging"])
def test_csv_predictions_equal_npz_predictions(
    model: str, runs: dict[str, Path], tmp_path: Path, command: Command
) -> None:
    tx_pos_m = [[0.1, 2, 0.5], [3, 1, 1.75]]
    heading = np.array([0.3, -1]) if model == "mri" else None  # strengths were kriged without headings
    positions = positions_file(tmp_path / "tx.csv", tx_pos_m, heading)
    arrays, out = command.predicted(runs[model], positions), tmp_path / "out.CSV"
    printed = command.json(["predict", runs[model], "--tx", positions, "--out", out])
    assert printed["arrays"]["prediction"] == [2, 2]
    assert ("std" in arrays) == (model == "kriging")
    units = {"prediction": "dbm"} | ({"std": "std_db", "std_mean": "std_mean_db"} if model == "kriging" else {})
    table = read_csv(out)
    given = positions.read_text().splitlines()[0].split(",")
    assert table.header == [*given, *(f"{name}_{unit}" for unit in units.values() for name in NAMES)]
    for key, unit in units.items():
        for r, name in enumerate(NAMES):
            np.testing.assert_array_equal(table.numbers(f"{name}_{unit}").astype(arrays[key].dtype), arrays[key][r])
    # The table begins with the columns that `predict --tx` reads.
    asked = read_inputs(out, None)
    np.testing.assert_array_equal(asked.tx_pos_m, tx_pos_m)
    if heading is not None:
        np.testing.assert_array_equal(asked.tx_heading_rad, heading)


def test_table_of_one_receiver_has_empty_fields_where_nothing_is_received(tmp_path: Path) -> None:
    """And names that CSV quotes."""
    inputs = Inputs(np.arange(6.0).reshape(2, 3))
    observations = {"prediction": np.array([[-50.25, np.nan]], np.float32)}
    written = write_prediction_file(tmp_path / "out.csv", inputs, ['hall, "upper"'], observations)
    assert written["prediction"].shape == (2,)
    table = read_csv(tmp_path / "out.csv")
    np.testing.assert_array_equal(table.numbers('hall, "upper"_dbm', may_be_empty=True), [-50.25, np.nan])
    assert (tmp_path / "out.csv").read_text().splitlines()[2] == "3.0,4.0,5.0,"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return positions_file(tmp_path / "tx.csv", [[0.1, 2, 0.5]])


@pytest.mark.parametrize("name", ["out", "out.txt", "out.csv.gz", "out.npy"])
def test_files_of_other_forms_are_refused(
    name: str, runs: dict[str, Path], place: Path, tmp_path: Path, command: Command
) -> None:
    words = ["predict", runs["mri"], "--tx", place, "--out", tmp_path / "new" / name]
    command.refused(words, f"{name}: predictions are written as .npz, or signal strengths as .csv; give such a name")
    assert not (tmp_path / "new").exists()


def test_table_of_spectra_is_refused(folder: Path, place: Path, tmp_path: Path, command: Command) -> None:
    run = train(folder, "idw", out=tmp_path / "run").folder
    words = ["predict", run, "--tx", place, "--out", tmp_path / "out.csv"]
    command.refused(words, r"out\.csv: \.csv holds signal strengths \(rssi\), .* predicts spectrum; give out\.npz")
    assert not (tmp_path / "out.csv").exists()
    (run / "metrics.json").unlink()
    command.refused(words, "no metrics.json, so no finished run")


def test_comparison_shows_names_without_formulas(runs: dict[str, Path], tmp_path: Path) -> None:
    """Also those in which Matplotlib would see a formula, and a wrong one."""
    compare(list(runs.values()), tmp_path / "out")
    assert (tmp_path / "out" / "plain-samples.png").exists()


def test_length_over_headings_is_refused(plain_flat_folder: Path, tmp_path: Path, command: Command) -> None:
    assert load(plain_flat_folder).tx_heading_rad is None
    given = ["train", plain_flat_folder, "--model", "kriging", "--out", tmp_path / "run", "--set", "heading_length=1"]
    command.refused(given, "setting heading_length=1.0: no effect on kriging of .*: the data have no headings; omit it")
    assert not (tmp_path / "run").exists()
