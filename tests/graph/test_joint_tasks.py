"""Gaussians and paths trained together for signal strengths and channels, and paths alone for every task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from traced_rooms import SHOEBOX, write_xml

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.tasks import instrument_of, task_of
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.training.config import default_config
from wrf_mi.training.trainer import Trainer

HZ = 920e6
BAND_HZ = HZ + np.linspace(-10e6, 10e6, 6)
WHOLE = SHOEBOX | {"ceiling": ("itu_metal", SHOEBOX["ceiling"][1])}
KNOWN = {name: part for name, part in SHOEBOX.items() if name != "ceiling"}
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
PLACES = (np.array([5.2, 2.4, 1.1]), np.array([0.9, 3.4, 1.9]))
SETTINGS = (
    "steps=300",
    "batch=16",
    "validate_every=50",
    "initial.gaussians=24",
    "network.width=32",
    "network.layers=2",
    "traced.reflections=1",
    "traced.depth=1",
    "traced.rays=4096",
    "deterministic=true",
)
SPECTRA = ("batch=4", "steps=60", "density.every=0")
CHANNELS = ("steps=200", "validate_every=100")
ALONE, PATHS = 0.2, {"rssi": 0.05, "csi": 0.2}
"""Least gains over Gaussians alone and over paths trained as long, dB; the latter's error of 0.2 dB leaves little."""
FLOAT32 = 1e-4
"""Relative difference between a batch of transmitters and a single one: sums in single precision."""


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A room with a metal ceiling, its known part (floor and walls), and that part with another material."""
    folder = tmp_path_factory.mktemp("rooms")
    thought = {name: ("itu_wood", corners) for name, (_, corners) in KNOWN.items()}
    return {
        "whole": write_xml(folder / "whole", WHOLE),
        "known": write_xml(folder / "known", KNOWN),
        "thought": write_xml(folder / "thought", thought),
    }


def measured(task: str, scene: Path, antennas: int = 1, depth: int = 2) -> Record:
    """Observations of two receivers in a room, traced by Sionna RT."""
    # Phases turn within a wavelength, powers that are added do not.
    near, far = ([1.7, 2.6, 1.4], [2.1, 3.0, 1.5]) if task == "csi" else ([1.2, 2.0, 1.2], [4.5, 3.8, 1.9])
    tx = np.random.default_rng(4).uniform(near, far, (90, 3))
    array = (
        planar_array(4, 4, 0.16) if task == "spectrum" else planar_array(antennas, 1, 0.16) if antennas > 1 else None
    )
    receivers = tuple(Receiver(f"rx{i}", place, UPRIGHT, array_m=array) for i, place in enumerate(PLACES))
    shape = {"spectrum": (24, 48), "rssi": (), "csi": ((antennas,) if antennas > 1 else ()) + (6,)}[task]
    empty = np.zeros((2, len(tx), *shape), np.complex64 if task == "csi" else np.float32)
    hz = BAND_HZ if task == "csi" else np.array([HZ])
    record = Record("room", task, tx, receivers, empty, frequencies_hz=hz)
    paths = trace_paths(open_scene(scene, HZ), tx, receivers, TraceOptions(depth=depth, rays=1 << 12)).paths
    seen = instrument_of(record).observe(paths)
    if task == "rssi":
        seen = seen + np.array([[3.0], [-8.0]])  # the receivers' units differ
    return replace(record, observation=seen.astype(empty.dtype))


def thirds(record: Record) -> Split:
    rows = np.arange(len(record))
    return Split("thirds", 0, rows[:50], rows[50:60], rows[60:])


def trained(record: Record, scene: Path | None, *settings: str) -> Trainer:
    own = {"spectrum": SPECTRA, "csi": CHANNELS}.get(record.task, ())
    config = with_settings(default_config(record.task), [*SETTINGS, *own, *settings])
    trainer = Trainer(record, thirds(record), config, scene=None if scene is None else open_scene(scene, HZ))
    trainer.run()
    return trainer


def score(record: Record, trainer: Trainer) -> float:
    """Median score on the test rows, the higher the better."""
    rows, task = thirds(record).test, task_of(record)
    found = np.stack([trainer.predictor()(record.tx_pos_m[rows], r) for r in range(2)])
    value = float(np.median(task.of_rows(found, record.observation[:, rows])))
    return value if task.higher_is_better else -value


@pytest.mark.parametrize(
    ("task", "antennas"), [("rssi", 1), ("csi", 1), pytest.param("csi", 2, marks=pytest.mark.slow)]
)
def test_joint_training_predicts_better_than_either_side(task: str, antennas: int, rooms: dict[str, Path]) -> None:
    record = measured(task, rooms["whole"], antennas)
    both = trained(record, rooms["known"])
    alone = trained(record, None)
    paths = trained(record, rooms["known"], "model=ray-tracing", "traced.surface=0")
    assert score(record, both) > score(record, alone) + ALONE
    assert score(record, both) > score(record, paths) + PATHS[task]
    assert {"level", "position", "receiver.rx0.gain", "material.itu_concrete.permittivity"} <= set(both.state.adam)
    row = record.tx_pos_m[thirds(record).test]
    np.testing.assert_allclose(
        both.predictor()(row[3:4], "rx1")[0], both.predictor()(row, 1)[3], rtol=FLOAT32, atol=FLOAT32 * 1e-3
    )


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_calibration_of_paths_improves_every_task(task: str, rooms: dict[str, Path]) -> None:
    """Walls of another material than the scene states: training of their permittivities improves the prediction."""
    record = measured(task, rooms["known"], depth=1)
    steps = ("model=ray-tracing", "steps=60", "traced.material=0.05", "traced.gain=0.02", "batch=16")
    held = trained(record, rooms["thought"], *steps, "traced.material=0")
    moved = trained(record, rooms["thought"], *steps)
    assert score(record, moved) > score(record, held)
    assert not any(name.startswith(("position", "level")) for name in moved.state.adam)
    assert any(name.startswith("material.") for name in moved.state.adam)
    with pytest.raises(ValueError, match="there are no Gaussians"):
        _ = moved.field


def test_receiver_without_paths_predicts_with_gaussians(rooms: dict[str, Path]) -> None:
    """No reflections, and a floor blocks the direct path."""
    record = measured("rssi", rooms["known"])
    below = replace(record, tx_pos_m=record.tx_pos_m - np.array([0, 0, 9.0]))
    trainer = trained(below, rooms["known"], "traced.transmission=false", "steps=30")
    assert np.isfinite(trainer.predictor()(below.tx_pos_m[:4], 0)).all()
    with pytest.raises(InputError, match="rx0: no training row is reached by a path"):
        trained(below, rooms["known"], "model=ray-tracing", "traced.transmission=false", "steps=30")


def test_joint_field_uses_positions_instead_of_the_uplink(rooms: dict[str, Path]) -> None:
    record = measured("csi", rooms["known"])
    first = replace(record, receivers=record.receivers[:1], observation=record.observation[:1])
    first = replace(first, uplink=np.asarray(first.observation[0][:, None]))
    trainer = trained(first, rooms["known"], "steps=20")
    assert trainer.graph.form.features == 0
    rows = thirds(record).test
    found = trainer.predictor()(first.tx_pos_m[rows], 0)
    assert found.shape == first.observation[0, rows].shape
    nowhere = replace(first, tx_pos_m=np.full_like(first.tx_pos_m, np.nan))
    with pytest.raises(InputError, match="room has no position in row 0"):
        trained(nowhere, rooms["known"])
