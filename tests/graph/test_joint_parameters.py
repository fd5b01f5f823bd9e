"""Materials, gains and poses trained beside Gaussians or alone: recovered, recorded and resumed; predictions."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, WALLS, receiver, room, transmitters
from scipy.spatial.transform import Rotation
from small_fits import stop_after
from traced_rooms import SHOEBOX, write_xml

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.estimators.gaussian.curriculum import fit_curriculum
from wrf_mi.receivers.receiver_models import PowerReceiver
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.sionna.materials import BELOW_1_GHZ
from wrf_mi.training.adam import NumericsError
from wrf_mi.training.config import calibration_config, default_config
from wrf_mi.training.fit_plan import FitPlan
from wrf_mi.training.loop import FitState
from wrf_mi.training.trainer import Trainer

ARRAY_M = planar_array(4, 4, 0.16)
BAND_HZ = FREQUENCY_HZ + np.linspace(-10e6, 10e6, 4)
OPTIONS = TraceOptions(depth=1, rays=4096)
TRUE_PERMITTIVITY, START_PERMITTIVITY = BELOW_1_GHZ["concrete"][0], 4.5
PERMITTIVITY = "material.itu_concrete.permittivity"
ONE_REFLECTION = ("traced.depth=1", "traced.reflections=1", "traced.transmission=false", "traced.rays=4096")
QUICK = ("optimiser.warm_up=10", "optimiser.ema_decay=0.9", "holdout_steps_fraction=0", "patience=0")


def record_of(task, scene, receivers, tx):
    """Observations traced by Sionna RT, independent of the graph."""
    shape = {"spectrum": (30, 120), "rssi": (), "csi": (16, 4)}[task]
    empty: Any = np.zeros((len(receivers), len(tx), *shape), np.complex64 if task == "csi" else np.float32)
    hz = BAND_HZ if task == "csi" else np.array([FREQUENCY_HZ])
    arrays = receivers if task == "rssi" else tuple(replace(station, array_m=ARRAY_M) for station in receivers)
    record = Record("room", task, tx, arrays, empty, frequencies_hz=hz)
    observed = instrument_of(record).observe(trace_paths(scene, tx, arrays, OPTIONS).paths)
    return replace(record, observation=observed.astype(empty.dtype))


def all_of(record, train=None):
    rows = np.arange(len(record))
    return Split("all", 0, rows[:train], rows[:0], rows[train:] if train else rows[:0])


def paths_alone(groups, *settings):
    return with_settings(calibration_config(groups.split(",")), [*ONE_REFLECTION, *QUICK, *settings])


def test_material_gain_and_pose_are_recovered(tmp_path):
    """Channels of an array displaced by 3 cm, turned by 2 degrees, with a gain, between other walls."""
    stated_receiver, shift_m, turn_rad = receiver(), np.array([0.02, -0.015, 0.01]), np.radians([0.5, -1.0, 2.0])
    turned = (Rotation.from_quat(stated_receiver.orientation_xyzw) * Rotation.from_rotvec(turn_rad)).as_quat()
    moved = replace(stated_receiver, position_m=stated_receiver.position_m + shift_m, orientation_xyzw=turned)
    tx, scene = np.random.default_rng(0).uniform([1, 1, 0.8], [5, 4, 2.4], (20, 3)), room(tmp_path, WALLS)
    record = record_of("csi", scene, (moved,), tx)
    observed = record.observation * np.complex64(40 * np.exp(0.3j))
    record = replace(record, receivers=(replace(stated_receiver, array_m=ARRAY_M),), observation=observed)
    scene.radio_materials["itu_concrete"].relative_permittivity = START_PERMITTIVITY
    rates = ("traced.position=2e-3", "traced.turn=5e-3", "traced.material=0.05", "steps=400", "batch=20")
    trainer = Trainer(record, all_of(record), paths_alone("gain,materials,pose", *rates), scene=scene)
    # A gain starts where the paths yield what was observed, on average.
    assert trainer.state.params()["receiver.array.gain"][0] == pytest.approx(np.log(40), abs=0.1)
    trainer.run()
    fitted = trainer.state.params()
    np.testing.assert_allclose(fitted["receiver.array.position"], shift_m, atol=1e-3)
    np.testing.assert_allclose(fitted["receiver.array.turn"], turn_rad, atol=1e-3)
    np.testing.assert_allclose(fitted["receiver.array.gain"], [np.log(40), 0.3], atol=0.02)
    assert 1 + np.exp(fitted[PERMITTIVITY]).item() == pytest.approx(TRUE_PERMITTIVITY, abs=0.1)


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_gain_starts_at_the_level_of_the_observations(task, tmp_path):
    scene = room(tmp_path, WALLS)
    record = record_of(task, scene, (receiver(),), transmitters(8))
    record = record if task == "spectrum" else replace(record, observation=record.observation + 32)
    trainer = Trainer(record, all_of(record), paths_alone("gain"), scene=scene)
    traced_field, params = trainer.graph.trace(record.tx_pos_m, 0)[0], dict(trainer.state.adam.items())
    if task == "rssi":
        assert float(params["receiver.array.gain"].array[0]) == pytest.approx(np.log(10) * 32 / 20, abs=1e-3)
    else:  # unscaled spectra peak at 1
        peaks = (
            trainer.graph.models[0].unscaled(traced_field(params), None).numpy().reshape(len(record), -1).max(axis=1)
        )
        assert peaks.mean() == pytest.approx(1, abs=1e-3)


def test_patterns_are_recovered(tmp_path):
    """Powers of a transmitter whose pattern turns with its heading, at receivers with different patterns."""
    scene, rng = room(tmp_path, WALLS), np.random.default_rng(7)
    tx, heading = rng.uniform([1, 1, 0.8], [5, 4, 2.4], (80, 3)), rng.uniform(-np.pi, np.pi, 80)
    receivers = receiver(), Receiver("tag", np.array([1.0, 4.0, 2.0]), receiver().orientation_xyzw)
    model, options = PowerReceiver(4, 8, (FREQUENCY_HZ,), interference=False), TracedOptions(OPTIONS, pattern_degree=1)
    names = "pattern.transmitter", *(f"receiver.{station.name}.pattern" for station in receivers)
    truth = {name: mi.TensorXf(rng.normal(0, 0.5, (2, 3)).astype(np.float32)) for name in names}
    traced_fields = [TracedField(scene, tx, station, options, heading) for station in receivers]
    observed = np.stack([model(field(truth), None).numpy() for field in traced_fields]).astype(np.float32)
    hz = np.array([FREQUENCY_HZ])
    record = Record("room", "rssi", tx, receivers, observed, frequencies_hz=hz, tx_heading_rad=heading)
    error = []
    for groups, degree in (("gain", ()), ("gain,patterns", ("traced.pattern_degree=1",))):
        trainer = Trainer(
            record, all_of(record, 60), paths_alone(groups, "steps=250", "batch=30", *degree), scene=scene
        )
        trainer.run()
        predict = trainer.predictor()
        predicted = np.stack([predict.of_rows(record, np.arange(60, 80), r) for r in range(2)])
        error.append(np.median(np.abs(predicted - observed[:, 60:])))
    assert error[1] < 0.1 * error[0]
    with pytest.raises(InputError, match="needs headings; give heading_rad"):
        predict(tx[:2])


@pytest.fixture
def rooms(tmp_path):
    """A room with a metal ceiling, and its walls alone, with a wrong permittivity of concrete."""
    known_room = room(tmp_path / "known", WALLS)
    known_room.radio_materials["itu_concrete"].relative_permittivity = START_PERMITTIVITY
    return room(tmp_path / "whole", {**WALLS, **CEILING}), known_room


def test_permittivity_is_recovered_in_joint_training(rooms):
    """The Gaussians model the reflection at the ceiling, which the mesh lacks."""
    record = record_of("csi", rooms[0], (receiver(),), transmitters(28))
    extra_settings = (
        "batch=20",
        "traced.material=0.05",
        "traced.materials=named",
        "traced.surface=0",
        "initial.gaussians=40",
    )
    small_field = ("steps=150", "network.width=32", "network.layers=2")
    config = with_settings(default_config("csi"), [*ONE_REFLECTION, *QUICK, *extra_settings, *small_field])
    trainer = fit_curriculum(FitPlan(record, all_of(record, 20), config, scene=rooms[1]))
    miss = trainer.predictor()(record.tx_pos_m[20:]) - record.observation[0, 20:]
    assert (np.abs(miss) ** 2).sum() < 0.1 * (np.abs(record.observation[0, 20:]) ** 2).sum()
    assert 1 + np.exp(trainer.state.params()[PERMITTIVITY]).item() == pytest.approx(TRUE_PERMITTIVITY, abs=0.2)


def small(rooms, *settings):
    """Paths of two receivers."""
    second = Receiver("tag", np.array([1.0, 4.0, 2.0]), receiver().orientation_xyzw)
    record = record_of("rssi", rooms[0], (receiver(), second), transmitters(12))
    config = paths_alone("gain,materials,pose", "traced.position=1e-4", "steps=60", "batch=5", *settings)
    return Trainer(record, all_of(record), config, scene=rooms[1])


def test_validation_of_paths_alone_searches_none(rooms, monkeypatch):
    """Scores of held-out rows by the paths known from the start: those of predictions, which search."""
    part = small(rooms)
    observed = part.plan.record.observation.copy()
    observed[1, 9] = np.nan
    record = replace(part.plan.record, observation=observed)
    split = Split("parts", 0, np.array([0, 2, 3, 6, 7, 8, 10]), np.array([1, 4, 5, 9, 11]), np.zeros(0, np.int64))
    trainer = Trainer(record, split, part.config, scene=part.graph.scene)
    predict = trainer.predictor()
    predicted = np.stack([predict.of_rows(record, split.validation, r) for r in range(2)])
    expected = np.nanmedian(trainer.plan.task.training_score(predicted, observed[:, split.validation]))
    monkeypatch.setattr(trainer.graph, "trace", lambda *_: pytest.fail("searched"))
    assert trainer.validate() == pytest.approx(float(expected), rel=1e-5)


def test_receivers_share_materials_and_steps_are_recorded_once(rooms):
    """Later batches and rates replay recorded steps."""
    trainer = small(rooms)
    assert {PERMITTIVITY, "receiver.array.gain", "receiver.tag.gain"} <= set(trainer.state.adam)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):  # a recording belongs to such flags
        trainer.run(stop=stop_after(12))
        recorded = {key: step.frozen.n_recordings for key, step in trainer.steps.recorded.items()}
        dr.kernel_history_clear()
        trainer.run(stop=stop_after(12))
        history = dr.kernel_history([dr.KernelType.JIT])
    assert trainer.state.step == 24
    assert [entry["hash"] for entry in history if not entry["cache_hit"]] == []
    assert {key: step.frozen.n_recordings for key, step in trainer.steps.recorded.items()} == recorded
    assert len(recorded) == 2


def test_step_with_non_finite_gradient_is_not_taken(rooms):
    trainer = small(rooms)
    trainer.run(stop=stop_after(3))
    before = trainer.state.params()
    trainer.steps.loss = lambda prediction, observed, batch, *shape: dr.sum(prediction) / 0
    trainer.record_functions()
    # Dr.Jit's sums drop NaN on the way back, so that Adam would go on by its momentum alone.
    with pytest.raises(NumericsError, match="step 4: not finite"):
        trainer.run()
    np.testing.assert_equal(trainer.state.params(), before)


def test_documented_training_runs(capsys):
    """With fewer steps."""
    page = (Path(__file__).parents[2] / "docs" / "joint.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert script.count('"steps=300"') == 1
    exec(compile(script.replace('"steps=300"', '"steps=2"'), "docs/joint.md", "exec"), {})
    permittivity, error = (float(line) for line in capsys.readouterr().out.split())
    assert 1 < permittivity < 10
    assert 0 < error < 1


def test_resumed_fit_keeps_its_paths(rooms):
    """Paths are searched again once a receiver has moved by a quarter of a wavelength, and restored on resumption."""
    extra_settings = ("traced.position=0.05", "optimiser.warm_up=1", "steps=14", "deterministic=true")
    uninterrupted, part = (small(rooms, *extra_settings) for _ in range(2))
    uninterrupted.run()
    stated_positions_m = np.stack([station.position_m for station in uninterrupted.graph.receivers])
    assert (np.linalg.norm(uninterrupted.state.searched_m - stated_positions_m, axis=1) > 0).any(), (
        "the receivers have hardly moved"
    )
    part.run(stop=stop_after(9))
    state = FitState.from_arrays(part.state.arrays())
    resumed = Trainer(part.plan.record, part.plan.split, part.config, scene=part.graph.scene, state=state)
    for traced_field, searched_m in zip(resumed.plan.traced_fields, part.state.searched_m, strict=True):
        np.testing.assert_array_equal(traced_field.searched_at_m, searched_m)
    resumed.run()
    np.testing.assert_equal(resumed.state.params(), uninterrupted.state.params())


SIX_HZ = FREQUENCY_HZ + np.linspace(-10e6, 10e6, 6)
WHOLE = SHOEBOX | {"ceiling": ("itu_metal", SHOEBOX["ceiling"][1])}
KNOWN = {name: part for name, part in SHOEBOX.items() if name != "ceiling"}
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
PLACES = (np.array([5.2, 2.4, 1.1]), np.array([0.9, 3.4, 1.9]))
SETTINGS = (
    *("steps=300", "batch=16", "validate_every=50", "initial.gaussians=24", "network.width=32", "network.layers=2"),
    *("traced.reflections=1", "traced.depth=1", "traced.rays=4096", "deterministic=true"),
)
SPECTRA = ("batch=4", "steps=60", "density.every=0")
CHANNELS = ("steps=200", "validate_every=100")
ALONE, PATHS = 0.2, {"rssi": 0.05, "csi": 0.2}
"""Least gains over Gaussians alone and over paths trained as long, dB; the latter's error of 0.2 dB leaves little."""
FLOAT32 = 1e-4  # Relative difference between a batch of transmitters and a single one: sums in single precision


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A room with a metal ceiling, its known part (floor and walls), and that part with another material."""
    folder, thought = tmp_path_factory.mktemp("scenes"), {name: ("itu_wood", mesh) for name, (_, mesh) in KNOWN.items()}
    parts = {"whole": WHOLE, "known": KNOWN, "thought": thought}
    return {name: write_xml(folder / name, meshes) for name, meshes in parts.items()}


def measured(task, scene, antennas=1, depth=2):
    """Observations of two receivers in a room, traced by Sionna RT."""
    # Phases turn within a wavelength, powers that are added do not.
    near, far = ([1.7, 2.6, 1.4], [2.1, 3.0, 1.5]) if task == "csi" else ([1.2, 2.0, 1.2], [4.5, 3.8, 1.9])
    tx = np.random.default_rng(4).uniform(near, far, (90, 3))
    several = planar_array(antennas, 1, 0.16) if antennas > 1 else None
    array = planar_array(4, 4, 0.16) if task == "spectrum" else several
    receivers = tuple(Receiver(f"rx{i}", place, UPRIGHT, array_m=array) for i, place in enumerate(PLACES))
    shape = {"spectrum": (24, 48), "rssi": (), "csi": (*(antennas,) * (antennas > 1), 6)}[task]
    empty = np.zeros((2, len(tx), *shape), np.complex64 if task == "csi" else np.float32)
    hz = SIX_HZ if task == "csi" else np.array([FREQUENCY_HZ])
    record = Record("room", task, tx, receivers, empty, frequencies_hz=hz)
    paths = trace_paths(open_scene(scene, FREQUENCY_HZ), tx, receivers, TraceOptions(depth=depth, rays=1 << 12)).paths
    offset = np.array([[3.0], [-8.0]]) if task == "rssi" else 0  # the receivers' units differ
    return replace(record, observation=(instrument_of(record).observe(paths) + offset).astype(empty.dtype))


def thirds(record):
    rows = np.arange(len(record))
    return Split("thirds", 0, rows[:50], rows[50:60], rows[60:])


def trained(record, scene, *settings):
    task_settings = {"spectrum": SPECTRA, "csi": CHANNELS}.get(record.task.name, ())
    config = with_settings(default_config(record.task.name), [*SETTINGS, *task_settings, *settings])
    opened = None if scene is None else open_scene(scene, FREQUENCY_HZ)
    return fit_curriculum(FitPlan(record, thirds(record), config, scene=opened))


def score(record, trainer):
    """Median score on the test rows, the higher the better."""
    rows, task = thirds(record).test, record.task
    predicted = np.stack([trainer.predictor()(record.tx_pos_m[rows], r) for r in range(2)])
    value = float(np.median(task.of_rows(predicted, record.observation[:, rows])))
    return value if task.higher_is_better else -value


@pytest.mark.parametrize(("task", "antennas"), [("rssi", 1), pytest.param("csi", 2, marks=pytest.mark.slow)])
def test_joint_training_predicts_better_than_either_component(task, antennas, scenes):
    record, paths_settings = measured(task, scenes["whole"], antennas), ("model=ray-tracing", "traced.surface=0")
    both, alone, paths = (
        trained(record, *how) for how in ((scenes["known"],), (None,), (scenes["known"], *paths_settings))
    )
    assert score(record, both) > score(record, alone) + ALONE
    assert score(record, both) > score(record, paths) + PATHS[task]
    assert {"level", "position", "receiver.rx0.gain", "material.itu_concrete.permittivity"} <= set(both.state.adam)
    row, predict = record.tx_pos_m[thirds(record).test], both.predictor()
    np.testing.assert_allclose(predict(row[3:4], "rx1")[0], predict(row, 1)[3], rtol=FLOAT32, atol=FLOAT32 * 1e-3)


@pytest.mark.parametrize("task", ["rssi", "csi"])
def test_calibration_of_paths_improves_every_task(task, scenes):
    """Walls of another material than the scene states: training of their permittivities improves the prediction."""
    record, steps = measured(task, scenes["known"], depth=1), ("steps=60", "traced.gain=0.02", "batch=16")
    fixed, moved = (
        trained(record, scenes["thought"], "model=ray-tracing", f"traced.material={rate}", *steps) for rate in (0, 0.05)
    )
    assert score(record, moved) > score(record, fixed)
    assert not any(name.startswith(("position", "level")) for name in moved.state.adam)
    assert any(name.startswith("material.") for name in moved.state.adam)
    with pytest.raises(ValueError, match="there are no Gaussians"):
        _ = moved.field


def test_receiver_without_paths_predicts_with_gaussians(scenes):
    """No reflections, and a floor blocks the direct path."""
    record, opaque = measured("rssi", scenes["known"]), ("traced.transmission=false", "steps=30")
    below = replace(record, tx_pos_m=record.tx_pos_m - np.array([0, 0, 9.0]))
    assert np.isfinite(trained(below, scenes["known"], *opaque).predictor()(below.tx_pos_m[:4], 0)).all()
    with pytest.raises(InputError, match="rx0: no training row is reached by a path"):
        trained(below, scenes["known"], "model=ray-tracing", *opaque)


def test_joint_field_uses_positions_instead_of_the_uplink(scenes):
    record = measured("csi", scenes["known"])
    first = replace(record, receivers=record.receivers[:1], observation=record.observation[:1])
    first = replace(first, uplink=np.asarray(first.observation[0][:, None]))
    trainer, rows = trained(first, scenes["known"], "steps=20"), thirds(record).test
    assert trainer.graph.form.features == 0
    assert trainer.predictor()(first.tx_pos_m[rows], 0).shape == first.observation[0, rows].shape
    nowhere = replace(first, tx_pos_m=np.full_like(first.tx_pos_m, np.nan))
    with pytest.raises(InputError, match="room has no position in row 0"):
        trained(nowhere, scenes["known"])
