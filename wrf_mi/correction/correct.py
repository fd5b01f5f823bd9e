"""Correction of a scene by measurements (``docs/correction.md`` has the steps).

Paths are found with the stated scene; choice (`wrf_mi.correction.moves`) and least squares
(`wrf_mi.correction.least_squares`) are done in rounds on training rows, once more with the paths of the scene that they
found where planes have moved. What is kept is decided on other training rows.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..datasets.observations import check_observations, fitted_receivers, warn_of_left_out
from ..scene.correction_data import CorrectionData
from ..scene.folder import read_scene_folder
from ..scene.hidden import Boxes, with_hidden_faces
from ..scene.materials import FILE as MATERIALS_FILE
from ..scene.mesh.surfaces import KINDS, Kind
from ..tasks import task_of
from ..tasks.conditions import scene_carrier
from ..tracing import open_scene
from ..tracing.paths.corrected_scene import check_materials, moved_search
from ..tracing.paths.instrument_parameters import gain_name
from ..tracing.paths.solve import Prepared
from ..training.selection import hold_out_groups, improves, last_gain
from .fit import LEAST_PATHS, Fit, State
from .misfit import Misfit
from .moves import Moves
from .options import DEFAULTS, FRAME, GAIN, HIDDEN, MATERIALS, PLANES, STRENGTHS, CorrectionOptions, OnStage

LEVEL = 0.9
"""Level of the intervals for which errors of rows that a scene knows are enlarged."""
NONE = np.zeros((0, 2), np.int64)
"""No rows are left to receivers that are held out (`wrf_mi.core.Split`)."""
CONFIDENCE = 0.95
"""One-sided confidence in the gain of a stage: fits with more freedom also fit what no surface explains."""


@dataclass
class Correction:
    """A corrected scene.

    Attributes:
        fit: fit to all training rows, with parameters of the surfaces that their paths meet.
        state: its parameters and choices; its stage is what was changed, "" for nothing.
        deviation: standard deviations of the parameters [p], 0 of those that were not changed.
        scores: scores of the rows held out while choosing, by stage.
        kinds: kinds of the scene's objects.
        data: rows that were used, and how much smaller their errors are for it; None where nothing was changed.
        seconds: duration.
        facts: sizes for the page.
    """

    fit: Fit
    state: State
    deviation: FloatArray
    scores: Mapping[str, FloatArray]
    kinds: Mapping[str, Kind]
    data: CorrectionData | None
    seconds: float
    facts: Mapping[str, Any]

    @property
    def misfit(self) -> Misfit:
        """Residuals over all training rows."""
        return self.fit.misfit

    @property
    def kept(self) -> str:
        """Parts that were changed, joined by "+"; "" for none."""
        return self.state.stage

    @property
    def vector(self) -> FloatArray:
        """Parameters [p] of `misfit`."""
        return self.state.vector


def default_options(record: Record) -> CorrectionOptions:
    """Options for a record where none are given."""
    return STRENGTHS if task_of(record).in_decibel else DEFAULTS


# Products are of a few rows: threads that share them wait for each other, on a busy machine ten times as long.
@threadpool_limits.wrap(1, "blas")
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
    record = record.seen(split)
    numbers, left_out = fitted_receivers(record, [split])
    warn_of_left_out(record, left_out)
    record, split = record.at_receivers(numbers), split.at_receivers(numbers)
    task, name = task_of(record), record.name
    if not task.receiver_with_scene:
        raise InputError(f"{name}: no receiver model reports {task.name} from paths")
    check_observations(record, split, complete=task.image)
    options = options or default_options(record)
    if task.in_decibel and GAIN not in options.parts:
        options = replace(options, parts=(*options.parts, GAIN))
    # An image of each receiver and row has some hundred values: as many images as one receiver's rows tell as much.
    split = _at_most(split, max(1, options.rows // (len(record.receivers) if task.image else 1)))
    carrier_hz = scene_carrier(record, split.all_train)
    completed = with_hidden_faces(scene) if HIDDEN in options.parts else nullcontext((scene, Boxes([], [])))
    with completed as (place, boxes):
        opened, copy = (open_scene(place, carrier_hz, material=material) for _ in range(2))
    supposed = frozenset(face.name for face in boxes.hidden)
    if not supposed:
        options = replace(options, parts=tuple(part for part in options.parts if part != HIDDEN))
    check_materials(opened)
    prepared = Prepared(opened)
    prepared.check(record.tx_pos_m, record.receivers)
    parts = _parts(record, split)
    named = [name.rpartition("/")[::2] for name in prepared.tables("surface").slabs.names]
    slabs = np.array([slab for slab, (thing, _) in enumerate(named) if thing in supposed], np.int64)
    hidden = np.array([int(named[slab][1]) for slab in slabs], np.int64), slabs

    def fit_of(record: Record, rows: IntArray, state: State | None = None, by: Fit | None = None) -> Fit:
        """Fit to paths of the stated scene, or to those of a scene whose planes have moved as a state has them."""
        on_stage("tracing", 0.0)
        searched = None
        if state and by and _moves(state.stage):
            parameters = {name: values.astype(np.float32) for name, values in by.of_scene(state).items()}
            searched = moved_search(copy, prepared.surfaces, parameters, by.absent(state))
        # What a fit knows of surfaces stays known where no path meets them any more, such as absent ones.
        further = (by.misfit.planes, by.misfit.slabs) if by else hidden
        misfit = Misfit(record, rows, prepared, options, searched, further)
        return Fit(misfit, options, on_stage, supposed, boxes.members)

    trial = fit_of(parts.known, parts.known_rows)
    if not any(side.exists.any() for side in trial.misfit.sides):
        raise InputError(f"{name}: no path reaches a receiver in {scene}; trace more interactions")
    if not len(trial.free("+".join(options.parts))):
        raise InputError(f"{name}: no surface is met by {LEAST_PATHS} paths; give more training rows or interactions")
    chosen = {stage: (Moves(trial, stage).best(), trial) for stage in _stages(options)}
    stated = fit_of(parts.held, parts.held_rows).misfit
    unseen = dict.fromkeys(chosen, stated)
    scores = {"": stated.scores(parts.with_mean_gain(stated.vector_of(trial.misfit.of_scene(trial.stated)), stated))}
    judged = {"": parts.units(scores[""])}
    for stage, (state, by) in chosen.items():
        scores[stage] = stated.scores(_vector_at(parts, stated, state, by))
        judged[stage] = parts.units(scores[stage])
        # Other paths make good planes better. They do not mend those that fit training rows alone, and finding them
        # takes as long as all that was done before.
        if _moves(stage) and _last_is_best(judged, task.higher_is_better):
            again = fit_of(parts.known, parts.known_rows, state, by)
            state, by = chosen[stage] = Moves(again, stage).continued(state, by), again
            unseen[stage] = fit_of(parts.held, parts.held_rows, state, by).misfit
            scores[stage] = unseen[stage].scores(_vector_at(parts, unseen[stage], state, by))
            judged[stage] = parts.units(scores[stage])
    kept = last_gain(judged.items(), task.higher_is_better, confidence=CONFIDENCE)
    best = chosen[kept] if kept else None
    final = fit_of(record, split.all_train, *(best or ()))
    state, data, deviation = final.start(""), None, np.zeros(len(final.stated))
    if best:
        state = final.solved(final.carried_over(*best))
        deviation[final.free(kept)], others = final.uncertainty(state)
        before = _vector_at(parts, unseen[kept], *best)
        after = parts.with_mean_gain(state.vector, final.misfit)
        ratio = _error_ratio(unseen[kept], before, final.misfit, after, others)
        data = CorrectionData(name, split.all_train, ratio)
    facts = {
        "rows": len(split.all_train),
        "held_out": len(parts.held_rows),
        "held_out_receivers": list(parts.out),
        "paths": len(final.misfit.paths.row),
    }
    seconds = time.perf_counter() - begun
    return Correction(final, state, deviation, scores, _kinds(scene), data, seconds, facts)


def _stages(options: CorrectionOptions) -> list[str]:
    """Parts that are changed together: materials without planes, and all."""
    stages, still = ["+".join(options.parts)], [part for part in options.parts if part not in (PLANES, FRAME)]
    if MATERIALS in still and len(still) < len(options.parts):
        stages.insert(0, "+".join(still))
    return stages


def _vector_at(parts: _Parts, misfit: Misfit, state: State, by: Fit) -> FloatArray:
    """Vector of a misfit of other rows from a state of a fit, with the mean gain at receivers held out."""
    return parts.with_mean_gain(misfit.vector_of(by.of_scene(state)), misfit)


def _error_ratio(unseen: Misfit, found: FloatArray, final: Misfit, vector: FloatArray, left_out: FloatArray) -> float:
    """Error of reports that a correction does not know over that of the same reports once it does, 1 or more.

    The larger of two ratios of 90 % quantiles: of the rows that were held out of every choice, which are few, and of
    all rows by least squares without each of them, after choices that knew them all.
    """
    count = len(final.record.receivers)
    fitted = np.abs(final.residual(vector))
    rows = fitted.reshape(count, len(final.rows), -1)[:, np.isin(final.rows, unseen.rows)]
    errors = (np.abs(unseen.residual(found)).reshape(rows.shape), rows), (np.abs(left_out), fitted)
    ratios = [1.0]
    for before, after in errors:
        seen = np.isfinite(before) & np.isfinite(after)
        larger, smaller = (float(np.quantile(values[seen], LEVEL)) for values in (before, after))
        ratios.append(larger / max(smaller, float(np.finfo(np.float32).tiny)))
    return max(ratios)


def _moves(stage: str) -> bool:
    """Whether a stage moves planes, so that other paths may exist."""
    return not {PLANES, FRAME}.isdisjoint(stage.split("+"))


class _Parts(NamedTuple):
    """Observations that a correction is fitted to, ``known``, and ``held`` ones that decide what is kept."""

    known: Record
    known_rows: IntArray
    held: Record
    held_rows: IntArray
    out: tuple[str, ...] = ()  # names of the receivers of ``held``; none where rows are held out instead
    fitted: tuple[str, ...] = ()  # names of the receivers of ``known``

    def units(self, score: FloatArray) -> FloatArray:
        """Independent scores: those of rows, or the mean of each receiver that is held out."""
        if not self.out:
            return score
        by_receiver = score.reshape(len(self.held.receivers), -1)
        return np.array([np.nanmean(row) for row in by_receiver if np.isfinite(row).any()])

    def with_mean_gain(self, vector: FloatArray, misfit: Misfit) -> FloatArray:
        """A vector with the mean gain of the receivers that were fitted at those that were not."""
        gains = {receiver.name: gain_name(receiver) for receiver in self.known.receivers}
        if not self.out or not set(gains.values()) <= set(misfit.parts):
            return vector
        found = vector.copy()
        mean = np.mean([vector[misfit.parts[gains[receiver]]] for receiver in self.fitted], axis=0)
        for receiver in self.out:
            found[misfit.parts[gains[receiver]]] = mean
        return found


def _parts(record: Record, split: Split) -> _Parts:
    """Training rows in groups, or where receivers are held out half of the others, as the scene has to serve those."""
    trained = np.flatnonzero(np.isfinite(record.observation).reshape(len(record.receivers), -1).any(axis=1))
    if split.held_receivers and len(trained) > 3:
        out = np.sort(np.random.default_rng([split.seed, 9]).permutation(trained)[: len(trained) // 2])
        others = np.setdiff1d(trained, out)
        names = (tuple(record.receivers[number].name for number in part) for part in (out, others))
        known, held = (record.seen(replace(split, held_receivers=tuple(hide), left=NONE)) for hide in (out, others))
        return _Parts(known, split.all_train, held, split.all_train, *names)
    groups = hold_out_groups(split, record.tx_pos_m)
    if groups is split:
        raise InputError(f"{record.name}: {len(split.train)} training rows are too few to hold some out; give more")
    # The regions alone judge: validation rows lie among those that the correction is fitted to, and add to few.
    rows = np.setdiff1d(groups.validation, split.validation)
    return _Parts(record, np.setdiff1d(split.all_train, rows), record, rows)


def _at_most(split: Split, count: int) -> Split:
    """The split with a random subset of its training and validation rows."""
    rows = np.random.default_rng([split.seed, 7]).permutation(split.all_train)[:count]
    return replace(split, train=np.intersect1d(split.train, rows), validation=np.intersect1d(split.validation, rows))


def _last_is_best(scores: Mapping[str, FloatArray], higher_is_better: bool) -> bool:
    """Whether no stage has a better mean than the last, over what is known of both."""
    *before, last = scores.values()
    return all(improves(last, score, higher_is_better, errors=0.0) for score in before)


def _kinds(scene: str | Path) -> dict[str, Kind]:
    """Kinds of the surfaces of a scene folder by name; none for other scenes."""
    folder = Path(scene)
    if not (folder / MATERIALS_FILE).is_file():
        return {}
    entries = read_scene_folder(folder).materials.surfaces
    return {name: entry for name, entry in entries.items() if entry in KINDS}
