"""Repeated rows, test rows among training rows, and what never changes are suspected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from checked_records import channels, spectra, strengths

from wrf_mi.checking.rows import (
    constant_observations,
    named_rows,
    repeated_observations,
    repeated_rows,
    single_position,
)
from wrf_mi.core import Record


def taken(record: Record, rows: np.ndarray) -> Record:
    """The record with some of its rows; the official split stays that of the numbers."""
    heading = None if record.tx_heading_rad is None else record.tx_heading_rad[rows]
    return replace(
        record, tx_pos_m=record.tx_pos_m[rows], observation=record.observation[:, rows], tx_heading_rad=heading
    )


def test_rows_that_differ_are_not_suspected() -> None:
    for record in (strengths(), channels(), spectra(40)):
        for check in (repeated_rows, repeated_observations, constant_observations, single_position):
            assert list(check(record)) == []


def test_repeated_rows_are_named() -> None:
    for record in (strengths(), channels(), spectra(60)):
        rows = np.arange(len(record))
        rows[[7, 9, 30]] = [2, 2, 29]
        ((name, text),) = repeated_rows(taken(record, rows))
        assert name == "repeated-rows"
        assert text.startswith(f"3 of {len(record)} rows repeat an earlier row, observation included: rows 8, 10, 31;")


def test_rows_at_one_place_are_no_repetition() -> None:
    """A robot that stands still, or turns."""
    record = strengths()
    rows = np.arange(len(record)) // 3 * 3
    still = replace(record, tx_pos_m=record.tx_pos_m[rows])
    assert list(repeated_rows(still)) == []
    turning = taken(record, rows)
    assert [name for name, _ in repeated_rows(turning)] == ["train-test", "repeated-rows"]
    assert list(repeated_rows(replace(turning, tx_heading_rad=np.arange(len(record)) * 0.01))) == []


def test_few_strengths_in_whole_decibels_may_repeat() -> None:
    record = taken(strengths(receivers=3), np.arange(120) // 2 * 2)
    assert list(repeated_rows(record)) == []
    four = taken(strengths(receivers=4), np.arange(120) // 2 * 2)
    assert list(repeated_rows(four)) != []
    observation = four.observation.copy()
    observation[0] = np.nan  # three that received
    assert list(repeated_rows(replace(four, observation=observation))) == []


def test_test_rows_among_training_rows_are_named_once() -> None:
    record = strengths()
    rows = np.arange(len(record))
    rows[[105, 119]] = [3, 50]
    ((name, text),) = repeated_rows(taken(record, rows))
    assert name == "train-test"
    assert text == (
        "2 of 20 test rows are training rows too, observation included: rows 106, 120; remove them from one of the two"
    )
    rows[8] = 7
    assert [name for name, _ in repeated_rows(taken(record, rows))] == ["train-test", "repeated-rows"]
    rows = np.arange(len(record))
    rows[119] = 110  # within the test rows
    assert [name for name, _ in repeated_rows(taken(record, rows))] == ["repeated-rows"]


def test_copies_of_observations_are_named() -> None:
    for record in (channels(), spectra(60)):
        observation = record.observation.copy()
        observation[:, [4, 5]] = observation[:, [1]]
        ((name, text),) = repeated_observations(replace(record, observation=observation))
        assert name == "repeated-observations"
        assert "2 of 60 rows have the observation of an earlier row at another position: rows 5, 6;" in text
    observation = strengths().observation.copy()
    observation[:, 4] = observation[:, 1]
    assert list(repeated_observations(replace(strengths(), observation=observation))) == []


def test_constant_receivers_and_blank_spectra_are_named() -> None:
    record = strengths()
    observation = record.observation.copy()
    observation[2] = -70
    observation[2, :5] = np.nan
    ((name, text),) = constant_observations(replace(record, observation=observation))
    assert (name, text.partition(":")[0]) == ("constant", "receiver anchor3")
    images = spectra(40)
    same = replace(images, observation=np.repeat(images.observation[:, :1], 40, axis=1))
    assert [name for name, _ in constant_observations(same)] == ["constant"]
    assert list(repeated_observations(same)) == []  # reported as constant
    blank = images.observation.copy()
    blank[0, [3, 8]] = 0.5
    ((_, text),) = constant_observations(replace(images, observation=blank))
    assert "spectra of a single grey value in rows 4, 9;" in text


def test_a_single_position_is_suspected() -> None:
    record = strengths()
    one = replace(record, tx_pos_m=np.repeat(record.tx_pos_m[3:4], len(record), axis=0))
    ((name, text),) = single_position(one)
    assert name == "single-position"
    assert text.startswith("all 120 transmitters are at (")
    assert list(single_position(replace(record, tx_pos_m=np.full((120, 3), np.nan)))) == []


def test_rows_are_counted_from_one_and_cut() -> None:
    assert named_rows(np.array([0])) == "row 1"
    assert named_rows(np.arange(13)) == "rows 1, 2, 3, 4, 5, 6, 7, 8, 9, 10 and 3 more"
