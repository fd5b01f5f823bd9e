"""Recovery of known materials, gains and poses by training; recording and resumption of steps."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, WALLS, receiver, room, transmitters
from scipy.spatial.transform import Rotation
from small_fits import stop_after

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.receivers.receiver_models import PowerReceiver
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.sionna.materials import BELOW_1_GHZ
from wrf_mi.training.adam import NumericsError
from wrf_mi.training.config import TrainConfig, calibration_config, default_config
from wrf_mi.training.loop import FitState
from wrf_mi.training.trainer import Trainer

# isort: split
import drjit as dr
import mitsuba as mi

ARRAY_M = planar_array(4, 4, 0.16)
BAND_HZ = FREQUENCY_HZ + np.linspace(-10e6, 10e6, 4)
OPTIONS = TraceOptions(depth=1, rays=4096)
TRUE_PERMITTIVITY, START_PERMITTIVITY = BELOW_1_GHZ["concrete"][0], 4.5
PERMITTIVITY = "material.itu_concrete.permittivity"
ONE_REFLECTION = ("traced.depth=1", "traced.reflections=1", "traced.transmission=false", "traced.rays=4096")
QUICK = ("optimiser.warm_up=10", "optimiser.ema_decay=0.9", "holdout_steps_fraction=0", "patience=0")


def rooms(folder: Path) -> tuple[Any, Any]:
    """A room with a metal ceiling, and its walls alone, with a wrong permittivity of concrete."""
    known = room(folder / "known", WALLS)
    known.radio_materials["itu_concrete"].relative_permittivity = START_PERMITTIVITY
    return room(folder / "whole", {**WALLS, **CEILING}), known


def record_of(task: str, scene: Any, receivers: tuple[Receiver, ...], tx: np.ndarray) -> Record:
    """Observations traced by Sionna RT, independent of the graph."""
    rows, count = len(tx), len(receivers)
    shape = {"spectrum": (30, 120), "rssi": (), "csi": (16, 4)}[task]
    empty = np.zeros((count, rows, *shape), np.complex64 if task == "csi" else np.float32)
    hz = BAND_HZ if task == "csi" else np.array([FREQUENCY_HZ])
    arrays = receivers if task == "rssi" else tuple(replace(one, array_m=ARRAY_M) for one in receivers)
    record = Record("room", task, tx, arrays, empty, frequencies_hz=hz)
    seen = instrument_of(record).observe(trace_paths(scene, tx, arrays, OPTIONS).paths)
    return replace(record, observation=seen.astype(empty.dtype))


def all_of(record: Record, train: int | None = None) -> Split:
    rows = np.arange(len(record))
    return Split("all", 0, rows[:train], rows[:0], rows[train:] if train else rows[:0])


def paths_alone(parts: str, *settings: str) -> TrainConfig:
    return with_settings(calibration_config(parts.split(",")), [*ONE_REFLECTION, *QUICK, *settings])


def moved(own: Receiver, shift_m: Any, turn_rad: Any) -> Receiver:
    turned = Rotation.from_quat(own.orientation_xyzw) * Rotation.from_rotvec(turn_rad)
    return replace(own, position_m=own.position_m + shift_m, orientation_xyzw=turned.as_quat())


def test_material_gain_and_pose_are_recovered(tmp_path: Path) -> None:
    """Channels of an array displaced by 3 cm, turned by 2 degrees, with a gain, between other walls."""
    own, shift_m, turn_rad = receiver(), np.array([0.02, -0.015, 0.01]), np.radians([0.5, -1.0, 2.0])
    tx = np.random.default_rng(0).uniform([1, 1, 0.8], [5, 4, 2.4], (20, 3))
    scene = room(tmp_path, WALLS)
    seen = record_of("csi", scene, (moved(own, shift_m, turn_rad),), tx)
    stated = replace(seen.receivers[0], position_m=own.position_m, orientation_xyzw=own.orientation_xyzw)
    record = replace(seen, receivers=(stated,), observation=seen.observation * np.complex64(40 * np.exp(0.3j)))
    scene.radio_materials["itu_concrete"].relative_permittivity = START_PERMITTIVITY
    rates = ("traced.position=2e-3", "traced.turn=5e-3", "traced.material=0.05", "steps=400", "batch=20")
    trainer = Trainer(record, all_of(record), paths_alone("gain,materials,pose", *rates), scene=scene)
    # A gain starts where the paths report what was observed, on average.
    assert trainer.state.params()["receiver.array.gain"][0] == pytest.approx(np.log(40), abs=0.1)
    trainer.run()
    found = trainer.state.params()
    np.testing.assert_allclose(found["receiver.array.position"], shift_m, atol=1e-3)
    np.testing.assert_allclose(found["receiver.array.turn"], turn_rad, atol=1e-3)
    np.testing.assert_allclose(found["receiver.array.gain"], [np.log(40), 0.3], atol=0.02)
    assert 1 + np.exp(found[PERMITTIVITY]).item() == pytest.approx(TRUE_PERMITTIVITY, abs=0.1)


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_gain_starts_at_the_level_of_the_observations(task: str, tmp_path: Path) -> None:
    scene = room(tmp_path, WALLS)
    record = record_of(task, scene, (receiver(),), transmitters(8))
    record = record if task == "spectrum" else replace(record, observation=record.observation + 32)
    trainer = Trainer(record, all_of(record), paths_alone("gain"), scene=scene)
    side, params = trainer.graph.trace(record.tx_pos_m, 0)[0], dict(trainer.state.adam.items())
    assert side is not None
    if task == "rssi":
        assert float(params["receiver.array.gain"].array[0]) == pytest.approx(np.log(10) * 32 / 20, abs=1e-3)
    else:  # unscaled spectra peak at 1
        unscaled: Any = trainer.graph.models[0]
        peaks = unscaled.unscaled(side(params), None).numpy().reshape(len(record), -1).max(axis=1)
        assert peaks.mean() == pytest.approx(1, abs=1e-3)


def test_patterns_are_recovered(tmp_path: Path) -> None:
    """Powers of a transmitter whose pattern turns with its heading, at receivers with different patterns."""
    scene, rng = room(tmp_path, WALLS), np.random.default_rng(7)
    tx, heading = rng.uniform([1, 1, 0.8], [5, 4, 2.4], (80, 3)), rng.uniform(-np.pi, np.pi, 80)
    receivers = receiver(), Receiver("tag", np.array([1.0, 4.0, 2.0]), receiver().orientation_xyzw)
    model, options = PowerReceiver(4, 8, (FREQUENCY_HZ,), interference=False), TracedOptions(OPTIONS, pattern_degree=1)
    truth = {"pattern.transmitter": rng.normal(0, 0.5, (2, 3))}
    truth |= {f"receiver.{one.name}.pattern": rng.normal(0, 0.5, (2, 3)) for one in receivers}
    given = {name: mi.TensorXf(value.astype(np.float32)) for name, value in truth.items()}
    sides = [TracedField(scene, tx, one, options, heading) for one in receivers]
    seen = np.stack([model(side(given), None).numpy() for side in sides]).astype(np.float32)
    hz = np.array([FREQUENCY_HZ])
    record = Record("room", "rssi", tx, receivers, seen, frequencies_hz=hz, tx_heading_rad=heading)
    error = []
    for parts in ("gain", "gain,patterns"):
        config = paths_alone(parts, "steps=400", "batch=30")
        config = with_settings(config, ["traced.pattern_degree=1"] if "patterns" in parts else [])
        trainer = Trainer(record, all_of(record, 60), config, scene=scene)
        trainer.run()
        predict = trainer.predictor()
        found = np.stack([predict.of_rows(record, np.arange(60, 80), r) for r in range(2)])
        error.append(np.median(np.abs(found - seen[:, 60:])))
    assert error[1] < 0.1 * error[0]
    with pytest.raises(InputError, match="needs headings; give heading_rad"):
        predict(tx[:2])


def test_permittivity_is_recovered_in_joint_training(tmp_path: Path) -> None:
    """The Gaussians model the reflection at the ceiling, which the mesh lacks."""
    whole, known = rooms(tmp_path)
    record = record_of("csi", whole, (receiver(),), transmitters(28))
    own = (*ONE_REFLECTION, *QUICK, "batch=20", "traced.material=0.05", "initial.gaussians=40", "steps=150")
    own = (*own, "traced.materials=named", "traced.surface=0")
    config = with_settings(default_config("csi"), [*own, "network.width=32", "network.layers=2"])
    trainer = Trainer(record, all_of(record, 20), config, scene=known)
    trainer.run()
    miss = trainer.predictor()(record.tx_pos_m[20:]) - record.observation[0, 20:]
    assert (np.abs(miss) ** 2).sum() < 0.1 * (np.abs(record.observation[0, 20:]) ** 2).sum()
    assert 1 + np.exp(trainer.state.params()[PERMITTIVITY]).item() == pytest.approx(TRUE_PERMITTIVITY, abs=0.2)


def small(tmp_path: Path, *settings: str) -> Trainer:
    """Paths of two receivers."""
    second = Receiver("tag", np.array([1.0, 4.0, 2.0]), receiver().orientation_xyzw)
    whole, known = rooms(tmp_path)
    record = record_of("rssi", whole, (receiver(), second), transmitters(12))
    config = paths_alone("gain,materials,pose", "traced.position=1e-4", "steps=60", "batch=5", *settings)
    return Trainer(record, all_of(record), config, scene=known)


def test_validation_of_paths_alone_searches_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores of held-out rows by the paths known from the start: those of predictions, which search."""
    part = small(tmp_path)
    observed = part.plan.record.observation.copy()
    observed[1, 9] = np.nan
    record = replace(part.plan.record, observation=observed)
    split = Split("parts", 0, np.array([0, 2, 3, 6, 7, 8, 10]), np.array([1, 4, 5, 9, 11]), np.zeros(0, np.int64))
    trainer = Trainer(record, split, part.config, scene=part.graph.scene)
    predict = trainer.predictor()
    found = np.stack([predict.of_rows(record, split.validation, r) for r in range(2)])
    expected = np.nanmedian(trainer.plan.task.training_score(found, observed[:, split.validation]))
    monkeypatch.setattr(trainer.graph, "trace", lambda *_: pytest.fail("searched"))
    assert trainer.validate() == pytest.approx(float(expected), rel=1e-5)


def test_receivers_share_materials_and_steps_are_recorded_once(tmp_path: Path) -> None:
    """Later batches and rates replay recorded steps."""
    trainer = small(tmp_path)
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


def test_step_with_non_finite_gradient_is_not_taken(tmp_path: Path) -> None:
    trainer = small(tmp_path)
    trainer.run(stop=stop_after(3))
    before = trainer.state.params()
    trainer.steps.loss = lambda prediction, observed, batch, *shape: dr.sum(prediction) / 0
    trainer.record_functions()
    # Dr.Jit's sums drop NaN on the way back, so that Adam would go on by its momentum alone.
    with pytest.raises(NumericsError, match="step 4: not finite"):
        trainer.run()
    for name, values in trainer.state.params().items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)


def test_documented_training_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """With fewer steps."""
    page = (Path(__file__).parents[2] / "docs" / "joint.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert script.count('"steps=300"') == 1
    exec(compile(script.replace('"steps=300"', '"steps=2"'), "docs/joint.md", "exec"), {})
    permittivity, error = (float(line) for line in capsys.readouterr().out.split())
    assert 1 < permittivity < 10
    assert 0 < error < 1


def test_resumed_fit_keeps_its_paths(tmp_path: Path) -> None:
    """Paths are searched again once a receiver has moved by a quarter of a wavelength, and restored on resumption."""
    own = (
        "traced.position=0.05",
        "optimiser.warm_up=1",
        "steps=14",
        "holdout_steps_fraction=0",
        "patience=0",
        "deterministic=true",
    )
    whole, part = (small(tmp_path / name, *own) for name in ("whole", "part"))
    whole.run()
    stated = np.stack([one.position_m for one in whole.graph.receivers])
    assert (np.linalg.norm(whole.state.searched_m - stated, axis=1) > 0).any(), "the receivers have hardly moved"
    part.run(stop=stop_after(9))
    state = FitState.from_arrays(part.state.arrays())
    resumed = Trainer(part.plan.record, part.plan.split, part.config, scene=part.graph.scene, state=state)
    for side, searched_m in zip(resumed.sides, part.state.searched_m, strict=True):
        assert side is not None
        np.testing.assert_array_equal(side.searched_at_m, searched_m)
    resumed.run()
    for name, values in whole.state.params().items():
        np.testing.assert_array_equal(resumed.state.params()[name], values, err_msg=name)
