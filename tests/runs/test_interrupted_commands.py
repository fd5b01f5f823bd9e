"""Trainings that end at a change of files and go on: killed, on a full disk, without permission, by Ctrl-C twice."""

import errno
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from calling import SET, call, contents, stored
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")
"""Audit events of changes of folders; opening a file to write is another."""
EXAMPLES = 10  # of each model
DEAD = 2**22 + 1  # no process of Linux has this number
TIMES = ("train_seconds", "trace_seconds", "ms_per_sample", "peak_memory_mb")


class Killed(BaseException):
    """End of a process: no later change of a file succeeds."""


class Changes:
    """Counts changes of files below a folder and passes their number to ``fault`` before; audit hooks stay for good."""

    def __init__(self) -> None:
        self.folder, self.number = "", 0
        self.fault: Callable[[int], object] = lambda number: None
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        written = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if self.folder and (written or event in EVENTS) and str(arguments[0]).startswith(self.folder):
            self.number += 1
            self.fault(self.number)


@pytest.fixture(scope="module")
def changes() -> Changes:
    return Changes()


def failing(error: BaseException, after: int) -> None:
    if after >= 0:
        raise error


FAULTS: Mapping[str, tuple[tuple[int, ...], Callable[[int], object]]] = {
    "killed": ((), lambda after: failing(Killed(), after)),
    "full disk": ((2,), lambda after: failing(OSError(errno.ENOSPC, "No space left on device", "a.npz"), after)),
    "no permission": ((2,), lambda after: failing(OSError(errno.EACCES, "Permission denied", "a.npz"), after)),
    "Ctrl-C twice": ((0, 130), lambda after: signal.raise_signal(signal.SIGINT) if after in (0, 1) else None),
}
"""Exit statuses of faults, and what happens at a change, by its number after the first one with the fault."""


def results(run: Path) -> dict[str, Any]:
    metrics = json.loads((run / "metrics.json").read_text())
    predictions = {name: (values.shape, values.tobytes()) for name, values in stored(run).items()}
    metrics["options"] = [{**option, "seconds": 0} for option in metrics.get("options", [])]
    return {name: metrics[name] for name in metrics.keys() - TIMES} | predictions | {"files": contents(run)}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of files that a killed process leaves open
@pytest.mark.parametrize("model", ["kriging", "wrf-gs+"])
def test_training_goes_on_after_a_fault_with_equal_results(model, folder, flat_folder, changes, tmp_path, capsys):
    data, more = (flat_folder, []) if model == "kriging" else (folder, [*SET, "--set", "checkpoint_every=2"])
    fit, out = ["train", data, "--model", model, "--deterministic", *more, "--out"], tmp_path / "run"
    changes.folder, changes.number, changes.fault = str(tmp_path), 0, lambda number: None
    assert call([*fit, tmp_path / "whole"], capsys)[0] == 0
    expected, count = results(tmp_path / "whole"), changes.number
    assert count > 10

    @settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))
    @given(st.integers(1, count), st.sampled_from(sorted(FAULTS)))
    @example(count, "killed")
    def goes_on(first: int, kind: str) -> None:
        statuses, fault = FAULTS[kind]
        shutil.rmtree(out, ignore_errors=True)  # of the example before
        changes.number, changes.fault = 0, lambda number: fault(number - first)
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(os, "getpid", lambda: DEAD)
            try:
                status, _, err = call([*fit, out], capsys)
            except Killed:
                assert kind == "killed"
            else:
                assert status in statuses, err
                assert status == 0 or err.splitlines()[-1].startswith("wrf-mi: ")
        changes.fault = lambda number: None
        begun = (out / "config.yaml").exists()
        assert call(["train", "--resume", out] if begun else [*fit, out], capsys)[0] == 0
        assert results(out) == expected

    try:
        goes_on()
    finally:
        changes.folder = ""
