"""Runs of version 0.1."""

from pathlib import Path

import pytest

import wrf_mi
from wrf_mi.core import InputError
from wrf_mi.runs.api import evaluate_run
from wrf_mi.runs.scene_view import scene_view

OLD = {
    "field": "dataset: here\nsplit: official\nn_train: null\nseed: 0\nversions: {}\nsettings: {model: wrf-gs+}\n",
    "hybrid": "model: hybrid\ndataset: here\nsplit: official\nseed: 0\nsettings: []\n",
    "baseline": "model: idw\ndataset: here\nsplit: official\nseed: 0\nsettings: {neighbours: 4}\n",
    "traced": "model: ray-tracing\ndataset: here\nscene: room\noptions: {max_depth: 3}\n",
}


@pytest.mark.parametrize("kind", OLD)
def test_runs_of_version_0_1_are_refused_by_every_command(kind: str, tmp_path: Path, command) -> None:
    run, out, positions = tmp_path / "old", tmp_path / "out", tmp_path / "tx.csv"
    run.mkdir()
    (run / "config.yaml").write_text(OLD[kind])
    (run / "metrics.json").write_text('{"task": "rssi"}')
    positions.write_text("x,y,z\n1,2,1\n")
    message = f"^wrf-mi: {run}/config.yaml: format not stated, .*; train it anew, or use the version that wrote it$"
    for arguments in (
        ["train", "--resume", run],
        ["evaluate", run],
        ["evaluate", run, "--split", "random"],
        ["predict", run, "--tx", positions, "--out", out],
        ["compare", run, "--out", out],
    ):
        command.refused(arguments, message)
    for use in (wrf_mi.open_run, wrf_mi.resume, evaluate_run, lambda path: scene_view(path, 0)):
        with pytest.raises(InputError, match="format not stated"):
            use(run)
    assert not out.exists()
