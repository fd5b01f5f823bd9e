"""Runs on uplink and downlink channels: antennas, the uplink as input and as reference, data without positions."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import stored
from made_channels import ANTENNAS, SUBCARRIERS, channels

from wrf_mi import models
from wrf_mi.core import InputError, Prediction, Record, Split
from wrf_mi.datasets import load, write_nerf2_csi
from wrf_mi.estimators.model import Arrays
from wrf_mi.estimators.uplink.uplink_waves import UplinkModel
from wrf_mi.models import Fitted, Inputs, Problem
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.results import read_run
from wrf_mi.training.session import FitSession

pytestmark = pytest.mark.usefixtures("undrawn")
ROUNDING = 1e-4  # powers of tens of dBm are stored in single precision
TURNED_DB = -20 * np.log10(2 * np.sin(0.05))  # A turn by 0.1 rad leaves 2 sin(0.05) of each coefficient


@pytest.fixture(scope="module")
def csi_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nerf2_csi(tmp_path_factory.mktemp("data") / "stations", channels())


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
    out = train(csi_folder, "idw", out=tmp_path / "run").folder
    metrics, arrays, record = json.loads((out / "metrics.json").read_text()), stored(out), load(csi_folder)
    assert arrays["prediction"].shape == arrays["truth"].shape == (10, ANTENNAS, SUBCARRIERS)
    error = np.square(np.abs(arrays["prediction"] - arrays["truth"])).sum(axis=(1, 2))
    expected = -10 * np.log10(error / np.square(np.abs(arrays["truth"])).sum(axis=(1, 2)))
    assert metrics["cea_db"]["median"] == pytest.approx(np.median(expected), abs=ROUNDING)
    assert list(metrics["reference"]) == ["uplink", "idw"]
    assert metrics["reference"]["uplink"]["median"] == pytest.approx(TURNED_DB, abs=1e-3)
    assert metrics["reference"]["idw"].items() >= metrics["cea_db"].items()
    np.testing.assert_allclose(arrays["reference_uplink"], record.uplink[arrays["row"]], rtol=1e-6)
    assert read_run(out).reference_name == "copy of the uplink"
    assert (tmp_path / "page" / "index.html") == compare([out], tmp_path / "page")
    with (tmp_path / "page" / "compare.csv").open(newline="") as file:
        assert [row["model"] for row in csv.DictReader(file)] == ["idw", "uplink", "idw", "constant"]


def test_methods_are_fitted_to_measurements_and_scored_by_the_truth(turned: None, tmp_path: Path) -> None:
    """The measured downlink is turned by another tenth of a radian, which the fit learns."""
    record = channels()
    measured = (record.observation * np.exp(0.1j)).astype(np.complex64)
    data = write_nerf2_csi(tmp_path / "noisy", replace(record, observation=measured, truth=record.observation))
    metrics = train(data, "turned", out=tmp_path / "run").metrics
    assert metrics["cea_db"]["median"] == pytest.approx(TURNED_DB, abs=1e-3)
    assert metrics["reference"]["uplink"]["median"] == pytest.approx(TURNED_DB, abs=1e-3)


def test_receivers_and_antennas_are_distinguished(tmp_path: Path) -> None:
    """[receivers, rows, antennas, subcarriers] and [receivers, rows, subcarriers] of as many axes."""
    single_station = channels()
    stations = (*single_station.receivers, replace(single_station.receivers[0], name="b"))
    two = replace(single_station, receivers=stations, observation=single_station.observation.repeat(2, 0))
    single = replace(two, observation=two.observation[:, :, 0], uplink=two.uplink[:, :1])
    for record, shape in ((single_station, (1, 10, 3, 4)), (two, (2, 10, 3, 4)), (single, (2, 10, 4))):
        run = read_run(train(record, "idw", out=tmp_path / "x".join(map(str, shape))).folder)
        assert (run.prediction.shape, run.score.shape) == (shape, shape[:2])


def test_uplink_predicts_without_positions(turned: None, tmp_path: Path, command) -> None:
    data = write_nerf2_csi(tmp_path / "unplaced", channels(positions=False))
    out = train(data, "turned", out=tmp_path / "run").folder
    metrics, arrays = json.loads((out / "metrics.json").read_text()), stored(out)
    assert metrics["cea_db"]["median"] > 100  # exact but for single precision
    assert list(metrics["reference"]) == ["uplink"]
    assert np.isnan(arrays["tx_pos"]).all()
    assert "over the test rows" in compare([out], tmp_path / "page").read_text()
    uplink, opened = load(data).uplink[arrays["row"]], open_run(out)
    np.testing.assert_allclose(opened.predict(uplink=uplink).mean, arrays["prediction"], rtol=1e-6)
    for wrong, message in (
        (uplink[:, :, :2], r"uplink \[10, 3, 2\]; fitted to 3 antennas and 4 subcarriers, so give \[10, 3, 4\]"),
        (uplink[:, :1], r"uplink \[10, 1, 4\]; fitted to 3 antennas"),
        (np.where(np.arange(10)[:, None, None] == 2, np.nan, uplink), "uplink, row 2: 12 of 12 values are not finite"),
    ):
        with pytest.raises(InputError, match=message):
            opened.predict(uplink=wrong)
    with pytest.raises(InputError, match=r"predicts from the uplink; give uplink \[m, antennas, subcarriers\]"):
        opened.predict(np.zeros((1, 3)))
    asked = ["predict", tmp_path, "--input", tmp_path / "none.npz", "--out", tmp_path / "out.npz"]
    command.refused(asked, "no such file")


def test_invalid_uplinks_of_predictions_are_refused(flat_folder, csi_folder, tmp_path: Path, command) -> None:
    run, placed = (train(data, name, out=tmp_path / name) for data, name in ((flat_folder, "mri"), (csi_folder, "idw")))
    good = np.ones((2, ANTENNAS, SUBCARRIERS), np.complex64)
    broken = good.copy()
    broken[1, 0, 0] = np.nan + 1j
    for of, arrays, message in (
        (run, {"uplink": good.real}, r"uplink has shape \[2, 3, 4\] of float32; store complex numbers"),
        (run, {"uplink": good[0]}, r"uplink has shape \[3, 4\]"),
        (run, {"uplink": broken}, "row 2: uplink is not finite; correct or remove the row"),
        (run, {"uplink": good, "tx_pos": np.zeros((3, 3))}, "2 rows of uplink and 3 positions"),
        (run, {"uplink": good[:0]}, "no positions"),
        (run, {"uplink": good, "tx_pos": np.zeros((2, 3))}, "which has no uplink; omit uplink"),
        (placed, {"uplink": good}, "idw: predicts from positions; give finite x, y, z"),
    ):
        np.savez(tmp_path / "in.npz", **arrays)
        asked = ["predict", of.folder, "--input", tmp_path / "in.npz", "--out", tmp_path / "out.npz"]
        command.refused(asked, message)


Changed = dict[str, Any]


def changed(of: Record, name: str, where: Any, value: complex) -> Changed:
    """An array of a record with other values in some places."""
    values = getattr(of, name).copy()
    values[where] = value
    return {name: values}


CSI = channels()
BAD_CHANNELS: dict[str, Changed] = {
    "made-up: has no uplink channels, from which turned predicts": {"uplink": None},
    "made-up: 4 subcarriers and 5 frequencies; give one for each": {"frequencies_hz": np.arange(1.0, 6)},
    "made-up: 4 uplink subcarriers and 3 frequencies": {"uplink_hz": np.arange(1.0, 4)},
    r"uplink \[30, 2, 4\] beside a downlink of 30 rows and 3 antennas": {"uplink": CSI.uplink[:, :2]},
    "made-up, row 5: uplink, 1 of 12 values are not finite": changed(CSI, "uplink", (5, 0, 0), np.nan),
    "made-up, row 5: uplink of zeros, where nothing was received; remove the row": changed(CSI, "uplink", 5, 0),
    "base-station, row 7: 1 of 12 values are not finite; correct": changed(CSI, "observation", (0, 7, 1, 1), np.nan),
    "base-station, row 7: 12 of 12 values are not finite; correct": changed(CSI, "observation", (0, 7), np.inf),
}


@pytest.mark.parametrize("message", BAD_CHANNELS)
def test_invalid_channels_are_refused(message: str, turned: None, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message) as error:
        train(replace(CSI, **BAD_CHANNELS[message]), "turned", out=tmp_path / "run")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("where", "value", "split", "model", "message"),
    [
        ((0, 0), -np.inf, "official", "mri", "^{folder}, receiver anchor1, row 0: 1 of 1 values are not finite"),
        ((1, 23), np.inf, "official", "mri", "^{folder}, receiver anchor2, row 23: 1 of 1 values are not finite"),
        ((0, 0), -50, "official", "turned", "^{folder}: holds rssi; turned serves csi"),
        (
            np.s_[:, :24],
            np.nan,
            "official",
            "mri",
            "flat, split official: no row that was received trains; use another",
        ),
        (np.s_[:, 1:], np.nan, "random", "mri", "a random split needs 3 at least"),
    ],
)
def test_strengths_are_refused_with_their_file(
    where: Any,
    value: float,
    split: str,
    model: str,
    message: str,
    turned: None,
    flat_folder: Path,
    tmp_path,
    monkeypatch,
) -> None:
    monkeypatch.setattr("wrf_mi.datasets.observations.ROWS_PER_CHUNK", 7)  # the rows come in parts
    record = load(flat_folder)
    with pytest.raises(InputError, match=message.format(folder=re.escape(str(flat_folder)))) as error:
        train(replace(record, **changed(record, "observation", where, value)), model, out=tmp_path / "run", split=split)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()
