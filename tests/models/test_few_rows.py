"""Receivers with few training rows, or none, are predicted by what the others teach, without harm to these."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, strength_commands
from made_building import FITS, PLACES_M, TRAINED, building

from wrf_mi.core import InputError, Record
from wrf_mi.core.types import Inputs
from wrf_mi.datasets import write_ble_folder
from wrf_mi.estimators.few_rows import SharedLaw
from wrf_mi.runs.api import open_run, train

NAMES = list(PLACES_M)
SCARCE: dict[str, tuple[int, ...]] = {"attic": (3, 5, 41, 44, 47, 50), "cellar": tuple(range(TRAINED, TRAINED + 8))}
"""Rows of receivers with two training rows and with none."""
NOISE_DB = 1.0  # standard deviation of the noise of `made_building.building`
WORSE_DB = 0.05  # allowed difference of a mean absolute error: kriging learns its common terms from the few rows, too


def errors_db(folder: Path) -> dict[str, Any]:
    """Absolute errors of the test rows by the name of the receiver."""
    stored = np.load(folder / "predictions.npz")
    return dict(zip(stored["receiver_name"], np.abs(stored["prediction"] - stored["truth"]), strict=True))


@pytest.mark.parametrize("model", FITS)
def test_every_model_serves_them_and_the_others_are_as_without(model: str, tmp_path: Path) -> None:
    intervals = model in ("idw", "trees")
    run = train(building(**SCARCE), model, out=tmp_path / "run", settings=FITS[model], intervals=intervals)
    assert run.metrics["receivers_with_few_rows"] == {"attic": 2, "cellar": 0}
    assert "receivers_left_out" not in run.metrics
    without = train(building(), model, out=tmp_path / "clean", settings=FITS[model], intervals=intervals)
    scarce, alone = errors_db(run.folder), errors_db(without.folder)
    assert list(scarce) == [*NAMES, "attic", "cellar"]
    assert np.mean([np.mean(scarce[name]) - np.mean(alone[name]) for name in NAMES]) < WORSE_DB
    # The law of the others and two rows with noise of 1 dB: three standard deviations of the mean of four errors.
    assert max(np.nanmean(scarce[name]) for name in ("attic", "cellar")) < 3 * NOISE_DB
    again = open_run(run.folder, building(**SCARCE))
    for name in ("lab", "cellar"):
        prediction = again.predict([[1, 2, 1.3], [5, 5, 1.3]], name)
        assert np.isfinite(prediction.mean).all()
        assert (prediction.std is not None) == (intervals or model in ("kriging", "hybrid"))


def noise_free(shift_db: dict[int, float]) -> Record:
    """The building without noise, by the law -40 - 25 log10 d, shifted for the receivers of some numbers."""
    record = building(**SCARCE)
    for number, receiver in enumerate(record.receivers):
        distance_m = np.linalg.norm(record.tx_pos_m - receiver.position_m, axis=1)
        received = np.isfinite(record.observation[number])
        power_dbm = -40 - 25 * np.log10(distance_m) + shift_db.get(number, 0.0)
        record.observation[number, received] = power_dbm[received]
    return record


def test_law_and_shift_of_data_without_noise_are_exact() -> None:
    law = SharedLaw.fit(noise_free({}), np.arange(TRAINED), np.array([3, 4]))
    np.testing.assert_allclose(law.law, [-40, -2.5], atol=1e-4)  # single precision
    np.testing.assert_allclose(law.shift_db, 0, atol=1e-4)


@pytest.mark.parametrize(("number", "expected_db"), [(3, 6.0), (4, 0.0)])
def test_shift_follows_the_rows_where_receivers_differ_more_than_rows(number: int, expected_db: float) -> None:
    """The shift of two exact rows is theirs, and without rows it is the mean of the others."""
    record = noise_free({0: -5.0, 1: 5.0, 3: 6.0})
    law, inputs = SharedLaw.fit(record, np.arange(TRAINED), np.array([number])), Inputs(record.tx_pos_m[:5])
    distance_m = np.linalg.norm(inputs.tx_pos_m - record.receivers[number].position_m, axis=1)
    error_db = law(inputs, number).mean - (-40 - 25 * np.log10(distance_m) + expected_db)
    # The exponent absorbs a part of the differences between receivers.
    assert np.abs(error_db).mean() < 1.5


def test_deviation_has_both_variances_and_a_receiver_at_an_unknown_place_the_mean_level() -> None:
    record = building(**SCARCE)
    record.observation[:3] += np.array([[-4.0], [0.0], [4.0]], np.float32)
    two_rows, none = SharedLaw.fit(record, np.arange(TRAINED), np.array([3, 4])).std_db
    # The variance between is that of three numbers, 16 dB^2, and within receivers noise of 1 dB and the law's misfit.
    assert none == pytest.approx(np.sqrt(16 + NOISE_DB**2), rel=0.25)
    assert two_rows == pytest.approx(np.sqrt(1.5) * NOISE_DB, rel=0.5)
    record = building(**SCARCE)
    lost = replace(record.receivers[4], position_m=np.full(3, np.nan))
    record = replace(record, receivers=(*record.receivers[:4], lost))
    predicted = SharedLaw.fit(record, np.arange(TRAINED), np.array([4]))(Inputs(record.tx_pos_m[:3]), 4)
    np.testing.assert_allclose(predicted.mean, np.nanmean(record.observation[:, :TRAINED]), atol=1.0)


def test_several_carriers_share_the_law(tmp_path: Path) -> None:
    record = building(**SCARCE)
    carriers_hz = np.where(np.arange(len(record)) % 2, 9e8, 2.4e9)
    record.observation[:] -= (20 * np.log10(carriers_hz / 2.4e9)).astype(np.float32)
    record = replace(record, frequencies_hz=None, carriers_hz=carriers_hz)
    run = train(record, "kriging", out=tmp_path / "run")
    low, high = (run.predict([[5, 5, 1.3]], "cellar", carriers_hz=[hz]).mean[0] for hz in (9e8, 2.4e9))
    assert low - high == pytest.approx(20 * np.log10(2.4e9 / 9e8), abs=1e-4)
    assert np.nanmean(errors_db(run.folder)["cellar"]) < 3 * NOISE_DB


def test_min_rows_leaves_receivers_out(tmp_path: Path) -> None:
    record = building(**SCARCE)
    for least, left in ((1, {"cellar": 0}), (3, {"attic": 2, "cellar": 0})):
        run = train(record, "mri", out=tmp_path / f"run{least}", min_rows=least)
        assert run.metrics["receivers_left_out"] == left
    with pytest.raises(InputError, match="min_rows -1: give a number of training rows, 0 or more"):
        train(record, "mri", out=tmp_path / "none", min_rows=-1)


def test_commands_take_a_run_with_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    office = write_ble_folder(tmp_path / "office", building(**SCARCE))
    run = tmp_path / "run"
    heard = {"hall": "-60", "stairs": "-70", "lab": "-65", "attic": "-80", "cellar": ""}
    status, out, _ = call(["train", office, "--model", "idw", "--intervals", "--out", run], capsys)
    assert status == 0
    assert "receivers with few training rows (number): attic (2), cellar (0)" in out
    for command in strength_commands(run, tmp_path, heard):
        status, _, err = call(command, capsys)
        assert status == 0, (command, err)
    assert json.loads((run / "metrics.json").read_text())["receivers_with_few_rows"] == {"attic": 2, "cellar": 0}
