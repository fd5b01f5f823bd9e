"""Runs on uplink and downlink channels: antennas, the uplink as input and as reference, data without positions."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calling import refused, stored
from made_channels import ANTENNAS, SUBCARRIERS, channels

from wrf_mi import models
from wrf_mi.core import InputError, Prediction, Split
from wrf_mi.datasets import load, write_nerf2_csi
from wrf_mi.models import Fitted, Inputs, Problem
from wrf_mi.models.model import Arrays
from wrf_mi.models.uplink.uplink_waves import UplinkModel
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.results import read_run
from wrf_mi.training.session import FitSession

ROUNDING = 1e-4
"""Powers of tens of dBm are stored in single precision."""


@pytest.fixture(scope="module")
def csi_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nerf2_csi(tmp_path_factory.mktemp("data") / "stations", channels())


@pytest.fixture(scope="module")
def unplaced_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without positions."""
    return write_nerf2_csi(tmp_path_factory.mktemp("data") / "unplaced", channels(positions=False))


@pytest.fixture(scope="module")
def run(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(flat_folder, tmp_path_factory.mktemp("runs") / "mri", "mri").folder


class Turned(Fitted):
    """Turns the uplink by a fitted angle: exact for `channels`."""

    def __init__(self, angle: float) -> None:
        self.angle = angle

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        return Prediction((inputs.uplink * np.exp(1j * self.angle)).astype(np.complex64))

    def arrays(self) -> dict[str, np.ndarray]:
        return {"angle": np.asarray(self.angle)}


class TurnedModel(UplinkModel):
    name, source, settings = "turned", "this test", models.MODELS["mri"].settings

    def fit(self, problem: Problem, split: Split, session: FitSession) -> Turned:
        record = problem.record
        rows = split.all_train
        return Turned(float(np.angle((record.observation[0, rows] * record.uplink[rows].conj()).sum())))

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Turned:
        return Turned(float(arrays["angle"]))


@pytest.fixture
def turned(monkeypatch: pytest.MonkeyPatch) -> None:
    """A method that predicts from the uplink, among the others."""
    monkeypatch.setitem(models.MODELS._known, "turned", TurnedModel())


def test_channels_of_an_array_are_scored_over_antennas_and_subcarriers(csi_folder: Path, tmp_path: Path) -> None:
    out = train(csi_folder, tmp_path / "run", "idw").folder
    metrics, arrays, record = json.loads((out / "metrics.json").read_text()), stored(out), load(csi_folder)
    assert arrays["prediction"].shape == arrays["truth"].shape == (10, ANTENNAS, SUBCARRIERS)
    error = np.square(np.abs(arrays["prediction"] - arrays["truth"])).sum(axis=(1, 2))
    expected = -10 * np.log10(error / np.square(np.abs(arrays["truth"])).sum(axis=(1, 2)))
    assert metrics["cea_db"]["median"] == pytest.approx(np.median(expected), abs=ROUNDING)
    # A turn by 0.1 rad leaves 2 sin(0.05) of each coefficient.
    assert list(metrics["reference"]) == ["uplink", "idw4"]
    assert metrics["reference"]["uplink"]["median"] == pytest.approx(-20 * np.log10(2 * np.sin(0.05)), abs=1e-3)
    assert metrics["reference"]["idw4"] == metrics["cea_db"]
    np.testing.assert_allclose(arrays["reference_uplink"], record.uplink[arrays["row"]], rtol=1e-6)
    read = read_run(out)
    assert read.prediction.shape == (1, 10, ANTENNAS, SUBCARRIERS)
    assert read.score.shape == (1, 10)
    assert read.reference_name == "copy of the uplink"
    assert (tmp_path / "page" / "index.html") == compare([out], tmp_path / "page")
    with (tmp_path / "page" / "compare.csv").open(newline="") as file:
        assert [row["model"] for row in csv.DictReader(file)] == ["idw", "uplink", "idw4"]


def test_methods_are_fitted_to_measurements_and_scored_by_the_truth(turned: None, tmp_path: Path) -> None:
    """The measured downlink is turned by another tenth of a radian, which the fit learns."""
    record = channels()
    measured = (record.observation * np.exp(0.1j)).astype(np.complex64)
    data = write_nerf2_csi(tmp_path / "noisy", replace(record, observation=measured, truth=record.observation))
    metrics = json.loads((train(data, tmp_path / "run", "turned").folder / "metrics.json").read_text())
    expected = -20 * np.log10(2 * np.sin(0.05))
    assert metrics["cea_db"]["median"] == pytest.approx(expected, abs=1e-3)
    assert metrics["reference"]["uplink"]["median"] == pytest.approx(expected, abs=1e-3)


def test_receivers_and_antennas_are_distinguished(tmp_path: Path) -> None:
    """[receivers, rows, antennas, subcarriers] and [receivers, rows, subcarriers] of as many axes."""
    one = channels()
    two = replace(
        one, receivers=(*one.receivers, replace(one.receivers[0], name="b")), observation=one.observation.repeat(2, 0)
    )
    single = replace(two, observation=two.observation[:, :, 0], uplink=two.uplink[:, :1])
    for record, shape in ((one, (1, 10, 3, 4)), (two, (2, 10, 3, 4)), (single, (2, 10, 4))):
        out = train(record, tmp_path / "x".join(map(str, shape)), "idw").folder
        assert read_run(out).prediction.shape == shape
        assert read_run(out).score.shape == shape[:2]


def test_uplink_predicts_without_positions(turned, unplaced_folder, tmp_path, capsys) -> None:
    out = train(unplaced_folder, tmp_path / "run", "turned").folder
    metrics, arrays = json.loads((out / "metrics.json").read_text()), stored(out)
    assert metrics["cea_db"]["median"] > 100  # exact but for single precision
    assert list(metrics["reference"]) == ["uplink"]
    assert np.isnan(arrays["tx_pos"]).all()
    assert "over the test rows" in compare([out], tmp_path / "page").read_text()
    uplink = load(unplaced_folder).uplink[arrays["row"]]
    np.savez(tmp_path / "up.npz", uplink=uplink)
    call_out = ["--out", tmp_path / "out.npz"]
    opened = open_run(out)
    np.testing.assert_allclose(opened.predict(uplink=uplink).mean, arrays["prediction"], rtol=1e-6)
    for wrong, message in (
        (uplink[:, :, :2], r"uplink \[10, 3, 2\]; fitted to 3 antennas and 4 subcarriers, so give \[10, 3, 4\]"),
        (uplink[:, :1], r"uplink \[10, 1, 4\]; fitted to 3 antennas"),
        (np.where(np.arange(10)[:, None, None] == 2, np.nan, uplink), "uplink, row 2: 12 of 12 values are not finite"),
        (None, r"predicts from the uplink; give uplink \[m, antennas, subcarriers\]"),
    ):
        with pytest.raises(InputError, match=message):
            opened.predict(uplink=wrong) if wrong is not None else opened.predict(np.zeros((1, 3)))
    refused(["predict", tmp_path, "--input", tmp_path / "none.npz", *call_out], "no such file", capsys)


def test_invalid_uplinks_of_predictions_are_refused(run, csi_folder, tmp_path, capsys) -> None:
    good = np.ones((2, ANTENNAS, SUBCARRIERS), np.complex64)
    broken = good.copy()
    broken[1, 0, 0] = np.nan + 1j
    for arrays, message in (
        ({"uplink": good.real}, r"uplink has shape \[2, 3, 4\] of float32; store complex numbers"),
        ({"uplink": good[0]}, r"uplink has shape \[3, 4\]"),
        ({"uplink": broken}, "row 2: uplink is not finite; correct or remove the row"),
        ({"uplink": good, "tx_pos": np.zeros((3, 3))}, "2 rows of uplink and 3 positions"),
        ({"uplink": good[:0]}, "no positions"),
        ({"uplink": good, "tx_pos": np.zeros((2, 3))}, "which has no uplink; omit uplink"),
    ):
        np.savez(tmp_path / "in.npz", **arrays)
        refused(["predict", run, "--input", tmp_path / "in.npz", "--out", tmp_path / "out.npz"], message, capsys)
    placed = train(csi_folder, tmp_path / "idw", "idw").folder
    np.savez(tmp_path / "in.npz", uplink=good)
    asked = ["predict", placed, "--input", tmp_path / "in.npz", "--out", tmp_path / "out.npz"]
    refused(asked, "idw: predicts from positions; give finite x, y, z", capsys)


# What is refused


BAD_DATA = {
    "no training row": ("flat, split official: no row that was received trains; use another split", "rssi"),
    "one sample": ("a random split needs 3 at least", "rssi"),
    "no uplink": ("made-up: has no uplink channels, from which turned predicts", "csi"),
    "frequencies": ("made-up: 4 subcarriers and 5 frequencies; give one for each", "csi"),
    "uplink frequencies": ("made-up: 4 uplink subcarriers and 3 frequencies", "csi"),
    "antennas": (r"uplink \[30, 2, 4\] beside a downlink of 30 rows and 3 antennas", "csi"),
    "NaN in the uplink": ("made-up, row 5: uplink, 1 of 12 values are not finite; correct or remove", "csi"),
    "silent uplink": ("made-up, row 5: uplink of zeros, where nothing was received; remove the row", "csi"),
    "NaN in the downlink": ("receiver base-station, row 7: 1 of 12 values are not finite; correct", "csi"),
    "infinite downlink": ("receiver base-station, row 7: 12 of 12 values are not finite; correct", "csi"),
}


@pytest.mark.parametrize("what", BAD_DATA)
def test_invalid_data_are_refused(what: str, turned: None, flat_folder: Path, tmp_path: Path) -> None:
    message, task = BAD_DATA[what]
    record = load(flat_folder) if task == "rssi" else channels()
    observation = record.observation.copy()
    uplink = None if record.uplink is None else record.uplink.copy()
    split = "official"
    if what == "no training row":
        observation[:, :24] = np.nan
    elif what == "one sample":
        observation[:, 1:], split = np.nan, "random"
    elif what == "NaN in the downlink":
        observation[0, 7, 1, 1] = 1 + 1j * np.nan
    elif what == "infinite downlink":
        observation[0, 7] = np.inf
    record = replace(record, observation=observation)
    if uplink is not None:
        if what == "NaN in the uplink":
            uplink[5, 0, 0] = np.nan
        if what == "silent uplink":
            uplink[5] = 0
        record = replace(record, uplink=uplink)
        record = replace(record, uplink=None) if what == "no uplink" else record
        record = replace(record, uplink=uplink[:, :2]) if what == "antennas" else record
        record = replace(record, frequencies_hz=np.arange(1.0, 6)) if what == "frequencies" else record
        record = replace(record, uplink_hz=np.arange(1.0, 4)) if what == "uplink frequencies" else record
    with pytest.raises(InputError, match=message) as error:
        train(record, tmp_path / "run", "mri" if task == "rssi" else "turned", split=split)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


PLACED = {
    "task": ({}, "turned", ": holds rssi; turned serves csi"),
    "row": ({"at": (1, 23), "value": np.inf}, "mri", ", receiver anchor2, row 23: 1 of 1 values are not finite"),
    "first row": ({"at": (0, 0), "value": -np.inf}, "mri", ", receiver anchor1, row 0: 1 of 1 values are not finite"),
}


@pytest.mark.parametrize("what", PLACED)
def test_errors_name_the_file_of_the_data(what, turned, flat_folder, tmp_path, monkeypatch) -> None:
    change, method, message = PLACED[what]
    monkeypatch.setattr("wrf_mi.datasets.observations.ROWS_PER_CHUNK", 7)  # the rows come in parts
    record = load(flat_folder)
    observation = record.observation.copy()
    if change:
        observation[change["at"]] = change["value"]
    with pytest.raises(InputError) as error:
        train(replace(record, name="other", observation=observation), tmp_path / "run", method)
    assert str(error.value).startswith(f"{flat_folder}{message}")
    assert not (tmp_path / "run").exists()
