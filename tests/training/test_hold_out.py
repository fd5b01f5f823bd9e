"""The hold-out of signal strengths: as far from the other rows as test rows are from training rows, places together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.training.selection import cells, hold_out

FACTOR = 1.6
"""Of medians of distances, either way: cells are halved, so that their sides are right within the root of two, and a
quarter of the rows is missing beside each held-out one."""


def record_of(tx_pos_m: np.ndarray) -> Record:
    receiver = Receiver("r", np.zeros(3), np.array(UPRIGHT))
    observed = np.full((1, len(tx_pos_m)), -50, np.float32)
    return Record("made", "rssi", tx_pos_m, (receiver,), observed, frequencies_hz=np.array([1e9]))


def away_m(tx_pos_m: np.ndarray, rows: np.ndarray, known: np.ndarray) -> float:
    return float(np.median(cKDTree(tx_pos_m[known]).query(tx_pos_m[rows])[0]))


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("far", [False, True])
def test_held_out_rows_are_as_far_as_test_rows(share: float, far: bool) -> None:
    rng = np.random.default_rng(0)
    tx_pos_m = np.column_stack([rng.uniform(0, 40, (600, 2)), np.full(600, 1.5)])
    # Test rows among the others, or in squares of 4 m without any.
    tested = (np.floor(tx_pos_m[:, :2] / 4).sum(axis=1) % 4 == 0) if far else rng.random(600) < share
    rows = np.arange(600)
    split = Split("made", 0, rows[~tested], rows[:0], rows[tested])
    fold = hold_out(record_of(tx_pos_m), split)
    assert fold is not None
    ratio = away_m(tx_pos_m, fold.test, fold.all_train) / away_m(tx_pos_m, split.test, split.train)
    assert 1 / FACTOR < ratio < FACTOR
    assert 0.15 < len(fold.test) / len(split.train) < 0.3


def test_rows_of_a_place_are_held_out_together() -> None:
    places_m = np.random.default_rng(0).uniform(0, 20, (60, 3))
    tx_pos_m, rows = np.tile(places_m, (3, 1)), np.arange(180)
    tested = rows % 60 < 12
    fold = hold_out(record_of(tx_pos_m), Split("made", 0, rows[~tested], rows[:0], rows[tested]))
    assert fold is not None
    assert not {*(fold.test % 60)} & {*(fold.all_train % 60)}


@pytest.mark.parametrize("test", [np.zeros((0, 3)), np.zeros((4, 3)), np.full((4, 3), np.nan)])
def test_clusters_are_large_where_test_positions_say_nothing(test: np.ndarray) -> None:
    """None, those of training rows, and unknown ones."""
    known_m = np.random.default_rng(0).uniform(0, 20, (100, 3))
    known_m[:4] = 0
    rows = np.arange(100 + len(test))
    record = record_of(np.concatenate([known_m, test]))
    fold = hold_out(record, Split("made", 0, rows[:100], rows[:0], rows[100:]))
    among = hold_out(record, Split("made", 0, rows[:100], rows[:0], rows[:0]))
    assert fold is not None
    assert among is not None
    np.testing.assert_array_equal(fold.test, among.test)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 80), st.integers(1, 80), st.integers(0, 9))
def test_cells_are_equal_parts(places: int, count: int, seed: int) -> None:
    label = cells(np.random.default_rng(seed).normal(size=(places, 3)), count)
    sizes = np.bincount(label)
    assert sizes.min() >= 1
    assert sizes.max() - sizes.min() <= 1 + np.log2(max(places, 2)) / 2
    assert len(sizes) >= min(count, places) or sizes.max() == 1


def test_wanted_positions_shape_the_hold_out_in_place_of_test_rows() -> None:
    rng = np.random.default_rng(0)
    tx_pos_m = np.column_stack([rng.uniform(0, 40, (400, 2)), np.full(400, 1.5)])
    rows = np.arange(400)
    wanted_m = np.add(tx_pos_m[:50], [0, 0, 3.0])
    split = Split("made", 0, rows[80:], rows[:0], rows[:80])
    fold, by_test = (hold_out(record_of(tx_pos_m), each) for each in (replace(split, wanted_m=wanted_m), split))
    assert fold is not None
    assert by_test is not None
    assert away_m(tx_pos_m, fold.test, fold.all_train) > 1.5 * away_m(tx_pos_m, by_test.test, by_test.all_train)
