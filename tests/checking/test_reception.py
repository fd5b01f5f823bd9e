"""Repeated rows, numbers for "not heard" and nearly silent receivers are suspected, measured strengths are not."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from calling import call
from checked_records import channels, spectra, strengths
from hypothesis import given, settings
from hypothesis import strategies as st
from made_building import TRAINED, building, silent_in
from scipy.stats import truncnorm

from wrf_mi.apps.checking import check_data
from wrf_mi.apps.checking.rows import constant_observations, few_rows, named_rows, not_heard, repeated_rows
from wrf_mi.core import Record
from wrf_mi.datasets import write_ble_folder
from wrf_mi.datasets.sentinels import suspicious_values
from wrf_mi.runs.api import train


def taken(record: Record, rows: np.ndarray) -> Record:
    """The record with some of its rows; the official split stays that of the numbers."""
    heading = None if record.tx_heading_rad is None else record.tx_heading_rad[rows]
    return replace(
        record, tx_pos_m=record.tx_pos_m[rows], observation=record.observation[:, rows], tx_heading_rad=heading
    )


def test_repeated_rows_are_named():
    for record in (strengths(), channels(), spectra(60)):
        for check in (repeated_rows, constant_observations):
            assert list(check(record)) == []
        rows = np.arange(len(record))
        rows[[7, 9, 30]] = [2, 2, 29]
        ((name, text),) = repeated_rows(taken(record, rows))
        assert name == "repeated-rows"
        assert text.startswith(f"3 of {len(record)} rows repeat an earlier row, observation included: rows 8, 10, 31;")
    assert named_rows(np.array([0])) == "row 1"
    assert named_rows(np.arange(13)) == "rows 1, 2, 3, 4, 5, 6 and 7 more"


def test_rows_at_one_place_and_few_strengths_in_whole_decibels_are_no_repetition():
    """A robot that stands still, or turns."""
    record = strengths()
    rows = np.arange(len(record)) // 3 * 3
    still = replace(record, tx_pos_m=record.tx_pos_m[rows])
    assert list(repeated_rows(still)) == []
    turning = taken(record, rows)
    assert [name for name, _ in repeated_rows(turning)] == ["train-test", "repeated-rows"]
    assert list(repeated_rows(replace(turning, tx_heading_rad=np.arange(float(len(record))) * 0.01))) == []
    record = taken(strengths(receivers=3), np.arange(120) // 2 * 2)
    assert list(repeated_rows(record)) == []
    four = taken(strengths(receivers=4), np.arange(120) // 2 * 2)
    assert list(repeated_rows(four)) != []
    observation = four.observation.copy()
    observation[0] = np.nan  # three that received
    assert list(repeated_rows(replace(four, observation=observation))) == []


def test_test_rows_among_training_rows_are_named_once():
    record = strengths()
    rows = np.arange(len(record))
    rows[[105, 119]] = [3, 50]
    ((name, text),) = repeated_rows(taken(record, rows))
    assert name == "train-test"
    again = "2 of 20 test rows are training rows too, observation included: rows 106, 120"
    assert text == f"{again}; remove them from one of the two"
    rows[8] = 7
    assert [name for name, _ in repeated_rows(taken(record, rows))] == ["train-test", "repeated-rows"]
    rows = np.arange(len(record))
    rows[119] = 110  # within the test rows
    assert [name for name, _ in repeated_rows(taken(record, rows))] == ["repeated-rows"]


def test_constant_receivers_and_blank_spectra_are_named():
    record = strengths()
    observation = record.observation.copy()
    observation[2] = -70
    observation[2, :5] = np.nan
    ((name, text),) = constant_observations(replace(record, observation=observation))
    assert (name, text.partition(":")[0]) == ("constant", "receiver anchor3")
    images = spectra(40)
    same = replace(images, observation=np.repeat(images.observation[:, :1], 40, axis=1))
    assert [name for name, _ in constant_observations(same)] == ["constant"]
    blank = images.observation.copy()
    blank[0, [3, 8]] = 0.5
    ((_, text),) = constant_observations(replace(images, observation=blank))
    assert "spectra of a single grey value in rows 4, 9;" in text


DRAWS = np.random.default_rng(0)
SENTINELS = (-999.0, -200.0, -127.0, -110.0, -101.0, -100.0, -1.0, 0.0, 1.0, 100.0, 127.0)


def marked(share: float, mark: float, *receivers: int, whole_db: bool = True) -> Record:
    """Strengths of a building, where some receivers state a number in their weakest rows, a share of all."""
    record = building()
    observed = np.round(record.observation, 0 if whole_db else 1)
    for receiver in receivers:
        count = max(round(share * len(record)), 1)
        observed[receiver, np.argsort(observed[receiver])[:count]] = mark
    return replace(record, observation=observed)


@pytest.mark.parametrize("share", [0.04, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("mark", SENTINELS)
@pytest.mark.parametrize("whole_db", [True, False])
def test_numbers_for_not_heard_are_named_with_receiver_share_and_rows(mark, share, whole_db):
    record = marked(share, mark, 1, whole_db=whole_db)
    rows, count = len(record), int((record.observation[1] == mark).sum())
    ((name, text),) = list(not_heard(record))
    assert name == "not-heard"
    assert text.startswith(f"{mark:g} dBm, apart from all other strengths: a number for 'not heard'")
    assert f": stairs {100 * count / rows:.2g} % ({count} of {rows} rows); leave the field empty" in text


def test_numbers_of_several_receivers_are_named_together_and_several_numbers_each():
    once = building()
    for receiver in range(3):
        once.observation[receiver, 7 * receiver] = -100
    ((_, text),) = list(not_heard(once))
    assert text.startswith("-100 dBm, apart from")
    assert "hall 1.9 % (1 of 52 rows), stairs 1.9 % (1 of 52 rows), lab 1.9 % (1 of 52 rows)" in text
    for mark in (-200, 0, 100):
        record = marked(0.3, mark, 0)
        record.observation[2] = mark  # in every row
        ((_, text),) = list(not_heard(record))
        assert "hall 31 % (16 of 52 rows), lab 100 % (52 of 52 rows)" in text
    record = marked(0.2, -200, 0)
    record.observation[1, :9] = 100
    record.observation[2, ::5] = 0
    assert [text.partition(" dBm")[0] for _, text in not_heard(record)] == ["-200", "0", "100"]


def test_strengths_clipped_at_the_sensitivity_and_nearly_silent_receivers_are_named():
    record = building()
    observed = np.round(record.observation)
    floor_dbm = np.sort(observed[0])[25]
    observed[0] = np.maximum(observed[0], floor_dbm)
    ((name, text),) = list(not_heard(replace(record, observation=observed)))
    assert name == "not-heard"
    begin = f"{floor_dbm:g} dBm, far more often than the strengths next to it: clipped at the sensitivity"
    assert text.startswith(begin)
    assert ("hall" in text, "stairs" in text) == (True, False)
    without_sign = replace(record, observation=-record.observation)  # a suspicion of its own
    assert list(not_heard(without_sign)) == []
    assert list(few_rows(building(attic=(1, 2, 3, 4, 5)))) == []
    ((name, text),) = list(few_rows(building(attic=(3, 45, 46), cellar=())))
    assert name == "few-rows"
    assert text.startswith("fewer than 5 training rows were received by attic (1), cellar (0): fits predict these")
    ((_, text),) = list(few_rows(silent_in(building(), list(range(TRAINED)), "hall", "stairs", "lab")))
    assert "nothing was received in the training rows by any receiver" in text


@settings(deadline=None, max_examples=150)
@given(st.integers(0, 10**6), st.floats(2, 12), st.sampled_from([0.0, 0.1, 0.5, 1.0]), st.sampled_from([60, 300, 2000]))
def test_quantised_strengths_are_seldom_suspected(seed, spread_db, step_db, rows):
    """Of twenty receivers, which a whole building may have, none or one."""
    values = np.random.default_rng(seed).normal(-65, spread_db, (20, rows))
    values = step_db * np.round(values / step_db) if step_db else values
    assert sum(bool(suspicious_values(strengths_dbm)) for strengths_dbm in values) <= 1


@pytest.mark.parametrize(
    "values",
    [
        np.round(DRAWS.normal(-65, 0.6, 500)),
        np.round(-82 + 9 * truncnorm.rvs(-1, 3, size=800, random_state=0)),
        np.round(-40 - 25 * np.log10(DRAWS.uniform(1, 20, 300))),
        np.round(-60 + 20 * np.log10(DRAWS.rayleigh(1, 1000))),
    ],
    ids=["standing still", "empty below the sensitivity", "path-loss law", "fading"],
)
def test_measured_strengths_are_not_suspected(values):
    assert suspicious_values(values) == []


def test_channels_and_spectra_of_zeros_are_named():
    for record, what in ((channels(), "channels"), (spectra(rows=30), "spectra")):
        assert list(not_heard(record)) == []
        observation = record.observation.copy()
        observation[0, [2, 5, 9]] = 0
        ((name, text),) = list(not_heard(replace(record, observation=observation)))
        share = f"{300 / len(record):.2g} % of the rows (3 of {len(record)}): rows 3, 6, 10"
        assert name == "not-heard"
        assert text.startswith(f"receiver {record.receivers[0].name}: {what} of zeros in {share};")


def test_fits_warn_of_them(tmp_path, caplog, capsys):
    folder = write_ble_folder(tmp_path / "office", marked(0.3, -101, 0, 1, 2))
    (suspicion,) = check_data(folder).suspicions
    with caplog.at_level(logging.WARNING):
        train(folder, "idw", out=tmp_path / "run")
    messages = [record.getMessage() for record in caplog.records if "suspicion" in record.getMessage()]
    assert messages == [f"office: suspicion not-heard: {suspicion.text} (wrf-mi data check)"]
    assert call(["data", "check", folder, "--strict"], capsys)[0] == 1
    assert call(["data", "check", folder, "--strict", "--ignore", "not-heard"], capsys)[0] == 0
    caplog.clear()
    train(strengths(), "idw", out=tmp_path / "clean")
    assert not [record for record in caplog.records if "suspicion" in record.getMessage()]
