"""Checks of data that a model is fitted to, and of inputs that it predicts from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.carriers import carriers_text
from ..core.files import listed
from ..core.settings import flat
from ..datasets.observations import count_not_finite, place_of
from .model import Inputs, Problem

if TYPE_CHECKING:
    from .model import Model


def check_record(method: Model, record: Record, others: Iterable[Model] = ()) -> None:
    """Refuse a record that a model does not serve, naming ``others`` that do; or as `check_parts`."""
    place, task = place_of(record), record.task.name
    if not method.serves(task):
        served = " and ".join(", ".join(method.tasks or ["nothing"]).rsplit(", ", 1))
        named = _names([other for other in others if other.serves(task)], ": {}")
        raise InputError(f"{place}: holds {task}; {method.name} serves {served}, so choose another model{named}")
    if method.uplink == "required" and record.uplink is None:
        text = f"has no uplink channels, from which {method.name} predicts; choose data with an uplink"
        raise InputError(f"{place}: {text}")
    check_parts(record)
    if record.carriers_hz is not None and not method.several_carriers:
        named = _names([other for other in others if other.several_carriers and other.serves(task)], " ({})")
        text = f"{carriers_text(record.carriers_hz)}; {method.name} serves one carrier"
        raise InputError(f"{place}: {text}, so choose another model{named} or give the rows of each carrier")


def _names(models: Sequence[Model], form: str) -> str:
    return form.format(", ".join(model.name for model in models)) if models else ""


def check_stated(method: Model, problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse settings that are stated and have no effect on a fit; raises InputError."""
    unused, values = method.unused_settings(problem, splits), dict(flat(asdict(problem.settings)))

    def reason(name: str) -> str | None:
        parts = name.split(".")
        return next((unused[key] for n in range(len(parts)) if (key := ".".join(parts[: n + 1])) in unused), None)

    place = f"{method.name} of {place_of(problem.record)}"
    for name in values:
        if name in problem.stated_settings and (why := reason(name)):
            raise InputError(f"setting {name}={values[name]}: no effect on {place}: {why}; omit it")


def check_held_receivers(record: Record, split: Split, method: Model, others: Iterable[Model]) -> None:
    """Refuse a split that holds out receivers, for a model or data that do not serve it; raises InputError."""
    if not split.held_receivers:
        return
    if not {*split.held_receivers} < {*range(len(record.receivers))}:
        numbers = listed(map(str, split.held_receivers))
        text = f"split {split.name} holds out receivers {numbers} of {len(record.receivers)}"
        raise InputError(f"{place_of(record)}: {text}; leave some to train on")
    if not record.task.shares_law:
        text = f"holds {record.task}; split {split.name} serves signal strengths"
        raise InputError(f"{place_of(record)}: {text}, so choose another split")
    if not (method.new_receivers or len(split.left)):
        able = [other.name for other in others if other.new_receivers and other.serves(record.task.name)]
        text = f"{method.name} predicts for the receivers it is trained on; choose {' or '.join(able)}"
        raise InputError(f"split {split.name}: {text}, or leave them rows, as receiver+20 does")


def _check_receiver_carriers(record: Record, carriers_hz: FloatArray) -> None:
    if record.carriers_hz is not None or not record.task.has_readings:
        text = "receivers' frequency_hz belongs to signal strengths without carriers_hz"
        raise InputError(f"{place_of(record)}: {text}; state the carriers of receivers or of rows")
    if not (carriers_hz > 0).all():
        text = "some receivers have no positive frequency_hz; give the carrier of each in Hz"
        raise InputError(f"{place_of(record)}: {text}")


def check_parts(record: Record) -> None:
    """Refuse a record whose parts do not fit together; raises InputError."""
    record.task.check(record)
    _check_noise(record)
    if record.runs is not None and record.runs.shape != (len(record),):
        raise InputError(f"{place_of(record)}: runs {list(record.runs.shape)}; give one for each of {len(record)} rows")
    if record.receiver_carriers_hz is not None:
        _check_receiver_carriers(record, record.receiver_carriers_hz)
    carriers, place = record.carriers_hz, place_of(record)
    if carriers is None:
        return
    if record.frequencies_hz is not None or not record.task.several_carriers:
        text = "carriers_hz belongs to spectra and signal strengths without frequencies_hz"
        raise InputError(f"{place}: {text}; set one of the two to None, or make a record for each carrier")
    if carriers.shape != (len(record),) or not (np.isfinite(carriers) & (carriers > 0)).all():
        raise InputError(f"{place}: carriers_hz {list(carriers.shape)}; give {len(record)} positive frequencies in Hz")


def _check_noise(record: Record) -> None:
    noise = {"n_readings": record.n_readings, "std": record.std}
    for name, values in noise.items():
        if values is None:
            continue
        if not record.task.has_readings:
            text = f"{name} belongs to signal strengths, not to {record.task}"
            raise InputError(f"{place_of(record)}: {text}; set Record.{name} to None")
        if values.shape != record.observation.shape:
            text = f"{name} {list(values.shape)} beside observations {list(record.observation.shape)}"
            raise InputError(f"{place_of(record)}: {text}; give one for each receiver and row")
        wrong = np.argwhere(np.isfinite(record.observation) & ~((values > 0) & np.isfinite(values)))
        if len(wrong):
            receiver, row = wrong[0]
            where = f"{place_of(record)}, receiver {record.receivers[receiver].name}, row {row}"
            raise InputError(f"{where}: {name} is {values[receiver, row]:g}; give a number above 0 where it received")


def check_inputs(inputs: Inputs, record: Record, method: Model) -> None:
    """Refuse inputs that a model fitted to a record cannot predict from; raises InputError."""
    if record.uplink is None and inputs.uplink is not None:
        raise InputError(f"{method.name}: fitted to {record.name}, which has no uplink; omit uplink")
    if inputs.uplink is None:
        if method.uplink == "required":
            form = "uplink [m, antennas, subcarriers], in the file of `predict --input`"
            raise InputError(f"{method.name}: predicts from the uplink; give {form}")
        return
    assert record.uplink is not None
    antennas, subcarriers = record.uplink.shape[1:]
    if inputs.uplink.shape != (len(inputs), antennas, subcarriers):
        text = f"fitted to {antennas} antennas and {subcarriers} subcarriers"
        text += f", so give [{len(inputs)}, {antennas}, {subcarriers}]"
        raise InputError(f"{method.name}: uplink {list(inputs.uplink.shape)}; {text}")
    bad = np.flatnonzero(~np.isfinite(inputs.uplink.reshape(len(inputs), -1)).all(axis=1))
    if len(bad):
        row = inputs.uplink[bad[0]].ravel()
        raise InputError(f"{method.name}: uplink, row {bad[0]}: {count_not_finite(row)}; correct or remove the row")
