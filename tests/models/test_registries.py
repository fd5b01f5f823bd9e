"""Models, receiver models, benchmarks, tasks and layouts from outside the package, registered or installed."""

import csv
import json
import sys
import types
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from outside_packages import ATTENUATORS, CABLE_DB, NEAREST, STEPS, commands, installed
from small_fits import stop_after
from wrf_mi_bench import bench
from wrf_mi_bench.bench import CHECKS, Check

from wrf_mi import models
from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.datasets import load
from wrf_mi.datasets.ble_folder import write_ble_folder
from wrf_mi.receivers import registry as receivers
from wrf_mi.receivers.registry import RECEIVERS
from wrf_mi.runs.api import Interrupted, evaluate_run, open_run, resume, train
from wrf_mi.runs.compare import compare
from wrf_mi.stages.further import FURTHER_STAGES
from wrf_mi.tasks import LOSSES

pytestmark = pytest.mark.usefixtures("undrawn")
SETTINGS: tuple[str, ...] = ("steps=60", "batch=8", "validate_every=20", "checkpoint_every=20", "initial.gaussians=6")
SETTINGS += ("network.layers=2", "network.width=8", "view.height=4", "view.columns=8", "deterministic=true")
FIELD_DB = 50.0  # field strength at one metre
SERVED = {"trees": "rssi", "wrf-gs": "spectrum, rssi and csi", "factorised": "spectrum, rssi and csi"}
"""Tasks of models that do not serve a task of others."""


def registered(name: str, source: str, entry: str, of: Any, registry: Any) -> Iterator[None]:
    """Register an entry of a module; another of its name is refused."""
    module = sys.modules[name] = types.ModuleType(name)  # where its dataclass looks for its types
    exec(source, module.__dict__)
    of.register(getattr(module, entry))
    added = getattr(module, entry).name
    with pytest.raises(InputError, match=f"{registry._what} '{added}': there is one of that name; choose another"):
        of.register(getattr(module, entry))
    yield
    del registry._known[added], sys.modules[name]


@pytest.fixture
def nearest() -> Iterator[None]:
    yield from registered("nearest_of_others", NEAREST, "MODEL", models, models.MODELS)


@pytest.fixture
def attenuated() -> Iterator[None]:
    yield from registered("attenuators", ATTENUATORS, "Attenuated", receivers, receivers.RECEIVERS)


def test_registered_model_is_trained_resumed_evaluated_and_compared(nearest, flat_folder, tmp_path, command) -> None:
    out = tmp_path / "run"
    with pytest.raises(Interrupted, match=rf"stopped in nearest rows; go on with: wrf-mi train --resume {out}"):
        train(flat_folder, "nearest", out=out, settings=("neighbours=2",), stop=lambda: True)
    command.refused(["evaluate", out], r"model\.npz: missing, the fit was stopped; finish it with train --resume")
    reported: list[tuple[str, float]] = []
    run = resume(out, on_progress=lambda stage, share, *_: reported.append((stage, share)))
    assert reported == [("nearest rows", 0.0)]
    assert (run.metrics["model"], run.metrics["rows"]) == ("nearest", 24)
    assert 0 < run.metrics["inside_90"] <= 1
    assert evaluate_run(out)["abs_error_db"] == run.metrics["abs_error_db"]
    record = load(flat_folder)
    first = open_run(out).predict(record.tx_pos_m[:1], "anchor1")
    rows = np.argsort(np.linalg.norm(record.tx_pos_m[:24] - record.tx_pos_m[0], axis=1))[:2]
    assert first.mean == pytest.approx([record.observation[0, rows].mean()])
    with pytest.raises(InputError, match="does not know how the transmitter is turned; omit heading_rad"):
        run.predict(record.tx_pos_m[:1], 0, [0.5])
    other = train(flat_folder, "nearest", out=tmp_path / "blocked", split="blocked")
    compare([out, other.folder], tmp_path / "page")
    with (tmp_path / "page" / "compare.csv").open(newline="") as file:
        assert [row["model"] for row in csv.DictReader(file)][:2] == ["nearest", "nearest"]
    command.refused(["train", flat_folder, "--model", "nearest", "--scene", "x", "--out", "y"], "takes no scene")


def test_registered_receiver_is_trained_resumed_evaluated_and_compared(attenuated, flat_folder, tmp_path) -> None:
    out = tmp_path / "run"
    with pytest.raises(Interrupted):
        train(flat_folder, "wrf-gs+", out=out, settings=SETTINGS, receiver="attenuated", stop=stop_after(30))
    run = resume(out)
    assert evaluate_run(out)["abs_error_db"] == run.metrics["abs_error_db"]
    positions = load(flat_folder).tx_pos_m[:2]
    predicted = open_run(out).predict(positions, 0).mean
    # The field is the same but for the attenuator.
    field = open_run(out).field
    field.form = replace(field.form, receiver="power")
    np.testing.assert_allclose(field.predictor(positions, 0), predicted + CABLE_DB, atol=1e-3)
    assert compare([out], tmp_path / "page").is_file()


@pytest.fixture
def stepped(tmp_path: Path) -> Iterator[Path]:
    """Strengths in steps of 4 dB by the law of distance, and the stage of another package that knows of steps."""
    module: dict[str, Any] = {}
    exec(STEPS, module)
    FURTHER_STAGES.add("steps", module["STAGE"])
    yield write_ble_folder(tmp_path / "data", in_steps())
    del FURTHER_STAGES._known["steps"]


def in_steps() -> Record:
    tx = np.random.default_rng(1).uniform([0, 0, 1], [12, 8, 1], (90, 3))
    receiver = Receiver("r", np.array([1.0, 1.0, 2.5]), np.array([0.0, 0, 0, 1]))
    power_dbm = -30 - 35 * np.log10(np.linalg.norm(tx - receiver.position_m, axis=1))
    observed = (4 * np.round(power_dbm / 4))[None].astype(np.float32)
    official = np.arange(60), np.arange(60, 90)
    return Record("steps", "rssi", tx, (receiver,), observed, frequencies_hz=np.array([2.4e9]), official=official)


def test_stage_of_another_package_is_trained_resumed_evaluated_and_compared(stepped: Path, tmp_path: Path) -> None:
    out, reports = tmp_path / "run", [""]
    with pytest.raises(Interrupted):
        train(stepped, out=out, on_progress=lambda what, *_: reports.append(what), stop=lambda: "fitted" in reports[-1])
    run = resume(out)
    uninterrupted = train(stepped, out=tmp_path / "whole")
    assert run.metrics["abs_error_db"] == uninterrupted.metrics["abs_error_db"] == evaluate_run(out)["abs_error_db"]
    chosen = {report["option"]: report for report in run.metrics["options"] if report["stage"] == "steps"}
    assert [name for name, report in chosen.items() if report["taken"]] == ["in steps"]
    without = train(stepped, out=tmp_path / "without", settings=("stages=residual",))
    assert run.metrics["abs_error_db"]["mean"] < without.metrics["abs_error_db"]["mean"]
    assert [(report["stage"], report["kept"]) for report in run.stages] == [("steps", True)]
    assert run.stages[0]["test"] == pytest.approx(run.metrics["abs_error_db"]["mean"])
    predicted = open_run(out).predict([[2.0, 3.0, 1.0], [9.0, 5.0, 1.0]], 0)
    np.testing.assert_array_equal(predicted.mean % 4, 0)
    assert predicted.std is not None
    assert compare([out, without.folder], tmp_path / "page").is_file()


@pytest.fixture
def noted_loss() -> Iterator[list[tuple[int, ...]]]:
    """A loss of the name ``noted``, the squared error, which notes the shapes that it is called with."""
    shapes = list[tuple[int, ...]]()

    def loss(prediction: Any, truth: Any, batch: int, *shape: int) -> Any:
        shapes.append((batch, *shape))
        return LOSSES["squared-error"](prediction, truth, batch, *shape)

    LOSSES.add("noted", loss)
    yield shapes
    del LOSSES._known["noted"]


def test_loss_of_a_name_is_trained_resumed_stored_and_compared(noted_loss, flat_folder: Path, tmp_path: Path) -> None:
    asked: dict[str, Any] = {"settings": SETTINGS, "loss": "noted"}
    with pytest.raises(Interrupted):
        train(flat_folder, "wrf-gs+", out=tmp_path / "run", **asked, stop=stop_after(2))
    assert noted_loss
    noted_loss.clear()
    run = resume(tmp_path / "run")
    assert noted_loss, "a resumed training has the loss that it began with"
    uninterrupted = train(flat_folder, "wrf-gs+", out=tmp_path / "whole", **asked)
    assert (
        run.metrics["abs_error_db"] == uninterrupted.metrics["abs_error_db"] == evaluate_run(run.folder)["abs_error_db"]
    )
    other = train(flat_folder, "wrf-gs+", out=tmp_path / "other", settings=SETTINGS)
    assert other.metrics["abs_error_db"] != uninterrupted.metrics["abs_error_db"]
    squared = train(flat_folder, "wrf-gs+", out=tmp_path / "squared", settings=SETTINGS, loss="squared-error")
    assert squared.metrics["abs_error_db"] == uninterrupted.metrics["abs_error_db"]
    assert np.isfinite(open_run(run.folder).predict([[1.0, 2.0, 1.3]], 0).mean).all()
    assert compare([run.folder, other.folder], tmp_path / "page").is_file()


def test_unknown_losses_and_models_without_one_are_refused(flat_folder: Path, folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="loss 'hubber': no such loss; choose from absolute-error, squared-error"):
        train(flat_folder, "wrf-gs+", out=tmp_path / "run", loss="hubber")
    with pytest.raises(InputError, match=r"belongs to fields of Gaussians \(.*wrf-gs\+.*\), not to kriging"):
        train(flat_folder, "kriging", out=tmp_path / "run", loss="squared-error")
    with pytest.raises(InputError, match=r"loss.ssim_weight.*in whose place loss\.name is"):
        train(folder, "wrf-gs", out=tmp_path / "run", loss="squared-error", settings=("loss.ssim_weight=0.3",))
    assert not (tmp_path / "run").exists()


def test_receiver_of_another_task_or_unknown_is_refused(attenuated, flat_folder: Path, tmp_path: Path) -> None:
    for name, reason in (("pixel", "pixel does not observe rssi"), ("horn", "'horn': unknown")):
        with pytest.raises(InputError, match=f"receiver model {reason}; choose from power, attenuated"):
            train(flat_folder, "wrf-gs+", out=tmp_path / "run", receiver=name)
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def outcome(flat_folder: Path, tmp_path_factory) -> tuple[Path, dict[str, tuple[int, str, str]]]:
    """A folder of runs by commands, whose packages are installed, and what each command returned."""
    folder = tmp_path_factory.mktemp("runs")
    environment, data = installed(folder / "site"), folder / "corridor"
    data.mkdir()
    places = np.random.default_rng(0).uniform(0, 5, (40, 3))
    delay_ns = 30 + 5 * places[:, 0] + np.sin(places[:, 1])
    table = np.column_stack([places, delay_ns])
    np.savetxt(data / "delays.csv", table, "%.4f", ",", header="x,y,z,delay_ns", comments="")
    (folder / "tx.csv").write_text("x,y,z\n1,2,1\n3,1,2\n")
    fields = folder / "fields"
    fields.mkdir()
    table[:, 3] = FIELD_DB - 20 * np.log10(np.linalg.norm(places - [0, 0, 2], axis=1))
    np.savetxt(fields / "fields.csv", table, "%.4f", ",", header="x,y,z,field_db", comments="")
    words = [word for setting in SETTINGS for word in ("--set", setting)]
    of_others = ["--set", "loss.name=huber", "--set", "attributes=roughness", "--set", "density.every=20"]
    field = ["--model", "wrf-gs+", "--json", *words, *of_others, "--set", "density.stop=0.7", "--out", folder / "field"]
    asked = ["--receiver-model", "attenuated", "--json", *words, "--out", folder / "attenuated"]
    nearest = ["--model", "nearest", "--set", "neighbours=1", "--json", "--out", folder / "nearest"]
    calls = {
        model: ["train", data, "--model", model, "--out", folder / model]
        for model in ("idw", "kriging", "hybrid", *SERVED)
    }
    calls |= {
        "nearest": ["train", flat_folder, *nearest],
        "receiver": ["train", flat_folder, "--model", "wrf-gs+", *asked],
        "field": ["train", fields, *field],
        "stage": ["train", write_ble_folder(folder / "steps", in_steps()), "--out", folder / "stage", "--json"],
        "benchmark": ["bench", "attenuator", "--out", folder / "results", "--runs", folder / "benchmarks"],
    }
    for name in ("idw/metrics.json", "field/model.npz", "field/metrics.json"):
        calls[name] = ["remove", folder / name]  # as of runs that were stopped
    # Models and stages are resumed, scored and compared within this process above.
    for run in ("idw", "field"):
        calls |= {
            f"{run} resumed": ["train", "--resume", folder / run, "--json"],
            f"{run} scored": ["evaluate", folder / run, "--json"],
            f"{run} compared": ["compare", folder / run, "--out", folder / f"{run} page"],
        }
    for run in ("nearest", "kriging", "stage", "field"):
        out = folder / f"{run}.npz"
        calls[f"{run} predicted"] = ["predict", folder / run, "--tx", folder / "tx.csv", "--out", out]
    calls["field exported"] = [
        "export",
        folder / "field",
        "--format",
        "3dgs",
        "--tx",
        "1,2,1",
        "--out",
        folder / "splat.ply",
    ]
    return folder, commands(environment, calls)


def test_commands_find_the_model_of_an_installed_package(outcome: Any) -> None:
    folder, results = outcome
    assert [results[name][0] for name in ("nearest", "nearest predicted")] == [0] * 2, results
    with np.load(folder / "nearest.npz") as predicted:
        assert predicted["prediction"].shape == predicted["std"].shape == (2, 2)


def test_commands_find_the_receiver_and_the_benchmark_of_an_installed_package(outcome: Any) -> None:
    folder, results = outcome
    assert json.loads(results["receiver"][1])["task"] == "rssi"
    assert results["benchmark"][0] == 0
    stored = json.loads((folder / "results" / "attenuator.json").read_text())
    assert stored["figures"]["rows"] == [{"what": "attenuation", "value": "17.0 dB", "asked": "17 dB"}]
    assert "attenuation" in (folder / "results" / "README.md").read_text()


def test_commands_find_the_stage_of_an_installed_package(outcome: Any) -> None:
    folder, results = outcome
    assert [results[name][0] for name in ("stage", "stage predicted")] == [0] * 2, results
    with np.load(folder / "stage.npz") as predicted:
        np.testing.assert_array_equal(predicted["prediction"] % 4, 0)


def test_commands_train_gaussians_on_task_receiver_loss_and_attribute_of_an_installed_package(outcome: Any) -> None:
    folder, results = outcome
    asked = [f"field{how}" for how in ("", " resumed", " scored", " predicted", " compared", " exported")]
    assert [results[name][0] for name in asked] == [0] * 6, results
    errors = [json.loads(results[name][1])["abs_error_db"] for name in asked[:3]]
    assert errors[0] == errors[1] == errors[2]
    with np.load(folder / "field.npz") as predicted:
        # Of the power of the Gaussians, which is far below, and the meter's factor.
        assert predicted["prediction"] == pytest.approx(FIELD_DB, abs=30)
    assert "name: huber" in (folder / "field" / "config.yaml").read_text()
    with np.load(folder / "field" / "model.npz") as arrays:
        stored = arrays["params/roughness"]
    assert stored.shape[0] == 1
    assert not np.isin(stored, np.array([0.1, 0.05], np.float32)).any()  # all have been trained
    exported = trimesh.load(folder / "splat.ply").metadata["_ply_raw"]["vertex"]["data"]["roughness"]
    np.testing.assert_array_equal(np.ravel(exported), stored[0])


def test_commands_find_the_task_and_the_layout_of_an_installed_package(outcome: Any) -> None:
    folder, results = outcome
    for model in ("idw", "kriging", "hybrid"):
        status, out, err = results[model]
        assert status == 0, err
        assert "absolute error (ns) on 10 test rows" in out
    for model, tasks in SERVED.items():
        status, _, err = results[model]
        assert (status, err.count("\n")) == (2, 1), err
        assert f"holds delay-spread; {model} serves {tasks}, so choose another model: hybrid, idw, kriging" in err
        assert not (folder / model).exists()
    again = [results[name] for name in ("idw resumed", "idw scored", "kriging predicted", "idw compared")]
    assert [status for status, _, _ in again] == [0] * 4, again
    with np.load(folder / "kriging.npz") as predicted:
        assert predicted["prediction"] == pytest.approx([30 + 5 + np.sin(2), 30 + 15 + np.sin(1)], abs=3)
    assert "absolute error (ns)" in (folder / "idw page" / "index.html").read_text()


def test_registered_benchmark_is_listed() -> None:
    bench.register("own", Check("own", "json:dumps"))
    try:
        assert "own" in CHECKS
        with pytest.raises(InputError, match="benchmark 'own': there is one of that name"):
            bench.register("own", Check("own", "json:dumps"))
    finally:
        del bench._CHECKS._known["own"]
    assert {"pixel", "array", "power", "csi"} <= set(RECEIVERS)
