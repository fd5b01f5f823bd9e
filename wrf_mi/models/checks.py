"""Checks of data that a model is fitted to, and of inputs that it predicts from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ..core import InputError, Record, Split
from ..core.carriers import carriers_text
from ..datasets.observations import count_not_finite, place_of
from ..tasks import task_of
from .model import Inputs

if TYPE_CHECKING:
    from .model import Model


def check_record(method: Model, record: Record, others: Iterable[Model] = ()) -> None:
    """Refuse a record that a model does not serve, naming ``others`` that do, or whose parts do not fit together.

    Raises:
        InputError: another task; no uplink for a model that needs it; rows of several carriers for a model that serves
            a single carrier; or as `check_parts`.
    """
    if not method.serves(record.task):
        *most, last = method.tasks or ("nothing",)
        served = f"{', '.join(most)} and {last}" if most else last
        able = [other.name for other in others if other.serves(record.task)]
        named = f": {', '.join(able)}" if able else ""
        text = f"holds {record.task}; {method.name} serves {served}, so choose another model{named}"
        raise InputError(f"{place_of(record)}: {text}")
    if method.uplink == "required" and record.uplink is None:
        raise InputError(
            f"{place_of(record)}: has no uplink channels, from which {method.name} predicts; choose data with an uplink"
        )
    check_parts(record)
    if record.carriers_hz is not None and not method.several_carriers:
        able = [other.name for other in others if other.several_carriers and other.serves(record.task)]
        named = f" ({', '.join(able)})" if able else ""
        text = f"{carriers_text(record.carriers_hz)}; {method.name} serves one carrier"
        raise InputError(f"{place_of(record)}: {text}, so choose another model{named} or give the rows of each carrier")


def check_held_receivers(record: Record, split: Split, method: Model, others: Iterable[Model]) -> None:
    """Refuse a split that holds out receivers, for a model or data that do not serve it.

    Raises:
        InputError: a model that predicts for trained receivers alone, other data than signal strengths, or a receiver
            that is not in the data.
    """
    if not split.held_receivers:
        return
    if max(split.held_receivers) >= len(record.receivers) or len(split.held_receivers) == len(record.receivers):
        numbers = ", ".join(map(str, split.held_receivers))
        text = f"split {split.name} holds out receivers {numbers} of {len(record.receivers)}"
        raise InputError(f"{place_of(record)}: {text}; leave some to train on")
    if not task_of(record).in_decibel:
        text = f"holds {record.task}; split {split.name} serves signal strengths"
        raise InputError(f"{place_of(record)}: {text}, so choose another split")
    if not (method.new_receivers or len(split.left)):
        able = [other.name for other in others if other.new_receivers and other.serves(record.task)]
        text = f"{method.name} predicts for the receivers it is trained on; choose {' or '.join(able)}"
        raise InputError(f"split {split.name}: {text}, or leave them rows, as receiver+20 does")


def check_parts(record: Record) -> None:
    """Refuse a record whose parts do not fit together.

    Raises:
        InputError: numbers of rows, antennas, subcarriers and frequencies that differ; carriers, runs, numbers of
            readings or standard deviations that do not fit the observations.
    """
    task_of(record).check(record)
    _check_noise(record)
    if record.runs is not None and record.runs.shape != (len(record),):
        raise InputError(f"{place_of(record)}: runs {list(record.runs.shape)}; give one for each of {len(record)} rows")
    carriers, place = record.carriers_hz, place_of(record)
    if (of_receivers := record.receiver_carriers_hz) is not None:
        if carriers is not None or not task_of(record).in_decibel:
            text = "receivers' frequency_hz belongs to signal strengths without carriers_hz"
            raise InputError(f"{place}: {text}; state the carriers of receivers or of rows")
        if not (of_receivers > 0).all():
            raise InputError(f"{place}: some receivers have no positive frequency_hz; give the carrier of each in Hz")
    if carriers is None:
        return
    if record.frequencies_hz is not None or task_of(record).is_complex:
        text = "carriers_hz belongs to spectra and signal strengths without frequencies_hz"
        raise InputError(f"{place}: {text}; set one of the two to None, or make a record for each carrier")
    if carriers.shape != (len(record),) or not (np.isfinite(carriers) & (carriers > 0)).all():
        raise InputError(f"{place}: carriers_hz {list(carriers.shape)}; give {len(record)} positive frequencies in Hz")


def _check_noise(record: Record) -> None:
    stated = {"n_readings": record.n_readings, "std": record.std}
    for name, values in stated.items():
        if values is None:
            continue
        if not task_of(record).in_decibel:
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
    """Refuse inputs that a model fitted to a record cannot predict from.

    Raises:
        InputError: no uplink for a model that needs it, another number of antennas or subcarriers, or values that are
            not finite.
    """
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
        raise InputError(
            f"{method.name}: uplink {list(inputs.uplink.shape)}; fitted to {antennas} antennas and {subcarriers} "
            f"subcarriers, so give [{len(inputs)}, {antennas}, {subcarriers}]"
        )
    bad = np.flatnonzero(~np.isfinite(inputs.uplink.reshape(len(inputs), -1)).all(axis=1))
    if len(bad):
        row = inputs.uplink[bad[0]].ravel()
        raise InputError(f"{method.name}: uplink, row {bad[0]}: {count_not_finite(row)}; correct or remove the row")
