"""Correction of a scene by measurements (``docs/correction.md`` has the steps).

Edits (`wrf_mi.correction.edits`) are fitted to training rows, and what is kept is decided on others.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import rankdata
from threadpoolctl import threadpool_limits

from ..core import InputError, Record, Split
from ..core.types import FloatArray, IntArray
from ..scene.correction_data import CorrectionData
from ..tasks import task_of
from ..tracing.paths.instrument_parameters import gain_name
from ..training.selection import hold_out_groups, improves, last_gain
from .edits import (
    Correction,
    TracedScene,
    by_all_rows,
    check_paths,
    checked,
    error_ratio,
    kinds_of,
    moves_planes,
)
from .misfit import Misfit
from .moves import Moves
from .options import FRAME, MATERIALS, PHASES, PLANES, CorrectionOptions, OnStage
from .state import ScenePosterior, State
from .uncertain_phases import UncertainPhases

NO_ROWS = np.zeros((0, 2), np.int64)  # no rows retained by receivers that are held out (`wrf_mi.core.Split`)
CONFIDENCE = 0.95  # one-sided, in the gain of a stage: fits with more freedom also fit what no surface explains
LEAST_RECEIVERS = 4  # fewest trained receivers of which half decide what is kept, where a split holds receivers out


# Products are of a few rows: threads that share them wait for each other, on a busy machine ten times as long.
@threadpool_limits.wrap(1, "blas")  # type: ignore[untyped-decorator]
def correct_scene(
    scene: str | Path,
    record: Record,
    split: Split,
    options: CorrectionOptions | None = None,
    material: str | None = None,
    on_stage: OnStage = lambda what, share: None,
) -> Correction:
    """Correct a scene by the training rows of a split.

    Args:
        scene: see `wrf_mi.tracing.open_scene`.
        record: measurements of any task, positions known.
        split: its training and validation rows are used, its test rows and receivers that it holds out are not.
        options: parts that may change, and the prior knowledge of them; None: `default_options`.
        material: radio material of a bare mesh.
        on_stage: called as the correction goes on.

    Raises:
        InputError: data or a scene that cannot be used, or no path to any receiver.
    """
    begun = time.perf_counter()
    record, split, options = checked(record, split, options)
    traced = TracedScene(scene, record, split, options, material, on_stage)
    held_out = _held_out(record, split)
    # Stages are fitted to some of the rows, and judged by the others.
    trial = traced.posterior(held_out.known, held_out.known_rows)
    check_paths(trial, scene)
    judged = _judged_stages(trial, traced, held_out)
    units = ((stage, held_out.units(result.score)) for stage, result in judged.items())
    best_stage = last_gain(units, held_out.higher_is_better, confidence=CONFIDENCE)
    if not moves_planes(best_stage):
        best_stage = _by_uncertain_phases(trial, traced, held_out, judged, best_stage)
    # What is kept is fitted to all rows, along the paths of the scene that the trial found.
    best = judged[best_stage].state if best_stage else None
    final = traced.posterior(record, split.all_train, best.edit if best else None)
    state, data, deviation = final.start(""), None, np.zeros(len(final.stated))
    if best:
        state, deviation, left_out = by_all_rows(best.edit, final)
        unseen = judged[best_stage].unseen
        before, after = held_out.vector_of(best, unseen), held_out.with_mean_gain(state.vector, final.misfit)
        ratio = error_ratio(_errors(unseen, before, final.misfit, after, left_out))
        data = CorrectionData(record.name, split.all_train, ratio)
    facts: dict[str, Any] = {"rows": len(split.all_train), "held_out": len(held_out.rows)}
    facts |= {"held_out_receivers": list(held_out.out), "paths": len(final.misfit.paths.row)}
    scores = {stage: result.score for stage, result in judged.items()}
    return Correction(state, deviation, scores, kinds_of(Path(scene)), data, time.perf_counter() - begun, facts)


class _Judged(NamedTuple):
    """A state of a stage, the misfit of rows held out of it, and their scores."""

    state: State
    unseen: Misfit
    score: FloatArray


def _judged_stages(trial: ScenePosterior, traced: TracedScene, held_out: _HeldOut) -> dict[str, _Judged]:
    """States of the stated scene ("") and of each stage, by the known rows, and scores of those held out."""
    # Parts that are changed together: materials without planes, and all.
    parts = [part for part in trial.options.parts if part != PHASES]
    stages, still = ["+".join(parts)], [part for part in parts if part not in (PLANES, FRAME)]
    if MATERIALS in still and len(still) < len(parts):
        stages.insert(0, "+".join(still))
    states = {stage: Moves(trial, stage).best() for stage in stages}
    stated = traced.posterior(held_out.record, held_out.rows).misfit
    judged = {"": held_out.judged(trial.start(""), stated)}
    for stage, state in states.items():
        judged[stage] = held_out.judged(state, stated)
        units = {name: held_out.units(result.score) for name, result in judged.items()}
        # Other paths make good planes better. They do not mend those that fit training rows alone, and finding them
        # takes as long as all that was done before.
        if moves_planes(stage) and _last_is_best(units, held_out.higher_is_better):
            along_moved = traced.posterior(held_out.known, held_out.known_rows, state.edit)
            state = Moves(along_moved, stage).continued(state.edit)
            judged[stage] = held_out.judged(state, traced.posterior(held_out.record, held_out.rows, state.edit).misfit)
    return judged


def _by_uncertain_phases(
    trial: ScenePosterior, traced: TracedScene, held_out: _HeldOut, judged: dict[str, _Judged], kept: str
) -> str:
    """The stage that is kept where planes are not resolved: ``kept``, or materials by uncertain phases (``judged``)."""
    if PHASES not in trial.options.parts or not UncertainPhases.serves(trial.misfit):
        return kept
    stage = "+".join(part for part in trial.options.parts if part not in (PLANES, FRAME))
    fit = UncertainPhases(trial)
    judged[stage] = held_out.judged(fit.best(stage), judged[""].unseen)
    # Predicted channels of wrong phases say nothing of materials: their likelihood with uncertain phases decides.
    unseen = UncertainPhases(traced.posterior(held_out.record, held_out.rows), fit.noise)
    vectors = (held_out.vector_of(judged[name].state, unseen.misfit) for name in (kept, stage))
    before, after = (held_out.units(unseen.scores(vector)) for vector in vectors)
    gain = (after - before)[np.isfinite(after - before)]
    # Signed ranks (Wilcoxon, 1945): rows of which a path is missing in the scene have gains and losses of any size.
    ranks = np.sign(gain) * rankdata(np.abs(gain))
    units = (kept, np.zeros(len(gain))), (stage, ranks)
    return last_gain(units, higher_is_better=True, confidence=CONFIDENCE)


def _errors(
    unseen: Misfit, before: FloatArray, final: Misfit, vector: FloatArray, left_out: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Errors without and with the rows held out of every choice, which are few; and without and with each row by least
    squares, after choices that knew them all.
    """
    count = len(final.record.receivers)
    fitted = np.abs(final.residual(vector))
    rows = fitted.reshape(count, len(final.rows), -1)[:, np.isin(final.rows, unseen.rows)]
    return [(unseen.residual(before).reshape(rows.shape), rows), (left_out, fitted)]


class _HeldOut(NamedTuple):
    """Observations that a correction is fitted to, ``known``, and those held out, which decide what is kept."""

    known: Record
    known_rows: IntArray
    record: Record
    rows: IntArray
    out: tuple[str, ...] = ()  # names of the receivers of ``record``; none where rows are held out instead
    fitted: tuple[str, ...] = ()  # names of the receivers of ``known``

    @property
    def higher_is_better(self) -> bool:
        """Whether higher scores are better."""
        return task_of(self.record).higher_is_better

    def judged(self, state: State, unseen: Misfit) -> _Judged:
        """A state with the scores of the rows held out."""
        return _Judged(state, unseen, unseen.scores(self.vector_of(state, unseen)))

    def units(self, score: FloatArray) -> FloatArray:
        """Independent scores: those of rows, or the mean of each receiver that is held out."""
        if not self.out:
            return score
        by_receiver = score.reshape(len(self.record.receivers), -1)
        return np.array([np.nanmean(row) for row in by_receiver if np.isfinite(row).any()])

    def vector_of(self, state: State, misfit: Misfit) -> FloatArray:
        """Vector of a misfit of other rows, with the mean gain at receivers held out."""
        return self.with_mean_gain(misfit.vector_of(state.scene_parameters()), misfit)

    def with_mean_gain(self, vector: FloatArray, misfit: Misfit) -> FloatArray:
        """A vector with the mean gain of the receivers that were fitted at those that were not."""
        gains = {receiver.name: gain_name(receiver) for receiver in self.known.receivers}
        if not self.out or not set(gains.values()) <= set(misfit.parts):
            return vector
        result = vector.copy()
        mean = np.mean([vector[misfit.parts[gains[receiver]]] for receiver in self.fitted], axis=0)
        for receiver in self.out:
            result[misfit.parts[gains[receiver]]] = mean
        return result


def _held_out(record: Record, split: Split) -> _HeldOut:
    """Training rows in groups in space, or where a split holds receivers out half of the others."""
    # Rows that judge a correction have to be like what the scene shall serve: new places, or new receivers.
    trained = np.flatnonzero(np.isfinite(record.observation).reshape(len(record.receivers), -1).any(axis=1))
    if split.held_receivers and len(trained) >= LEAST_RECEIVERS:
        out = np.sort(np.random.default_rng([split.seed, 9]).permutation(trained)[: len(trained) // 2])
        others = np.setdiff1d(trained, out)
        names = (tuple(record.receivers[number].name for number in part) for part in (out, others))
        known, held_out = (
            record.seen(replace(split, held_receivers=tuple(hidden), left=NO_ROWS)) for hidden in (out, others)
        )
        return _HeldOut(known, split.all_train, held_out, split.all_train, *names)
    groups = hold_out_groups(split, record.tx_pos_m)
    if groups is split:
        raise InputError(f"{record.name}: {len(split.train)} training rows are too few to hold some out; give more")
    # The regions alone judge: validation rows lie among those that the correction is fitted to, and add to few.
    rows = np.setdiff1d(groups.validation, split.validation)
    return _HeldOut(record, np.setdiff1d(split.all_train, rows), record, rows)


def _last_is_best(scores: Mapping[str, FloatArray], higher_is_better: bool) -> bool:
    """Whether no stage has a better mean than the last, over what is known of both."""
    *before, last = scores.values()
    return all(improves(last, score, higher_is_better, errors=0.0) for score in before)
