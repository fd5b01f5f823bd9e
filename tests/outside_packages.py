"""Packages of others with models, receivers, benchmarks, tasks, layouts and losses, and commands that find them."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

NEAREST = '''
from dataclasses import dataclass

import numpy as np

from wrf_mi.core import Prediction
from wrf_mi.models import Fitted, Model

@dataclass(frozen=True)
class NearestSettings:
    neighbours: int = 3

class Nearest(Fitted):
    """The mean of the nearest training rows."""

    def __init__(self, arrays, settings):
        self.kept, self.settings = arrays, settings

    def predict(self, inputs, receiver):
        apart = np.linalg.norm(inputs.tx_pos_m[:, None] - self.kept["tx_pos"], axis=2)
        nearest = self.kept["observation"][receiver, np.argsort(apart, axis=1)[:, : self.settings.neighbours]]
        return Prediction(np.nanmean(nearest, axis=1), np.nanstd(nearest, axis=1) + 1)

    def arrays(self):
        return self.kept

    def facts(self):
        return {"rows": len(self.kept["tx_pos"])}

class NearestModel(Model):
    name, source, settings, tasks = "nearest", "this test", NearestSettings, ("rssi",)

    def fit(self, problem, split, session):
        session.progress("nearest rows", 0.0)
        record, rows = problem.record, problem.rows(split)
        return self.load({"tx_pos": record.tx_pos_m[rows], "observation": record.observation[:, rows]}, problem, None)

    def load(self, arrays, problem, folder):
        return Nearest(arrays, problem.settings)

MODEL = NearestModel()
'''
CABLE_DB = 17.0
ATTENUATORS = '''
from dataclasses import dataclass

from wrf_mi.receivers.receiver_models import PowerReceiver
from wrf_mi_bench.bench import Check

CABLE_DB = 17.0

@dataclass(frozen=True)
class Attenuated(PowerReceiver):
    """A power meter behind an attenuator."""

    name = "attenuated"

    def __call__(self, traced, learned):
        return super().__call__(traced, learned) - CABLE_DB

def measure():
    return {"rows": [{"what": "attenuation", "value": f"{CABLE_DB} dB", "asked": "17 dB"}]}

CHECK = Check("attenuator", "attenuators:measure")
'''
DELAYS = """
import csv

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.datasets.layouts import Layout
from wrf_mi.tasks import Task

class DelaySpread(Task):
    name, block, label, higher_is_better = "delay-spread", "abs_error_ns", "absolute error (ns)", False
    axes = 0
    heading, quantity, note = "delay spread", "delay spread (ns)", "The absolute error in ns."

    def score(self, prediction, truth):
        return np.abs(np.asarray(prediction, float) - np.asarray(truth, float))

TASK = DelaySpread()

def read(path, name):
    with (path / "delays.csv").open() as file:
        table = np.array([[float(value) for value in row] for row in list(csv.reader(file))[1:]])
    rows = np.arange(len(table))
    receiver = Receiver("sounder", np.array([0.0, 0, 2]), np.array([0.0, 0, 0, 1]))
    official = rows[rows % 4 > 0], rows[rows % 4 == 0]
    values = table[None, :, 3].astype(np.float32)
    return Record(name or path.name, TASK.name, table[:, :3], (receiver,), values, official=official, source=str(path))

LAYOUT = Layout("delays", TASK.name, read, files=("delays.csv",))
"""
FIELD_STRENGTHS = '''
import csv
from dataclasses import dataclass

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.datasets.layouts import Layout
from wrf_mi.receivers.receiver_models import PowerReceiver
from wrf_mi.tasks import Task

FACTOR_DB = 60.0

class FieldStrength(Task):
    name, block, label, higher_is_better = "field-strength", "abs_error_db", "absolute error (dB)", False
    axes, has_offsets, loss_unit = 0, True, 10.0
    heading, quantity = "field strength", "field strength (dBuV/m)"
    receiver = receiver_with_scene = "field-meter"

    def score(self, prediction, truth):
        return np.abs(np.asarray(prediction, float) - np.asarray(truth, float))

@dataclass(frozen=True)
class FieldMeter(PowerReceiver):
    """An antenna with a factor from its power to the strength of the field."""

    name, tasks = "field-meter", ("field-strength",)
    sums = None  # a correction differentiates the call

    def __call__(self, traced, learned):
        return super().__call__(traced, learned) + FACTOR_DB

    def observed(self, paths, receiver):
        return super().observed(paths, receiver) + FACTOR_DB

TASK = FieldStrength()

def read(path, name):
    with (path / "fields.csv").open() as file:
        table = np.array([[float(value) for value in row] for row in list(csv.reader(file))[1:]])
    rows = np.arange(len(table))
    receiver = Receiver("meter", np.array([0.0, 0, 2]), np.array([0.0, 0, 0, 1]))
    values, hz = table[None, :, 3].astype(np.float32), np.array([2.4e9])
    official = rows[rows % 4 > 0], rows[rows % 4 == 0]
    about = {"frequencies_hz": hz, "official": official, "source": str(path)}
    return Record(name or path.name, TASK, table[:, :3], (receiver,), values, **about)

LAYOUT = Layout("fields", TASK.name, read, files=("fields.csv",))
'''
HUBER = """
import drjit as dr

LIMIT = 3.0  # dB up to which errors count as squares

def huber(prediction, truth, batch, *shape):
    known = dr.isfinite(truth)
    error = dr.abs(prediction - dr.select(known, truth, prediction))
    return dr.mean(dr.select(error < LIMIT, dr.square(error) / 2, LIMIT * (error - LIMIT / 2)))
"""
STEPS = """
from dataclasses import dataclass, replace

import numpy as np

from wrf_mi.core import Prediction
from wrf_mi.stages.further import Further, FurtherStage
from wrf_mi.stages.stage import Option

@dataclass
class InSteps(Further):
    \"\"\"Strengths of an instrument that observes multiples of a step.\"\"\"

    stage = "steps"
    step_db: float

    def predict(self, inputs, receiver):
        prediction = self.before.predict(inputs, receiver)
        return Prediction(self.step_db * np.round(prediction.mean / self.step_db), prediction.std)

class Steps(FurtherStage):
    name, fitted = "steps", InSteps

    def options(self, problem, split):
        if problem.record.task.name != "rssi":
            return []
        return [Option("as predicted", lambda state, split, session: state), Option("in steps", self._fit)]

    def _fit(self, state, split, session):
        values = np.unique(state.problem.record.observation[:, split.all_train])
        step_db = float(np.diff(values[np.isfinite(values)]).min())
        return replace(state, fitted=InSteps(state.fitted, step_db))

STAGE = Steps()
"""
ROUGHNESS = """
from dataclasses import replace

import drjit as dr
import numpy as np

from wrf_mi.gaussians import GaussianAttribute

class Roughness(GaussianAttribute):
    \"\"\"Loss of the coherent signal of a rough surface, exp(-g^2).\"\"\"

    name, rate = "roughness", 1e-2

    def start(self, initial, rng):
        return np.full((1, initial.count), 0.1, np.float32)

    def applied(self, gaussians, values):
        loss = dr.tile(dr.exp(-dr.square(values[0])), gaussians.batch)
        return replace(gaussians, signal=[part * loss for part in gaussians.signal])

    def grown(self, values, source, divided):
        return np.where(divided, 0.05, values[:, source]).astype(np.float32)

ROUGHNESS = Roughness()
"""
SOURCES = {
    "nearest_of_others": NEAREST,
    "attenuators": ATTENUATORS,
    "delays_of_others": DELAYS,
    "fields_of_others": FIELD_STRENGTHS,
    "losses_of_others": HUBER,
    "stages_of_others": STEPS,
    "roughness_of_others": ROUGHNESS,
}
ENTRY_POINTS = """
[wrf_mi.models]
nearest = nearest_of_others:MODEL
[wrf_mi.receivers]
attenuated = attenuators:Attenuated
field-meter = fields_of_others:FieldMeter
[wrf_mi.benchmarks]
attenuator = attenuators:CHECK
[wrf_mi.tasks]
delay-spread = delays_of_others:TASK
field-strength = fields_of_others:TASK
[wrf_mi.layouts]
delays = delays_of_others:LAYOUT
fields = fields_of_others:LAYOUT
[wrf_mi.losses]
huber = losses_of_others:huber
[wrf_mi.stages]
steps = stages_of_others:STAGE
[wrf_mi.gaussian_attributes]
roughness = roughness_of_others:ROUGHNESS
"""
CALLS = """
import contextlib, io, json, os, sys
from wrf_mi.apps.commands.main import main

for words in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = os.remove(words[1]) if words[0] == "remove" else main(words)
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""


def installed(site: Path) -> dict[str, str]:
    """The environment of a Python that has the packages in the folder ``site``, which is made."""
    info = site / "of_others-1.0.dist-info"
    info.mkdir(parents=True)
    for module, source in SOURCES.items():
        (site / f"{module}.py").write_text(source)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: of-others\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    path = os.pathsep.join([str(site), *filter(None, sys.path)])
    return {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "error::RuntimeWarning"}


def commands(environment: dict[str, str], calls: dict[str, list[Any]]) -> dict[str, tuple[int, str, str]]:
    """Status, standard output and standard error of commands, one after the other in a process of their own.

    ``remove FILE`` among them removes a file.
    """
    words = json.dumps([[str(word) for word in call] for call in calls.values()])
    process = [sys.executable, "-c", CALLS, words]
    done = subprocess.run(process, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return dict(zip(calls, map(json.loads, done.stdout.splitlines()), strict=True))
