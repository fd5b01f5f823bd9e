"""The model ``kriging``: the covariance that suits the task and the data, else that of the observations themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...core import InputError, Split
from ...tasks import task_of
from ..model import Arrays, Fitted, Model, Problem, Session, known_positions
from .by_receiver import model_by_receiver
from .diffuse import fit_channels, load_channels
from .kriging import SOURCE, KrigingSettings, fit_generic, load_generic
from .spectra import SpectrumKrigingSettings, fit_spectra, load_spectra
from .strengths import Strengths, StrengthSettings, fit_strengths

NAME = "kriging"
GENERIC = model_by_receiver(
    NAME,
    None,
    KrigingSettings,
    fit_generic,
    load_generic,
    SOURCE,
    lambda record, settings: settings.heading and task_of(record).in_decibel,
)
"""Kriging of any observations, each receiver alone."""
STOPS = "stop.value_dbm"
"""Array of pooled strengths, which generic kriging has not: readings, NaN where a receiver did not report at a stop."""


def _is_pooled(problem: Problem) -> bool:
    """Whether strengths are pooled over receivers: with a single, known carrier, from which free space follows."""
    return not problem.settings.is_generic and problem.record.frequencies_hz is not None


def _fit_strengths(problem: Problem, split: Split, session: Session) -> Fitted:
    if not _is_pooled(problem):
        return GENERIC.fit(problem, split, session)
    rows = problem.rows(split)
    known_positions(problem.record, rows, NAME)
    return fit_strengths(problem.record, rows, None, problem.settings, session.report)


def _load_strengths(arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
    return Strengths.from_arrays(arrays) if STOPS in arrays else GENERIC.load(arrays, problem, folder)


def _check_strengths(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse receivers without training rows where receivers are not pooled."""
    for split in splits:
        if split.held_receivers and not len(split.left) and not _is_pooled(problem):
            text = "kriging of each receiver alone, without a single known carrier, predicts for trained receivers"
            raise InputError(f"split {split.name}: {text}; choose mri, or leave them rows, as receiver+20 does")


_BY_TASK = {
    "rssi": replace(
        GENERIC,
        settings=StrengthSettings,
        fit=_fit_strengths,
        load=_load_strengths,
        new_receivers=True,
        gaps=(STOPS,),
        check=_check_strengths,
    ),
    # Neither depends on how the transmitter is turned.
    "spectrum": replace(
        model_by_receiver(NAME, None, SpectrumKrigingSettings, fit_spectra, load_spectra, SOURCE), headings=False
    ),
    "csi": replace(model_by_receiver(NAME, None, KrigingSettings, fit_channels, load_channels, SOURCE), headings=False),
}


def _by_data(task: str, with_scene: bool) -> Model:
    return _BY_TASK.get(task, GENERIC)


MODEL = replace(
    _BY_TASK["rssi"],
    settings={
        "signal strengths": StrengthSettings,
        "spectra": SpectrumKrigingSettings,
        "channel coefficients and other tasks": KrigingSettings,
    },
    by_data=_by_data,
)
