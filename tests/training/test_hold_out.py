"""Held-out rows of strengths and validation rows of Gaussians: as far from training rows as test rows are."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_spectra import RECEIVERS, spectra
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from small_fits import settings as quick

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.tasks.scores import ssim
from wrf_mi.training.fit_plan import FitPlan
from wrf_mi.training.selection import FAR_POSITIONS, HELD_OUT, HeldOut, cells, hold_out, hold_out_far
from wrf_mi.training.trainer import Trainer

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


def walk(count: int) -> np.ndarray:
    """Positions [count, 3] along a closed curve, metres."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.column_stack([np.sin(2 * turn), 2 * np.cos(turn), 0.2 * np.sin(3 * turn)])


def nearest_m(tx_pos_m: np.ndarray, rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    return cdist(tx_pos_m[rows], tx_pos_m[known]).min(axis=1)


def blocked(tx_pos_m: np.ndarray, test: np.ndarray, seed: int = 0) -> Split:
    """A split with a tenth of the other rows for validation."""
    others = np.random.default_rng(seed).permutation(np.setdiff1d(np.arange(len(tx_pos_m)), test))
    count = max(1, len(others) // 10)
    return Split("blocked", 0, np.sort(others[count:]), np.sort(others[:count]), test)


@given(count=st.integers(30, 150), share=st.floats(0.02, 0.3), repeats=st.integers(1, 3), seed=st.integers(0, 999))
@settings(max_examples=60, deadline=None)
def test_some_validation_rows_are_as_far_from_training_rows_as_test_rows(count, share, repeats, seed):
    """Positions may repeat."""
    tx_pos_m = np.repeat(walk(count), repeats, axis=0)
    split = blocked(tx_pos_m, np.arange(round(share * count) * repeats), seed)
    far = hold_out_far(split, tx_pos_m)
    np.testing.assert_array_equal(far.all_train, split.all_train)
    np.testing.assert_array_equal(far.test, split.test)
    assert not len(np.intersect1d(far.train, far.validation))
    assert np.isin(split.validation, far.validation).all()
    moved = len(split.train) - len(far.train)
    assert moved <= HELD_OUT * len(split.train)
    away_m = nearest_m(tx_pos_m, far.validation, far.train)
    is_far = away_m >= np.median(nearest_m(tx_pos_m, split.test, split.all_train))
    if moved:
        assert len(np.unique(tx_pos_m[far.validation[is_far]], axis=0)) >= FAR_POSITIONS


@pytest.mark.parametrize(
    ("rows", "test", "beyond_m"),
    [(200, np.arange(0, 200, 5), 0), (12, np.arange(4), 0), (200, np.arange(20), 50), (200, np.zeros(0, int), 0)],
    ids=["near test rows", "few rows", "test rows beyond all others", "no test rows"],
)
def test_split_stays_where_no_rows_have_to_move_or_too_many(rows, test, beyond_m):
    tx_pos_m = walk(rows)
    tx_pos_m[test] += beyond_m
    split = blocked(tx_pos_m, test)
    assert hold_out_far(split, tx_pos_m) is split


def test_split_without_validation_rows_keeps_all_training_rows():
    tx_pos_m = walk(200)
    split = blocked(tx_pos_m, np.arange(20))
    every = replace(split, train=split.all_train, validation=split.validation[:0])
    assert hold_out_far(every, tx_pos_m) is every


@pytest.fixture
def walked() -> tuple[Record, Split]:
    """Spectra at 60 positions of a walk, the first tenth of which is predicted."""
    record = spectra(rows=60)[0]
    record = replace(record, tx_pos_m=walk(60))
    return record, blocked(record.tx_pos_m, np.arange(6))


@pytest.mark.all_threads
def test_score_in_training_is_that_of_rows_held_out_as_far_as_test_rows(walked):
    record, split = walked
    received = []
    trainer = Trainer(record, split, quick("steps=40", "holdout_steps_fraction=0.5", "validate_every=20"))
    held_out, joined = trainer.plan.selection, trainer.schedule.joined
    moved = np.setdiff1d(held_out.validation, split.validation)
    assert len(moved)
    assert not np.isin(trainer.schedule.rows[:joined], held_out.validation).any()
    assert np.isin(trainer.schedule.rows[joined:], moved).any()

    def compare(progress):
        if progress.step == joined:
            rows, at_m = held_out.validation, record.tx_pos_m
            test_m = np.median(nearest_m(at_m, split.test, split.all_train))
            far = nearest_m(at_m, rows, held_out.train) >= test_m
            score = ssim(trainer.predictor()(at_m[rows]), record.observation[0, rows])
            assert (progress.validation_rows, progress.far_rows) == (len(rows), far.sum())
            assert progress.far_rows >= FAR_POSITIONS
            assert progress.test_m == pytest.approx(test_m)
            assert progress.far_score == pytest.approx(np.median(score[far]), abs=1e-5)
            assert progress.validation_score == pytest.approx(np.median(score), abs=1e-5)
        received.append(progress)

    trainer.run(compare)
    assert {p.step for p in received if p.far_score is not None and p.held_out} == {joined}


def test_no_receiver_loses_its_batches_to_far_validation_rows():
    """The second receiver received what is held out, and of the other rows a single one."""
    tx_pos_m = walk(60)
    split = blocked(tx_pos_m, np.arange(6))
    far = hold_out_far(split, tx_pos_m)
    strengths = np.full((2, 60), -50, np.float32)
    strengths[1, far.train[1:]] = np.nan
    both = Record("made-here", "rssi", tx_pos_m, RECEIVERS, strengths, frequencies_hz=np.array([2.4e9]))
    for batch, train in ((4, split.train), (1, far.train)):
        np.testing.assert_array_equal(FitPlan(both, split, quick(f"batch={batch}")).selection.train, train)
    every = replace(both, receivers=RECEIVERS[:1], observation=strengths[:1])
    np.testing.assert_array_equal(FitPlan(every, split, quick("batch=4")).selection.train, far.train)


def test_runs_are_held_out_where_other_runs_are_predicted() -> None:
    rng = np.random.default_rng(0)
    runs = np.repeat(list("abcdefgh"), 30)
    record = replace(record_of(rng.uniform(0, 20, (240, 3))), runs=runs)
    rows = np.arange(240)
    fold = hold_out(record, Split("made", 0, rows[:180], rows[:0], rows[180:]))
    assert fold is not None
    assert not {*runs[fold.test]} & {*runs[fold.all_train]}
    assert 0.1 < len(fold.test) / 180 <= 0.5
    held_out = HeldOut.of(record, fold, 0)
    assert all(len({*held_out.group[runs[held_out.row] == run]}) == 1 for run in np.unique(runs[fold.test]))
    # A run of one row alone is no hold-out, and where held-out runs were heard by nobody who trains, places are.
    short = replace(record, runs=np.repeat(["x", "y", "z", "w"], [1, 89, 90, 60]))
    for seed in range(6):
        fold = hold_out(short, Split("made", seed, rows[:180], rows[:0], rows[180:]))
        assert fold is not None
        assert len(fold.test) > 20
    # Runs that train are predicted, or too few train: by place.
    for split in (Split("made", 0, rows[::2], rows[:0], rows[1::2]), Split("made", 0, rows[:60], rows[:0], rows[180:])):
        fold = hold_out(record, split)
        assert fold is not None
        assert {*runs[fold.test]} & {*runs[fold.all_train]}
