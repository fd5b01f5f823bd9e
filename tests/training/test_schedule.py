"""The plan of a fit: rows, receivers, rates and rounds of density control of every step."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from wrf_mi.core import InputError, Split
from wrf_mi.core.settings import with_settings
from wrf_mi.training.adam import density_rounds, schedule_of
from wrf_mi.training.config import TrainConfig


def split_of(train, validation=3):
    """Rows whose numbers are not their places."""
    rows = np.random.default_rng(0).permutation(3 * (train + validation + 2))
    parts = np.split(rows[: train + validation + 2], [train, train + validation])
    return Split("own", 0, np.sort(parts[0]), np.sort(parts[1]), np.sort(parts[2]))


def plan_of(split, receivers=1, *settings, **values):
    config = with_settings(TrainConfig(**values), settings)
    rng, rounds = np.random.default_rng([config.seed, 1]), density_rounds(config.density, config.steps)
    return schedule_of(config, [split.train] * receivers, [split.all_train] * receivers, rng, rounds)


@given(
    st.integers(1, 12), st.integers(0, 4), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3), st.integers(0, 99)
)
def test_each_epoch_visits_each_row_at_each_receiver_once(batches, validation, batch, receivers, epochs, seed):
    split, per_epoch = split_of(batches * batch, validation), receivers * batches
    steps = epochs * per_epoch
    schedule = plan_of(split, receivers, batch=batch, steps=steps, holdout_steps_fraction=1.0, seed=seed)
    assert schedule.rows.shape == (steps, batch)
    for start in range(0, steps, per_epoch):
        epoch = slice(start, start + per_epoch)
        pairs = zip(schedule.rows[epoch], schedule.receiver[epoch], strict=True)
        visits = Counter((row, r) for rows, r in pairs for row in rows)
        assert visits == Counter((row, r) for row in split.train for r in range(receivers))


@given(train=st.integers(3, 20), batch=st.integers(2, 3), seed=st.integers(0, 99))
def test_batches_have_distinct_rows(train, batch, seed):
    """Where the batch does not divide the rows too; each of them is visited then as well."""
    schedule = plan_of(split_of(train), 2, batch=batch, steps=40, seed=seed)
    assert schedule.rows.shape == (40, batch)
    assert all(len(set(rows)) == batch for rows in schedule.rows)
    split = split_of(7)
    assert set(plan_of(split, 1, batch=3, steps=40, holdout_steps_fraction=1.0).rows.ravel()) == set(split.train)


@given(fraction=st.floats(0, 1), steps=st.integers(1, 200), receivers=st.integers(1, 3), seed=st.integers(0, 99))
@example(1.0, 100, 1, 0)
@example(0.0, 100, 1, 0)
def test_schedule_holds_out_validation_and_excludes_test_rows(fraction, steps, receivers, seed):
    split = split_of(9, 3)
    schedule = plan_of(split, receivers, steps=steps, holdout_steps_fraction=fraction, seed=seed)
    assert schedule.joined == round(fraction * steps)
    assert not np.isin(schedule.rows[: schedule.joined], split.validation).any()
    assert not np.isin(schedule.rows, split.test).any()
    assert np.isin(schedule.rows, split.all_train).all()
    after = schedule.rows[schedule.joined :]
    assert len(after) < 12 * receivers or np.isin(split.validation, after).all()


def test_plan_depends_on_settings_split_and_seed_alone():
    split = split_of(20)
    first = plan_of(split, 2, steps=90, seed=4)
    np.random.default_rng().random()  # nothing global is drawn from
    again, other = (plan_of(split, 2, steps=90, seed=seed) for seed in (4, 5))
    for values, repeated in zip(dataclasses.astuple(first), dataclasses.astuple(again), strict=True):
        np.testing.assert_array_equal(values, repeated)
    assert not np.array_equal(first.rows, other.rows)
    assert not np.array_equal(first.receiver, other.receiver)
    rows = plan_of(split_of(30), 1, steps=60, holdout_steps_fraction=1.0).rows
    assert not np.array_equal(rows[:30], rows[30:])  # epochs differ in order


def test_rates_warm_up_and_fall_as_a_cosine():
    steps, final = 1000, 0.05
    factor = plan_of(split_of(9), 1, "optimiser.warm_up=100", f"optimiser.final={final}", steps=steps).factor
    assert factor.shape == (steps,)
    t = np.arange(steps)
    cosine = final + (1 - final) * (1 + np.cos(np.pi * t / steps)) / 2
    np.testing.assert_allclose(factor[100:], cosine[100:])
    np.testing.assert_allclose(factor[:100], cosine[:100] * (t[:100] + 1) / 100)
    assert factor[0] == pytest.approx(0.01)  # never nothing: the first step counts
    assert (np.diff(factor[99:]) < 0).all()
    assert factor[-1] == pytest.approx(final, abs=1e-4)
    assert plan_of(split_of(9), 1, "optimiser.warm_up=0", steps=50).factor[0] == 1.0


def test_running_mean_discards_starting_values():
    """Decay rises from 1/10 to the setting: the starting values' share of the mean is soon nothing."""
    decay = plan_of(split_of(9), 1, "optimiser.ema_decay=0.99", steps=3000).decay
    assert decay[0] == pytest.approx(0.1)
    assert (np.diff(decay) >= 0).all()
    assert decay.max() == 0.99
    assert np.prod(decay[:20]) < 1e-6
    assert not plan_of(split_of(9), 1, "optimiser.ema_decay=0", steps=30).decay.any()


@pytest.mark.parametrize(
    ("change", "steps", "rounds"),
    [
        *(("density.every=100", 1000, {100, 200, 300, 400, 500}), ("density.start=0.15", 1000, {200, 300, 400, 500})),
        ("density.every=0", 1000, set()),
        ("density.stop=1", 300, {100, 200}),  # a round after the last step would change what was trained
    ],
)
def test_rounds_of_density_control(change, steps, rounds):
    settings = ["density.every=100", "density.start=0.1", "density.stop=0.5", change]
    assert plan_of(split_of(9), 1, *settings, steps=steps).density == rounds


def test_rates_are_constant_before_the_cosine():
    factor = plan_of(split_of(9), 1, "optimiser.warm_up=0", "optimiser.cosine_start=0.6", steps=50).factor
    np.testing.assert_array_equal(factor[:31], 1)
    final = TrainConfig().optimiser.final
    np.testing.assert_allclose(factor[40], (1 + final) / 2)
    assert (np.diff(factor[30:]) < 0).all()
    assert (plan_of(split_of(9), 1, "optimiser.warm_up=0", "optimiser.cosine_start=1", steps=50).factor == 1).all()


def test_a_batch_is_no_larger_than_the_rows_of_any_receiver():
    assert plan_of(split_of(3, 2), 1, "batch=4", steps=10).rows.shape == (10, 3)
    assert plan_of(split_of(3, 1), 1, "batch=5", "holdout_steps_fraction=0", steps=10).rows.shape == (10, 4)
    rows = [np.array([4, 7, 9]), np.array([1, 2, 3, 5, 6, 8])]
    config = with_settings(TrainConfig(batch=5, steps=9), ["holdout_steps_fraction=1"])
    schedule = schedule_of(config, rows, rows, np.random.default_rng(0))
    assert schedule.rows.shape == (9, 3)
    # An epoch has one batch of the first receiver and two of the second, each of its own rows.
    for three in range(0, 9, 3):
        owner = schedule.receiver[three : three + 3]
        assert sorted(owner) == [0, 1, 1]
        for number, batch in zip(owner, schedule.rows[three : three + 3], strict=True):
            assert set(batch) <= set(rows[number])
    with pytest.raises(InputError, match="no training row at one receiver beside 1 validation rows"):
        plan_of(split_of(0, 1), 1, steps=10)


def test_without_hold_out_validation_rows_train_from_step_zero():
    split = split_of(0, 4)
    rows = plan_of(split, 1, steps=10, batch=4, holdout_steps_fraction=0.0).rows
    np.testing.assert_array_equal(np.sort(rows, axis=1), np.tile(split.validation, (10, 1)))
