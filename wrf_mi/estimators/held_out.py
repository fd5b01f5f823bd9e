"""Predictions of training rows by models that are fitted without them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction, Record, Split
from ..core.antenna import AS_STATED
from ..core.array_files import stored_arrays, write_arrays
from ..core.stored import from_arrays, to_arrays
from ..core.types import IntArray
from ..datasets.observations import fitted_receivers
from ..scene.correction_data import read_correction_data
from ..training.selection import HeldOut, hold_out
from .model import Fitted, HeldOutPrediction, Model, Problem, Session, inputs_of
from .receiver_places import placed_problem


class HoldOut(NamedTuple):
    """Rows that are held out of the training rows of a split."""

    split: Split  # the split
    observation: NDArray[Any]  # observations of its record, by which the hold-out is known again
    seed: int  # seed by which many observations are thinned
    fold: Split  # the other training rows, and as test rows those held out
    held_out: HeldOut


def hold_out_once(problem: Problem, split: Split) -> HoldOut | None:
    """`wrf_mi.training.selection.hold_out` of a split, computed once for all that choose by its rows; None: no rows."""
    record, hold_outs = problem.record, cast(list[HoldOut], problem.hold_outs)
    for each in hold_outs:
        if each.split is split and each.observation is record.observation and each.seed == problem.seed:
            return each
    fold = hold_out(record, split)
    held_out = None if fold is None else HeldOut.of(record, fold, problem.seed)
    if fold is None or not held_out:
        return None
    hold_outs.append(HoldOut(split, record.observation, problem.seed, fold, held_out))
    return hold_outs[-1]


def labelled(session: Session, label: str) -> Session:
    """A session whose progress has a label, without that of optimiser steps."""
    on_progress = session.on_progress
    return replace(
        session, on_progress=lambda stage, share, *_: on_progress(f"{label}: {stage.rpartition(': ')[2]}", share)
    )


def fit_model(entry: Model, problem: Problem, split: Split, session: Session) -> tuple[Fitted, Problem]:
    """A fitted model, and the problem with the settings that its `Model.prepare` chose."""
    settings = entry.prepare(problem, [split], session)
    if settings is not problem.settings:  # a new problem would open its scene anew
        problem = replace(problem, settings=settings)
    return entry.fit(problem, split, session), problem


def fold_of(entry: Model | None, problem: Problem, fold: Split, session: Session) -> tuple[Problem, Split, IntArray]:
    """What a fit to a fold of the training rows may see: problem and split of the receivers with enough rows, their
    numbers, ascending. Places that nobody surveyed are estimated for a model that uses them, ``entry``.
    """
    numbers, left_out = fitted_receivers(problem.record, [fold])
    if left_out:
        problem = replace(problem, dataset=problem.record.at_receivers(numbers), antennas=AS_STATED)
        fold = fold.at_receivers(numbers)
    problem = problem.seen(fold)
    return problem if entry is None else placed_problem(problem, fold, entry, session.progress), fold, numbers


def fit_fold(entry: Model, problem: Problem, fold: Split, session: Session) -> tuple[Fitted, IntArray]:
    """A model fitted to a fold of the training rows, and the numbers of the receivers with enough, ascending."""
    problem, fold, numbers = fold_of(entry, problem, fold, session)
    return fit_model(entry, problem, fold, session)[0], numbers


def predicted_rows(fitted: Fitted, record: Record, rows: IntArray, receiver: int) -> Prediction:
    """Prediction of rows of the record, stored or made."""
    return fitted.predict_rows(rows, receiver) or fitted.predict(inputs_of(record, rows), receiver)


def with_error_ratio(mean: NDArray[Any], problem: Problem, held_out: HeldOut) -> NDArray[Any]:
    """Predictions [q, ...] whose errors are as large as if the scene did not know the held-out rows."""
    record, data = problem.record, read_correction_data(problem.scene)
    if data is None:
        return mean
    observed, in_correction = held_out.observed(record), data.knows(record.name, held_out.row)
    # The scene was corrected by these rows, too: their errors are smaller than those of rows to be predicted.
    enlarged = observed + data.error_ratio * (mean - observed)
    enlarged = record.task.limited(enlarged, most=False)
    return np.where(in_correction.reshape(-1, *[1] * (mean.ndim - 1)), enlarged, mean)


def held_out_predictions(
    entry: Model, problem: Problem, fold: Split, held_out: HeldOut, session: Session, name: str
) -> HeldOutPrediction:
    """Predictions [q, ...] of held-out observations of a fold by a model that is fitted to the other rows.

    They are kept in the session's folder; a stopped fit goes on with them. ``name`` is for the progress callback.

    Raises:
        InputError: rows that the model cannot be fitted to.
    """
    path = session.folder / "held_out.npz"
    if not path.exists():
        session.folder.mkdir(parents=True, exist_ok=True)
        fitted, numbers = fit_fold(entry, problem, fold, labelled(session, f"{name}, held-out rows"))
        write_arrays(path, to_arrays(predicted_held_out(fitted, problem.record, numbers, held_out)))
    return stored_held_out(path, problem, held_out)


def predicted_held_out(fitted: Fitted, record: Record, numbers: IntArray, held_out: HeldOut) -> HeldOutPrediction:
    """Predictions of held-out observations by a model of the receivers of some numbers."""
    of_rows = _of_pairs(fitted, record, numbers, held_out.receiver, held_out.row)
    every = _of_pairs(fitted, record, numbers, *held_out.every.T) if len(held_out.every) else None
    return HeldOutPrediction(of_rows.mean, of_rows.std, every=every)


def stored_held_out(path: Path, problem: Problem, held_out: HeldOut) -> HeldOutPrediction:
    """Predictions of a file of `predicted_held_out`, with errors as of rows that the scene does not know."""
    stored = from_arrays(HeldOutPrediction, stored_arrays(path))
    return replace(stored, mean=with_error_ratio(stored.mean, problem, held_out))


def _of_pairs(fitted: Fitted, record: Record, numbers: IntArray, receiver: IntArray, row: IntArray) -> Prediction:
    """Predictions, with deviations if stated, of pairs [q] by a model of the receivers of some numbers."""
    predictions = [
        predicted_rows(fitted, record, row[receiver == number], place)
        for place, number in enumerate(numbers)
        if (receiver == number).any()
    ]
    # Predicted receiver by receiver, while a fold may hold receivers out in any order.
    order = np.argsort(np.argsort(receiver, kind="stable"), kind="stable")
    mean = np.concatenate([prediction.mean for prediction in predictions])[order]
    if predictions[0].std is None:
        return Prediction(mean)
    return Prediction(mean, np.concatenate([prediction.stated_std for prediction in predictions])[order])
