"""Weights by distance on scores with a known best choice, and how far from training rows Gaussians correct paths."""

from dataclasses import replace
from functools import partial

import drjit as dr
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from traced_rooms import SHOEBOX, write_xml

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.settings import with_settings
from wrf_mi.tracing import open_scene
from wrf_mi.training.by_distance import FORMS, HeldOutScores, Reach, choose_reach, choose_weights
from wrf_mi.training.config import default_config
from wrf_mi.training.selection import hold_out_groups
from wrf_mi.training.trainer import Trainer

ROWS = 200
RNG = np.random.default_rng(0)
DISTANCE = RNG.uniform(0, 1, ROWS)
FOLD = np.arange(ROWS) % 5
EACH = np.arange(ROWS)


def errors_of(errors):
    """Minus the absolute weighted error of predictions with errors [k, q]."""
    return lambda weights, rows: -np.abs(np.einsum("qk,kq->q", weights, errors[:, rows]))


def chosen_of(errors, distance_m, fold, unit, trusted=None):
    scores = HeldOutScores(errors_of(errors), distance_m, unit, len(errors))
    return choose_weights(scores, fold, lambda share: None, trusted)[:2]


def chosen(errors):
    return chosen_of(errors, DISTANCE, FOLD, EACH)


def test_prediction_that_is_best_everywhere_has_all_the_weight_and_equal_ones_are_averaged():
    noise = RNG.normal(size=(3, ROWS))
    _, mixture = chosen(np.stack([noise[0], 0.01 * noise[1], noise[2]]))
    assert mixture(np.array([0.0, 0.5, 9.0])) == pytest.approx(np.tile([0.0, 1.0, 0.0], (3, 1)))
    _, mixture = chosen(RNG.normal(size=(2, ROWS)))
    assert mixture(np.array([0.5]))[0] == pytest.approx([0.5, 0.5], abs=0.2)


def test_equal_weights_hedge_where_few_rows_tell_predictions_apart_by_chance():
    """Over many draws of five held-out rows, weights that start equal are better on other rows than the best single."""
    better, five, others = [], np.arange(5), np.arange(5, 105)
    for seed in range(40):
        errors = np.random.default_rng(seed).normal(size=(3, 105))
        _, mixture = chosen_of(errors[:, :5], np.zeros(5), five, five)
        single = np.eye(3)[[np.argmin(np.abs(errors[:, :5]).mean(axis=1))] * 100]
        score = errors_of(errors)
        better.append((score(mixture(np.zeros(100)), others) - score(single, others)).mean())
    assert np.mean(better) > 0.15  # 0.2; the mean of three has 0.34 less error than each


def test_clearly_worse_predictions_have_no_share_in_a_mean():
    """Two predictions of equal errors among five of ten times these: held-out rows tell which to average."""
    errors = np.random.default_rng(4).normal(size=(7, 40)) * np.repeat([1.0, 10.0], [2, 5])[:, None]
    every = np.arange(40)
    weights = HeldOutScores(errors_of(errors), np.zeros(40), every, 7).averaged(every).weights[0]
    assert weights[2:].max() == 0
    assert weights[:2] == pytest.approx([0.5, 0.5], abs=0.25)


def test_a_trusted_prediction_is_left_where_rows_show_a_gain():
    """A common error hides in five rows that the trusted prediction is the best; two hundred show which is."""
    common, independent = np.random.default_rng(1).normal(size=(2, 3, ROWS))
    errors = 3 * common[:1] + independent * np.array([[0.1], [1.0], [1.0]])
    five = np.arange(5)
    few = [chosen_of(errors[:, k : k + 5], np.zeros(5), five, five, 0) for k in range(100)]
    assert sum(form == "single" for form, _ in few) > 50
    assert all(mixture(np.zeros(1))[0, 0] == 1 for form, mixture in few if form == "single")
    form, mixture = chosen_of(errors, DISTANCE, FOLD, EACH, 1)
    assert form != "single"
    assert mixture(np.array([0.5]))[0, 1] < 0.2


def test_weights_without_a_fold_are_not_chosen_by_its_rows():
    """Each fold alone is best predicted by the part that is worst elsewhere: the others never choose that one."""
    errors = np.ones((5, ROWS))
    errors[FOLD, EACH] = 0
    scores = HeldOutScores(errors_of(errors), DISTANCE, EACH, len(errors))
    _, _, without = choose_weights(scores, FOLD, lambda share: None)
    np.testing.assert_allclose(without.sum(axis=1), 1)
    assert (without[EACH, FOLD] < 1 / 5).all()


def test_copies_of_a_row_are_no_evidence():
    """Six receivers of each of five rows share its error: thirty observations are as good as five."""
    errors = np.random.default_rng(8).normal(size=(2, 5)) + np.array([[0.0], [0.3]])
    copied, rows = np.repeat(errors, 6, axis=1), np.repeat(np.arange(5), 6)
    once = chosen_of(errors, np.zeros(5), np.arange(5), np.arange(5), 1)
    again = chosen_of(copied, np.zeros(30), rows, rows, 1)
    assert once[0] == again[0] == "single"
    assert chosen_of(copied, np.zeros(30), rows, np.arange(30), 1)[0] != "single"


def test_weights_follow_the_distance():
    noise = RNG.normal(size=(2, ROWS))
    near, far = noise[0] * 5 * DISTANCE**2, noise[1]
    form, mixture = chosen(np.stack([near, far]))
    assert form == "by distance"
    assert mixture(np.array([0.0]))[0, 0] > 0.9
    assert mixture(np.array([1.0, np.inf]))[:, 1] == pytest.approx([1.0, 1.0], abs=0.3)
    assert mixture(DISTANCE).sum(axis=1) == pytest.approx(np.ones(ROWS))


def test_more_freedom_without_evidence_is_refused():
    rows = np.arange(4)
    errors = np.array([[1.0, 1.0, 1.0, 1.0], [0.9, 1.3, 0.9, 1.3]])
    form, mixture = chosen_of(errors, np.arange(4.0), rows, rows)
    assert form == "averaged"
    assert mixture(np.zeros(1))[0] == pytest.approx([1.0, 0.0], abs=0.1)


@pytest.mark.parametrize("form", FORMS)
def test_no_form_is_below_the_best_single_prediction_on_its_rows(form):
    errors = np.random.default_rng(3).normal(size=(4, ROWS)) * np.array([[1.0], [2.0], [1.5], [0.8]])
    score, every = errors_of(errors), np.arange(ROWS)
    mixture = FORMS[form](HeldOutScores(score, DISTANCE, every, 4), every)
    best = max(score(np.broadcast_to(weights, (ROWS, 4)), every).mean() for weights in np.eye(4))
    assert score(mixture(DISTANCE), every).mean() >= best - 1e-3


UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
ORIGIN = (np.zeros((1, 3)),)
SMALL = ("steps=60", "validate_every=20", "initial.gaussians=12", "network.width=16", "network.layers=2", "batch=8")
FLOAT32 = 1e-5  # Relative, of sums in single precision


def at(*distances_m):
    return np.array([[0.0, distance, 0.0] for distance in distances_m])


def test_weight_is_a_gaussian_of_the_distance_from_the_nearest_known_transmitter():
    two = Reach((np.array([[0.0, 0, 0], [0, 3.0, 0]]),), 0.5)
    expected = np.exp(-np.square([0, 0.5, 1.5, 0.2]) / 0.25)
    np.testing.assert_allclose(two.weight(at(0, 0.5, 1.5, 2.8), 0), expected, rtol=FLOAT32)
    assert (two.weight(at(10.0), 0) == 0).all()  # and where it is negligible, none


def test_reach_of_zero_and_infinity_give_weights_zero_and_one():
    places = at(0, 0.1, 1e6)
    assert not Reach(ORIGIN, 0.0).weight(places, 0).any()
    assert (Reach(ORIGIN, np.inf).weight(places, 0) == 1).all()
    assert not Reach((np.zeros((0, 3)),), 1.0).weight(places, 0).any()  # a receiver without observations


@given(st.integers(2, 80), st.integers(0, 20), st.integers(0, 99))
@example(20, 14, 20)  # a cluster of most rows
def test_held_out_groups_keep_training_rows(train, validation, seed):
    rng = np.random.default_rng(seed)
    parts = np.split(rng.permutation(train + validation + 5), [train, train + validation])
    split = Split("own", seed, np.sort(parts[0]), np.sort(parts[1]), np.sort(parts[2]))
    position = rng.normal(size=(train + validation + 5, 3))
    fold, again = hold_out_groups(split, position), hold_out_groups(split, position)
    assert len(fold.train) >= max(1, train / 2)
    assert set(split.validation) <= set(fold.validation)
    assert sorted([*fold.train, *fold.validation]) == sorted([*split.train, *split.validation])
    np.testing.assert_array_equal(fold.validation, again.validation)


def test_held_out_groups_are_clusters_of_positions():
    """Rows of one cluster of ten are held out together, those of the others train."""
    centre = np.repeat(10.0 * np.arange(10), 8)
    position = np.stack([centre, 0 * centre, 0 * centre], 1) + np.random.default_rng(0).normal(0, 0.1, (80, 3))
    fold = hold_out_groups(Split("own", 1, np.arange(80), np.empty(0, int), np.empty(0, int)), position)
    for cluster in np.arange(80).reshape(10, 8):
        assert len(set(cluster) & set(fold.validation)) in (0, 8)
    assert 8 <= len(fold.validation) <= 24


@pytest.mark.parametrize("higher_is_better", [True, False])
def test_reach_with_the_best_held_out_scores_is_chosen(higher_is_better):
    """The truth is a correction that falls off within half a metre: weights of that reach have no error."""
    positions, reach, sign = [at(*np.linspace(0.05, 1.0, 20))], Reach(ORIGIN, 0.0), -1 if higher_is_better else 1
    lengths = reach.lengths(positions)
    truth = replace(reach, length_m=lengths[3]).weight(positions[0], 0)
    choice = choose_reach(reach, lengths, lambda r: sign * np.abs(r.weight(positions[0], 0) - truth), higher_is_better)
    assert choice[0] == lengths[3]
    assert not choice[1].any()


def test_reach_whose_gain_is_within_its_standard_error_is_not_chosen():
    """Gaussians that add noise of mean zero, and a gain of half its standard error."""
    positions, noise = at(*np.linspace(0.05, 1.0, 40)), np.random.default_rng(0).normal(0, 1, 40)
    noise += 0.5 * noise.std() / np.sqrt(40) - noise.mean()
    for gain, chosen in ((0, 0), (1, np.inf)):
        score = partial(lambda gain, reach: (noise + gain) * reach.weight(positions, 0), gain)
        assert choose_reach(Reach(ORIGIN, np.inf), [0.0, np.inf], score, True)[0] == chosen


def channels(channel, position):
    receiver = (Receiver("rx", np.array([5.2, 2.4, 1.1]), UPRIGHT),)
    return Record("own", "csi", position, receiver, channel[None].astype(np.complex64), frequencies_hz=np.array([9e8]))


def of_gaussians(record, *settings):
    """A short fit without paths to the first 45 of 60 rows."""
    config = with_settings(default_config("csi"), [*SMALL, *settings])
    train, validation, test = np.split(np.arange(60), [40, 45])
    trainer = Trainer(record, Split("own", 0, train, validation, test), config)
    trainer.run()
    return trainer


def test_channels_of_random_phase_are_predicted_as_zero():
    """Phases are independent from row to row: whatever is predicted for a new row is worse than nothing."""
    rng = np.random.default_rng(0)
    record = channels(np.exp(2j * np.pi * rng.random((60, 1))), rng.uniform(1, 4, (60, 3)))
    trainer = of_gaussians(record)
    assert trainer.state.reach_m == 0
    assert trainer.state.chosen
    assert not trainer.predictor()(record.tx_pos_m[45:]).any()


def beside_paths(folder, record, *ends):
    """A short fit of Gaussians beside the paths of a room; its training, validation and test rows end there."""
    scene = open_scene(write_xml(folder, SHOEBOX), 9e8)
    train, validation, test = np.split(np.arange(len(record)), ends)
    config = with_settings(default_config("csi", True), [*SMALL, "steps=20", "traced.depth=1", "traced.rays=4096"])
    trainer = Trainer(record, Split("own", 0, train, validation, test), config, scene=scene)
    trainer.run()
    return trainer


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    """To channels of random phases."""
    rng = np.random.default_rng(0)
    record = channels(np.exp(2j * np.pi * rng.random((60, 1))), rng.uniform([1.5, 2, 1], [2, 2.5, 1.5], (60, 3)))
    return beside_paths(tmp_path_factory.mktemp("room"), record, 45, 50)


FAR_M = np.array([[4.5, 3.5, 1.2]])


def test_far_from_training_rows_a_joint_fit_predicts_its_paths_alone(joint):
    predictions = []
    for reach_m in (0.1, 0.0):
        joint.state.reach_m = reach_m
        predictions.append([joint.predictor()(place) for place in (joint.plan.record.tx_pos_m[:1], FAR_M)])
    (near, far), (near_paths, far_paths) = predictions
    np.testing.assert_allclose(far, far_paths, rtol=FLOAT32)
    assert np.abs(far).max() > 0
    assert np.abs(near - near_paths).max() > 0


def test_gaussians_beyond_their_reach_are_not_evaluated(joint):
    """Far from the training rows a joint fit launches the kernels of its paths alone."""
    kernels = {}
    for reach_m in (0.1, np.inf, 0.0):
        joint.state.reach_m = reach_m
        predict = joint.predictor()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            predict(FAR_M)
            kernels[reach_m] = len(dr.kernel_history([dr.KernelType.JIT]))
    assert kernels[0.1] == kernels[0.0] < kernels[np.inf]


def test_too_few_rows_to_choose_a_reach_switch_gaussians_off(tmp_path, caplog):
    position = np.random.default_rng(0).uniform([1.5, 2, 1], [2, 2.5, 1.5], (12, 3))
    trainer = beside_paths(tmp_path, channels(np.ones((12, 1)), position), 6, 7)
    assert trainer.state.reach_m == 0
    assert "6 training rows do not suffice to choose a reach" in caplog.text
    assert np.abs(trainer.predictor()(position[7:])).max() > 0


@pytest.mark.parametrize(("holdout_steps_fraction", "known"), [(0.7, 45), (1.0, None)])
def test_held_out_rows_do_not_extend_the_reach(holdout_steps_fraction, known):
    """Kept out to the end, held-out rows are judged by their distance from those that trained."""
    record = channels(np.ones((60, 1)), np.random.default_rng(0).uniform(1, 2, (60, 3)))
    trainer = of_gaussians(record, f"holdout_steps_fraction={holdout_steps_fraction}")
    assert trainer.state.chosen
    assert len(trainer.reach().known_m[0]) == (known or len(trainer.plan.selection.train))
    assert len(trainer.plan.selection.train) < 40
