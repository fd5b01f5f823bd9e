"""The command: what it prints where, its exit status, and one line for whatever is wrong with its input."""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from calling import SET
from changed_folders import needs
from commands import Command, arrays_in, rows_of
from made_spectra import SIZE

from wrf_mi import synthetic
from wrf_mi.apps.commands import demo
from wrf_mi.apps.commands.main import build_parser, main
from wrf_mi.apps.commands.output import Watch
from wrf_mi.backend.device import Recorded
from wrf_mi.core import InputError
from wrf_mi.datasets import load, make_splits
from wrf_mi.runs import api as runs
from wrf_mi.runs.api import open_run
from wrf_mi.synthetic import stored
from wrf_mi.training.checkpoint import read_checkpoint
from wrf_mi.training.loop import Progress
from wrf_mi.training.session import quiet

SECONDS_TO_START = 120
"""Importing, compiling and a first step take some 3 s; a busy machine needs much longer."""
COMMANDS = {"doctor", "check", "data", "mesh", "correct", "edit", "train", "trace", "sweep", "evaluate", "predict"}
COMMANDS |= {"compare", "table", "map", "locate", "view", "export", "import", "bench", "demo", "plan"}


def commands(parser: argparse.ArgumentParser, name: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The command and all its subcommands."""
    yield name
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for key, sub in action.choices.items():
                yield from commands(sub, (*name, key))


def training(folder: Path, out: Path, *more: Any, model: str = "wrf-gs+", **changed: float) -> list[Any]:
    assignments = [word for word in SET if word != "--set" and word.partition("=")[0] not in changed]
    assignments += [f"{name}={value}" for name, value in changed.items()]
    settings = [word for setting in assignments for word in ("--set", setting)]
    return ["train", folder, "--model", model, "--out", out, *settings, *more]


def test_every_command_has_help(command: Command) -> None:
    names = list(commands(build_parser()))
    assert {name[0] for name in names if name} == COMMANDS
    for name in names:
        status, out, err = command([*name, "--help"])
        assert (status, err) == (0, ""), name
        assert out.startswith(f"usage: {' '.join(('wrf-mi', *name))} ")


def test_help_imports_no_tracer_and_a_training_no_package_of_scenes_and_pictures() -> None:
    """Help and parser errors appear before Dr.Jit, Mitsuba or Sionna RT is imported.

    What a training leaves out takes the longest to import: a quarter of its start each.
    """
    code = """
import sys
from wrf_mi.apps.commands.main import main
for arguments in (["--help"], ["train", "--help"], ["export", "--help"], ["train", "--seed", "x"]):
    try:
        main(arguments)
    except SystemExit:
        pass
print({"drjit", "mitsuba", "sionna"} & set(sys.modules))
import wrf_mi.runs.api, wrf_mi.training.trainer
slow = {"matplotlib", "scipy.signal", "scipy.stats", "sionna", "plotly", "xarray", "pandas"}
print(slow & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["set()"] * 2


def test_version_and_settings(command: Command) -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", command.done(["--version"]))
    listed = command.done(["train", "--help-settings"])
    for line in ("optimiser.network=0.001\n", "kriging, signal strengths:", "kriging, spectra:", "cone_deg=80.0"):
        assert line in listed
    assert "shadow_db=" in listed
    assert "generic=False" in listed


def test_data_info_states_the_extent_and_how_far_test_rows_are(folder: Path, command: Command) -> None:
    status, out, err = command(["data", "info", folder, "--json"])
    assert status == 0, err
    facts, record = json.loads(out), load(folder)
    assert facts["extent_m"] == pytest.approx(np.ptp(record.tx_pos_m, axis=0))
    (split,) = make_splits(record, "official")
    train_m, test_m = record.tx_pos_m[split.all_train], record.tx_pos_m[split.test]
    nearest_m = np.linalg.norm(test_m[:, None] - train_m, axis=2).min(axis=1)
    assert facts["nearest_m"]["official"] == pytest.approx([np.median(nearest_m), nearest_m.max()])


def test_train_prints_a_table_and_progress_elsewhere(folder: Path, tmp_path: Path, command: Command) -> None:
    out_folder = tmp_path / "run"
    status, out, err = command(training(folder, out_folder, "--seed", 3, model="wrf-gs"))
    assert status == 0
    head, model_line, blend, facts, counts, verdict, worse, where = out.splitlines()
    assert head.split() == ["SSIM", "on", "5", "test", "rows", "median", "mean", "p10", "p90"]
    metrics = json.loads((out_folder / "metrics.json").read_text())
    for line, block in ((model_line, metrics["ssim"]), (blend, metrics["reference"]["idw"])):
        assert line.split()[-4:] == [f"{block[k]:.3f}" for k in ("median", "mean", "p10", "p90")]
    assert model_line.startswith("wrf-gs ")
    assert facts.startswith("split official, 19 training rows,")
    tiles = metrics["evaluated"]["tiles of Gaussians"]
    assert tiles["skipped"] > 0
    assert counts == f"evaluated: {tiles['evaluated']:,} of {sum(tiles.values()):,} tiles of Gaussians"
    assert verdict.startswith(
        f"median SSIM {metrics['ssim']['median']:.3f}: no better than the best constant, the mean"
    )
    assert worse.startswith("wrf-gs is no better than predicting the mean")  # after four steps
    assert where == f"results: {out_folder}"
    assert (metrics["model"], metrics["seed"], metrics["steps"]) == ("wrf-gs", 3, 4)
    assert re.fullmatch(
        r"training 4/4  loss 0\.\d+  SSIM -?\d\.\d+ \(2 validation rows, now trained on\)  8 Gaussians  0:00 left\n",
        err,
    )


def test_train_as_json(folder: Path, tmp_path: Path, command: Command) -> None:
    more = ["--split", "random", "--n-train", "0.5", "--deterministic"]
    printed = command.json(training(folder, tmp_path / "run", *more))
    assert printed == json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (printed["split"], printed["n_train"], printed["n_test"]) == ("random", 10, 5)
    assert "deterministic: true" in (tmp_path / "run" / "config.yaml").read_text()


def test_training_with_one_row_logs_null_for_the_validation_score(folder, tmp_path, command):
    status, _, err = command(training(folder, tmp_path / "run", "--n-train", 1))
    assert status == 0
    assert "4/4" in err
    assert "nan" not in err
    for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines():
        assert json.loads(line, parse_constant=pytest.fail)["validation_score"] is None


def test_settings_override_the_preset(folder: Path, tmp_path: Path, command: Command) -> None:
    command.done(training(folder, tmp_path / "run", "--preset", "paper", "--set", "encoding.tx_octaves=3"))
    text = (tmp_path / "run" / "config.yaml").read_text()
    assert "position_octaves: 10" in text
    assert "tx_octaves: 3" in text


def test_evaluate(run: Path, command: Command) -> None:
    assert command.done(["evaluate", run]).splitlines()[-1] == f"results: {run}"
    status, out, err = command(["evaluate", run, "--json"])
    assert (status, err) == (0, "")
    before = (run / "metrics.json").read_bytes()
    assert json.loads(out) == json.loads(before)
    # Every row is in a block; five of them were not trained on.
    assert command.json(["evaluate", run, "--split", "blocked"])["n_test"] == 5
    assert (run / "metrics.json").read_bytes() == before


def test_predict(run: Path, tmp_path: Path, command: Command) -> None:
    positions = np.array([[0.1, -0.2, 0.3], [0.5, 0.5, -0.5], [0.0, 0.0, 0.0]])
    rows = "\n".join(f"{z},{x},tag,{y}" for x, y, z in positions)
    (tmp_path / "tx.csv").write_text(f"Z, X,name,Y\n{rows}\n\n")
    np.savez(tmp_path / "tx.npz", tx_pos=positions)
    first, second = tmp_path / "a.npz", tmp_path / "new" / "b.npz"
    alone = tmp_path / "alone.npz"
    command.done(["predict", run, "--tx", "0.5,0.5,-0.5", "--out", alone])
    ended = command(["predict", run, "--tx", tmp_path / "tx.csv", "--out", first])
    assert ended == (0, f"3 predictions: {first}\n", "")
    printed = command.json(["predict", run, "--input", tmp_path / "tx.npz", "--out", second])
    with np.load(first) as a, np.load(second) as b:
        assert printed == {"out": str(second), "arrays": {k: list(b[k].shape) for k in b.files}}
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key])
        np.testing.assert_array_equal(arrays_in(alone)["prediction"][0], a["prediction"][1])
        np.testing.assert_array_equal(a["row"], [0, 1, 2])
        np.testing.assert_array_equal(a["tx_pos"], positions)
        np.testing.assert_array_equal(a["receiver_name"], ["gateway1"])
        assert a["prediction"].shape == (3, *SIZE)
        np.testing.assert_allclose(a["prediction"], open_run(run).predictor()(positions), atol=1e-6)


def test_data_list(folder: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.setenv("WRF_MI_DATA", str(folder.parent))
    assert {"rfid-lab", "laboratory"} <= {entry["name"] for entry in command.json(["data", "list"])}
    assert "rfid-lab" in command.done(["data", "list"])


def test_non_finite_fit_ends_with_status_1(folder: Path, tmp_path: Path, command: Command) -> None:
    """The error is one line, without traceback."""
    status, out, err = command(training(folder, tmp_path / "run", "--set", "optimiser.signal=1e38", steps=20))
    assert (status, out) == (1, "")
    assert re.fullmatch(r"wrf-mi: .*not finite.*\n", err.splitlines(keepends=True)[-1])
    assert "Traceback" not in err


def test_stopped_run_ends_with_status_130(folder, tmp_path, monkeypatch, command):
    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr(Watch, "stop", lambda self: True)
        ended = command(training(folder, run))
    assert ended == (130, "", f"wrf-mi: stopped after step 1 of 4; go on with: wrf-mi train --resume {run}\n")
    command.refused(["evaluate", run], "model.npz: missing, the fit was stopped; finish it with train")
    command.refused(["compare", run, "--out", tmp_path / "out"], "finish it with train --resume")
    assert command.json(["train", "--resume", run])["steps"] == 4


def test_signal_to_end_writes_a_checkpoint_to_resume_from(folder: Path, tmp_path: Path) -> None:
    """A training process receives the signal of batch systems; in this process a test below raises that of Ctrl-C."""
    out = tmp_path / "run"
    words = training(folder, out, steps=200, log_every=1, validate_every=200)
    process = subprocess.Popen(
        [sys.executable, "-m", "wrf_mi.apps.commands", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    with process:
        end = time.monotonic() + SECONDS_TO_START
        while not (out / "log.jsonl").exists() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        stdout, stderr = process.communicate(timeout=SECONDS_TO_START)
    assert process.returncode == 130, stderr
    assert stdout == ""
    goes_on = f"then go on with: wrf-mi train --resume {out}"
    assert stderr.splitlines()[0] == f"stopping after this step; Ctrl-C again ends at once; {goes_on}"
    step = int(read_checkpoint(out)["step"])
    assert 0 < step < 200
    assert stderr.splitlines()[-1].startswith(f"wrf-mi: stopped after step {step} of 200; go on with:")
    assert main(["train", "--resume", str(out)]) == 0
    lines = [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]
    assert lines == list(range(1, 201))
    assert (out / "metrics.json").exists()


def test_watch_stops_at_the_first_and_ends_at_the_second_signal(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGINT)
    with Watch(resumable=True) as watch:
        assert not watch.stop()
        signal.raise_signal(signal.SIGINT)
        assert watch.stop()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    assert capsys.readouterr().err.count("\n") == 1


def progress(**values: Any) -> Progress:
    return Progress(**({"step": 10, "seconds": 1.0, "loss": 0.25, "validation_score": None, "held_out": True,
                        "gaussians": 8, "left_s": 61.0} | values))  # fmt: skip


def test_watch_prints_plain_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with Watch() as watch:
        watch.on_progress("training", 0.25, progress())
        watch.on_progress("training", 0.5, progress(step=20, validation_score=0.5))
        of_rows = {"validation_rows": 9, "validation_m": 0.05, "test_m": 0.17}
        watch.on_progress("fold0", 0.5, progress(step=20, validation_score=0.95, **of_rows))
        watch.on_progress("paths", 0.5, progress(step=20, validation_score=0.95, **of_rows, far_score=0.79, far_rows=4))
        watch.on_progress("fold1", 0.5, progress(step=20, validation_score=0.75, held_out=False))
        watch.on_progress("fold2", 0.5, progress(step=20, validation_score=float("nan")))
        watch.on_progress("vae", 0.5, progress(step=20, validation_score=0.5, gaussians=0))
        for stage, share in (("a", 0.0), ("a", 0.5), ("b", 0.1), ("b", 1.0)):  # of fits without steps: named once
            watch.on_progress(stage, share)
    assert capsys.readouterr().err.splitlines() == [
        "training 20/40  loss 0.2500  SSIM 0.500 (validation rows)  8 Gaussians  1:01 left",
        "fold0 20/40  loss 0.2500  SSIM 0.950 (9 validation rows, median 0.05 m from training rows, test rows 0.17 m)"
        "  8 Gaussians  1:01 left",
        "paths 20/40  loss 0.2500  SSIM 0.790 (4 validation rows as far from training rows as test rows, 0.17 m; "
        "0.950 of all 9)  8 Gaussians  1:01 left",
        "fold1 20/40  loss 0.2500  SSIM 0.750 (validation rows, now trained on)  8 Gaussians  1:01 left",
        "fold2 20/40  loss 0.2500    8 Gaussians  1:01 left",
        "vae 20/40  loss 0.2500  SSIM 0.500 (validation rows)  1:01 left",
        "a",
        "b",
    ]


def test_watch_states_the_time_left_of_a_long_stage_where_there_is_no_terminal(monkeypatch, capsys):
    now = 100.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    with Watch() as watch:
        for second in range(513):
            now = 100.0 + second
            watch.on_progress("mapping", second / 512)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == ["mapping", "mapping  1%  8:27 left", "mapping  2%  8:22 left"]
    assert lines[-1] == "mapping  62%  3:12 left"
    assert len(lines) == 8  # at 0, 5, 10, 20, 40, ... 320 seconds


def test_watch_shows_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in (("TTY_COMPATIBLE", "1"), ("FORCE_COLOR", "1"), ("COLUMNS", "150")):
        monkeypatch.setenv(name, value)
    with Watch() as watch:
        for fold in ("fold0", "fold1"):
            for step in (20, 40):
                watch.on_progress(fold, step / 40, progress(step=step, validation_score=0.5))
    with Watch() as watch:
        watch.on_progress("first stage", 0.5)
        watch.on_progress("second stage", 1.0)
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
    for text in ("fold0", "fold1", "first stage", "second stage"):
        assert text in shown
    assert "SSIM 0.500 (validation rows)  8 Gaussians  1:01 left" in shown


@pytest.mark.slow
@needs("flat-ble")
def test_demo_fits_and_compares_the_measured_flat(tmp_path: Path) -> None:
    shown = demo.Demo(tmp_path, quiet, lambda: False)
    fitted = shown.measured_flat()
    assert [run.metrics["model"] for run in fitted] == list(demo.MODELS)
    assert all(Path(file).is_file() for file in shown.pages(fitted).values())


def test_demo_finds_or_fetches_real_data(folder, monkeypatch, capsys):
    monkeypatch.setattr("wrf_mi.datasets.registry.locate", lambda name: folder)
    assert demo.find_data("rfid-lab") == folder
    monkeypatch.setattr("wrf_mi.datasets.registry.locate", lambda name: None)
    monkeypatch.setattr("wrf_mi.datasets.fetch", lambda name: folder)
    assert demo.find_data("rfid-lab") == folder
    assert capsys.readouterr().err == ""

    def offline(name: str) -> Path:
        raise InputError("no network")

    monkeypatch.setattr("wrf_mi.datasets.fetch", offline)
    assert demo.find_data("rfid-lab") is None
    assert capsys.readouterr().err == "no rfid-lab (no network)\n"


@pytest.mark.usefixtures("undrawn")
def test_demo_compares_models_in_a_held_out_region_and_in_a_measured_flat(flat_folder, tmp_path, monkeypatch, command):
    """With fewer rows and points and without the hybrid, which other tests fit; the flat is synthetic."""
    room, rows = synthetic.load_record("laboratory"), np.arange(20)
    scan = arrays_in(Path(room.source) / stored.SCAN)
    np.savez(tmp_path / "scan.npz", points=scan["points"][::4])
    monkeypatch.setattr(stored, "SCAN", tmp_path / "scan.npz")
    few = replace(
        room, tx_pos_m=room.tx_pos_m[rows], observation=room.observation[:, rows], official=(rows[6:], rows[:6])
    )
    monkeypatch.setattr(synthetic, "laboratory_record", lambda progress: few)
    monkeypatch.setattr(demo, "MODELS", {"ray-tracing": True, "kriging": False})
    for name, value in {"ROWS": 8, "REAL_ROWS": 8, "IN_A_FLAT": ("depth=1", "rays=1024")}.items():
        monkeypatch.setattr(demo, name, value)
    monkeypatch.setattr(demo, "find_data", lambda name: flat_folder)
    status, out, err = command(["demo", "--out", tmp_path / "demo"])
    assert status == 0, err
    for text in ("a scan of the room laboratory becomes a scene", "median SSIM on the test rows: ray-tracing"):
        assert text in out + err
    assert "median absolute error" in out
    table = rows_of(tmp_path / "demo" / "compare" / "compare.csv")
    models = ["ray-tracing", "kriging", "idw", "constant", "ray-tracing", "kriging", "idw", "constant", "constant"]
    assert [row["model"] for row in table] == models
    assert {row["dataset"] for row in table} == {"laboratory", "flat"}
    assert (tmp_path / "demo" / "scene" / "preview.png").is_file()
    assert "plotly" in (tmp_path / "demo" / "view.html").read_text()
    held_out = json.loads((tmp_path / "demo" / "kriging" / "metrics.json").read_text())
    assert (held_out["split"], held_out["n_train"]) == ("blocked:0", 8)


def raising(error: type[BaseException]) -> Any:
    def evaluate(*arguments: Any) -> None:
        raise error("a bug")

    return evaluate


def test_unexpected_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "evaluate_run", raising(RuntimeError))
    with pytest.raises(RuntimeError, match="a bug"):
        main(["evaluate", "run"])


@pytest.mark.parametrize("recording", [False, True], ids=["before training", "while a kernel is recorded"])
def test_ctrl_c_ends_with_status_130(recording: bool, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    pressed = raising(KeyboardInterrupt)
    evaluate = (lambda *arguments: Recorded(pressed)(dr.llvm.Float(1, 2))) if recording else pressed
    monkeypatch.setattr(runs, "evaluate_run", evaluate)
    assert command(["evaluate", "run"]) == (130, "", "wrf-mi: interrupted\n")
