"""Registry of models: a model from outside the package, by registration and by an installed entry point."""

from __future__ import annotations

import csv
import json
import os
import sys
import types
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from calling import call, in_subprocess, refused

import wrf_mi
from wrf_mi import models
from wrf_mi.core import InputError
from wrf_mi.core.registry import Registry
from wrf_mi.datasets import load
from wrf_mi.runs.api import evaluate_run, open_run, resume, train
from wrf_mi.runs.compare import compare
from wrf_mi.training.session import Interrupted

PACKAGE = '''
"""A package with a model: the mean of the nearest training rows."""

from dataclasses import dataclass

import numpy as np

from wrf_mi.core import Prediction
from wrf_mi.models import Fitted, Model


@dataclass(frozen=True)
class NearestSettings:
    neighbours: int = 3


class Nearest(Fitted):
    def __init__(self, arrays, settings):
        self.kept, self.settings = arrays, settings

    def predict(self, inputs, receiver):
        apart = np.linalg.norm(inputs.tx_pos_m[:, None] - self.kept["tx_pos"], axis=2)
        seen = self.kept["observation"][receiver, np.argsort(apart, axis=1)[:, : self.settings.neighbours]]
        return Prediction(np.nanmean(seen, axis=1), np.nanstd(seen, axis=1) + 1)

    def arrays(self):
        return self.kept

    def facts(self):
        return {"rows": len(self.kept["tx_pos"])}


class NearestModel(Model):
    name, source, settings = "nearest", "this test", NearestSettings
    tasks = ("rssi",)

    def fit(self, problem, split, session):
        session.report("nearest rows", 0.0)
        record, rows = problem.record, problem.rows(split)
        kept = {"tx_pos": record.tx_pos_m[rows], "observation": record.observation[:, rows]}
        return Nearest(kept, problem.settings)

    def load(self, arrays, problem, folder):
        return Nearest(arrays, problem.settings)


MODEL = NearestModel()
'''


@pytest.fixture
def registered() -> Iterator[None]:
    module = types.ModuleType("nearest_of_others")
    sys.modules[module.__name__] = module  # where its dataclass looks for its types
    exec(PACKAGE, module.__dict__)
    models.register(module.MODEL)
    with pytest.raises(InputError, match="model 'nearest': there is one of that name; choose another"):
        models.register(module.MODEL)
    yield
    del models.MODELS._known["nearest"], sys.modules[module.__name__]


def test_registered_model_is_trained_resumed_evaluated_and_compared(registered, flat_folder, tmp_path, capsys) -> None:
    out = tmp_path / "run"
    with pytest.raises(Interrupted, match=rf"stopped in nearest rows; go on with: wrf-mi train --resume {out}"):
        train(flat_folder, out, "nearest", settings=("neighbours=2",), stop=lambda: True)
    refused(["evaluate", out], r"model\.npz: missing, the fit was stopped; finish it with train --resume", capsys)
    reported: list[tuple[str, float]] = []
    run = resume(out, on_progress=lambda stage, share, _: reported.append((stage, share)))
    assert reported == [("nearest rows", 0.0)]
    assert (run.metrics["model"], run.metrics["rows"]) == ("nearest", 24)
    assert 0 < run.metrics["inside_90"] <= 1
    assert evaluate_run(out)["abs_error_db"] == run.metrics["abs_error_db"]
    record = load(flat_folder)
    one = open_run(out).predict(record.tx_pos_m[:1], "anchor1")
    nearest = np.argsort(np.linalg.norm(record.tx_pos_m[:24] - record.tx_pos_m[0], axis=1))[:2]
    assert one.mean == pytest.approx([record.observation[0, nearest].mean()])
    with pytest.raises(InputError, match="does not know how the transmitter is turned; omit heading_rad"):
        run.predict(record.tx_pos_m[:1], 0, [0.5])
    other = train(flat_folder, tmp_path / "blocked", "nearest", split="blocked")
    compare([out, other.folder], tmp_path / "page")
    with (tmp_path / "page" / "compare.csv").open(newline="") as file:
        assert [row["model"] for row in csv.DictReader(file)][:2] == ["nearest", "nearest"]
    refused(["train", flat_folder, "--model", "nearest", "--scene", "x", "--out", "y"], "takes no scene", capsys)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a Python that has the package installed."""
    site = tmp_path_factory.mktemp("site")
    (site / "nearest_of_others.py").write_text(PACKAGE)
    info = site / "nearest_of_others-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: nearest-of-others\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[wrf_mi.models]\nnearest = nearest_of_others:MODEL\n")
    path = os.pathsep.join([str(site), *(part for part in sys.path if part)])
    return {**os.environ, "PYTHONPATH": path}


def test_commands_find_the_model_of_an_installed_package(installed, flat_folder, tmp_path) -> None:
    out = tmp_path / "run"
    settings = ("--set", "neighbours=1", "--out", out, "--json")
    (trained,) = in_subprocess(installed, ("train", flat_folder, "--model", "nearest", *settings))
    for name in ("model.npz", "metrics.json", "predictions.npz"):  # as a run that was stopped
        (out / name).unlink()
    (tmp_path / "tx.csv").write_text("x,y,z\n1,2,1\n3,1,2\n")
    resumed, scored, *_ = in_subprocess(
        installed,
        ("train", "--resume", out, "--json"),
        ("evaluate", out, "--json"),
        ("predict", out, "--tx", tmp_path / "tx.csv", "--out", tmp_path / "p.npz"),
        ("compare", out, "--out", tmp_path / "page"),
    )
    errors = [json.loads(text)["abs_error_db"] for text in (trained, resumed, scored)]
    assert errors[0] == errors[1] == errors[2]
    with np.load(tmp_path / "p.npz") as predicted:
        assert predicted["prediction"].shape == predicted["std"].shape == (2, 2)
    assert "nearest" in (tmp_path / "page" / "index.html").read_text()


OLD = {
    "field": "dataset: here\nsplit: official\nn_train: null\nseed: 0\nversions: {}\nsettings: {model: wrf-gs+}\n",
    "hybrid": "model: hybrid\ndataset: here\nsplit: official\nseed: 0\nsettings: []\n",
    "baseline": "model: idw\ndataset: here\nsplit: official\nseed: 0\nsettings: {neighbours: 4}\n",
    "traced": "model: ray-tracing\ndataset: here\nscene: room\noptions: {max_depth: 3}\n",
}


@pytest.mark.parametrize("kind", OLD)
def test_runs_of_version_0_1_are_refused_by_every_command(kind, tmp_path, capsys) -> None:
    run, out = tmp_path / "old", tmp_path / "out"
    run.mkdir()
    (run / "config.yaml").write_text(OLD[kind])
    (run / "metrics.json").write_text('{"task": "rssi"}')
    (tmp_path / "tx.csv").write_text("x,y,z\n1,2,1\n")
    message = f"^wrf-mi: {run}/config.yaml: format not stated, .*; train it anew, or use the version that wrote it$"
    for arguments in (
        ["train", "--resume", run],
        ["evaluate", run],
        ["evaluate", run, "--split", "random"],
        ["predict", run, "--tx", tmp_path / "tx.csv", "--out", tmp_path / "p.npz"],
        ["compare", run, "--out", out],
    ):
        refused(arguments, message, capsys)
    for use in (wrf_mi.open_run, wrf_mi.resume, wrf_mi.evaluate_run, lambda path: wrf_mi.scene_view(path, 0)):
        with pytest.raises(InputError, match="format not stated"):
            use(run)
    assert not out.exists()
    assert not (tmp_path / "p.npz").exists()
    if kind == "field":
        assert call(["train", "--help"], capsys)[0] == 0


def test_registry_imports_entries_on_access() -> None:
    registry: Registry[Any] = Registry("parser", "no.such.group", {"json": "json:loads"})
    assert list(registry) == ["json"]
    assert registry["json"] is json.loads
    registry.add("other", json.dumps)
    assert len(registry) == 2
    with pytest.raises(KeyError):
        registry["none"]
