"""Receiver models of other packages, with tasks of theirs."""

import sys
import types
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from outside_packages import FIELD_STRENGTHS
from random_paths import paths_of

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.receivers.registry import RECEIVERS, receiver_model, register
from wrf_mi.tasks import TASKS, instrument_of


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A registered task, field strengths, and the receiver model that observes it."""
    module = types.ModuleType("fields_of_others")
    monkeypatch.setitem(sys.modules, "fields_of_others", module)  # where its dataclass looks for its types
    exec(FIELD_STRENGTHS, module.__dict__)
    TASKS.add("field-strength", module.TASK)
    register(module.FieldMeter)
    yield module
    del TASKS._known["field-strength"], RECEIVERS._known["field-meter"]


def test_registered_receiver_observes_paths(others: Any) -> None:
    receiver = Receiver("meter", np.zeros(3), np.array([0.0, 0, 0, 1]))
    hz, observed = np.array([2.4e9]), np.zeros((1, 3), np.float32)
    record = Record("own", others.TASK, np.ones((3, 3)), (receiver,), observed, frequencies_hz=hz)
    meter, power = instrument_of(record), instrument_of(replace(record, task="rssi"))
    assert (record.task, meter.kind, power.kind) == (others.TASK, "field-meter", "power")
    arrival, gain = np.tile([0.0, 0, 1], (3, 1)), np.array([1e-3, 2e-3j, 1e-4])
    paths = paths_of(np.arange(3), np.zeros(3, int), gain, np.full(3, 2.0), arrival, n_tx=3, n_rx=1)
    np.testing.assert_allclose(meter.observe(paths), power.observe(paths) + others.FACTOR_DB)
    # Without a stated derivative of sums over paths, a correction differentiates the call.
    assert (meter.model(receiver).sums, power.model(receiver).sums) == (None, "powers")


def test_registered_receiver_serves_its_task_alone(others: Any) -> None:
    assert receiver_model("field-meter", "field-strength") is others.FieldMeter
    with pytest.raises(InputError, match="receiver model field-meter does not observe rssi; choose from power"):
        receiver_model("field-meter", "rssi")
    with pytest.raises(InputError, match="receiver model power does not observe field-strength; choose from field-m"):
        receiver_model("power", "field-strength")
