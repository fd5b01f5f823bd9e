"""Receiver models and benchmarks from outside the package, by registration and by an installed entry point."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import in_subprocess
from wrf_mi_bench import bench
from wrf_mi_bench.bench import CHECKS, Check

from wrf_mi.core import InputError
from wrf_mi.datasets import load
from wrf_mi.graph import receivers
from wrf_mi.graph.receivers import RECEIVERS
from wrf_mi.runs.api import Interrupted, evaluate_run, open_run, resume, train
from wrf_mi.runs.compare import compare

CABLE_DB = 17.0
PACKAGE = '''
"""A package with a receiver model and a benchmark: a power meter behind an attenuator."""

from dataclasses import dataclass, replace

from wrf_mi.graph.receivers import RECEIVERS
from wrf_mi.receivers.receiver_models import PowerReceiver

CABLE_DB = 17.0


@dataclass(frozen=True)
class Attenuated(PowerReceiver):
    def __call__(self, traced, learned):
        return super().__call__(traced, learned) - CABLE_DB


def make(form, receiver):
    return Attenuated(*form.size, (0.0,), interference=False)


ATTENUATED = replace(RECEIVERS["power"], name="attenuated", make=make)


def measure():
    return {"rows": [{"what": "attenuation", "value": f"{CABLE_DB} dB", "asked": "17 dB"}]}
'''
SETTINGS = (
    "steps=60",
    "batch=8",
    "validate_every=20",
    "checkpoint_every=20",
    "initial.gaussians=6",
    "network.layers=2",
    "network.width=8",
    "view.height=4",
    "view.columns=8",
    "deterministic=true",
)


@pytest.fixture
def registered() -> Iterator[Any]:
    module: dict[str, Any] = {"__name__": "attenuators"}
    sys.modules["attenuators"] = type(sys)("attenuators")  # where its dataclass looks for its types
    exec(PACKAGE, module)
    receivers.register(module["ATTENUATED"])
    with pytest.raises(InputError, match="receiver model 'attenuated': there is one of that name; choose another"):
        receivers.register(module["ATTENUATED"])
    yield module
    del receivers._RECEIVERS._known["attenuated"], sys.modules["attenuators"]


def test_registered_receiver_is_trained_resumed_evaluated_and_compared(registered, flat_folder, tmp_path) -> None:
    out, steps = tmp_path / "run", 0

    def stop() -> bool:
        nonlocal steps
        steps += 1
        return steps == 30

    with pytest.raises(Interrupted):
        train(flat_folder, out, "wrf-gs+", settings=SETTINGS, receiver="attenuated", stop=stop)
    run = resume(out)
    assert evaluate_run(out)["abs_error_db"] == run.metrics["abs_error_db"]
    positions = load(flat_folder).tx_pos_m[:2]
    found = open_run(out).predict(positions, 0).mean
    # The field is the same but for the attenuator.
    field = open_run(out).field
    field.form = replace(field.form, receiver="power")
    np.testing.assert_allclose(field.predictor(positions, 0), found + CABLE_DB, atol=1e-3)
    assert compare([out], tmp_path / "page")


def test_receiver_of_another_task_or_unknown_is_refused(registered: Any, flat_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="receiver model pixel does not report rssi; choose from power, attenuated"):
        train(flat_folder, tmp_path / "run", "wrf-gs+", receiver="pixel")
    with pytest.raises(InputError, match="receiver model 'horn': unknown; choose from power, attenuated"):
        train(flat_folder, tmp_path / "run", "wrf-gs+", receiver="horn")
    assert not (tmp_path / "run").exists()


def test_receivers_and_benchmarks_of_installed_packages_are_found(flat_folder, tmp_path_factory, tmp_path) -> None:
    site = tmp_path_factory.mktemp("site")
    (site / "attenuators.py").write_text(PACKAGE)
    info = site / "attenuators-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: attenuators\nVersion: 1.0\n")
    named = (
        "[wrf_mi.receivers]\nattenuated = attenuators:ATTENUATED\n[wrf_mi.benchmarks]\nattenuator = own_check:CHECK\n"
    )
    (info / "entry_points.txt").write_text(named)
    check = 'from wrf_mi_bench.bench import Check\nCHECK = Check("attenuator", "attenuators:measure")\n'
    (site / "own_check.py").write_text(check)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *(part for part in sys.path if part)])}

    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    trained, _ = in_subprocess(
        environment,
        [
            "train",
            flat_folder,
            "--model",
            "wrf-gs+",
            "--receiver",
            "attenuated",
            "--out",
            tmp_path / "run",
            "--json",
            *settings,
        ],
        ["bench", "attenuator", "--out", tmp_path / "results", "--runs", tmp_path / "runs"],
    )
    assert json.loads(trained)["task"] == "rssi"
    stored = json.loads((tmp_path / "results" / "attenuator.json").read_text())
    assert stored["figures"]["rows"] == [{"what": "attenuation", "value": "17.0 dB", "asked": "17 dB"}]
    assert "attenuation" in (tmp_path / "results" / "README.md").read_text()


def test_registered_benchmark_is_listed() -> None:
    bench.register("own", Check("own", "json:dumps"))
    try:
        assert "own" in CHECKS
        with pytest.raises(InputError, match="benchmark 'own': there is one of that name"):
            bench.register("own", Check("own", "json:dumps"))
    finally:
        del bench._CHECKS._known["own"]
    assert {"pixel", "array", "power", "csi"} <= set(RECEIVERS)
