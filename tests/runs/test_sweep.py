"""A sweep: which runs, their names and table, going on, a lost worker, what is refused, and digests of its data."""

import argparse
import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from calling import SET
from commands import rows_of

from wrf_mi.apps.commands.main import build_parser, main
from wrf_mi.apps.commands.train import TRACING, training_names, training_request
from wrf_mi.core import InputError
from wrf_mi.core.digest import content_digest
from wrf_mi.runs import sweep as module
from wrf_mi.runs.folder import RunRequest, package_versions
from wrf_mi.runs.results import read_run
from wrf_mi.runs.sweep import FLAGS, OPTIONS, Sweep, check_failures, plan_sweep, run_sweep, scene_files, sweep_table

SECONDS = 60
"""For a worker to begin its part, on a busy machine."""
NAMES = [f"seed={seed},loss.ssim_weight=0.1" for seed in range(3)]
VARY = ("seed=0,1,2", "loss.ssim_weight=0.1")


def test_plan_has_every_combination_with_a_name_and_a_command(tmp_path: Path) -> None:
    options, settings = {"dataset": "rfid-lab", "model": "mri"}, ["holdout_steps_fraction=0"]
    plan = plan_sweep(tmp_path, ["split=official,blocked:2", "steps=1;2"], options, settings, ["--flag"])
    assert plan.varied == ["split", "steps"]
    names = ["split=official,steps=1", "split=official,steps=2", "split=blocked-2,steps=1", "split=blocked-2,steps=2"]
    assert [run.folder for run in plan.runs] == [tmp_path / name for name in names]
    words = "train rfid-lab --model mri --split blocked:2 --flag --set holdout_steps_fraction=0 --set steps=1"
    assert " ".join(plan.runs[2].arguments) == words
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ([], "nothing varies"),
        (["seed"], "expected KEY=VALUE,VALUE"),
        (["seed=1,,2"], "expected KEY=VALUE,VALUE"),
        (["seed=1,2,1"], "a value is given twice"),
        (["seed=1", "seed=2"], "seed is given already"),
        (["steps=1"], "steps is given already"),
        (["model=mri"], "model is given already"),
        (["scene=a/b,a b"], "two runs would be named scene=a-b"),
        (["intervals=true,maybe"], "intervals is on or off; give true, false"),
        (["deterministic=true,false"], "deterministic is given already"),
    ],
)
def test_bad_plans_are_refused(vary: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        plan_sweep(tmp_path, vary, {"dataset": "x", "model": "wrf-gs"}, ["steps=3"], ["--deterministic"])


def test_a_preset_is_that_of_the_models_that_have_some(tmp_path: Path) -> None:
    fast = {"dataset": "x", "preset": "fast"}
    plan = plan_sweep(tmp_path, ["model=kriging,wrf-gs+"], fast)
    assert [" ".join(run.arguments) for run in plan.runs] == [
        "train x --model kriging",
        "train x --preset fast --model wrf-gs+",
    ]
    # No run has it, which train refuses.
    assert all("--preset" in run.arguments for run in plan_sweep(tmp_path, ["model=kriging,idw"], fast).runs)


def test_every_option_of_train_may_vary(tmp_path: Path) -> None:
    assert set(training_names()) == {*OPTIONS, *FLAGS, "set"}
    plan = plan_sweep(tmp_path, ["intervals=true,false", "phase-error=0,1"], {"dataset": "x"})
    assert [" ".join(run.arguments) for run in plan.runs] == [
        f"train x --phase-error {error}{flag}" for flag in (" --intervals", "") for error in (0, 1)
    ]


def option_value(action: argparse.Action) -> list[str]:
    """A value of an option that is not its default, in words."""
    values = {"model": "ray-tracing", "calibrate": "gain", "n_train": "7", "rays": "64", "paths": "line-of-sight"}
    values |= {"phase_error": "0.5", "preset": "fast", "set": "stages=mean", "stages": "mean"}
    if action.nargs == 0:
        return []
    return [values.get(action.dest) or (str(list(action.choices)[-1]) if action.choices else "9")]


SWEEP: Any = dict(vars(build_parser()._subparsers._group_actions[0])["choices"])["sweep"]
ACTIONS = [
    action
    for action in SWEEP._actions
    if action.option_strings and action.dest not in ("help", "json", "vary", "out", "scheduler")
]
"""Options of sweep that each run has."""


@pytest.mark.parametrize("action", ACTIONS, ids=lambda action: action.dest)
def test_each_run_has_every_option_of_the_sweep(action, tmp_path, monkeypatch):
    """Options that a sweep shares with train are those of its runs, alone and varied."""
    planned: list[Sweep] = []

    def stop(dataset: str, request: RunRequest) -> None:
        raise InputError("planned")

    def plan(*arguments: Any) -> Sweep:
        planned.append(plan_sweep(*arguments))
        return planned[-1]

    monkeypatch.setattr(module, "plan_sweep", plan)
    monkeypatch.setattr(module, "check_run", stop)
    # The tracer's options belong to its model.
    model = ["--model", "ray-tracing"] if action.dest in TRACING else []
    model = ["--model", "wrf-gs+"] if action.dest in ("preset", "receiver", "evaluation") else model
    option = [action.option_strings[0], *option_value(action)]
    other = "loss.ssim_weight" if action.dest == "seed" else "seed"
    common = ["sweep", "data", *model, "--vary", f"{other}=0,1", "--out", str(tmp_path / "sweep")]
    parser = build_parser()
    for arguments in (common, [*common, *option]):
        assert main(arguments) == 2
    plain, optioned = (parser.parse_args(sweep.runs[0].arguments) for sweep in planned)
    assert vars(plain) | {action.dest: getattr(optioned, action.dest)} == vars(optioned)
    assert getattr(optioned, action.dest) == getattr(parser.parse_args(["train", *option]), action.dest)
    assert training_request(plain) != training_request(optioned)


def test_bad_input_is_refused_before_anything_starts(folder, flat_folder, tmp_path, command):
    out = tmp_path / "sweep"
    for data, varied, message in (
        (folder, "seed=0,x", "--seed: invalid int value: 'x'"),
        (folder, "model=wrf-gs,other", "--model: model 'other': no such model"),
        (folder, "no.such=1", "unknown setting no.such"),
        (folder, "batch=1,0", "batch: 0 is out of range"),
        (folder, "split=official,blocked:9", "blocked"),
        (folder, "initial.points=nowhere.ply", "nowhere.ply"),
        (folder, "scene=a,b", "carrier frequency unknown"),
        (folder, "model=kriging steps=1", "steps"),
        (folder, "model=kriging n-train=0,4", "n_train 0; choose 1"),
        (flat_folder, "model=vae seed=0,1", "holds rssi; vae serves spectrum, so choose another model"),
        (flat_folder, "model=ray-tracing scene=nowhere", "nowhere"),
        (tmp_path / "none", "seed=0,1", "none"),
    ):
        vary = [part for option in varied.split() for part in ("--vary", option)]
        model = [] if varied.startswith("model") else ["--model", "wrf-gs+"]
        command.refused(["sweep", data, *model, *vary, "--out", out], message)
        assert not out.exists(), varied


@contextmanager
def runs_in_this_process() -> Iterator[None]:
    """Without a process for each run, which takes seconds to import; the sweep of baselines starts them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "run_module", lambda name, arguments: (main(list(arguments)), ""))
        yield


@pytest.fixture(scope="module")
def swept(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs, one after the other."""
    out, settings = tmp_path_factory.mktemp("sweeps") / "serial", [part for part in SET if part != "--set"]
    plan = plan_sweep(out, VARY, {"dataset": str(folder), "model": "wrf-gs+"}, settings, ["--deterministic"])
    with runs_in_this_process():
        assert [row["status"] for row in run_sweep(plan)] == ["done"] * 3
    return out


def test_table_contains_the_scores_of_the_runs(swept: Path) -> None:
    assert sorted(path.name for path in swept.iterdir() if path.is_dir()) == NAMES
    rows = rows_of(swept / "scores.csv")
    assert [(row["seed"], row["loss.ssim_weight"]) for row in rows] == [("0", "0.1"), ("1", "0.1"), ("2", "0.1")]
    for row, full in zip(rows, json.loads((swept / "scores.json").read_text()), strict=True):
        run = read_run(row["run"])
        assert full["metrics"] == run.metrics
        assert (row["score"], float(row["median"])) == ("SSIM", pytest.approx(np.median(run.score)))
        assert float(row["reference_median"]) == pytest.approx(np.median(run.reference_score))
    lines = (swept / "scores.md").read_text().splitlines()
    assert len(lines) == 5
    assert lines[0].startswith("| seed | loss.ssim_weight | score | median |")
    assert len({len(line.split("|")) for line in lines}) == 1


@pytest.mark.slow
def test_lost_worker_loses_no_run_and_results_are_those_of_one_process(folder, swept, tmp_path, command):
    """The command on two workers, one of which is killed while it trains."""
    out, killed = tmp_path / "sweep", list[int]()

    def kill_one() -> None:
        until = time.monotonic() + SECONDS
        while not killed and time.monotonic() < until:
            for worker in psutil.Process().children(recursive=True):
                try:
                    busy = any("wrf_mi.parallel.child" in " ".join(c.cmdline()) for c in worker.children())
                except psutil.Error:
                    continue
                if busy and any(out.glob("seed=*")):
                    os.kill(worker.pid, signal.SIGKILL)
                    killed.append(worker.pid)
                    return
            time.sleep(0.02)

    killer = threading.Thread(target=kill_one)
    killer.start()
    varied = ["--set", "loss.ssim_weight=0.1", "--vary", "seed=0,1", "--out", out, "--scheduler", "local:2", "--json"]
    status, printed, err = command(["sweep", folder, "--model", "wrf-gs+", *SET, "--deterministic", *varied])
    killer.join()
    assert status == 0, err
    assert killed
    rows = json.loads(printed)
    names = ["seed=0", "seed=1"]
    assert [Path(row["run"]).name for row in rows] == names
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == names
    assert len(err.splitlines()) == 2
    for name in names:
        serial, parallel = read_run(swept / f"{name},loss.ssim_weight=0.1"), read_run(out / name)
        np.testing.assert_array_equal(parallel.row, serial.row)
        np.testing.assert_array_equal(parallel.prediction, serial.prediction)
        steps = [json.loads(line)["step"] for line in (out / name / "log.jsonl").read_text().splitlines()]
        assert steps == [2, 4]


def test_finished_runs_are_kept_and_others_done_again(folder, swept, tmp_path, command):
    out = shutil.copytree(swept, tmp_path / "sweep")
    for file in ("metrics.json", "predictions.npz"):  # as if stopped while it was scored
        (out / NAMES[0] / file).unlink()
    (out / NAMES[1] / "config.yaml").unlink()  # as if stopped before it began
    (out / NAMES[1] / "metrics.json").unlink()
    date = (out / NAMES[2] / "metrics.json").stat().st_mtime_ns
    vary = [part for varied in VARY for part in ("--vary", varied)]
    again = ["sweep", folder, "--model", "wrf-gs+", *SET, "--deterministic", *vary, "--out", out]
    with runs_in_this_process():
        command.done(again)
    rows = json.loads((out / "scores.json").read_text())
    assert [row["status"] for row in rows] == ["done", "done", "kept"]
    assert (out / NAMES[2] / "metrics.json").stat().st_mtime_ns == date
    for name in NAMES:
        np.testing.assert_array_equal(read_run(out / name).prediction, read_run(swept / name).prediction)
    command.refused([*again, "--set", "holdout_steps_fraction=0"], "holds a sweep with other settings")
    command.refused([*again[:-1], folder], "holds no sweep")


def test_sweep_refuses_other_data_and_versions(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = shutil.copytree(folder, tmp_path / "data")
    monkeypatch.setattr(module, "run_module", lambda *call: (1, "not run"))

    def again(*values: str) -> list[str]:
        plan = plan_sweep(tmp_path / "sweep", ["seed=0,1", *values], {"dataset": str(data)})
        return [row["status"] for row in run_sweep(plan)]

    assert again() == again() == ["not run"] * 2
    original = (data / "gateway_info.yml").read_bytes()
    (data / "gateway_info.yml").write_bytes(original + b"\n")
    with pytest.raises(InputError, match=rf"holds a sweep with other content of {data}; choose another --out"):
        again()
    (data / "gateway_info.yml").write_bytes(original)
    versions = package_versions()
    monkeypatch.setattr(module, "package_versions", lambda: versions | {"drjit": "0.1"})
    with pytest.raises(InputError, match="holds a sweep by other versions of drjit; choose another --out"):
        again()
    path = tmp_path / "sweep" / "sweep.json"
    stored = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in stored.items() if key != "versions"}))
    with pytest.raises(InputError, match="by other versions of what it does not state"):
        again()


def test_failed_run_is_reported_and_the_others_go_on(folder, tmp_path, monkeypatch, command):
    plan = plan_sweep(tmp_path / "sweep", ["seed=0,1"], {"dataset": str(folder)})
    calls = []

    def run(name: str, arguments: tuple[str, ...]) -> tuple[int, str]:
        calls.append(arguments)
        return (1, "wrf-mi: out of | memory") if "0" in arguments else (-6, "")

    monkeypatch.setattr(module, "run_module", run)
    rows = run_sweep(plan)
    assert len(calls) == 2
    assert [row["status"] for row in rows] == ["out of | memory", "ended with status -6"]
    assert "| out of \\| memory |" in sweep_table(rows, plan.varied)
    with pytest.raises(module.SweepFailed, match=r"2 of 2 runs failed: seed=0: out of \| memory; seed=1: ended"):
        check_failures(rows)
    status, _, err = command(["sweep", folder, "--vary", "seed=0,1", "--out", tmp_path / "other"])
    assert status == 1
    assert err.splitlines()[-1].startswith("wrf-mi: sweep: 2 of 2 runs failed: ")


def test_digest_tells_values_apart() -> None:
    values: list[Any] = [
        "a", "b", 1, 1.0, True, None, (), ("a",), ("a", "b"), "a\n'b'", {"a": 1}, {"a": 2}, {"b": 1}, [("a", 1)],
        np.zeros(2), np.zeros(2, np.float32), np.zeros((1, 2)), np.zeros((2, 1)), np.array([0, 1.0]),
    ]  # fmt: skip
    assert len({content_digest(value) for value in values}) == len(values)
    assert content_digest({"a": 1, "b": 2}) == content_digest({"b": 2, "a": 1})
    assert content_digest(np.arange(6).reshape(2, 3).T) == content_digest(np.arange(6).reshape(2, 3).T.copy())
    with pytest.raises(TypeError, match="object has no digest"):
        content_digest(object())


def test_digest_of_a_folder_is_that_of_names_and_contents(tmp_path: Path) -> None:
    scene, copy = tmp_path / "scene", tmp_path / "copy"
    (scene / "meshes").mkdir(parents=True)
    named = '<scene><shape type="ply"><string name="filename" value="{}"/></shape></scene>'
    (scene / "scene.xml").write_text(named.format("meshes/wall.ply"))
    (scene / "meshes" / "wall.ply").write_text("ply")
    shutil.copytree(scene, copy)
    assert content_digest(copy) == content_digest(scene)
    (copy / "beside.xml").write_text(named.format("floor.ply"))
    (copy / "floor.ply").write_text("ply")
    for file, mesh in (("scene.xml", "meshes/wall.ply"), ("beside.xml", "floor.ply")):
        before = content_digest(scene_files(copy / file))
        (copy / mesh).write_text("ply2")
        assert content_digest(scene_files(copy / file)) != before
    for name in ("beside.xml", "floor.ply"):
        (copy / name).unlink()
    assert content_digest(copy) != content_digest(scene)
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "meshes").symlink_to(copy / "meshes")
    before = content_digest(tmp_path / "linked")
    (copy / "meshes" / "wall.ply").write_text("ply")
    assert content_digest(tmp_path / "linked") != before
    assert content_digest(copy) == content_digest(scene)
    (copy / "meshes" / "wall.ply").rename(copy / "meshes" / "door.ply")
    assert content_digest(copy) != content_digest(scene)
    assert scene_files("laboratory") == []
    with pytest.raises(InputError, match="no such file or folder"):
        content_digest(tmp_path / "none")
