"""Receivers that a split holds out: hidden from fits, and scored alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.datasets import write_ble_folder
from wrf_mi.models import MODELS
from wrf_mi.runs.api import evaluate_run, resume, train
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene
from wrf_mi.tracing.offsets import fit_offsets

LAW_DBM, EXPONENT = -40.0, 2.5
ROUNDING_DB = 1e-4
"""Predictions are stored as float32."""


@pytest.fixture
def law() -> Record:
    """Signal strengths of four receivers that follow one path-loss law, but for an offset of each."""
    rng = np.random.default_rng(0)
    positions_m = rng.uniform(1, 5, (60, 3))
    places = np.array([[0.0, 0, 0], [6, 0, 1], [0, 6, 2], [6, 6, 0]])
    receivers = tuple(Receiver(f"anchor{k}", place, np.array([0.0, 0, 0, 1])) for k, place in enumerate(places))
    distance = np.linalg.norm(positions_m - places[:, None], axis=2)
    observation = LAW_DBM - 10 * EXPONENT * np.log10(distance) + np.array([-3.0, 1, 2, 9])[:, None]
    known = {"frequencies_hz": np.array([2.44e9]), "official": (np.arange(40), np.arange(40, 60))}
    return Record("law", "rssi", positions_m, receivers, observation.astype(np.float32), **known)


def test_a_held_out_receiver_takes_the_law_of_the_others(law: Record, tmp_path: Path) -> None:
    folder = write_ble_folder(tmp_path / "law", law)
    run = train(folder, tmp_path / "run", "mri", split="receiver:3")
    found = read_run(run.folder)
    assert np.isnan(found.truth[:3]).all()
    assert np.isnan(found.prediction[:3]).all()
    np.testing.assert_array_equal(found.truth[3], law.observation[3, found.row])
    np.testing.assert_array_equal(found.prediction[3], found.references["law"][3])
    assert run.metrics["n_test"] == 20
    assert run.metrics["receivers"]["anchor3"]["n_test"] == 20
    # The mean offset of the three others, to which distances are not exactly alike, is 9 dB below.
    assert run.metrics["abs_error_db"]["median"] == pytest.approx(9, abs=1)
    assert evaluate_run(run.folder)["abs_error_db"] == run.metrics["abs_error_db"]
    pooled = train(folder, tmp_path / "all", "mri", split="receiver").metrics
    assert pooled["n_test"] == 80


def test_what_held_out_receivers_observed_changes_no_fit(law: Record, tmp_path: Path) -> None:
    broken = law.observation.copy()
    broken[3, :40] = 1e6 * np.arange(40)
    runs = [
        train(record, tmp_path / name, "mri", split="receiver:3")
        for name, record in (("as-is", law), ("broken", replace(law, observation=broken)))
    ]
    first, second = (np.load(run.folder / "model.npz") for run in runs)
    for key in first.files:
        if not key.startswith("run/"):
            np.testing.assert_array_equal(first[key], second[key])
    assert runs[0].metrics["reference"] == runs[1].metrics["reference"]


def test_a_stopped_run_goes_on_without_the_held_out_receivers(law: Record, tmp_path: Path) -> None:
    run = train(law, tmp_path / "run", "mri", split="receiver:1")
    before = run.metrics
    (run.folder / "model.npz").unlink()
    (run.folder / "metrics.json").unlink()
    assert resume(run.folder, record=law).metrics["abs_error_db"] == before["abs_error_db"]


def test_traced_strengths_take_the_mean_offset(law: Record, tmp_path: Path) -> None:
    layout = tmp_path / "layout.csv"
    layout.write_text("x,y\n-3,-3\n9,-3\n9,9\n-3,9\n-3,-3\n", encoding="utf-8")
    scene = make_scene(layout, tmp_path / "scene", height_m=8.0).folder
    run = train(law, tmp_path / "run", "ray-tracing", scene=str(scene), split="receiver:2", settings=["max_depth=1"])
    offset_db = np.load(run.folder / "model.npz")["offset_db"]
    assert offset_db[2] == pytest.approx(offset_db[[0, 1, 3]].mean())


def test_offsets_of_receivers_that_heard_nothing() -> None:
    traced = np.array([[-50.0, -60], [-50, -60], [-50, np.nan]])
    found = fit_offsets(traced, [[-53.0, -63], [np.nan, np.nan], [-59, -80]])
    np.testing.assert_allclose(found.offset_db, [-3, -6, -9])
    np.testing.assert_allclose(found.floor_dbm, [-63, -80, -80])
    with pytest.raises(InputError, match="receiver 0: no training row is both received and reached"):
        fit_offsets([[np.nan], [-50.0]], [[-53.0], [-50.0]])


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if not model.new_receivers])
def test_models_of_trained_receivers_refuse(name: str, law: Record, tmp_path: Path) -> None:
    if MODELS[name].serves("rssi") and MODELS[name].scene != "required":
        with pytest.raises(InputError, match=f"receiver:0: {name.replace('+', '.')} predicts for the receivers it is"):
            train(law, tmp_path / "run", name, split="receiver")
        assert not (tmp_path / "run").exists()


def test_all_receivers_held_out_are_refused(law: Record, tmp_path: Path) -> None:
    rows = np.arange(40), np.zeros(0, np.int64), np.arange(40, 60)
    for held in ((0, 1, 2, 3), (4,)):
        with pytest.raises(InputError, match=r"split mine holds out receivers .* of 4; leave some to train on"):
            train(law, tmp_path / "run", "mri", split=Split("mine", 0, *rows, held))
