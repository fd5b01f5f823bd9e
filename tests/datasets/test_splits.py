"""Splits: every row once, seeded, nested, stored; and the errors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import error_line, refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.cluster.vq import kmeans2

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.array_files import write_arrays
from wrf_mi.core.stored import to_arrays
from wrf_mi.datasets import load_split, make_splits, save_split
from wrf_mi.datasets.splits import SPLIT_FORMAT, position_folds

RULES = ("official", "random", "blocked", "trajectory")


def make_record(rows: int = 50, folds: bool = True) -> Record:
    """Any task will do: here one number per receiver and row."""
    rng = np.random.default_rng(3)
    blobs = np.arange(rows) * 5 // rows
    order = rng.permutation(rows)
    return Record(
        name="made-up",
        task="rssi",
        tx_pos_m=np.stack([10.0 * blobs, np.zeros(rows), np.zeros(rows)], axis=-1) + rng.uniform(-1, 1, (rows, 3)),
        receivers=(Receiver("gateway1", np.zeros(3), np.array([0.0, 0, 0, 1])),),
        observation=np.zeros((1, rows), np.float32),
        official=(order[rows // 4 :], order[: rows // 4]),
        folds=blobs if folds else None,
    )


def assert_partition(split: Split, rows: int, all_rows: bool = True) -> None:
    parts = [split.train, split.validation, split.test]
    together = np.concatenate(parts)
    assert len(np.unique(together)) == len(together), "a row is used twice"
    assert set(together) <= set(range(rows))
    assert not all_rows or len(together) == rows
    assert all(part.dtype == np.int64 and (np.diff(part) > 0).all() for part in parts), "rows are not sorted"


def assert_same(read: Split, split: Split) -> None:
    np.testing.assert_equal(vars(read), vars(split))


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("folds", [True, False])
def test_every_row_is_in_exactly_one_part(rule: str, folds: bool):
    for split in make_splits(make_record(folds=folds), rule, seed=1):
        assert_partition(split, 50)


def test_split_rules_select_the_stated_rows():
    record = make_record()
    (official,) = make_splits(record, "official")
    np.testing.assert_array_equal(official.test, np.sort(record.official[1]))
    np.testing.assert_array_equal(official.all_train, np.sort(record.official[0]))
    (random,) = make_splits(record, "random", seed=4)
    assert (len(random.all_train), len(random.test)) == (40, 10)
    (trajectory,) = make_splits(record, "trajectory", seed=4)
    assert trajectory.test.tolist() == list(range(40, 50))
    assert trajectory.all_train.tolist() == list(range(40))
    blocked = make_splits(record, "blocked")
    assert [split.name for split in blocked] == [f"blocked:{k}" for k in range(5)]
    for k, split in enumerate(blocked):
        np.testing.assert_array_equal(split.test, np.flatnonzero(record.folds == k))
    (third,) = make_splits(record, "blocked:2")
    assert_same(third, blocked[2])
    # Without a file of folds blocks are the clusters of positions.
    clusters = {tuple(split.test) for split in make_splits(replace(record, folds=None), "blocked")}
    assert clusters == {tuple(split.test) for split in blocked}


def test_blocks_are_the_tightest_of_several_starts():
    """Of clusters that could be cut in many ways, ours is among the tightest quarter."""
    positions = np.random.default_rng(2).uniform(size=(300, 3))
    record = replace(make_record(300), tx_pos_m=positions, folds=None)

    def spread(labels: np.ndarray) -> float:
        return sum(positions[labels == k].var(axis=0).sum() * (labels == k).sum() for k in range(5))

    starts = [spread(kmeans2(positions, 5, iter=50, minit="++", rng=seed)[1]) for seed in range(100, 130)]
    assert spread(position_folds(record)) <= np.percentile(starts, 25)


def several_carriers(official: bool) -> Record:
    """50 positions at three carriers."""
    record = make_record()
    tests = np.concatenate([record.official[1] + 50 * number for number in range(3)])
    return replace(
        record,
        tx_pos_m=np.tile(record.tx_pos_m, (3, 1)),
        observation=np.zeros((1, 150), np.float32),
        carriers_hz=np.repeat([5e9, 1e9, 2e9], 50),
        official=(np.setdiff1d(np.arange(150), tests), tests) if official else None,
        folds=None,
    )


@pytest.mark.parametrize("official", [True, False])
def test_carriers_and_positions_are_held_out_together(official: bool):
    record = several_carriers(official)
    splits, known_splits = (make_splits(record, name, seed=2) for name in ("frequency", "frequency-known"))
    assert [split.name for split in splits] == ["frequency:0", "frequency:1", "frequency:2"]
    for split, beside, carrier_hz in zip(splits, known_splits, [1e9, 2e9, 5e9], strict=True):
        assert_partition(split, 150, all_rows=False)
        assert (record.carriers_hz[split.test] == carrier_hz).all()
        assert carrier_hz not in record.carriers_hz[split.all_train]
        places, trained = (set(map(tuple, record.tx_pos_m[rows])) for rows in (split.test, split.all_train))
        assert len(places) == (12 if official else 10)
        assert not places & trained
        np.testing.assert_array_equal(beside.test, split.test)
        np.testing.assert_array_equal(beside.all_train, np.flatnonzero(record.carriers_hz != carrier_hz))
    if official:
        assert set(np.concatenate([split.test for split in splits])) == set(record.official[1])
    (second,) = make_splits(record, "frequency:1", seed=2)
    assert_same(second, splits[1])


def several_receivers(count: int, official: bool = True) -> Record:
    """50 positions; each receiver misses a row in ten, and the last one the rows from 20 on."""
    record = make_record()
    observation = np.zeros((count, 50), np.float32)
    observation[np.arange(50) % 10 == np.arange(count)[:, None] % 10] = np.nan
    observation[-1, 20:] = np.nan
    receivers = tuple(replace(record.receivers[0], name=f"gateway{number}") for number in range(count))
    return replace(record, receivers=receivers, observation=observation, official=record.official if official else None)


@pytest.mark.parametrize(("count", "folds"), [(3, 3), (16, 4)])
@pytest.mark.parametrize("official", [True, False])
def test_each_receiver_is_held_out_once(count: int, folds: int, official: bool):
    record = several_receivers(count, official)
    splits = make_splits(record, "receiver", seed=3)
    assert [split.name for split in splits] == [f"receiver:{k}" for k in range(folds)]
    assert sorted(sum((split.held_receivers for split in splits), ())) == list(range(count))
    (base,) = make_splits(record, "official" if official else "random", seed=3)
    received = np.isfinite(record.observation)
    for split in splits:
        held_receivers = list(split.held_receivers)
        others = np.setdiff1d(np.arange(count), held_receivers)
        assert abs(len(held_receivers) - count / folds) < 1
        np.testing.assert_array_equal(split.test, base.test[received[held_receivers][:, base.test].any(axis=0)])
        np.testing.assert_array_equal(split.all_train, base.all_train[received[others][:, base.all_train].any(axis=0)])
    (second,) = make_splits(record, "receiver:1", seed=3)
    assert_same(second, splits[1])


def test_rows_are_left_to_held_out_receivers():
    record = several_receivers(3)
    (few,), (more,), (none,) = (make_splits(record, f"receiver{left}:1", seed=3) for left in ("+5", "+20", ""))
    for split, count in ((few, 5), (more, 20)):
        assert split.held_receivers == (1,)
        np.testing.assert_array_equal(split.left[:, 0], np.ones(count))
        assert np.isin(split.left[:, 1], split.all_train).all()
        np.testing.assert_array_equal(split.all_train, none.all_train)
        observed = record.seen(split).observation
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(observed[1])), split.left[:, 1])
        np.testing.assert_array_equal(observed[[0, 2]], record.observation[[0, 2]])
    assert set(few.left[:, 1]) < set(more.left[:, 1])


@pytest.mark.parametrize("rule", RULES)
def test_rows_that_no_receiver_received_are_left_out(rule: str):
    record = make_record()
    observation = np.repeat(record.observation, 2, axis=0)
    observation[:, [3, 17, 40]] = np.nan
    observation[0, 20:30] = np.nan  # received by the other
    heard = replace(record, receivers=record.receivers * 2, observation=observation)
    for split in make_splits(heard, rule):
        assert sorted([*split.all_train, *split.test]) == sorted({*range(50)} - {3, 17, 40})


def test_a_part_that_was_not_received_at_all_is_refused():
    record = make_record()
    observation = record.observation.copy()
    observation[:, record.folds == 2] = np.nan
    deaf = replace(record, observation=observation)
    refusal(make_splits, deaf, "blocked", "split blocked:2: no row that was received scores; use another split")
    assert len(make_splits(deaf, "blocked:1")[0].test) == 10
    observation[:] = np.nan
    refusal(make_splits, deaf, "random", "0 rows")
    refusal(make_splits, deaf, "official", "split official: no row that was received trains")


def test_splits_depend_on_the_seed():
    record = make_record(200, folds=False)
    for rule in ("random", "trajectory"):
        again, same, other = (make_splits(record, rule, seed=seed)[0] for seed in (5, 5, 6))
        np.testing.assert_array_equal(again.validation, same.validation)
        assert set(again.validation.tolist()) != set(other.validation.tolist())
    first, second = (make_splits(record, "random", seed=seed)[0] for seed in (5, 6))
    assert set(first.test.tolist()) != set(second.test.tolist())
    # The blocks belong to the data: no seed moves them.
    blocks, same_blocks = ([split.test for split in make_splits(record, "blocked", seed=seed)] for seed in (5, 6))
    np.testing.assert_equal(blocks, same_blocks)


RUNS = np.array(["tuesday"] * 20 + ["monday", "10"] * 15)


def test_runs_are_held_out_in_the_order_of_their_first_rows():
    record = replace(make_record(), runs=RUNS)
    splits = make_splits(record, "other-run")
    assert [split.name for split in splits] == ["other-run:0", "other-run:1", "other-run:2"]
    for split, run in zip(splits, ("tuesday", "monday", "10"), strict=True):
        assert_partition(split, 50)
        np.testing.assert_array_equal(split.test, np.flatnonzero(record.runs == run))
    (second,) = make_splits(record, "other-run:1", n_train=12)
    np.testing.assert_array_equal(second.test, splits[1].test)
    assert len(second.all_train) == 12


FRACTIONS = st.sampled_from([0, 0.1, 0.15, 0.5, 0.9])
SEEDED = st.sampled_from(["official", "random", "trajectory"])


@settings(max_examples=60, deadline=None)
@given(st.integers(5, 120), st.integers(1, 100), st.integers(1, 100), FRACTIONS, st.integers(0, 2**32 - 1), SEEDED)
def test_subsets_are_nested_validation_included(rows, smaller, larger, fraction, seed, rule):
    record = make_record(rows)
    full_split = make_splits(record, rule, seed, validation_fraction=fraction)[0]
    counts = sorted(min(count, len(full_split.all_train)) for count in (smaller, larger))
    few, many = (make_splits(record, rule, seed, count, fraction)[0] for count in counts)
    for split, count in zip((few, many), counts, strict=True):
        assert_partition(split, rows, all_rows=False)
        assert len(split.all_train) == count
        assert len(split.train) >= 1
        assert len(split.validation) == int(np.ceil(round((count - 1) * fraction, 9)))
        np.testing.assert_array_equal(split.test, full_split.test)
    assert set(few.train) <= set(many.train) <= set(full_split.train)
    assert set(few.validation) <= set(many.validation) <= set(full_split.validation)


@pytest.mark.parametrize(
    ("options", "part", "count"),
    [
        ({"n_train": 0.25}, "all_train", 20),
        ({"n_train": 1.0}, "all_train", 80),
        ({"n_train": 1}, "all_train", 1),
        ({}, "validation", 8),
        ({"validation_fraction": 0}, "validation", 0),
        ({"n_train": 31}, "validation", 3),  # 30 * 0.1 is a little above 3 in floating point
    ],
)
def test_fractions_count_from_the_rows_of_each_split(options: dict, part: str, count: int):
    (split,) = make_splits(make_record(100), "random", **options)
    assert len(getattr(split, part)) == count


RECORD, RECEIVERS = make_record(), several_receivers(3)
NOWHERE = replace(several_carriers(False), tx_pos_m=np.full((150, 3), np.nan))
ONE_PLACE = replace(make_record(folds=False), tx_pos_m=np.full((50, 3), 2.0))
NO_RUNS = r"made-up: split other-run .* {}; give a column run .* with two"


@pytest.mark.parametrize(
    ("record", "arguments", "message"),
    [
        (RECORD, {"name": "authors"}, "'authors': unknown"),
        (RECORD, {"name": ""}, "unknown"),
        (RECORD, {"name": "blocked:5"}, "no such fold.*blocked:0 to blocked:4"),
        (RECORD, {"name": "receiver"}, "one receiver, and split receiver holds receivers out"),
        (RECORD, {"name": "frequency"}, "split frequency holds out carriers, and these data have one"),
        (RECORD, {"n_train": 0}, "n_train 0; choose 1 to 40 rows"),
        (RECORD, {"n_train": 1.5}, "n_train 1.5"),
        (RECORD, {"seed": -1}, "seed -1"),
        (RECORD, {"validation_fraction": 1.0}, "validation fraction"),
        (RECORD, {"name": "other-run"}, NO_RUNS.format("state none")),
        (replace(RECORD, runs=np.full(50, "a")), {"name": "other-run"}, NO_RUNS.format("have one")),
        (replace(RECORD, runs=RUNS), {"name": "other-run:3"}, "no such fold; made-up has other-run:0 to other-run:2"),
        (replace(RECORD, official=None), {"name": "official"}, "no official split"),
        (make_record(4, folds=False), {"name": "blocked"}, "4 distinct positions"),
        (ONE_PLACE, {"name": "blocked"}, "all of 50 rows are at one place; measure at more places$"),
        (make_record(1), {"name": "random"}, "all of 1 rows are at one place; measure at more places$"),
        (make_record(1, folds=False), {"name": "none"}, "all of 1 rows are at one place; measure at more places$"),
        (NOWHERE, {"name": "frequency"}, "positions are not known, which this split holds out"),
        (RECEIVERS, {"name": "receiver+30:2"}, r"gateway2 received 14 of the training rows, and .*\+30:2 leaves it 30"),
        *(
            (RECEIVERS, {"name": wrong}, r"unknown; choose .*receiver\+20")
            for wrong in ("receiver+0", "receiver+", "receiver+x:1", "blocked+5", "receiver+-1")
        ),
    ],
)
def test_bad_arguments_and_records_that_cannot_follow_a_rule_are_refused(record: Record, arguments: dict, message: str):
    error_line(make_splits, record, message, **{"name": "random"} | arguments)


@pytest.mark.parametrize("name", ["blocked:1", "receiver:2", "receiver+5:1"])
def test_a_split_is_stored_with_arrays_only(name: str, tmp_path: Path):
    (split,) = make_splits(RECORD if name == "blocked:1" else RECEIVERS, name, seed=8)
    path = tmp_path / "run" / "split.npz"
    save_split(path, split)
    assert_same(load_split(path), split)
    assert [entry.name for entry in path.parent.iterdir()] == ["split.npz"]
    with np.load(path, allow_pickle=False) as file:
        assert {"format", "name", "seed", "test", "train", "validation"} <= set(file)


def test_bad_split_files_are_refused(tmp_path: Path):
    path = tmp_path / "split.npz"
    refusal(load_split, path, "missing")
    path.write_text("no npz")
    refusal(load_split, path, "not readable")
    np.savez(path, train=np.arange(3))
    refusal(load_split, path, "not readable")
    rows = np.arange(3)
    full_split = Split("a", 0, rows, rows + 3, rows + 6)
    head: dict[str, Any] = {"format": SPLIT_FORMAT, **to_arrays(full_split)}
    for wrong, message in (
        ({"validation": rows, "test": rows + 3}, "twice"),
        ({"validation": rows + 3, "test": rows - 9}, "whole numbers"),
        ({"validation": rows + 3.5, "test": rows + 9}, "whole numbers"),
        ({"validation": rows + 3, "test": rows + 9, "format": 9}, "format 9, not"),
    ):
        write_arrays(path, head | wrong)
        refusal(load_split, path, message)
    (split,) = make_splits(RECEIVERS, "receiver+5:1")
    save_split(path, replace(split, left=split.left - np.array([1, 0])))
    refusal(load_split, path, "leaves rows that no held-out receiver trains on")
