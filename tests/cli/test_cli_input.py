"""Bad input to the command: exit status 2, one line that says what is wrong, nothing half written."""

import errno
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SET
from commands import Command


def test_bad_arguments_are_refused(command: Command) -> None:
    """The parser's error is one line that names the command."""
    for words, message in (
        ("", "wrf-mi: the following arguments are required: COMMAND; see wrf-mi --help"),
        ("fly", "argument COMMAND: invalid choice: 'fly'"),
        ("data", "wrf-mi data: the following arguments are required: COMMAND"),
        ("predict run", "wrf-mi predict: .*required"),
        ("predict run --tx a --input b --out c", "not allowed with argument"),
        ("evaluate", "nothing to score; give a run folder"),
        ("compare run", "required: --out"),
        ("train x --model nerf3 --out y", "argument --model: model 'nerf3': no such model; choose from wrf-gs, "),
        ("train x --seed one --out y", "invalid int value: 'one'"),
        ("train x --n-train many --out y", "argument --n-train: 'many' is no number"),
        ("train x --preset slow --out y", "invalid choice: 'slow'"),
    ):
        command.refused(words.split(), message)


@pytest.mark.parametrize(
    ("words", "asked"),
    [
        ("train data --bogus", "wrf-mi train"),
        ("train data --out run extra", "wrf-mi train"),
        ("data check data --bogus 3", "wrf-mi data check"),
        ("--bogus data list", "wrf-mi"),
    ],
)
def test_unknown_arguments_name_the_help_of_their_command(words: str, asked: str, command: Command) -> None:
    command.refused(words.split(), f"^{asked}: unrecognized arguments: .*; see {asked} --help$")


def test_bad_data_and_folders_are_refused(folder, run, tmp_path, monkeypatch, command):
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path / "nothing"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "nothing"))
    file, empty, out = tmp_path / "file", tmp_path / "empty", tmp_path / "out"
    file.write_text("")
    empty.mkdir()
    fit = ["train", folder, "--model", "wrf-gs+", "--out"]
    for words, message in (
        (["train"], "train needs DATASET and --out RUN"),
        (["train", folder], "train needs DATASET and --out RUN"),
        (["train", "nowhere", "--out", out], "nowhere"),
        (["train", "rfid-lab", "--out", out], "wrf-mi data fetch rfid-lab"),
        (["train", empty, "--out", out], "empty: an empty folder; a data set is a folder with receivers.csv"),
        ([*fit, folder], "exists and is not empty; choose another --out"),
        ([*fit, file, *SET], "file: exists and is not empty"),
        ([*fit, file / "out", *SET], r"file.*; choose another place"),
        (["train", "--resume", empty], "no config.yaml, so not a run folder"),
        (["train", "--resume", tmp_path / "none"], "no config.yaml, so not a run folder"),
        (["evaluate", empty], "no config.yaml, so not a run folder"),
        (["evaluate", run, "--split", "nowhere"], "split 'nowhere'"),
        (["compare", empty, "--out", out], "no metrics.json"),
        (["compare", run, run, "--out", out], "given twice"),
        (["compare", run, "--out", file], "file.*; choose another place"),
        (["data", "fetch", "nowhere"], "nowhere"),
        (["bench", "nowhere", "--out", out, "--runs", tmp_path / "runs"], "nowhere"),
    ):
        command.refused(words, message)
    assert not out.exists()


def test_resume_takes_no_settings(run: Path, command: Command) -> None:
    for option in (
        *("--set steps=9", "--seed 0", "--split random", "--n-train 0", "--deterministic", "--model wrf-gs"),
        *("--preset fast", "--out elsewhere", "data"),
    ):
        command.refused(["train", "--resume", run, *option.split()], "omit data set and settings")


BAD_POSITIONS: dict[str, tuple[Any, str]] = {
    "row.csv": (b"x,y,z\n1,2,3\n1,two,3\n", "row.csv: row 2: y is 'two'; give a finite number"),
    "header.csv": (b"a,b,c\n1,2,3\n", "header.csv: line 1: header 'a,b,c' has no column x"),
    "binary.csv": (b"\xff\xfe\x00\x80", "binary.csv: cannot be read"),
    "junk.npz": (b"no archive", "junk.npz: not readable as .npz"),
    "other.npz": ({"other": np.zeros((2, 3))}, "no array tx_pos"),
    "flat.npz": ({"tx_pos": np.zeros((2, 2))}, r"tx_pos has shape \[2, 2\], expected \[m, 3\]"),
    "infinite.npz": ({"tx_pos": np.array([[0, 0, np.inf]])}, "row 1: not a finite number"),
}


@pytest.mark.parametrize("name", BAD_POSITIONS)
def test_bad_positions_are_refused(name: str, run: Path, tmp_path: Path, command: Command) -> None:
    content, message = BAD_POSITIONS[name]
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    else:
        np.savez(tmp_path / name, **content)
    option = "--input" if name.endswith(".npz") else "--tx"
    command.refused(["predict", run, option, tmp_path / name, "--out", tmp_path / "out.npz"], message)
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "a.npz"), "a.npz: No space left on device; free some space"),
        (OSError(errno.EACCES, "Permission denied", "a.npz"), "a.npz: Permission denied; change its permissions"),
        (
            OSError(errno.EROFS, "Read-only file system"),
            "Read-only file system; change its permissions or choose another place",
        ),
        (OSError(errno.EISDIR, "Is a directory", "part", None, "a"), "a: Is a directory; choose another place"),
        (OSError(errno.ENOENT, "No such file or directory", "a"), "a: No such file or directory; check the name"),
        (OSError("a damaged\nfile"), "a damaged file"),
    ],
)
def test_system_errors_are_one_line_with_a_remedy(error, line, monkeypatch, command):
    def fails(_: object) -> int:
        raise error

    monkeypatch.setattr("wrf_mi.apps.commands.data.list_command", fails)
    command.refused(["data", "list"], f"^wrf-mi: {re.escape(line)}")


def test_closed_pipe_ends_the_command_silently() -> None:
    """The command writes to a pipe without reader, as with ``head``."""
    code = "import sys; sys.stdin.read(1); from wrf_mi.apps.commands.main import main; sys.exit(main(['data', 'list']))"
    with subprocess.Popen([sys.executable, "-c", code], stdin=-1, stdout=-1, stderr=-1) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.stdin.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_bad_predictions_are_refused(run: Path, tmp_path: Path, command: Command) -> None:
    (tmp_path / "tx.csv").write_text("x,y,z\n0,0,0\n")
    folder = tmp_path / "folder.npz"
    folder.mkdir()
    good, out = ["--tx", tmp_path / "tx.csv"], ["--out", tmp_path / "out.npz"]
    for words, message in (
        ([run, "--tx", tmp_path / "no.csv", *out], "no.csv: no such file"),
        ([tmp_path, *good, *out], "no config.yaml, so not a run folder"),
        ([run, *good, "--out", folder], f"{folder}: Is a directory; choose another place"),
        ([run, *good, "--out", tmp_path / "tx.csv" / "a.npz"], "choose another place: a file"),
    ):
        command.refused(["predict", *words], message)
