"""Gateways without reception in training rows, and traces that are stopped.

Errors are a single line that names the data, before anything is written or progress is reported.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused

from wrf_mi.core import InputError, Split
from wrf_mi.datasets import load
from wrf_mi.models import ray_tracing
from wrf_mi.runs import api as runs
from wrf_mi.runs.api import train
from wrf_mi.runs.results import read_run
from wrf_mi.tracing import TraceOptions

DIRECT = TraceOptions(reflection=False, max_depth=0)
ROWS, TRAINED = 12, 8
GATEWAYS_M = {"near": (0.4, 0.5, 2.1), "far": (4.5, 3.4, 2.3)}


@pytest.fixture
def silent(tmp_path: Path) -> Path:
    """Strengths in the flat's room, in NeRF2's layout; the second gateway received none of the training rows."""
    folder = tmp_path / "silent"
    folder.mkdir()
    places = np.random.default_rng(4).uniform([0.6, 0.6, 1], [4.2, 3.2, 1.5], (ROWS, 3))
    lines = [f"{name}: [{x}, {y}, {z}]" for name, (x, y, z) in GATEWAYS_M.items()]
    (folder / "gateway_position.yml").write_text("\n".join([*lines, ""]))
    np.savetxt(folder / "tx_pos.csv", places, delimiter=",", header="x,y,z", comments="")
    powers = [f"{-50 - row},{-100 if row < TRAINED else -70 + row}" for row in range(ROWS)]
    (folder / "gateway_rssi.csv").write_text("\n".join(["near,far", *powers, ""]))
    for name, rows in (("train_index.txt", range(TRAINED)), ("test_index.txt", range(TRAINED, ROWS))):
        (folder / name).write_text("".join(f"{row}\n" for row in rows))
    return folder


@pytest.mark.parametrize("model", ["ray-tracing", "kriging", "mri"])
def test_a_gateway_without_training_rows_is_left_out(
    model: str, silent: Path, room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings, scene = (DIRECT, room) if model == "ray-tracing" else ((), None)
    left_out, alone = (
        train(data, tmp_path / name, model, scene=scene, settings=settings)
        for name, data in (("run", silent), ("alone", load(silent).at_receivers([0])))
    )
    assert left_out.metrics["receivers_left_out"] == {"far": 0}
    assert left_out.metrics["abs_error_db"] == alone.metrics["abs_error_db"]
    (message,) = [record.message for record in caplog.records if record.name == "wrf_mi.datasets.observations"]
    assert (
        message == "silent: receivers with fewer than 2 training rows are left out, with their number of rows: far (0)"
    )


def test_data_without_any_received_training_row_are_refused_before_anything_is_done(
    silent: Path, room: Path, tmp_path: Path
) -> None:
    record = load(silent)
    record.observation[:, :3] = np.nan
    split = Split("mine", 0, np.arange(3), np.zeros(0, np.int64), np.arange(3, 5))
    stages: list[str] = []
    message = r"nothing was received in the training rows by any receiver \(near, far\); use another split"
    for model, options in (("ray-tracing", {"scene": room, "settings": DIRECT}), ("kriging", {})):
        with pytest.raises(InputError, match=message):
            train(
                record,
                tmp_path / "run",
                model,
                split=split,
                on_progress=lambda *said: stages.append(said[0]),
                **options,
            )
        assert not (tmp_path / "run").exists()
    assert stages == []


def test_a_gateway_that_no_path_reaches_leaves_nothing_behind(flat_folder: Path, room: Path, tmp_path: Path) -> None:
    """It is known only from the paths."""
    nothing = TraceOptions(line_of_sight=False, reflection=False, transmission=True, max_depth=1)
    (tmp_path / "run").mkdir()
    with pytest.raises(InputError, match="no training row is both received and reached by a path"):
        train(flat_folder, tmp_path / "run", "ray-tracing", scene=room, settings=nothing)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("module", "stage"), [(ray_tracing, "fit_offsets"), (runs, "score_part")])
@pytest.mark.parametrize("split", ["official", "blocked"])
def test_a_stopped_trace_goes_on_with_its_paths(
    module: Any,
    stage: str,
    split: str,
    flat_folder: Path,
    room: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(module, stage, stopped)
        with pytest.raises(KeyboardInterrupt):
            train(flat_folder, out, "ray-tracing", scene=room, settings=DIRECT, split=split)
    written = (out / "paths.npz").stat().st_mtime_ns  # an hour's work may lie there
    again = ["train", flat_folder, "--model", "ray-tracing", "--scene", room, "--paths", "line-of-sight", "--depth", 0]
    refused([*again, "--out", out], f"{out}: exists and is not empty; choose another --out", capsys)
    refused(["compare", out, "--out", tmp_path / "page"], "no metrics.json, so no finished run; finish it", capsys)
    status, _, err = call(["train", "--resume", out], capsys)
    assert status == 0, err
    assert (out / "paths.npz").stat().st_mtime_ns == written
    assert read_run(out).metrics["paths"] > 0
