"""The hybrid as a run without a scene: parts, restored predictions, refusals."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_channels import channels

import wrf_mi
from wrf_mi.core import InputError, Record, Split
from wrf_mi.datasets import make_splits
from wrf_mi.models import Problem
from wrf_mi.runs.api import evaluate_run
from wrf_mi.stages.hybrid import HybridSettings, parts_of
from wrf_mi.tasks.scores import cea_db
from wrf_mi.training.selection import HeldOut, hold_out

UNCLEAR_DB = 0.1  # difference on 24 held-out rows that is no clear gain over the most trusted ingredient, kriging
EXACT_DB = 30.0  # CEA of a downlink that is its uplink turned, from twenty rows: single precision and a little penalty


def test_strengths_without_a_scene_are_those_of_kriging_and_restored(flat_folder: Path, tmp_path: Path):
    run = wrf_mi.train(flat_folder, out=tmp_path / "run")
    kriging = wrf_mi.train(flat_folder, "kriging", out=tmp_path / "kriging")
    assert run.metrics["abs_error_db"] == kriging.metrics["abs_error_db"]
    assert run.metrics["weights"] == [{"distance_m": 0.0, "kriging": 1.0}]
    assert 0.5 < run.metrics["inside_90"] <= 1
    position = np.array([[2.0, 1.0, 1.3], [3.0, 2.0, 1.0]])
    before, after = (opened.predict(position, 1) for opened in (run, wrf_mi.open_run(run.folder)))
    assert after.mean == pytest.approx(before.mean)
    assert after.std == pytest.approx(before.std)
    assert evaluate_run(run.folder)["weights"] == run.metrics["weights"]


def test_two_rows_are_interpolated_by_kriging_and_five_spectra_have_intervals(flat_folder, tmp_path, folder):
    run = wrf_mi.train(flat_folder, "hybrid", out=tmp_path / "run", n_train=2)
    assert list(run.metrics["weights"][0]) == ["distance_m", "kriging"]
    assert "inside_90" not in run.metrics
    # Three remain where two are held out, through which kriging may pass without any deviation.
    run = wrf_mi.train(folder, out=tmp_path / "five", n_train=5)
    assert 0 < run.metrics["inside_90"] <= 1


def test_field_alone_is_a_part_where_it_is_named(folder: Path, tmp_path: Path):
    asked = HybridSettings(stages="field,residual")
    problem = Problem(wrf_mi.load(str(folder)), asked)
    split = make_splits(problem.record, "official")[0]
    assert list(parts_of(problem, split)) == ["field", "kriging"]
    assert list(parts_of(replace(problem, settings=HybridSettings()), split)) == ["kriging"]


def test_hybrid_mixes_models_from_positions_and_from_the_uplink(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Without the networks, whose training takes a minute."""
    monkeypatch.setattr("wrf_mi.stages.hybrid.UPLINK_PARTS", ("r2f2", "linear"))
    record = channels()
    run = wrf_mi.train(record, out=tmp_path / "run")
    accuracy = run.metrics["held_out"]
    assert {"r2f2", "linear", "kriging"} <= set(accuracy)
    assert accuracy["hybrid"] >= accuracy["linear"] - UNCLEAR_DB > accuracy["kriging"]
    assert all(weights.get("kriging", 0) < 0.5 for weights in run.metrics["weights"])
    again, rows = wrf_mi.open_run(run.folder, record), slice(20, 24)
    predicted = again.predict(record.tx_pos_m[rows], uplink=record.uplink[rows]).mean
    assert cea_db(predicted, record.observation[0, rows]).min() > EXACT_DB
    with pytest.raises(InputError, match="has a weight and predicts from the uplink"):
        again.predict(record.tx_pos_m[rows])


def test_held_out_observations_are_limited_by_their_size(one_gateway: Record):
    rows = np.arange(1000)
    places, nothing = np.random.default_rng(0).random((1000, 3)), np.zeros(0, np.float32)
    many = Record("many", "spectrum", places, one_gateway.receivers, nothing)
    fold = Split("fold", 0, rows[500:], rows[:0], rows[:500])
    for shape, most in (((), 500), ((20, 20), 200), ((50,), 400)):
        record = replace(many, observation=np.zeros((1, 1000, *shape), np.float32))
        assert len(HeldOut.of(record, fold, 0)) == most
        assert np.array_equal(HeldOut.of(record, fold, 0).row, HeldOut.of(record, fold, 0).row)


CARRIERS_HZ = (0.9e9, 1.8e9, 2.4e9, 3.5e9)


@pytest.fixture(scope="module")
def bands(flat_folder: Path) -> Record:
    """Signal strengths of equal positions at four carriers, lower by 6 dB an octave."""
    record = wrf_mi.load(flat_folder)
    places, loss_db = np.tile(record.tx_pos_m, (4, 1)), 20 * np.log10(np.divide(CARRIERS_HZ, CARRIERS_HZ[0]))
    observation = np.concatenate([record.observation - loss for loss in loss_db], axis=1).astype(np.float32)
    carriers_hz = np.repeat(CARRIERS_HZ, len(record))
    return Record("bands", "rssi", places, record.receivers, observation, carriers_hz=carriers_hz)


@pytest.mark.parametrize("known", [True, False])
def test_a_carrier_is_held_out_as_the_split_does(bands: Record, known: bool) -> None:
    """A trained one; its held-out rows' positions remain in training only where the test rows' do."""
    split = make_splits(bands, "frequency-known:2" if known else "frequency:2")[0]
    fold = hold_out(bands, split)
    trained, out = fold.all_train, fold.test
    assert set(trained) | set(out) <= set(split.all_train)
    assert len(set(bands.carriers_hz[out])) == 1
    assert not set(bands.carriers_hz[out]) & set(bands.carriers_hz[trained])
    places = [set(map(tuple, bands.tx_pos_m[rows])) for rows in (out, trained)]
    assert places[0] <= places[1] if known else not places[0] & places[1]


def test_a_carrier_between_others_is_predicted_with_intervals(bands: Record, tmp_path: Path) -> None:
    """Strengths are linear in the logarithm of the frequency, so that interpolation has the error of one carrier."""
    run = wrf_mi.train(bands, out=tmp_path / "run", split="frequency-known:2")
    assert run.metrics["abs_error_db"]["median"] < 0.5  # positions are known at the other carriers
    assert 0.5 < run.metrics["inside_90"] <= 1
    asked: dict[str, Any] = {"tx_pos_m": bands.tx_pos_m[:3], "receiver": 0, "carriers_hz": np.full(3, 2.4e9)}
    again = wrf_mi.open_run(run.folder, bands)
    assert again.predict(**asked).mean == pytest.approx(run.predict(**asked).mean)
