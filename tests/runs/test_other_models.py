"""Predictions of other programs: scored and compared like runs of this package, and refused in one line."""

import shlex
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import rows_of

from wrf_mi import InputError, Record, compare, load, make_splits, open_run, score_predictions, train
from wrf_mi.apps.commands.main import main
from wrf_mi.apps.commands.output import show_metrics
from wrf_mi.core.files import write_csv
from wrf_mi.runs.compare_tables import OTHER_ROWS, TIE, differences
from wrf_mi.runs.results import read_runs

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def flat(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Path]:
    """Signal strengths, and a run on them."""
    run = train(flat_folder, "kriging", out=tmp_path_factory.mktemp("runs") / "kriging")
    return load(flat_folder), run.folder


def predicted(run: Path) -> dict[str, Any]:
    with np.load(run / "predictions.npz") as arrays:
        return dict(arrays)


def test_predictions_of_a_run_have_its_scores_under_another_name(flat: tuple[Record, Path], tmp_path: Path) -> None:
    record, run = flat
    metrics = open_run(run).metrics
    copied = score_predictions(record.source, run / "predictions.npz", tmp_path / "copied", "my NeRF")
    for key in ("abs_error_db", "reference", "constant", "inside_90", "crps", "receivers", "n_train", "n_test"):
        assert copied.metrics[key] == metrics[key], key
    assert np.isnan(copied.metrics["train_seconds"])
    page = compare([run, copied.folder], tmp_path / "compare")
    text = unescape(page.read_text())
    assert "my NeRF" in text
    assert "training rows as stated by their author" in text
    command = next(line for line in text.splitlines() if line.startswith("wrf-mi evaluate"))
    again = shlex.split(command.replace("<pre>", ""))[1:-1]
    assert main([*again, str(tmp_path / "again")]) == 0
    assert read_config_text(tmp_path / "again") == read_config_text(copied.folder)
    table = {row["run"]: row for row in rows_of(tmp_path / "compare" / "compare.csv")}
    constant = table["median of each receiver's training rows, official"]
    assert float(constant["median"]) == metrics["constant"]["median"]
    between = [each for each in differences(read_runs([run, copied.folder])) if each.against == "kriging"]
    assert {(each.difference, each.verdict) for each in between} == {(0.0, TIE)}


def read_config_text(folder: Path) -> str:
    return (folder / "config.yaml").read_text()


def test_other_numbers_of_training_rows_are_not_compared(flat: tuple[Record, Path], tmp_path: Path) -> None:
    record, run = flat
    file = run / "predictions.npz"
    fewer = score_predictions(record.source, file, tmp_path / "fewer", "fewer", n_train=0.5, seed=3)
    page = compare([run, fewer.folder], tmp_path / "compare").read_text()
    assert OTHER_ROWS in page
    assert "--n-train 0.5 --seed 3" in page
    gains = {(gain.run, gain.against): gain for gain in differences(read_runs([run, fewer.folder]))}
    assert {gain.verdict for names, gain in gains.items() if set(names) == {"kriging", "fewer"}} == {OTHER_ROWS}


@pytest.mark.parametrize("by", ["rows", "positions", "csv"])
def test_rows_are_found_by_number_or_position_in_any_order(by: str, flat: tuple[Record, Path], tmp_path: Path) -> None:
    record, run = flat
    stored, file = predicted(run), tmp_path / f"other.{'csv' if by == 'csv' else 'npz'}"
    order = np.random.default_rng(0).permutation(len(stored["row"]))
    values, names = stored["prediction"][:, order], [receiver.name for receiver in record.receivers]
    if by == "csv":
        columns = [f"{name}_dbm" for name in names]
        write_csv(file, ["x", "y", "z", *columns], np.concatenate([stored["tx_pos"][order], values.T], axis=1))
    else:
        where = {"row": stored["row"][order]} if by == "rows" else {"tx_pos": stored["tx_pos"][order]}
        np.savez(file, prediction=values[::-1], receiver_name=names[::-1], train_seconds=7.0, **where)
    other = score_predictions(record.source, file, tmp_path / "other", "mine").metrics
    assert other["abs_error_db"] == pytest.approx(open_run(run).metrics["abs_error_db"], abs=1e-4)
    assert np.isnan(other["train_seconds"]) if by == "csv" else other["train_seconds"] == 7


def test_folds_are_pooled(flat: tuple[Record, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record, _ = flat
    file = tmp_path / "all.npz"
    np.savez(file, prediction=record.observation + 1, row=np.arange(len(record)))
    run = score_predictions(record.source, file, tmp_path / "run", "one off", split="blocked")
    metrics, splits = run.metrics, make_splits(record, "blocked")
    counts = [len(split.all_train) for split in splits]
    assert metrics["n_train_of_folds"] == counts
    in_words = f"{len(counts)} folds of {min(counts)} to {max(counts)} training rows"
    assert in_words in compare([run.folder], tmp_path / "compare").read_text()
    show_metrics(metrics, run.folder, as_json=False)
    assert f"split blocked, {in_words}" in capsys.readouterr().out
    assert metrics["abs_error_db"]["median"] == pytest.approx(1, abs=1e-5)
    assert metrics["n_test"] == sum(len(split.test) for split in splits)


def damaged(**changes: Any) -> Any:
    return lambda arrays: {key: value for key, value in (arrays | changes).items() if value is not None}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (damaged(prediction=None), "no array prediction"),
        (lambda a: a | {"prediction": a["prediction"][:1]}, r"prediction has shape \[1, "),
        (lambda a: a | {"prediction": a["prediction"] + 1j}, "prediction is complex"),
        (lambda a: a | {"row": a["row"] + 0.5}, r"row .* is none of"),
        (lambda a: a | {"row": a["row"][1:]}, "rows and"),
        (lambda a: {key: a[key][..., 1:] for key in ("row", "prediction")}, "1 of the .* test rows have no prediction"),
        (lambda a: a | {"prediction": np.where(a["row"] == a["row"][2], np.nan, a["prediction"])}, "is not finite"),
        (damaged(row=None, tx_pos=None), "neither row"),
        (lambda a: {"prediction": a["prediction"], "tx_pos": a["tx_pos"] + 0.1}, "no prediction at the position of"),
        (lambda a: a | {"receiver_name": np.array(["a", "b"])}, "receivers a, b"),
    ],
)
def test_unusable_predictions_are_refused_in_one_line(change, message, flat, tmp_path):
    record, run = flat
    np.savez(tmp_path / "bad.npz", **change(predicted(run)))
    with pytest.raises(InputError, match=message) as refused:
        score_predictions(record.source, tmp_path / "bad.npz", tmp_path / "run", "mine")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "run").exists()


def test_command_scores_and_refuses(flat, tmp_path, capsys):
    record, run = flat
    call = ["evaluate", "--predictions", str(run / "predictions.npz"), "--dataset", str(record.source)]
    assert main([*call, "--name", "mine", "--out", str(tmp_path / "run")]) == 0
    shown = capsys.readouterr().out
    assert "mine" in shown
    assert "nan" not in shown
    refusals = {
        "a model of wrf_mi": [*call, "--name", "kriging", "--out", str(tmp_path / "other")],
        "--predictions needs --name": [*call, "--out", str(tmp_path / "other")],
        "omit RUN": [*call, str(run), "--name", "mine", "--out", str(tmp_path / "other")],
        "--dataset belongs to --predictions": ["evaluate", str(run), "--dataset", "rfid-lab"],
        "nothing to score": ["evaluate"],
    }
    for message, arguments in refusals.items():
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
