"""Calls of the command within this process."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wrf_mi.cli import main

SMALL = ["initial.gaussians=8", "optimiser.warm_up=5", "density.every=0", "log_every=2", "validate_every=4", "steps=4"]
SET = [part for setting in SMALL for part in ("--set", setting)]
"""A training of a moment."""


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
    """The command says in one line what is wrong, and nothing else."""
    status, out, err = call(arguments, capsys)
    assert status == 2
    assert out == ""
    assert err.startswith("wrf-mi")
    assert err.endswith("\n")
    assert err.count("\n") == 1, err
    assert re.search(message, err), err


def stored(run: Path) -> dict[str, np.ndarray]:
    """What ``predictions.npz`` of a run holds."""
    with np.load(run / "predictions.npz", allow_pickle=False) as arrays:
        return dict(arrays)
