"""What a fit has stored stays where it fails, and a resumed fit equals an uninterrupted one."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call
from traced_rooms import LENGTH, SHOEBOX, WIDTH, receiver, write_xml

from wrf_mi.apps.commands.output import Watch
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load, write_ble_folder
from wrf_mi.receivers import rssi_dbm
from wrf_mi.runs import api
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

HZ = 2.44e9
QUICK = ("stages=mean,residual",)


@pytest.fixture(scope="module")
def strengths(flat_folder: Path) -> Record:
    """Signal strengths without an official split."""
    return replace(load(flat_folder), official=None)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xml(tmp_path_factory.mktemp("room"), SHOEBOX)


@pytest.fixture(scope="module")
def walked(room: Path) -> Record:
    """Strengths that are traced in the room, with noise of 1 dB; an official split."""
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(0.5, [LENGTH - 0.5, WIDTH - 0.5], (36, 2)), np.full(36, 1.2)])
    receivers = (receiver([5.2, 2.4, 2.1], "rx0"), receiver([0.6, 4.2, 2.1], "rx1"))
    paths = trace_paths(open_scene(room, HZ), places, receivers, TraceOptions(depth=1, rays=1 << 12)).paths
    observed = np.asarray(rssi_dbm(paths) + rng.normal(0, 1, (2, 36)), np.float32)
    official = np.arange(30), np.arange(30, 36)
    return Record("room", "rssi", places, receivers, observed, official=official, frequencies_hz=np.array([HZ]))


def failing_at(stage: str, error: BaseException) -> Callable[..., None]:
    """Progress callback that raises an error at a stage."""

    def on_progress(reported: str, *more: Any) -> None:
        if reported.startswith(stage):
            raise error

    return on_progress


def stages_of(resumed: Callable[..., Any]) -> tuple[Any, list[str]]:
    """What a call returns, and the stages that it reports."""
    stages = list[str]()
    return resumed(on_progress=lambda stage, *_: stages.append(stage)), stages


def assert_noted(error: BaseException, folder: Path) -> None:
    assert error.__notes__ == [f"what was fitted is kept; go on with: wrf-mi train --resume {folder}"]


@pytest.mark.parametrize("kind", [InputError, RuntimeError, KeyboardInterrupt])
def test_folds_that_are_fitted_stay_where_a_later_one_fails(kind, strengths: Record, tmp_path: Path):
    known: dict[str, Any] = {"model": "kriging", "split": "none"}
    folder, plain = tmp_path / "run", api.train(strengths, out=tmp_path / "plain", **known)
    with pytest.raises(kind) as raised:
        api.train(strengths, out=folder, on_progress=failing_at("fold 3", kind("a fault")), **known)
    assert_noted(raised.value, folder)
    resumed, stages = stages_of(lambda **how: api.resume(folder, record=strengths, **how))
    assert not any(stage.startswith(("fold 1", "fold 2")) for stage in stages)
    assert resumed.metrics["abs_error_db"] == plain.metrics["abs_error_db"]


def test_stages_that_are_fitted_stay_where_a_later_one_fails(walked: Record, room: Path, tmp_path: Path):
    """The scene's stages take minutes; then interpolation without the scene fails."""
    known: dict[str, Any] = {"scene": room, "settings": QUICK, "deterministic": True}
    folder, plain = tmp_path / "run", api.train(walked, out=tmp_path / "plain", **known)
    with pytest.raises(InputError, match="a fault") as raised:
        api.train(walked, out=folder, on_progress=failing_at("kriging", InputError("a fault")), **known)
    assert_noted(raised.value, folder)
    stored = {path: path.stat().st_mtime_ns for path in (folder / "parts" / "paths").rglob("*.*")}
    # Predictions by the options of each stage, and by the chosen ones.
    assert {"chosen.npz", "as stated+local+default.npz"} <= {path.name for path in stored}
    resumed = api.resume(folder, record=walked)
    assert all(path.stat().st_mtime_ns == time for path, time in stored.items() if path.exists())
    for name in ("abs_error_db", "weights", "held_out"):
        assert resumed.metrics[name] == plain.metrics[name]


@pytest.mark.parametrize("intervals", [False, True])
def test_no_part_is_fitted_again_where_the_model_could_not_be_stored(intervals, walked, room, tmp_path, monkeypatch):
    """The disk is full; parts without a weight are removed only after the model is stored."""
    known: dict[str, Any] = {"model": "kriging"} if intervals else {"scene": room, "settings": QUICK}

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(api, "write_fitted", full)
        with pytest.raises(OSError, match="No space left") as raised:
            api.train(walked, out=tmp_path / "run", intervals=intervals, **known)
    assert_noted(raised.value, tmp_path / "run")
    _, stages = stages_of(lambda **how: api.resume(tmp_path / "run", record=walked, **how))
    assert not [stage for stage in stages if ", held-out rows" in stage]
    left = {path.name for path in (tmp_path / "run").rglob("*") if path.is_dir()}
    assert not left & {"tried", "held_out"}


def test_last_line_of_a_failed_fit_says_how_to_go_on(strengths: Record, tmp_path: Path, capsys, monkeypatch):
    data, folder = write_ble_folder(tmp_path / "data", strengths), tmp_path / "run"
    words = ["train", data, "--model", "kriging", "--split", "none", "--out", folder]
    with monkeypatch.context() as patched:
        fails = failing_at("fold 3", InputError("a fault in the data"))
        patched.setattr(Watch, "on_progress", lambda self, *report: fails(*report))
        status, _, err = call(words, capsys)
    note = f"a fault in the data; what was fitted is kept; go on with: wrf-mi train --resume {folder}"
    assert (status, err.splitlines()[-1]) == (2, f"wrf-mi: {note}")
    assert call(["train", "--resume", folder], capsys)[0] == 0


def test_folder_without_anything_fitted_is_removed(strengths: Record, tmp_path: Path):
    fault = InputError("a fault in the data")
    with pytest.raises(InputError, match=re.escape(str(fault))) as raised:
        api.train(strengths, "kriging", out=tmp_path / "run", split="none", on_progress=failing_at("fold 1", fault))
    assert not hasattr(raised.value, "__notes__")
    assert not (tmp_path / "run").exists()
