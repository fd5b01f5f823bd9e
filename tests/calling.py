"""Calls of the command within this process, and the run folders that it writes."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wrf_mi.apps.commands.main import main
from wrf_mi.core.array_files import CHECKSUM
from wrf_mi.runs.folder import FORMAT

SMALL = ["network.width=16", "network.layers=2", "initial.gaussians=8", "optimiser.warm_up=5", "density.every=0"]
SMALL += ["log_every=2", "validate_every=4", "steps=4"]
SET = [part for setting in SMALL for part in ("--set", setting)]
"""Settings of a very short training."""


def call(arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of the command."""
    capsys.readouterr()
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as end:  # argparse
        status = int(end.code or 0)
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def refused(arguments: list[Any], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The command prints one line with the error, and nothing else."""
    status, out, err = call(arguments, capsys)
    assert status == 2
    assert out == ""
    assert err.startswith("wrf-mi")
    assert err.endswith("\n")
    assert err.count("\n") == 1, err
    assert re.search(message, err), err


def strength_commands(run: Path, folder: Path, heard: dict[str, str], tx: str = "x,y,z\n1,2,1.3\n") -> list[list[Any]]:
    """Commands on a run of signal strengths; ``heard``: strengths at one place by the ids of receivers."""
    (folder / "tx.csv").write_text(tx)
    names = ",".join(f"rssi_{name}" for name in heard)
    (folder / "heard.csv").write_text(f"{names}\n{','.join(heard.values())}\n")
    return [
        ["evaluate", run],
        ["predict", run, "--tx", folder / "tx.csv", "--out", folder / "powers.csv"],
        ["map", run, "--step", "1", "--out", folder / "map.nc"],
        ["locate", run, "--step", "1", "--observed", folder / "heard.csv", "--out", folder / "positions.csv"],
        ["compare", run, "--out", folder / "page"],
        ["view", run, "--out", folder / "view.html"],
    ]


def stored(run: Path) -> dict[str, np.ndarray]:
    """Content of ``predictions.npz`` of a run."""
    with np.load(run / "predictions.npz", allow_pickle=False) as arrays:
        return dict(arrays)


def contents(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def copied(run: Path, to: Path) -> Path:
    return Path(shutil.copytree(run, to))


def scored_again_as_before(run: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """``evaluate`` finds and writes the scores and predictions that the run holds, all but the time of a prediction.

    Returns:
        The metrics.
    """
    before, arrays = json.loads((run / "metrics.json").read_text()), stored(run)
    status, out, err = call(["evaluate", run, "--json"], capsys)
    assert (status, err) == (0, "")
    again = json.loads(out)
    assert again == json.loads((run / "metrics.json").read_text())
    for name in before.keys() - {"ms_per_sample"}:
        assert again[name] == before[name], name
    for name, values in stored(run).items():
        np.testing.assert_array_equal(values, arrays[name])
    return dict(again)


def damaged_models_refused(run: Path, key: str, capsys: pytest.CaptureFixture[str]) -> None:
    """``evaluate`` refuses a model that is cut, lacks the array ``key``, or is of another format."""
    model, asked = run / "model.npz", ["evaluate", run]
    content = model.read_bytes()
    with np.load(model) as archive:
        arrays = {name: values for name, values in archive.items() if name != CHECKSUM}
    model.write_bytes(content[: len(content) // 2])
    refused(asked, "model.npz: not readable .*; train the run anew", capsys)
    np.savez(model, **{name: value for name, value in arrays.items() if name != key})
    refused(asked, f"model.npz: not readable .*{key.partition('/')[2]}.*; train the run anew", capsys)
    np.savez(model, **arrays | {"run/format": np.array(99)})
    refused(asked, f"model.npz: format 99, this version reads {FORMAT}; use the version that wrote it", capsys)


def without_seconds(values: np.ndarray) -> np.ndarray:
    """An array of a run file, in texts without the durations of reports, which no two fits share."""
    values = np.asarray(values)
    return np.array(re.sub(r'"seconds": [^,}]*', "", str(values))) if values.dtype.kind == "U" else values
