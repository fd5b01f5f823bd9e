"""Runs of kriging, on spectra, and on strengths without headings of anchors with names: folders, commands, tables."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from calling import contents, scored_again_as_before, stored
from commands import Command, positions_file, rows_of
from made_flat import NAMED_ANCHORS_M
from made_waves import SIZE, wave_record

from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.datasets.folder_files import read_csv
from wrf_mi.models import Inputs
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.folder import FORMAT
from wrf_mi.runs.prediction_file import read_inputs, write_prediction_file
from wrf_mi.tasks.scores import inside_interval, ssim

QUICK = ("directions=20", "lengths=2")
"""Of spectra: a fit of a second."""
FILES = {"config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"}
ROUNDING = 1e-5
"""Predictions are float32."""


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spectra at two receivers, 36 rows in two folds."""
    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "waves", wave_record(36, 10))


@pytest.fixture(scope="module")
def run(waves: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(waves, "kriging", out=tmp_path_factory.mktemp("runs") / "run", settings=QUICK).folder


def test_run_folder_holds_model_and_standard_deviation(waves: Path, run: Path) -> None:
    assert contents(run) == FILES
    config = yaml.safe_load((run / "config.yaml").read_text())
    expected = {
        "model": "kriging",
        "dataset": str(waves),
        "scene": None,
        "split": "official",
        "n_train": None,
        "seed": 0,
    }
    expected |= {"format": FORMAT, "task": "spectrum", "material": None, "deterministic": False}
    assert expected.items() <= config.items()
    assert (config["settings"]["directions"], config["settings"]["lengths"]) == (20, 2)
    record, arrays = load(waves), stored(run)
    assert record.official is not None
    np.testing.assert_array_equal(arrays["row"], record.official[1])
    assert arrays["std"].shape == arrays["prediction"].shape == (2, 10, *SIZE)
    assert arrays["std"].dtype == np.float32
    assert arrays["std"].min() > 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["model"], metrics["task"], metrics["n_train"], metrics["n_test"]) == ("kriging", "spectrum", 26, 10)
    assert metrics["ssim"]["median"] == pytest.approx(np.median(ssim(arrays["prediction"], arrays["truth"])))
    assert metrics["ssim"]["median"] > metrics["reference"]["idw"]["median"]
    inside = inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])
    assert metrics["inside_90"] == pytest.approx(inside)
    assert 0.5 < inside < 1
    assert set(metrics["receivers"]) == {"one", "two"}
    assert [fitted["parts"] for fitted in metrics["fitted"]] == ["signals, nearby"] * 2
    assert metrics["train_seconds"] > 0
    assert metrics["peak_memory_mb"] > 10


def test_evaluation_reproduces_and_prints_the_scores(run, capsys, command):
    scored_again_as_before(run, capsys)
    lines = command.done(["evaluate", run]).splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["SSIM", "kriging", "IDW"]
    assert "of the test values lie inside the predicted 90 % intervals, continuous ranked" in lines[3]


def test_predictions_at_new_positions_have_standard_deviations(run: Path, tmp_path: Path, command: Command) -> None:
    held_out = stored(run)
    arrays = command.predicted(run, positions_file(tmp_path / "tx.csv", held_out["tx_pos"]))
    assert arrays["std"].shape == (2, 10, *SIZE)
    for name in ("prediction", "std"):
        np.testing.assert_allclose(arrays[name], held_out[name], atol=ROUNDING)
    assert arrays["receiver_name"].tolist() == ["one", "two"]
    # How the transmitter is turned changes no spectrum: a model that cannot use it says so.
    out = ["--out", tmp_path / "out.npz"]
    for option, name, content, message in (
        ("--tx", "turned.csv", "x,y,z,heading_rad\n0,0,0,0.5\n", "does not know how the transmitter is turned"),
        ("--tx", "nan.csv", "x,y,z,heading_rad\n0,0,0,nan\n", "row 1: heading_rad is 'nan'; give a finite number"),
        ("--tx", "short.csv", "x,y,z,heading_rad\n0,0,0\n", "row 1: 3 fields, but the header has 4"),
        ("--input", "turned.npz", None, "omit heading_rad"),
    ):
        if content is None:
            positions_file(tmp_path / name, np.zeros((3, 3)), np.zeros(3))
        else:
            (tmp_path / name).write_text(content)
        command.refused(["predict", run, option, tmp_path / name, *out], message)
    assert not (tmp_path / "out.npz").exists()


def test_standard_deviations_of_folds_are_pooled(plain_flat_folder: Path, tmp_path: Path) -> None:
    run = train(plain_flat_folder, "kriging", out=tmp_path / "run", split="blocked")
    arrays = stored(run.folder)
    assert run.metrics["inside_90"] == inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])


def test_comparison_shows_kriging_and_reference(run: Path, tmp_path: Path) -> None:
    assert "inside 90 %" in compare([run], tmp_path / "page").read_text()
    rows = rows_of(tmp_path / "page" / "compare.csv")
    assert [row["model"] for row in rows] == ["kriging", "idw", "constant"]
    assert float(rows[0]["inside_90"]) == json.loads((run / "metrics.json").read_text())["inside_90"]
    assert rows[1]["inside_90"] == ""
    assert (tmp_path / "page" / "waves-samples.png").is_file()


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
    outputs = command.predicted(run, positions_file(tmp_path / "tx.csv", before["tx_pos"]))
    assert outputs["receiver_name"].tolist() == NAMES
    np.testing.assert_allclose(outputs["prediction"], before["prediction"], atol=1e-4)
    if model != "mri":  # the others use the height
        outputs = command.predicted(run, positions_file(tmp_path / "tx.csv", [[0.6, 0.6, 0.3], [0.6, 0.6, 1.9]]))
        assert (np.abs(np.diff(outputs["prediction"], axis=1)) > 1e-3).any()


@pytest.mark.parametrize("model", ["mri", "kriging"])
def test_csv_predictions_equal_npz_predictions(model, runs, tmp_path, command):
    tx_pos_m = [[0.1, 2, 0.5], [3, 1, 1.75]]
    heading = np.array([0.3, -1]) if model == "mri" else None  # strengths were kriged without headings
    positions = positions_file(tmp_path / "tx.csv", tx_pos_m, heading)
    arrays, out = command.predicted(runs[model], positions), tmp_path / "out.CSV"
    printed = command.json(["predict", runs[model], "--tx", positions, "--out", out])
    assert printed["arrays"]["prediction"] == [2, 2]
    assert ("std" in arrays) == (model == "kriging")
    units = {"prediction": "dbm"} | ({"std": "std_db", "std_mean": "std_mean_db"} if model == "kriging" else {})
    table = read_csv(out)
    columns = positions.read_text().splitlines()[0].split(",")
    assert table.header == [*columns, *(f"{name}_{unit}" for unit in units.values() for name in NAMES)]
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
def test_files_of_other_forms_are_refused(name, runs, place, tmp_path, command):
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
    compare([runs["mri"]], tmp_path / "out")
    assert (tmp_path / "out" / "plain-samples.png").exists()


def test_length_over_headings_is_refused(plain_flat_folder: Path, tmp_path: Path, command: Command) -> None:
    assert load(plain_flat_folder).tx_heading_rad is None
    words = ["train", plain_flat_folder, "--model", "kriging", "--out", tmp_path / "run", "--set", "heading_length=1"]
    command.refused(words, "setting heading_length=1.0: no effect on kriging of .*: the data have no headings; omit it")
    assert not (tmp_path / "run").exists()
