"""Bad input to the command: exit status 2, one line that says what is wrong, nothing half written."""

from __future__ import annotations

import errno
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from calling import SET, refused

from wrf_mi.cli.main import main
from wrf_mi.core import InputError
from wrf_mi.runs.prediction_file import read_inputs


@pytest.fixture(scope="module")
def run(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    assert main(["train", str(folder), "--model", "wrf-gs+", "--out", str(out), *SET]) == 0
    return out


def test_bad_arguments_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """The parser's error is one line that names the command."""
    for arguments, message in (
        ([], "wrf-mi: the following arguments are required: COMMAND; see wrf-mi --help"),
        (["fly"], "argument COMMAND: invalid choice: 'fly'"),
        (["data"], "wrf-mi data: the following arguments are required: COMMAND"),
        (["predict", "run"], "wrf-mi predict: .*required"),
        (["predict", "run", "--tx", "a", "--input", "b", "--out", "c"], "not allowed with argument"),
        (["evaluate"], "required: RUN"),
        (["compare", "run"], "required: --out"),
        (["train", "x", "--model", "nerf3", "--out", "y"], "invalid choice: 'nerf3'"),
        (["train", "x", "--seed", "one", "--out", "y"], "invalid int value: 'one'"),
        (["train", "x", "--n-train", "many", "--out", "y"], "argument --n-train: 'many' is no number"),
        (["train", "x", "--preset", "best", "--out", "y"], "invalid choice: 'best'"),
    ):
        refused(arguments, message, capsys)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (["--set", "steps"], "--set steps: expected key=value"),
        (["--set", "stepz=3"], "unknown setting stepz"),
        (["--set", "steps=many"], "setting steps: expected int, got 'many'"),
        (["--set", "steps=[1"], "is no YAML value"),
        (["--set", "holdout_steps_fraction=2"], "setting holdout_steps_fraction: 2.0 is out of range, choose 0 to 1"),
        (["--set", "initial.points=none.ply"], "none.ply: no such file"),
        (["--set", "batch=0"], "setting batch: 0 is out of range, choose 1 or more"),
        (["--set", "model=nerf3"], r"setting model: nerf3, where the model is wrf-gs\+; choose it with --model"),
        (["--seed", "-1"], "setting seed: -1 is out of range"),
        (["--split", "nowhere"], "split 'nowhere'"),
        (["--split", ""], "split ''"),
        (["--split", "blocked:3"], "no such fold"),
        (["--n-train", "0"], "n_train 0; choose 1 to 19 rows"),
        (["--n-train", "20"], "n_train 20; choose 1 to 19 rows"),
        (["--n-train", "1.5"], "n_train 1.5; choose"),
        (["--n-train", "-0.5"], "n_train -0.5; choose"),
        (["--n-train", "nan"], "n_train nan; choose"),
    ],
)
def test_bad_training_options_are_refused(
    own: list[str], message: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for split in ([], ["--split", "blocked"]):
        if split and ("--split" in own or "--n-train" in own):
            continue
        refused(["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "run", *SET, *split, *own], message, capsys)
        assert not (tmp_path / "run").exists()  # nothing is half written


def test_bad_data_and_folders_are_refused(
    folder: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path / "nothing"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "nothing"))
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        (["train"], "train needs DATASET and --out RUN"),
        (["train", folder], "train needs DATASET and --out RUN"),
        (["train", "nowhere", "--out", tmp_path / "out"], "nowhere"),
        (["train", "rfid-lab", "--out", tmp_path / "out"], "wrf-mi data fetch rfid-lab"),
        (
            ["train", tmp_path / "empty", "--out", tmp_path / "out"],
            "empty: an empty folder; a data set is a folder with receivers.csv",
        ),
        (["train", folder, "--model", "wrf-gs+", "--out", folder], "exists and is not empty; choose another --out"),
        (["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "file", *SET], "file: exists and is not empty"),
        (
            ["train", folder, "--model", "wrf-gs+", "--out", tmp_path / "file" / "out", *SET],
            r"file.*; choose another place",
        ),
        (["train", "--resume", tmp_path / "empty"], "no config.yaml, so not a run folder"),
        (["train", "--resume", tmp_path / "none"], "no config.yaml, so not a run folder"),
        (["evaluate", tmp_path / "empty"], "no config.yaml, so not a run folder"),
        (["evaluate", run, "--split", "nowhere"], "split 'nowhere'"),
        (["compare", tmp_path / "empty", "--out", tmp_path / "out"], "no metrics.json"),
        (["compare", run, run, "--out", tmp_path / "out"], "given twice"),
        (["compare", run, "--out", tmp_path / "file"], "file.*; choose another place"),
        (["data", "fetch", "nowhere"], "nowhere"),
        (["bench", "nowhere", "--out", tmp_path / "out", "--runs", tmp_path / "runs"], "nowhere"),
    ):
        refused(arguments, message, capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "own",
    [
        ["--set", "steps=9"],
        ["--seed", "0"],
        ["--split", "random"],
        ["--n-train", "0"],
        ["--deterministic"],
        ["--model", "wrf-gs"],
        ["--preset", "quick"],
        ["--out", "elsewhere"],
        ["data"],
    ],
)
def test_resume_takes_no_settings(own: list[str], run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Options beside ``--resume`` are refused."""
    refused(["train", "--resume", run, *own], "omit data set and settings", capsys)


BAD_POSITIONS = {
    "row.csv": (b"x,y,z\n1,2,3\n1,two,3\n", "row.csv: row 2: y is 'two'; give a finite number"),
    "short.csv": (b"x,y,z\n1,2\n", "short.csv: row 1: 2 fields, but the header has 3"),
    "nan.csv": (b"x,y,z\n1,2,3\n\n4,nan,6\n", "nan.csv: row 2: y is 'nan'; give a finite number"),
    "header.csv": (b"a,b,c\n1,2,3\n", "header.csv: line 1: header 'a,b,c' has no column x"),
    "empty.csv": (b"", "empty.csv: empty; give a header"),
    "none.csv": (b"x,y,z\n", "none.csv: no rows below the header"),
    "binary.csv": (b"\xff\xfe\x00\x80", "binary.csv: cannot be read"),
    "junk.npz": (b"no archive", "junk.npz: not readable as .npz"),
}


@pytest.mark.parametrize("name", BAD_POSITIONS)
def test_bad_positions_are_refused(name: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, message = BAD_POSITIONS[name]
    (tmp_path / name).write_bytes(content)
    option = "--input" if name.endswith(".npz") else "--tx"
    refused(["predict", run, option, tmp_path / name, "--out", tmp_path / "out.npz"], message, capsys)
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": np.zeros((2, 3))}, "no array tx_pos"),
        ({"tx_pos": np.zeros((2, 2))}, r"tx_pos has shape \[2, 2\], expected \[m, 3\]"),
        ({"tx_pos": np.zeros((0, 3))}, "no positions"),
        ({"tx_pos": np.array([[0, 0, np.inf]])}, "row 1: not a finite number"),
        ({"tx_pos": np.array([["a", "b", "c"]])}, "not readable as .npz"),
    ],
)
def test_bad_arrays_of_positions_are_refused(arrays: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "tx.npz", **arrays)
    with pytest.raises(InputError, match=message):
        read_inputs(None, tmp_path / "tx.npz")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a.npz"), "a.npz: No space left on device; free some space"),
        (OSError(errno.EACCES, "Permission denied", "a.npz"), "a.npz: Permission denied; change its permissions"),
        (OSError(errno.EROFS, "Read-only file system"), "Read-only file system; choose a place that can be written"),
        (
            OSError(errno.EISDIR, "Is a directory", "part", None, "a"),
            "a: Is a directory; choose another place",
        ),
        (OSError(errno.ENOENT, "No such file or directory", "a"), "a: No such file or directory; check the name"),
        (OSError("a damaged\nfile"), "a damaged file"),
    ],
)
def test_system_errors_are_one_line_with_a_remedy(
    error: OSError, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr("wrf_mi.cli.data.list_command", fails)
    refused(["data", "list"], f"^wrf-mi: {re.escape(line)}", capsys)


def test_closed_pipe_ends_the_command_silently() -> None:
    """The command writes to a pipe without reader, as with ``head``."""
    code = "import sys; sys.stdin.read(1); from wrf_mi.cli.main import main; sys.exit(main(['data', 'list']))"
    with subprocess.Popen([sys.executable, "-c", code], stdin=-1, stdout=-1, stderr=-1) as command:
        assert command.stdin
        assert command.stdout
        assert command.stderr
        command.stdout.close()
        command.stdin.close()
        assert command.stderr.read() == b""
    assert command.returncode == 141


def test_bad_predictions_are_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tx.csv").write_text("x,y,z\n0,0,0\n")
    good, out = ["--tx", tmp_path / "tx.csv"], ["--out", tmp_path / "out.npz"]
    refused(["predict", run, "--tx", tmp_path / "no.csv", *out], "no.csv: no such file", capsys)
    refused(["predict", tmp_path, *good, *out], "no config.yaml, so not a run folder", capsys)
    folder = tmp_path / "folder.npz"
    folder.mkdir()
    refused(["predict", run, *good, "--out", folder], f"{folder}: Is a directory; choose another place", capsys)
    refused(["predict", run, *good, "--out", tmp_path / "tx.csv" / "a.npz"], "choose another place: a file", capsys)
