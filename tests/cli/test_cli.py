"""The command: what it prints where, its exit status, and one line for whatever is wrong with its input."""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from calling import SET, SMALL, call, refused
from made_spectra import SIZE

from wrf_mi.backend.device import Recorded
from wrf_mi.cli import demo
from wrf_mi.cli.main import build_parser, main
from wrf_mi.cli.output import Watch
from wrf_mi.core import InputError
from wrf_mi.runs import api as runs
from wrf_mi.runs.api import open_run
from wrf_mi.training import config
from wrf_mi.training.checkpoint import read_checkpoint
from wrf_mi.training.loop import Progress

SECONDS_TO_START = 120
"""Importing, compiling and a first step take some 3 s; a busy machine needs much longer."""


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", str(folder), "--model", "wrf-gs+", "--out", str(out), *SET]) == 0
    return out


def commands(parser: argparse.ArgumentParser, name: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The command and all its subcommands."""
    yield name
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for key, sub in action.choices.items():
                yield from commands(sub, (*name, key))


def test_commands_are_complete() -> None:
    expected = {
        "doctor",
        "check",
        "data",
        "mesh",
        "correct",
        "edit",
        "train",
        "trace",
        "sweep",
        "evaluate",
        "predict",
        "compare",
    }
    expected |= {"map", "locate", "view", "export", "import", "bench", "demo"}
    assert {name[0] for name in commands(build_parser()) if name} == expected


@pytest.mark.parametrize("name", list(commands(build_parser())), ids=" ".join)
def test_every_command_has_help(name: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = call([*name, "--help"], capsys)
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: {' '.join(('wrf-mi', *name))} ")


def test_help_and_bad_arguments_import_no_tracer() -> None:
    """Help and parser errors appear before Dr.Jit, Mitsuba or Sionna RT is imported."""
    code = """
import sys
from wrf_mi.cli.main import main
for arguments in (["--help"], ["train", "--help"], ["export", "--help"], ["train", "--seed", "x"]):
    try:
        main(arguments)
    except SystemExit:
        pass
print({"drjit", "mitsuba", "sionna"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


def test_version_and_settings(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(["--version"], capsys)
    assert status == 0
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", out)
    status, out, _ = call(["train", "--help-settings"], capsys)
    assert status == 0
    assert "optimiser.network=0.001\n" in out


def test_train_prints_a_table_and_progress_elsewhere(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out_folder = tmp_path / "run"
    status, out, err = call(["train", folder, "--out", out_folder, "--model", "wrf-gs", "--seed", 3, *SET], capsys)
    assert status == 0
    head, own, blend, facts, worse, where = out.splitlines()
    assert head.split() == ["SSIM", "on", "5", "test", "rows", "median", "mean", "p10", "p90"]
    metrics = json.loads((out_folder / "metrics.json").read_text())
    for line, block in ((own, metrics["ssim"]), (blend, metrics["reference"]["idw4"])):
        assert line.split()[-4:] == [f"{block[k]:.3f}" for k in ("median", "mean", "p10", "p90")]
    assert own.startswith("wrf-gs ")
    assert facts.startswith("split official, 19 training rows,")
    assert worse.startswith("wrf-gs is no better than predicting the mean")  # after four steps
    assert where == f"results: {out_folder}"
    assert (metrics["model"], metrics["seed"], metrics["steps"]) == ("wrf-gs", 3, 4)
    assert re.fullmatch(
        r"training 4/4  loss 0\.\d+  SSIM -?\d\.\d+ \(validation rows, now trained on\)  8 Gaussians  0:00 left\n", err
    )


def test_train_as_json(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = ["--split", "random", "--n-train", "0.5", "--deterministic", "--json"]
    status, out, _ = call(["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "run", *own, *SET], capsys)
    assert status == 0
    printed = json.loads(out)
    assert printed == json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (printed["split"], printed["n_train"], printed["n_test"]) == ("random", 10, 5)
    assert "deterministic: true" in (tmp_path / "run" / "config.yaml").read_text()


def test_train_with_one_row_logs_no_validation_score(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without validation rows the logged score is null, not NaN."""
    status, _, err = call(
        ["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "run", "--n-train", 1, *SET], capsys
    )
    assert status == 0
    assert "4/4" in err
    assert "nan" not in err
    for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines():
        assert json.loads(line, parse_constant=pytest.fail)["validation_score"] is None


def test_settings_override_the_preset(folder: Path, tmp_path: Path) -> None:
    """``--set`` takes precedence over ``--preset``."""
    chosen = ["--preset", "paper", *SET, "--set", "encoding.tx_octaves=3"]
    assert main(["train", str(folder), "--model", "wrf-gs+", "--out", str(tmp_path / "run"), *chosen]) == 0
    text = (tmp_path / "run" / "config.yaml").read_text()
    assert "position_octaves: 10" in text
    assert "tx_octaves: 3" in text


def test_evaluate(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, table, _ = call(["evaluate", run], capsys)
    assert status == 0
    assert table.splitlines()[-1] == f"results: {run}"
    status, out, err = call(["evaluate", run, "--json"], capsys)
    assert (status, err) == (0, "")
    assert json.loads(out) == json.loads((run / "metrics.json").read_text())


def test_evaluate_on_other_rows(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "metrics.json").read_bytes()
    status, out, _ = call(["evaluate", run, "--split", "blocked", "--json"], capsys)
    assert status == 0
    assert json.loads(out)["n_test"] == 5  # every row is in a block; five of them were not trained on
    assert (run / "metrics.json").read_bytes() == before


def test_predict(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    positions = np.array([[0.1, -0.2, 0.3], [0.5, 0.5, -0.5], [0.0, 0.0, 0.0]])
    rows = "\n".join(f"{z},{x},tag,{y}" for x, y, z in positions)
    (tmp_path / "tx.csv").write_text(f"Z, X,name,Y\n{rows}\n\n")
    np.savez(tmp_path / "tx.npz", tx_pos=positions)
    status, out, err = call(["predict", run, "--tx", tmp_path / "tx.csv", "--out", tmp_path / "a.npz"], capsys)
    assert (status, out, err) == (0, f"3 predictions: {tmp_path / 'a.npz'}\n", "")
    arguments = ["predict", run, "--input", tmp_path / "tx.npz", "--out", tmp_path / "new" / "b.npz", "--json"]
    status, out, _ = call(arguments, capsys)
    assert status == 0
    printed = json.loads(out)
    with np.load(tmp_path / "a.npz") as a, np.load(tmp_path / "new" / "b.npz") as b:
        assert printed == {"out": str(tmp_path / "new" / "b.npz"), "arrays": {k: list(b[k].shape) for k in b.files}}
        for key in a.files:
            np.testing.assert_array_equal(a[key], b[key])
        np.testing.assert_array_equal(a["row"], [0, 1, 2])
        np.testing.assert_array_equal(a["tx_pos"], positions)
        np.testing.assert_array_equal(a["receiver_name"], ["gateway1"])
        assert a["prediction"].shape == (3, *SIZE)
        np.testing.assert_allclose(a["prediction"], open_run(run).predictor()(positions), atol=1e-6)


def test_compare(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(["compare", run, "--out", tmp_path / "page"], capsys)
    assert (status, out) == (0, f"comparison: {tmp_path / 'page' / 'index.html'}\n")
    assert (tmp_path / "page" / "compare.csv").is_file()


def test_data_list(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("WRF_MI_DATA", str(folder.parent))
    status, out, _ = call(["data", "list", "--json"], capsys)
    assert status == 0
    assert {"rfid-lab", "laboratory"} <= {entry["name"] for entry in json.loads(out)}
    status, table, _ = call(["data", "list"], capsys)
    assert status == 0
    assert "rfid-lab" in table


def test_non_finite_fit_ends_with_status_1(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The error is one line, without traceback."""
    own = [*SET, "--set", "optimiser.signal=1e38", "--set", "steps=20"]
    status, out, err = call(["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "run", *own], capsys)
    assert (status, out) == (1, "")
    assert re.fullmatch(r"wrf-mi: .*not finite.*\n", err.splitlines(keepends=True)[-1])
    assert "Traceback" not in err


def test_stopped_run_ends_with_status_130(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Watch, "stop", lambda self: True)
    status, out, err = call(["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "run", *SET], capsys)
    assert (status, out) == (130, "")
    assert err == f"wrf-mi: stopped after step 1 of 4; go on with: wrf-mi train --resume {tmp_path / 'run'}\n"
    refused(["evaluate", tmp_path / "run"], "model.npz: missing, the fit was stopped; finish it with train", capsys)
    refused(["compare", tmp_path / "run", "--out", tmp_path / "out"], "finish it with train --resume", capsys)
    monkeypatch.undo()
    status, out, _ = call(["train", "--resume", tmp_path / "run", "--json"], capsys)
    assert status == 0
    assert json.loads(out)["steps"] == 4


def test_ctrl_c_writes_a_checkpoint_to_resume_from(folder: Path, tmp_path: Path) -> None:
    """A training process receives SIGINT."""
    out = tmp_path / "run"
    own = [*SET, "--set", "steps=400", "--set", "log_every=1", "--set", "validate_every=400"]
    process = subprocess.Popen(
        [sys.executable, "-m", "wrf_mi.cli", "train", str(folder), "--model", "wrf-gs+", "--out", str(out), *own],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    with process:
        end = time.monotonic() + SECONDS_TO_START
        while not (out / "log.jsonl").exists() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=SECONDS_TO_START)
    assert process.returncode == 130, stderr
    assert stdout == ""
    assert stderr.splitlines()[0] == "stopping after this step; Ctrl-C again ends at once"
    step = int(read_checkpoint(out)["step"])
    assert 0 < step < 400
    assert stderr.splitlines()[-1].startswith(f"wrf-mi: stopped after step {step} of 400; go on with:")
    assert main(["train", "--resume", str(out)]) == 0
    lines = [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]
    assert lines == list(range(1, 401))
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
        watch.on_progress("fold1", 0.5, progress(step=20, validation_score=0.75, held_out=False))
        watch.on_progress("fold2", 0.5, progress(step=20, validation_score=float("nan")))
        watch.on_progress("vae", 0.5, progress(step=20, validation_score=0.5, gaussians=0))
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "training 20/40  loss 0.2500  SSIM 0.500 (validation rows)  8 Gaussians  1:01 left",
        "fold1 20/40  loss 0.2500  SSIM 0.750 (validation rows, now trained on)  8 Gaussians  1:01 left",
        "fold2 20/40  loss 0.2500    8 Gaussians  1:01 left",
        "vae 20/40  loss 0.2500  SSIM 0.500 (validation rows)  1:01 left",
    ]


def test_watch_shows_a_bar_on_a_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "150")
    with Watch() as watch:
        for fold in ("fold0", "fold1"):
            for step in (20, 40):
                watch.on_progress(fold, step / 40, progress(step=step, validation_score=0.5))
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
    assert "fold0" in shown
    assert "fold1" in shown
    assert "SSIM 0.500 (validation rows)  8 Gaussians  1:01 left" in shown


def test_demo_finds_or_fetches_real_data(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_demo_on_real_data(
    folder: Path, flat_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A field on spectra and a traced flat, with synthetic data in the layouts of the real data sets."""
    monkeypatch.setattr(demo, "REAL", str(folder))
    monkeypatch.setattr(demo, "FLAT", str(flat_folder))
    monkeypatch.setattr(demo, "find_data", Path)
    monkeypatch.setattr(config, "PRESETS", {"quick": tuple(SMALL)})
    status, out, err = call(["demo", "--out", tmp_path / "run", "--json"], capsys)
    assert status == 0, err
    assert json.loads(out) == json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert f"pictures: {tmp_path / 'run' / 'compare' / 'index.html'}" in err
    page = (tmp_path / "run" / "compare" / "index.html").read_text()
    for row in ("wrf-gs+", "ray-tracing", "IDW of 4 nearest", "IDW of 100 nearest"):
        assert row in page
    assert json.loads((tmp_path / "run" / "traced" / "metrics.json").read_text())["task"] == "rssi"


def test_demo_in_the_embedded_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without real data the field and the ray tracer are scored on the same rows of the embedded room."""
    monkeypatch.setattr(demo, "find_data", lambda name: None)
    monkeypatch.setattr(config, "PRESETS", {"quick": tuple(SMALL)})
    status, _, err = call(["demo", "--out", tmp_path / "run"], capsys)
    assert status == 0, err
    with (tmp_path / "run" / "compare" / "compare.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["model"] for row in rows] == ["wrf-gs+", "ray-tracing", "idw4"]
    assert {row["dataset"] for row in rows} == {"laboratory"}
    assert (tmp_path / "run" / "scene" / "preview.png").is_file()


def test_unexpected_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: Any) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr(runs, "evaluate_run", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["evaluate", "run"])


def test_ctrl_c_before_training_starts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*arguments: Any) -> SimpleNamespace:
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "evaluate_run", interrupted)
    assert call(["evaluate", "run"], capsys) == (130, "", "wrf-mi: interrupted\n")


def test_ctrl_c_while_a_kernel_is_recorded(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def pressed(x: Any) -> None:
        raise KeyboardInterrupt

    def interrupted(*arguments: Any) -> None:
        Recorded(pressed)(dr.llvm.Float(1, 2))

    monkeypatch.setattr(runs, "evaluate_run", interrupted)
    assert call(["evaluate", "run"], capsys) == (130, "", "wrf-mi: interrupted\n")
