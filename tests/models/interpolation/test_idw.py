"""The number of neighbours of inverse-distance weighting, chosen on held-out training rows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_channels import channels
from made_spectra import spectra

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.datasets import make_splits
from wrf_mi.estimators.interpolation import idw
from wrf_mi.estimators.interpolation.idw import COUNTS, MODEL, best_count
from wrf_mi.estimators.model import Problem, default_settings
from wrf_mi.runs.api import open_run, train

RECEIVERS = tuple(Receiver(name, np.zeros(3), np.array(UPRIGHT)) for name in ("anchor1", "anchor2"))


def chosen(record: Record, split: Split) -> int:
    return best_count(Problem(record, default_settings(MODEL, (), {})), split)


def strengths(power_dbm: np.ndarray, position_m: np.ndarray) -> Record:
    """Two receivers, the second of which misses every third row; four fifths of the rows train, drawn at random."""
    observed = np.stack([power_dbm, power_dbm - 5]).astype(np.float32)
    observed[1, ::3] = np.nan
    return Record("made-up", "rssi", position_m, RECEIVERS, observed, frequencies_hz=np.array([2.4e9]))


@pytest.fixture
def positions_m() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 40, (400, 3)) * [1, 1, 0]


def test_a_field_without_noise_takes_the_nearest_rows(positions_m: np.ndarray) -> None:
    record = strengths(-60 + 10 * np.sin(positions_m[:, 0] / 4), positions_m)
    assert chosen(record, make_splits(record, "random")[0]) == COUNTS[0]


def test_noise_about_a_constant_is_averaged_over_many_rows(positions_m: np.ndarray) -> None:
    record = strengths(np.random.default_rng(1).normal(-60, 6, len(positions_m)), positions_m)
    assert chosen(record, make_splits(record, "random")[0]) >= 64


def test_test_rows_have_no_part_in_the_choice(positions_m: np.ndarray) -> None:
    noise = np.random.default_rng(1).normal(0, 2, len(positions_m))
    record = strengths(-60 + 10 * np.sin(positions_m[:, 0] / 8) + noise, positions_m)
    (split,) = make_splits(record, "random")
    observed = record.observation.copy()
    observed[:, split.test] = np.random.default_rng(2).normal(-60, 40, (2, len(split.test)))
    assert chosen(replace(record, observation=observed), split) == chosen(record, split)


def test_rows_of_another_lap_are_predicted_from_more_rows_than_the_next_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Laps differ by an offset, so that the rows before and after tell more than other laps; test rows are a lap."""
    laps, rows = 12, 80
    along_m = np.tile(np.linspace(0, 2, rows), laps)
    beside_m = np.repeat(np.random.default_rng(0).normal(0, 0.3, laps), rows)
    place_m = np.stack([along_m, beside_m, np.zeros(laps * rows)], axis=1)
    offset_db = np.repeat(np.random.default_rng(1).normal(0, 8, laps), rows)
    record = strengths(-60 + offset_db, place_m)
    last = (laps - 1) * rows
    split = Split("mine", 0, np.arange(last), np.zeros(0, np.int64), np.arange(last, laps * rows))
    of_lap = chosen(record, split)
    monkeypatch.setattr(idw, "_rows_apart", lambda split: 0.0)
    assert of_lap > chosen(record, split)


def test_one_row_has_the_number_of_its_task(positions_m: np.ndarray) -> None:
    record = strengths(np.full(len(positions_m), -60.0), positions_m)
    assert chosen(record, Split("mine", 0, np.arange(1), np.zeros(0, np.int64), np.arange(5, 9))) == 100


@pytest.mark.parametrize("record", [channels(), spectra(rows=24)[0]], ids=["channels", "spectra"])
def test_the_reference_is_the_model_by_default(record: Record, tmp_path: Path) -> None:
    run = train(record, "idw", out=tmp_path / "run", split="random")
    counts = run.metrics["reference"]["idw"]["neighbours"]
    assert counts == [run.metrics["neighbours"]]
    assert counts[0] in COUNTS
    assert run.metrics["reference"]["idw"]["gain"] == 0


def test_a_stated_number_of_neighbours_holds(positions_m: np.ndarray, tmp_path: Path) -> None:
    record = strengths(np.random.default_rng(1).normal(-60, 6, len(positions_m)), positions_m)
    run = train(record, "idw", out=tmp_path / "run", split="random", settings=["neighbours=3"])
    assert run.metrics["neighbours"] == 3
    assert run.metrics["reference"]["idw"]["neighbours"] != [3]
    assert open_run(run.folder, record).fitted.facts() == {"neighbours": 3}
