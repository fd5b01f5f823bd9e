"""How far from training rows Gaussians correct paths, and channels of zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from traced_rooms import SHOEBOX, write_xml

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.settings import with_settings
from wrf_mi.tracing import open_scene
from wrf_mi.training.by_distance import Reach, choose_reach
from wrf_mi.training.config import default_config
from wrf_mi.training.selection import hold_out_groups
from wrf_mi.training.trainer import Trainer

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ORIGIN = (np.zeros((1, 3)),)
SMALL = ("steps=60", "validate_every=20", "initial.gaussians=12", "network.width=16", "network.layers=2", "batch=8")
FLOAT32 = 1e-5
"""Relative, of sums in single precision."""


def at(*distances_m: float) -> np.ndarray:
    return np.array([[0.0, distance, 0.0] for distance in distances_m])


def test_weight_is_a_gaussian_of_the_distance_from_the_nearest_known_transmitter() -> None:
    two = Reach((np.array([[0.0, 0, 0], [0, 3.0, 0]]),), 0.5)
    expected = np.exp(-np.square([0, 0.5, 1.5, 0.2]) / 0.25)
    np.testing.assert_allclose(two.weight(at(0, 0.5, 1.5, 2.8), 0), expected, rtol=FLOAT32)
    assert (two.weight(at(10.0), 0) == 0).all()  # and where it is negligible, none


def test_reach_of_zero_and_infinity_give_weights_zero_and_one() -> None:
    places = at(0, 0.1, 1e6)
    assert not Reach(ORIGIN, 0.0).weight(places, 0).any()
    assert (Reach(ORIGIN, np.inf).weight(places, 0) == 1).all()


def test_receiver_without_observations_has_weight_zero() -> None:
    assert not Reach((np.zeros((0, 3)),), 1.0).weight(at(0, 1), 0).any()


@given(st.floats(0.01, 100), st.floats(0.01, 100), st.floats(0, 100))
def test_weight_rises_with_the_reach(one: float, other: float, distance: float) -> None:
    low, high = (float(Reach(ORIGIN, r).weight(at(distance), 0)[0]) for r in sorted((one, other)))
    assert 0 <= low <= high <= 1


@given(st.integers(2, 80), st.integers(0, 20), st.integers(0, 99))
@example(20, 14, 20)  # a cluster of most rows
def test_held_out_groups_keep_training_rows(train: int, validation: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.permutation(train + validation + 5)
    split = Split("own", seed, np.sort(rows[:train]), np.sort(rows[train : train + validation]), np.sort(rows[-5:]))
    position = rng.normal(size=(len(rows), 3))
    held = hold_out_groups(split, position)
    assert len(held.train)
    assert set(split.validation) <= set(held.validation)
    assert sorted([*held.train, *held.validation]) == sorted([*split.train, *split.validation])
    again = hold_out_groups(split, position)
    np.testing.assert_array_equal(held.validation, again.validation)
    assert len(held.train) >= len(split.train) / 2


def test_held_out_groups_are_clusters_of_positions() -> None:
    """Rows of one cluster of ten are held out together, those of the others train."""
    centre = np.repeat(10.0 * np.arange(10), 8)
    position = np.stack([centre, 0 * centre, 0 * centre], 1) + np.random.default_rng(0).normal(0, 0.1, (80, 3))
    held = hold_out_groups(Split("own", 1, np.arange(80), np.empty(0, int), np.empty(0, int)), position)
    for cluster in np.arange(80).reshape(10, 8):
        assert len(set(cluster) & set(held.validation)) in (0, 8)
    assert 8 <= len(held.validation) <= 24


@pytest.mark.parametrize("higher_is_better", [True, False])
def test_reach_with_the_best_held_out_scores_is_chosen(higher_is_better: bool) -> None:
    """The truth is a correction that falls off within half a metre: weights of that reach have no error."""
    held = [at(*np.linspace(0.05, 1.0, 20))]
    reach = Reach(ORIGIN, 0.0)
    lengths = reach.lengths(held)
    truth = replace(reach, length_m=lengths[3]).weight(held[0], 0)

    def score(receiver: int, weight: Sequence[float]) -> np.ndarray:
        return np.abs(weight - truth) * (-1 if higher_is_better else 1)

    found, scores = choose_reach(reach, lengths, held, score, higher_is_better)
    assert found == lengths[3]
    assert not scores.any()


def test_reach_whose_gain_is_within_its_standard_error_is_not_chosen() -> None:
    """Gaussians that add noise of mean zero, and a gain of half its standard error."""
    held = [at(*np.linspace(0.05, 1.0, 40))]
    noise = np.random.default_rng(0).normal(0, 1, 40)
    noise += 0.5 * noise.std() / np.sqrt(40) - noise.mean()
    reach = Reach(ORIGIN, np.inf)
    assert choose_reach(reach, [0.0, np.inf], held, lambda r, weight: noise * weight, True)[0] == 0
    assert choose_reach(reach, [0.0, np.inf], held, lambda r, weight: (noise + 1) * weight, True)[0] == np.inf


def test_without_held_out_rows_the_reach_is_kept() -> None:
    found, scores = choose_reach(Reach(ORIGIN, 2.0), [0.0, 1.0], [np.zeros((0, 3))], lambda r, w: w, True)
    assert found == 2.0
    assert not len(scores)


def channels(channel: np.ndarray, position: np.ndarray) -> Record:
    receiver = (Receiver("rx", np.array([5.2, 2.4, 1.1]), UPRIGHT),)
    return Record("own", "csi", position, receiver, channel[None].astype(np.complex64), frequencies_hz=np.array([9e8]))


def test_channels_of_random_phase_are_predicted_as_zero() -> None:
    """Phases are independent from row to row: whatever is predicted for a new row is worse than nothing."""
    rng = np.random.default_rng(0)
    record = channels(np.exp(2j * np.pi * rng.random((60, 1))), rng.uniform(1, 4, (60, 3)))
    rows = np.arange(60)
    config = with_settings(default_config("csi"), SMALL)
    trainer = Trainer(record, Split("own", 0, rows[:40], rows[40:45], rows[45:]), config)
    trainer.run()
    assert trainer.state.reach_m == 0
    assert trainer.state.chosen
    assert not trainer.predictor()(record.tx_pos_m[45:]).any()


@pytest.fixture(scope="module")
def joint(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """A short fit of Gaussians beside the paths of a room, to channels of random phases."""
    scene = open_scene(write_xml(tmp_path_factory.mktemp("room"), SHOEBOX), 9e8)
    rng = np.random.default_rng(0)
    record = channels(np.exp(2j * np.pi * rng.random((60, 1))), rng.uniform([1.5, 2, 1], [2, 2.5, 1.5], (60, 3)))
    rows = np.arange(60)
    config = with_settings(default_config("csi", True), [*SMALL, "steps=20", "traced.depth=1", "traced.rays=4096"])
    trainer = Trainer(record, Split("own", 0, rows[:45], rows[45:50], rows[50:]), config, scene=scene)
    trainer.run()
    return trainer


FAR_M = np.array([[4.5, 3.5, 1.2]])


def test_far_from_training_rows_a_joint_fit_predicts_its_paths_alone(joint: Trainer) -> None:
    near_m = joint.plan.record.tx_pos_m[:1]
    joint.state.reach_m = 0.1
    predict = joint.predictor()
    near, far = predict(near_m), predict(FAR_M)
    joint.state.reach_m = 0.0
    predict = joint.predictor()
    np.testing.assert_allclose(far, predict(FAR_M), rtol=FLOAT32)
    assert np.abs(far).max() > 0
    assert np.abs(near - predict(near_m)).max() > 0


def test_gaussians_beyond_their_reach_are_not_evaluated(joint: Trainer) -> None:
    """Far from the training rows a joint fit launches the kernels of its paths alone."""

    def kernels(reach_m: float) -> int:
        joint.state.reach_m = reach_m
        predict = joint.predictor()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            predict(FAR_M)
            return len(dr.kernel_history([dr.KernelType.JIT]))

    far, everywhere = kernels(0.1), kernels(np.inf)
    assert far == kernels(0.0)
    assert far < everywhere


def test_too_few_rows_to_choose_a_reach_switch_gaussians_off(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = open_scene(write_xml(tmp_path, SHOEBOX), 9e8)
    position = np.random.default_rng(0).uniform([1.5, 2, 1], [2, 2.5, 1.5], (12, 3))
    record, rows = channels(np.ones((12, 1)), position), np.arange(12)
    config = with_settings(default_config("csi", True), [*SMALL, "steps=20", "traced.depth=1", "traced.rays=4096"])
    trainer = Trainer(record, Split("own", 0, rows[:6], rows[6:7], rows[7:]), config, scene=scene)
    trainer.run()
    assert trainer.state.reach_m == 0
    assert "6 training rows do not suffice to choose a reach" in caplog.text
    assert np.abs(trainer.predictor()(position[7:])).max() > 0


@pytest.mark.parametrize(("holdout_steps_fraction", "known"), [(0.7, 45), (1.0, None)])
def test_held_out_rows_do_not_extend_the_reach(holdout_steps_fraction: float, known: int | None) -> None:
    """Kept out to the end, held-out rows are judged by their distance from those that trained."""
    rng = np.random.default_rng(0)
    record, rows = channels(np.ones((60, 1)), rng.uniform(1, 2, (60, 3))), np.arange(60)
    config = with_settings(default_config("csi"), [*SMALL, f"holdout_steps_fraction={holdout_steps_fraction}"])
    trainer = Trainer(record, Split("own", 0, rows[:40], rows[40:45], rows[45:]), config)
    trainer.run()
    reach = trainer.reach()
    assert trainer.state.chosen
    assert reach is not None
    assert len(reach.known_m[0]) == (known or len(trainer.plan.choosing.train))
    assert len(trainer.plan.choosing.train) < 40
