"""WRF-GS, WRF-GS+ and factorised fields for signal strengths and channels: against the operator, round trips."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.settings import with_settings
from wrf_mi.estimators.model import inputs_of
from wrf_mi.estimators.networks import nerf2
from wrf_mi.estimators.networks.nerf2 import Nerf2Settings
from wrf_mi.estimators.networks.nerf2_march import Networks
from wrf_mi.gaussians import FIELDS
from wrf_mi.gaussians.parameters import by_component
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.models import Problem
from wrf_mi.runs.api import train
from wrf_mi.tasks import TASKS
from wrf_mi.training.checkpoint import read_checkpoint, write_checkpoint
from wrf_mi.training.config import default_config
from wrf_mi.training.evaluator import TOGETHER
from wrf_mi.training.loop import FitState
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.session import FitSession
from wrf_mi.training.step import TrainingData, device_pose
from wrf_mi.training.targets import targets_of
from wrf_mi.training.trainer import Trainer

MODELS = tuple(FIELDS)
FIELD = (
    *("batch=8", "holdout_steps_fraction=0.5", "initial.gaussians=12", "network.layers=2"),
    *("network.width=16", "optimiser.network=2e-3", "optimiser.warm_up=20", "optimiser.ema_decay=0.98"),
    *("view.height=6", "view.columns=24"),
)
SMALL = ("steps=500", *FIELD, "view.components=3")
THREADED = 1e-2  # Of the largest value: ten steps of Adam, whose gradients are summed by threads in any order
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
TURNED = np.array([0.5, -0.5, 0.5, 0.5])
ROUNDING = 2e-3  # dB: float32 sums of 288 directions that partly cancel, in another order than the operator's


def receivers(count):
    turns = (UPRIGHT, TURNED)
    return tuple(Receiver(f"rx{r}", np.array([2.0 * r, 1.0, 0.5]), turns[r % 2]) for r in range(count))


def strengths(count=2, rows=60):
    along = np.random.default_rng(0).permutation(np.linspace(-3, 3, rows))
    tx, places = np.stack([along, 2 + np.sin(along), np.full(rows, 0.3)], axis=1), receivers(count)
    power = -40 - 20 * np.log10([np.linalg.norm(tx - r.position_m, axis=1) for r in places])
    power[0, :3] = np.nan
    return Record("made", "rssi", tx, places, power.astype(np.float32), frequencies_hz=np.array([2.4e9]))


def channels(rows=60, antennas=3, subcarriers=8):
    """Two paths whose delays go with one coordinate: the downlink follows from the uplink."""
    along = np.random.default_rng(1).uniform(0, 1, (rows, antennas, 1))
    band = np.arange(2 * subcarriers) / subcarriers
    h = np.exp(-2j * np.pi * band * (0.2 + 0.3 * along)) + 0.4 * np.exp(-2j * np.pi * band * (0.6 - 0.2 * along))
    up, down = np.split((3e-4 * h).astype(np.complex64), 2, axis=-1)
    return Record("made", "csi", np.full((rows, 3), np.nan), receivers(1), down[None], uplink=up, uplink_hz=None)


def halves(record, validation=6):
    rows = np.arange(len(record))
    return Split("halves", 0, rows[: 40 - validation], rows[40 - validation : 40], rows[40:])


def config(record, *settings):
    return with_settings(default_config(record.task.name), [*SMALL, *settings])


def fitted(record, split, *settings):
    trainer = Trainer(record, split, config(record, *settings))
    trainer.run()
    return trainer.predictor()


def detached(trainer):
    return {name: dr.detach(trainer.state.adam[name]) for name in trainer.state.adam}


def relative_error(prediction, truth):
    """Median over the rows of the energy of the error."""
    axes = tuple(range(1, truth.ndim))
    energy = np.square(np.abs(prediction - truth)).sum(axis=axes) / np.square(np.abs(truth)).sum(axis=axes)
    return float(np.median(energy))


@pytest.mark.parametrize("model", MODELS)
def test_power_equals_the_sum_over_the_full_sphere(model):
    record = strengths()
    trainer = Trainer(record, halves(record), config(record, f"model={model}"))
    trainer.state.set_param("level", np.array([[-0.3, 0.7]], np.float32))
    params = detached(trainer)
    predict = Predictor(trainer.graph, {name: value.numpy() for name, value in params.items()})
    gaussians = trainer.field.gaussians(params, to_tensor(record.tx_pos_m[:1].T))
    for r, receiver in enumerate(record.receivers):
        field = learned_field(gaussians, device_pose(receiver), perception_plane(6, 24, mi.Float), sphere=True)
        re, im = (part.numpy() for part in field)
        amplitude = abs(np.tile(solid_angles(6, 24), 2) @ (re + 1j * im))
        level_db = 20 / np.log(10) * (-0.3, 0.7)[r]
        predicted = predict(record.tx_pos_m[:1], r)[0]
        assert predicted == pytest.approx(level_db + 20 * np.log10(amplitude), abs=ROUNDING)


@pytest.mark.parametrize("model", MODELS)
def test_starting_level_matches_each_receivers_observations(model):
    record = strengths()
    louder = replace(record, observation=record.observation + np.array([[0], [-35]], np.float32))
    predict = Trainer(louder, halves(louder), config(louder, f"model={model}")).predictor()
    rows = halves(louder).all_train
    for r in range(2):
        level_db = predict(louder.tx_pos_m[rows], r).mean()
        assert level_db == pytest.approx(np.nanmean(louder.observation[r, rows]), abs=1.0)


@pytest.mark.parametrize("model", MODELS)
def test_components_have_separate_images(model):
    record = channels()
    trainer = Trainer(record, halves(record), config(record, f"model={model}", "initial.gaussians=5"))
    joint = trainer.field.gaussians(detached(trainer), to_tensor(np.random.default_rng(0).normal(size=(16, 4))))
    separated = by_component(joint, 3)
    assert (separated.batch, separated.count) == (12, 5)
    shared = dr.width(joint.scale[0]) == 5
    for component in range(3):
        for part, half in ((0, 0), (1, 3)):
            signal = separated.signal[part].numpy().reshape(4, 3, 5)[:, component]
            np.testing.assert_array_equal(signal, joint.signal[half + component].numpy().reshape(4, 5))
        if not shared:
            for wide, narrow in zip((*separated.scale, separated.opacity), (*joint.scale, joint.opacity), strict=True):
                each = wide.numpy().reshape(4, 3, 5)[:, component]
                np.testing.assert_array_equal(each, narrow.numpy().reshape(4, 5), strict=True)


def test_components_span_the_channels():
    modes, shares = (np.random.default_rng(0).normal(size=(2, *size)) for size in ((2, 8), (60, 2)))
    h = ((shares[0] + 1j * shares[1]) @ (modes[0] + 1j * modes[1]))[None].astype(np.complex64)
    record = Record("made", "csi", np.random.default_rng(1).uniform(-2, 2, (60, 3)), receivers(1), h)
    basis = Trainer(record, halves(record), config(record, "view.components=2")).graph.form.basis
    np.testing.assert_allclose(basis @ basis.conj().T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose((h[0] @ basis.conj().T) @ basis, h[0], atol=1e-5)


@pytest.mark.all_threads
@pytest.mark.parametrize("model", ["wrf-gs+", "factorised"])
def test_strengths_are_learned_and_kept(model, tmp_path):
    record = strengths()
    split = halves(record)
    run = train(record, model, out=tmp_path / "run", split=split, settings=("steps=500", *FIELD))
    with np.load(tmp_path / "run" / "predictions.npz") as stored:
        scored = stored["prediction"]
    for r in range(2):
        predicted, truth = run.predict(record.tx_pos_m[split.test], r).mean, record.observation[r, split.test]
        mean = np.nanmean(record.observation[r, split.all_train])
        assert np.median(np.abs(predicted - truth)) < np.median(np.abs(mean - truth))
        np.testing.assert_array_equal(scored[r], predicted)


@pytest.mark.parametrize("model", ["wrf-gs", "factorised"])
def test_channels_are_learned_from_the_uplink_and_kept(model, tmp_path):
    record = channels()
    split, changed = halves(record), ("steps=200", "view.components=3", "batch=32", "optimiser.network=3e-3")
    extra_settings = (*(text for text in FIELD if not text.startswith(("batch", "optimiser.network"))), *changed)
    run = train(record, model, out=tmp_path / "run", split=split, settings=extra_settings)
    assert record.uplink is not None
    uplink, truth = record.uplink[split.test], record.observation[0, split.test]
    predicted = run.predict(uplink=uplink).mean
    assert predicted.shape == truth.shape
    assert relative_error(predicted, truth) < 0.3 * relative_error(uplink, truth)
    with np.load(tmp_path / "run" / "predictions.npz") as stored:
        np.testing.assert_array_equal(stored["prediction"], predicted)
    with pytest.raises(InputError, match="the rows to predict have none; give `uplink`"):
        run.predict(record.tx_pos_m[split.test])


@pytest.mark.parametrize("lost", [{"position_m": 3, "orientation_xyzw": 4}, {"position_m": 3}, {"orientation_xyzw": 4}])
def test_an_uplink_needs_no_pose_of_the_station(lost):
    record = channels()
    station = replace(record.receivers[0], **{name: np.full(size, np.nan) for name, size in lost.items()})
    unknown = replace(record, receivers=(station,))
    assert unknown.uplink is not None
    predict = fitted(unknown, halves(record), "steps=5")
    assert np.isfinite(predict(unknown.tx_pos_m[:3], 0, unknown.uplink[:3])).all()


def two_stations(rows=60, antennas=1):
    """Channels over positions; the second station's are 20 dB weaker and orthogonal to the first's, some unheard."""
    tx = np.column_stack([np.random.default_rng(4).uniform(-2, 2, (rows, 2)), np.full(rows, 0.3)])
    modes = np.exp(2j * np.pi * np.outer([1, 3], np.arange(8)) / 8)
    h = np.exp(1j * tx[:, :1]) * modes[:, None] * np.array([1e-3, 1e-4])[:, None, None]
    h[0, :5] = h[1, 3:9] = np.nan
    h = h.reshape(2, rows, antennas, -1) if antennas > 1 else h
    return Record("made", "csi", tx, receivers(2), h.astype(np.complex64))


def test_a_second_receiver_with_other_components_is_learned():
    record = two_stations(antennas=2)
    split = halves(record)
    predict = fitted(record, split, "view.components=2", "steps=700", "batch=16", "optimiser.network=3e-3")
    for r in range(2):
        truth, predicted = record.observation[r, split.test], predict(record.tx_pos_m[split.test], r)
        assert predicted.shape == truth.shape
        assert relative_error(predicted, truth) < 0.2, "in components of the other receiver alone it is 1 at least"


@pytest.mark.all_threads
@pytest.mark.parametrize("model", [*MODELS, "nerf2"])
def test_fit_is_invariant_to_the_power_of_a_receiver(model):
    """A receiver 40 dB weaker is told in its own units: a power of two changes no digit of what is learned."""
    record, weak = two_stations(), 2.0**-7
    fainter = replace(record, observation=record.observation * np.array([1, weak], np.float32)[:, None, None])
    split, small = halves(record), Nerf2Settings(steps=12, sphere_batch=8, sphere_rays=16, networks=Networks(2, 8))

    def predicted(stations):
        if model == "nerf2":
            fit = nerf2.MODEL.fit(Problem(stations, small, 0), split, FitSession())
            return fit.predict(inputs_of(stations, split.test), 1).mean
        extra_settings = f"model={model}", "view.components=2", "steps=10", "patience=0"
        return fitted(stations, split, *extra_settings)(stations.tx_pos_m[split.test], 1)

    plain, faint = predicted(record), predicted(fainter)
    assert np.abs(plain).max() > 1e-6
    np.testing.assert_allclose(faint, weak * plain, rtol=0, atol=THREADED * weak * np.abs(plain).max())


def test_predictions_do_not_depend_on_the_number_of_rows():
    record = strengths(1, 2 * TOGETHER + 53)
    split = Split("all", 0, np.arange(40), np.arange(40, 50), np.arange(50, len(record)))
    predict = fitted(record, split, "steps=10")
    everything = predict(record.tx_pos_m, 0)
    chosen = [0, TOGETHER, len(record) - 1]
    np.testing.assert_array_equal(everything[chosen], [predict(record.tx_pos_m[i : i + 1], 0)[0] for i in chosen])


STOPPING = ("steps=160", "validate_every=10", "patience=2", "deterministic=true")


@pytest.mark.parametrize("holdout_steps_fraction", [0.5, 1.0])
def test_early_stopping_resumes_from_the_best_state(holdout_steps_fraction):
    """Scores are given: the third of eight is the best, and after two worse ones no more are waited for."""
    record, fraction = strengths(), f"holdout_steps_fraction={holdout_steps_fraction}"
    scores, best = iter([5.0, 4.0, 3.0, 6.0, 6.0, 2.0, 2.0, 2.0]), dict[str, Any]()
    steps: dict[bool, list[int]] = {True: [], False: []}
    trainer = Trainer(record, halves(record), config(record, *STOPPING, fraction))
    trainer.validate = lambda: next(scores)  # type: ignore[method-assign]
    trainer.validation_facts = dict  # type: ignore[method-assign]  # those of scores that are not made

    def on_progress(progress):
        if progress.validation_score is not None:
            steps[progress.held_out].append(progress.step)
        if progress.step == 30:
            best.update(trainer.state.params())

    trainer.run(on_progress)
    left = 80 * 30 // 80 if holdout_steps_fraction < 1 else 0
    assert steps == {True: [10, 20, 30, 40, 50], False: [*range(160 - left + 10, 161, 10)]}
    assert (trainer.state.chosen, trainer.state.step) == (30, 160)
    if not left:
        np.testing.assert_equal(trainer.state.params(), best)


@pytest.fixture(scope="module")
def uninterrupted():
    trainer = Trainer(strengths(), halves(strengths()), config(strengths(), *STOPPING))
    trainer.run()
    return trainer.state


@pytest.mark.parametrize("stop", [25, 45, 150])
def test_resumed_fit_chooses_the_same_state(stop, uninterrupted, tmp_path):
    record = strengths()
    fit = record, halves(record), config(record, *STOPPING)
    part = Trainer(*fit)
    part.run(save=lambda: write_checkpoint(tmp_path, part), stop=lambda: part.state.step >= stop)
    again = Trainer(*fit, state=FitState.from_arrays(read_checkpoint(tmp_path)))
    again.run()
    assert again.state.chosen == uninterrupted.chosen
    np.testing.assert_equal(again.state.mean_params(), uninterrupted.mean_params())


def test_missing_observations_do_not_train():
    record, rows = strengths(), np.arange(40)
    targets, schedule = targets_of(record, rows), Trainer(record, halves(record), config(record)).schedule
    first, second = targets.received(rows)
    assert set(rows) - set(first) == {0, 1, 2}
    np.testing.assert_array_equal(second, rows)
    assert not set(schedule.rows[schedule.receiver == 0].ravel()) & {0, 1, 2}


def test_loss_divides_differences_by_stated_noise():
    record, rows, rng = strengths(rows=20), np.arange(4, 20), np.random.default_rng(0)
    shape = record.observation.shape
    std, readings = rng.uniform(0.5, 4, shape), rng.integers(1, 9, shape)
    targets = targets_of(replace(record, std=std), rows)
    weight, received = targets.weight, np.isfinite(record.observation[:, rows])
    np.testing.assert_allclose((weight * std)[:, rows], (weight * std)[0, 4])
    np.testing.assert_allclose(weight[:, rows][received].mean(), 1)
    of_means = targets_of(replace(record, n_readings=readings), rows).weight
    np.testing.assert_allclose((of_means / np.sqrt(readings))[:, rows], of_means[0, 4] / np.sqrt(readings[0, 4]))
    assert targets_of(record, rows).weight is None
    np.testing.assert_array_equal(targets_of(replace(record, std=np.full_like(std, 3)), rows).weight, 1)
    batch, scale = rng.permutation(rows)[:6], 1 / targets.unit
    data = TrainingData(to_tensor(targets.condition), to_float(targets.observed), to_float(scale), to_float(weight))
    for r in (0, 1):
        _, truth, factor = data.select(mi.UInt32(batch.tolist()), r, 1)
        loss = TASKS["rssi"].loss((truth + 2) * factor, truth * factor, len(batch), ssim_weight=0.0)
        # Everything is 2 dB too high; the sum of two numbers near -50 in single precision.
        np.testing.assert_allclose(loss[0], (2 * weight[r, batch] * scale[r]).mean(), rtol=1e-5)


def test_noisy_rows_have_less_weight():
    record = strengths(1)
    record = replace(record, observation=np.nan_to_num(record.observation, nan=-50))
    split, wrong = halves(record), np.zeros(record.observation.shape, bool)
    wrong[0, split.all_train[::2]] = True
    louder = replace(record, observation=np.where(wrong, record.observation + 20, record.observation))

    def error(observed):
        predicted = fitted(observed, split, "steps=150").of_rows(record, split.test, 0)
        return float(np.median(np.abs(predicted - record.observation[0, split.test])))

    assert error(replace(louder, std=np.where(wrong, 40.0, 1.0))) < 0.5 * error(louder)


def test_inconsistent_readings_and_noise_are_refused(tmp_path):
    record = strengths()
    std = np.ones(record.observation.shape)
    for change, message in (
        ({"std": std[:1]}, r"std \[1, 60\] beside observations \[2, 60\]"),
        ({"std": 0 * std}, "receiver rx0, row 3: std is 0; give a number above 0"),
        ({"n_readings": np.zeros(std.shape, int)}, "receiver rx0, row 3: n_readings is 0"),
        ({"runs": np.array(["a", "b"])}, r"runs \[2\]; give one for each of"),
    ):
        with pytest.raises(InputError, match=message):
            train(replace(record, **change), "idw", out=tmp_path / "run", split=halves(record))
    with pytest.raises(InputError, match="std belongs to signal strengths, not to csi"):
        train(replace(channels(), std=std), "idw", out=tmp_path / "run", split=halves(record))


def test_unsuitable_records_are_refused():
    record, deaf = strengths(), "receiver rx0: received none of 40 training rows"
    for name, message in (("tx_pos_m", "no position in row 0"), ("observation", deaf)):
        missing = replace(record, **{name: np.full_like(getattr(record, name), np.nan)})
        with pytest.raises(InputError, match=message):
            Trainer(missing, halves(record), config(record))


@pytest.mark.parametrize("model", [*MODELS, "nerf2"])
@pytest.mark.parametrize(("lost", "size"), [("position_m", 3), ("orientation_xyzw", 4)])
def test_unknown_poses_are_refused_for_fields_over_positions(model, lost, size):
    record = strengths()
    unknown = replace(record.receivers[1], **{lost: np.full(size, np.nan)})
    record, quick = replace(record, receivers=(record.receivers[0], unknown)), Nerf2Settings(steps=3, batch=4)
    fits = {"nerf2": lambda: nerf2.MODEL.fit(Problem(record, quick, 0), halves(record), FitSession())}
    fit = fits.get(model, lambda: Trainer(record, halves(record), config(record, f"model={model}")))
    with pytest.raises(InputError, match=r"made: the pose of receiver rx1 is not known.*give its position") as error:
        fit()
    assert "\n" not in str(error.value)
