"""Arrays of every model: independent of test rows bit for bit, finite but for stated gaps, and enough to predict."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from calling import without_seconds
from made_channels import channels

from wrf_mi.backend import init
from wrf_mi.core import Record, Split
from wrf_mi.datasets import load
from wrf_mi.estimators.model import Arrays, default_settings, inputs_of
from wrf_mi.models import MODELS, Problem, Session

STEPS = ("steps=3", "log_every=100", "validate_every=3")
SMALL = ("initial.gaussians=8", "network.width=8", "network.layers=2", "density.every=0", *STEPS)
SETTINGS = {
    "wrf-gs": SMALL,
    "wrf-gs+": SMALL,
    "factorised": SMALL,
    "trees": ("trees=5",),
    "vae": (*STEPS, "width=8", "last=8"),
    "dcgan": (*STEPS, "channels=8"),
    "nerf2": (*STEPS, "samples=4", "rays=8"),
    "fire": (*STEPS, "width=8"),
    "optml": (*STEPS, "max_paths=2"),
    "r2f2": ("max_paths=2",),
    "ray-tracing": ("rays=1000", "depth=1"),
}
"""Settings of short fits; the others have none that matter."""
TASK = {"ray-tracing": "rssi", "hybrid": "rssi", "nerf2": "rssi", "wrf-gs+": "spectrum"}
"""Task where a model serves several; the first one else."""
WRONG = np.array([np.nan, np.inf, -np.inf])
ROUNDING = 1e-5
"""Sums in single precision, whose order may differ."""


def broken(record: Record, rows: np.ndarray) -> Record:
    """The record with values that are not finite throughout some rows."""
    observation = record.observation.copy()
    observation[:, rows] = np.resize(WRONG, observation[:, rows].shape)
    return replace(record, observation=observation)


def fitted_arrays(name: str, record: Record, split: Split, folder: Path) -> Arrays:
    """Arrays of a fitted model."""
    scene = None
    if MODELS[name].scene == "required":
        scene = str(folder / "room.ply")
        trimesh.creation.box((20, 20, 10)).export(scene)
    entry = MODELS[name].serving(record.task.name, scene is not None)
    arguments = {"model": name, "seed": 0, "deterministic": True}
    settings = default_settings(entry, SETTINGS.get(name, ()), arguments)
    problem = Problem(record, settings, 0, scene, None if scene is None else "concrete")
    session = Session(folder, folder)
    problem.settings = entry.prepare(problem, [split], session)
    fitted = entry.fit(problem, split, session)
    arrays, asked = fitted.arrays(), inputs_of(record, split.train[:2])
    assert not any(key.startswith("run/") for key in arrays)
    again = entry.load(arrays, problem, folder)
    for receiver in range(len(record.receivers)):
        before, after = (each.predict(asked, receiver) for each in (fitted, again))
        np.testing.assert_allclose(after.mean, before.mean, rtol=ROUNDING, atol=ROUNDING)
        assert (after.std is None) == (before.std is None)
        if before.std is not None:
            np.testing.assert_allclose(after.std, before.std, rtol=ROUNDING)
    for key, values in arrays.items():
        may_have_gaps = key.rpartition("/")[2] in entry.gaps or np.asarray(values).dtype.kind not in "fc"
        assert may_have_gaps or np.isfinite(values).all(), key
    return arrays


@pytest.mark.parametrize("name", MODELS)
def test_test_rows_do_not_reach_the_fit(name: str, one_gateway: Record, flat_folder: Path, tmp_path: Path) -> None:
    init("llvm", threads=1)
    of_task = {"spectrum": one_gateway, "rssi": load(flat_folder), "csi": channels()}
    record = of_task[TASK.get(name) or (MODELS[name].tasks or ("rssi",))[0]]
    train, test = record.official
    split, folders = Split("official", 0, train[:-3], train[-3:], test), [tmp_path / "clean", tmp_path / "broken"]
    for folder in folders:
        folder.mkdir()
    records = record, broken(record, test)
    clean, other = (fitted_arrays(name, of, split, folder) for of, folder in zip(records, folders, strict=True))
    assert clean.keys() == other.keys()
    for key in clean.keys() - {"trace_seconds"}:
        np.testing.assert_array_equal(without_seconds(clean[key]), without_seconds(other[key]), err_msg=key)
