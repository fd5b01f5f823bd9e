"""Runs of the physics model in a scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused, stored
from made_waves import wave_record
from traced_rooms import FREQUENCY_HZ, inside, write_xml
from traced_rooms import SHOEBOX as ROOM
from wrf_mi_scenes.build_laboratory import box

from wrf_mi.core import Receiver, Record
from wrf_mi.datasets import write_spectrum_folder
from wrf_mi.runs.api import evaluate_run, train
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks.scores import inside_interval


@pytest.fixture(scope="module")
def flat_scene(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scene(flat_folder / "layout.csv", tmp_path_factory.mktemp("scenes") / "flat", height_m=2.7).folder


def test_mesh_alone_predicts_signal_strengths(
    flat_folder: Path, flat_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    asked = ["--scene", flat_scene, "--n-train", 0, "--set", "max_depth=2", "--set", "spacing_m=0.5"]
    status, printed, err = call(["train", flat_folder, "--model", "physics", "--out", out, "--json", *asked], capsys)
    assert status == 0, err
    metrics = json.loads(printed)
    assert (metrics["n_train"], metrics["scene"]) == (0, str(flat_scene))
    assert metrics["reference"]["idw100"]["median"] > 0  # the blend keeps its rows
    again = evaluate_run(out)
    assert (again["n_train"], again["abs_error_db"]) == (0, metrics["abs_error_db"])
    assert evaluate_run(out, "random")["n_test"] == 6  # it has seen no row: a fifth of all
    # Strengths are not calibrated: without any row the scale is not known.
    assert stored(out)["std"].min() > 5


def test_mesh_alone_predicts_spectra(tmp_path: Path) -> None:
    """Predictions without training rows depend on the mesh."""
    record = wave_record(30, 10, receivers=1)
    middle = np.array([2.0, 2.0, 1.2])
    receiver = replace(record.receivers[0], position_m=np.array([4.4, 3.1, 0.8]))
    record = replace(record, tx_pos_m=record.tx_pos_m + middle, receivers=(receiver,))
    folder = write_spectrum_folder(tmp_path / "waves", record)
    found = []
    for name, parts in (("room", ROOM), ("half", {k: v for k, v in ROOM.items() if k in ("floor", "west")})):
        scene = write_xml(tmp_path / name, parts)
        out = train(folder, tmp_path / f"run-{name}", "physics", scene=scene, n_train=0, settings=("rays=4096",)).folder
        assert json.loads((out / "metrics.json").read_text())["n_train"] == 0
        assert evaluate_run(out)["ssim"] == read_run(out).metrics["ssim"]
        found.append(stored(out)["prediction"])
    assert np.abs(found[0] - found[1]).mean() > 0.02


def test_antennas_are_checked_once_and_as_the_ray_tracer_does(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five folds warn once; a receiver or a transmitter in a column is refused in the words of `wrf-mi trace`."""
    record = wave_record(40, 10, receivers=1)
    record = replace(
        record, tx_pos_m=record.tx_pos_m + np.array([2.0, 2.0, 1.2]), receivers=(_at([4.4, 3.1, -2e-3], record),)
    )
    scene = write_xml(tmp_path / "hall", {**ROOM, "column": ("itu_concrete", box((4.8, 3.6, 0), (5.3, 4.1, 3)))})
    plain = ("rays=1024", "reflections=1", "surfaces=0", "amplitudes=false", "rest=false", "steps=1")
    folder = write_spectrum_folder(tmp_path / "waves", record)
    train(folder, tmp_path / "run", "physics", scene=scene, split="blocked", settings=plain)
    said = [one.getMessage() for one in caplog.records if one.levelname == "WARNING"]
    assert [text.partition(" (first: receiver one)")[0] for text in said] == [
        "1 of 1 antennas lie up to 1 cm behind a surface",
    ]
    moved = record.tx_pos_m.copy()
    moved[7] = [5.0, 4.0, 1.0]
    for name, wrong, antenna in (
        ("rx", replace(record, receivers=(_at([5.0, 4.0, 1.0], record),)), "receiver one"),
        ("tx", replace(record, tx_pos_m=moved), "transmitter 8"),
    ):
        data = write_spectrum_folder(tmp_path / name, wrong)
        message = rf"{antenna} at \(5.00, 4.00, 1.00\) m is inside the solid 'column'; move one of them"
        for command in (["train", data, "--model", "physics", "--scene", scene], ["trace", scene, data]):
            refused([*command, "--out", tmp_path / "out"], message, capsys)
            assert not (tmp_path / "out").exists()


def _at(position: Any, record: Record) -> Receiver:
    return replace(record.receivers[0], position_m=np.array(position, float))


def test_channels_are_predicted_from_a_mesh(tmp_path: Path) -> None:
    scene = write_xml(tmp_path / "room", {"floor": ROOM["floor"]})
    where, tx_pos = inside(30, seed=4), np.array([1.0, 1.5, 2.0])
    wavenumber = 2 * np.pi * FREQUENCY_HZ / 299792458.0
    csi = np.zeros(30, complex)
    for source in (tx_pos, tx_pos * [1, 1, -1]):  # a floor that reflects all
        distance = np.linalg.norm(where - source, axis=1)
        csi += np.exp(-1j * wavenumber * distance) / (2 * wavenumber * distance)
    np.savez(tmp_path / "hall.npz", tx_pos=tx_pos, rx_pos=where, frequency_hz=FREQUENCY_HZ, csi=csi)
    quick = ("rays=8192", "reflections=1", "repair_rounds=2", "visibility_rounds=1", "folds=2")
    out = train(tmp_path / "hall.npz", tmp_path / "run", "physics", scene=scene, settings=quick).folder
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["cea_db"]["median"] > 20
    assert metrics["cea_db"]["median"] > metrics["reference"]["idw4"]["median"] + 15
    arrays = stored(out)
    assert arrays["prediction"].dtype == np.complex64
    assert arrays["std"].dtype == np.float32
    assert arrays["std"].shape == arrays["prediction"].shape == (6, 1)
    assert metrics["inside_90"] == inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])
