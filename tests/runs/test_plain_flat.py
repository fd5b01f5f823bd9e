"""Signal strengths without headings, at heights that differ, of anchors with names: every step from file to picture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from calling import call, refused, stored
from made_flat import NAMED_ANCHORS_M

from wrf_mi.core import Record
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.datasets.folder_files import read_csv
from wrf_mi.models import Inputs
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.prediction_file import read_inputs, write_prediction_file

NAMES = list(NAMED_ANCHORS_M)
MODELS = {"kriging": (), "trees": ("--set", "trees=20"), "mri": ()}


@pytest.fixture(scope="module")
def runs(plain_flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    from wrf_mi.cli.main import main

    folder = tmp_path_factory.mktemp("runs")
    for model, more in MODELS.items():
        given = ["train", str(plain_flat_folder), "--model", model, "--out", str(folder / model), *more]
        assert main(given) == 0
    return {model: folder / model for model in MODELS}


@pytest.mark.parametrize("model", MODELS)
def test_models_work_without_headings(
    model: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert list(json.loads((runs[model] / "metrics.json").read_text())["receivers"]) == NAMES
    before = stored(runs[model])
    assert call(["evaluate", runs[model]], capsys)[0] == 0
    np.testing.assert_array_equal(stored(runs[model])["prediction"], before["prediction"])
    (tmp_path / "tx.csv").write_text("\n".join(["x,y,z", *(",".join(map(str, row)) for row in before["tx_pos"])]))
    assert call(["predict", runs[model], "--tx", tmp_path / "tx.csv", "--out", tmp_path / "out.npz"], capsys)[0] == 0
    with np.load(tmp_path / "out.npz") as found:
        assert found["receiver_name"].tolist() == NAMES
        np.testing.assert_allclose(found["prediction"], before["prediction"], atol=1e-4)


@pytest.mark.parametrize("model", ["kriging", "trees"])
def test_models_use_the_height(
    model: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tx.csv").write_text("x,y,z\n0.6,0.6,0.3\n0.6,0.6,1.9\n")
    assert call(["predict", runs[model], "--tx", tmp_path / "tx.csv", "--out", tmp_path / "out.npz"], capsys)[0] == 0
    with np.load(tmp_path / "out.npz") as found:
        assert (np.abs(np.diff(found["prediction"], axis=1)) > 1e-3).any()


@pytest.mark.parametrize("model", ["mri", "kriging"])
def test_csv_predictions_equal_npz_predictions(
    model: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = model != "kriging"  # Strengths were kriged without headings, so they are refused.
    columns = ["x", "y", "z", "heading_rad"] if turned else ["x", "y", "z"]
    rows = [["0.1", "2", "0.5", "0.3"], ["3", "1", "1.75", "-1"]]
    text = "\n".join(",".join(row[: len(columns)]) for row in [columns, *rows]) + "\n"
    (tmp_path / "tx.csv").write_text(text)
    for name in ("out.npz", "out.CSV"):
        given = ["predict", runs[model], "--tx", tmp_path / "tx.csv", "--out", tmp_path / name, "--json"]
        status, printed, err = call(given, capsys)
        assert (status, err) == (0, "")
    assert json.loads(printed)["arrays"]["prediction"] == [2, 2]
    table = read_csv(tmp_path / "out.CSV")
    with np.load(tmp_path / "out.npz") as found:
        arrays = dict(found)
    assert ("std" in arrays) == (model == "kriging")
    values = {"prediction": "dbm"} | ({"std": "std_db"} if "std" in arrays else {})
    names = [f"{name}_{unit}" for unit in values.values() for name in NAMES]
    assert table.header == [*columns, *names]
    for key, unit in values.items():
        for r, name in enumerate(NAMES):
            np.testing.assert_array_equal(table.numbers(f"{name}_{unit}").astype(arrays[key].dtype), arrays[key][r])
    # The table begins with the columns that `predict --tx` reads.
    asked = read_inputs(tmp_path / "out.CSV", None)
    np.testing.assert_array_equal(asked.tx_pos_m, [[0.1, 2, 0.5], [3, 1, 1.75]])
    if turned:
        np.testing.assert_array_equal(asked.tx_heading_rad, [0.3, -1])


def test_table_of_one_receiver_has_empty_fields_where_nothing_is_received(tmp_path: Path) -> None:
    """And names that CSV quotes."""
    inputs = Inputs(np.arange(6.0).reshape(2, 3))
    observations = {"prediction": np.array([[-50.25, np.nan]], np.float32)}
    written = write_prediction_file(tmp_path / "out.csv", inputs, ['hall, "upper"'], observations)
    assert written["prediction"].shape == (2,)
    table = read_csv(tmp_path / "out.csv")
    np.testing.assert_array_equal(table.numbers('hall, "upper"_dbm', may_be_empty=True), [-50.25, np.nan])
    assert (tmp_path / "out.csv").read_text().splitlines()[2] == "3.0,4.0,5.0,"


@pytest.mark.parametrize("name", ["out", "out.txt", "out.csv.gz", "out.npy"])
def test_files_of_other_forms_are_refused(
    name: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tx.csv").write_text("x,y,z\n0.1,2,0.5\n")
    given = ["predict", runs["mri"], "--tx", tmp_path / "tx.csv", "--out", tmp_path / "new" / name]
    refused(given, f"{name}: predictions are written as .npz, or signal strengths as .csv; give such a name", capsys)
    assert not (tmp_path / "new").exists()


def test_table_of_spectra_is_refused(one_gateway: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_spectrum_folder(tmp_path / "data", one_gateway)
    run = train(data, tmp_path / "run", "idw").folder
    (tmp_path / "tx.csv").write_text("x,y,z\n0.1,2,0.5\n")
    given = ["predict", run, "--tx", tmp_path / "tx.csv", "--out", tmp_path / "out.csv"]
    refused(given, r"out\.csv: \.csv holds signal strengths \(rssi\), .* predicts spectrum; give out\.npz", capsys)
    assert not (tmp_path / "out.csv").exists()
    (run / "metrics.json").unlink()
    refused(given, "no metrics.json, so no finished run", capsys)


def test_comparison_shows_names_without_formulas(runs: dict[str, Path], tmp_path: Path) -> None:
    """Also those in which Matplotlib would see a formula, and a wrong one."""
    compare(list(runs.values()), tmp_path / "out")
    assert (tmp_path / "out" / "plain-samples.png").exists()


def test_length_over_headings_is_refused(
    plain_flat_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert load(plain_flat_folder).tx_heading_rad is None
    given = ["train", plain_flat_folder, "--model", "kriging", "--out", tmp_path / "run", "--set", "heading_length=1"]
    refused(given, "plain: has no headings for kriging's heading_length; omit the setting", capsys)
    assert not (tmp_path / "run").exists()
