"""``--replace`` of commands that make a run folder."""

import json
from pathlib import Path
from typing import Any

import pytest

from wrf_mi.core import InputError
from wrf_mi.runs.api import train
from wrf_mi.runs.folder import new_run_folder
from wrf_mi.runs.other_models import score_predictions


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all files below a folder, by their names in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fit(folder: Path, out: Path, *more: str) -> list[Any]:
    return ["train", folder, "--model", "kriging", "--out", out, *more]


@pytest.fixture
def run(flat_folder: Path, tmp_path: Path) -> Path:
    """A run of IDW with a file of an earlier version."""
    folder = train(flat_folder, "idw", out=tmp_path / "run").folder
    (folder / "paths.npz").write_text("of before")
    return folder


def test_run_is_replaced_only_when_asked(flat_folder: Path, run: Path, command: Any) -> None:
    command.refused(fit(flat_folder, run), "exists and is not empty; choose another --out, give --replace")
    command.done(fit(flat_folder, run, "--replace"))
    assert json.loads((run / "metrics.json").read_text())["model"] == "kriging"
    assert not (run / "paths.npz").exists()
    assert [path.name for path in run.parent.iterdir()] == ["run"]


def test_traced_run_replaces_a_run(flat_folder: Path, room: Path, run: Path, command: Any) -> None:
    words = ["trace", flat_folder, "--scene", room, "--depth", "1", "--rays", "1024", "--out", run]
    command.refused(words, "give --replace")
    command.done([*words, "--replace"])
    assert json.loads((run / "metrics.json").read_text())["model"] == "ray-tracing"


def test_scored_predictions_replace_a_run(flat_folder: Path, run: Path, command: Any) -> None:
    predictions = ["--predictions", run / "predictions.npz", "--dataset", flat_folder, "--name", "theirs"]
    command.refused(["evaluate", *predictions, "--out", run], "give --replace")
    command.refused(["evaluate", run, "--replace"], "--replace belongs to --predictions")
    command.done(["evaluate", *predictions, "--out", run, "--replace"])
    assert json.loads((run / "metrics.json").read_text())["model"] == "theirs"


def test_folder_of_other_files_is_not_replaced(flat_folder: Path, tmp_path: Path, command: Any) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "config.yaml").write_text("model: mine\n")
    command.refused(fit(flat_folder, mine, "--replace"), "exists and is no run, which --replace would replace")
    with pytest.raises(InputError, match="is no run"):
        score_predictions(flat_folder, mine / "p.npz", mine, "theirs", overwrite=True)
    assert contents(mine) == {"config.yaml": b"model: mine\n"}


@pytest.mark.parametrize("words", [["--set", "no_such=1"], ["--split", "nowhere"]])
def test_invalid_request_leaves_the_run(flat_folder: Path, run: Path, command: Any, words: list[str]) -> None:
    before = contents(run)
    command.refused(fit(flat_folder, run, "--replace", *words), words[1].partition("=")[0])
    assert contents(run) == before


def test_run_comes_back_where_nothing_new_was_fitted(run: Path) -> None:
    def fail() -> None:
        with new_run_folder(run, replace=True):
            (run / "config.yaml").write_text("half")
            raise InputError("fit failed")

    before = contents(run)
    with pytest.raises(InputError, match="fit failed"):
        fail()
    assert contents(run) == before
    assert [path.name for path in run.parent.iterdir()] == ["run"]
