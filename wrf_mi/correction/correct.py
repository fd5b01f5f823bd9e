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
from scipy.stats import rankdata
from threadpoolctl import threadpool_limits

from ..core import InputError, Record, Split
from ..core.files import listed
from ..core.types import FloatArray, IntArray
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
from .misfit import Misfit
from .moves import Moves
from .options import DEFAULTS, FRAME, GAIN, HIDDEN, MATERIALS, PHASES, PLANES, STRENGTHS, CorrectionOptions, OnStage
from .state import LEAST_PATHS, ScenePosterior, State
from .uncertain_phases import UncertainPhases

LEVEL = 0.9  # level of the intervals for which errors of rows that a scene knows are enlarged
NO_ROWS = np.zeros((0, 2), np.int64)  # no rows retained by receivers that are held out (`wrf_mi.core.Split`)
CONFIDENCE = 0.95  # one-sided, in the gain of a stage: fits with more freedom also fit what no surface explains
LEAST_RECEIVERS = 4  # fewest trained receivers of which half decide what is kept, where a split holds receivers out


@dataclass
class Correction:
    """A corrected scene.

    Attributes:
        state: parameters and choices over all training rows; its stage is what was changed, "" for nothing.
        deviation: standard deviations of the parameters [p], 0 of those that were not changed.
        scores: scores of the rows held out while choosing, by stage.
        kinds: kinds of the scene's objects.
        data: rows that were used, and how much smaller their errors are for it; None where nothing was changed.
        seconds: duration.
        facts: sizes for the page.
    """

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
        return self.state.posterior.misfit

    @property
    def kept(self) -> str:
        """Parts that were changed, joined by "+"; "" for none."""
        return self.state.stage

    @property
    def vector(self) -> FloatArray:
        """Parameters [p] of `misfit`."""
        return self.state.vector


def default_options(record: Record, n_train: int | float | None = None) -> CorrectionOptions:
    """Options for a record where none are given; all rows are compared if their number ``n_train`` is stated."""
    options = STRENGTHS if task_of(record).in_decibel else DEFAULTS
    return options if n_train is None else replace(options, rows=max(1, len(record) * len(record.receivers)))


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
    record, split, options = _checked(record, split, options)
    traced = _TracedScene(scene, record, split, options, material, on_stage)
    held_out = _held_out(record, split)
    # Stages are fitted to some of the rows, and judged by the others.
    trial = traced.posterior(held_out.known, held_out.known_rows)
    if not any(side.exists.any() for side in trial.misfit.sides):
        raise InputError(f"{record.name}: no path reaches a receiver in {scene}; trace more interactions")
    if not len(trial.free("+".join(trial.options.parts))):
        text = f"no surface is met by {LEAST_PATHS} paths; give more training rows or interactions"
        raise InputError(f"{record.name}: {text}")
    judged = _judged_stages(trial, traced, held_out)
    units = ((stage, held_out.units(result.score)) for stage, result in judged.items())
    best_stage = last_gain(units, held_out.higher_is_better, confidence=CONFIDENCE)
    if not _moves(best_stage):
        best_stage = _by_uncertain_phases(trial, traced, held_out, judged, best_stage)
    # What is kept is fitted to all rows, along the paths of the scene that the trial found.
    best = judged[best_stage].state if best_stage else None
    final = traced.posterior(record, split.all_train, best)
    state, data, deviation = final.start(""), None, np.zeros(len(final.stated))
    if best:
        state, deviation, left_out = _by_all_rows(best, final)
        unseen = judged[best_stage].unseen
        before, after = held_out.vector_of(best, unseen), held_out.with_mean_gain(state.vector, final.misfit)
        data = CorrectionData(record.name, split.all_train, _error_ratio(unseen, before, final.misfit, after, left_out))
    facts: dict[str, Any] = {"rows": len(split.all_train), "held_out": len(held_out.rows)}
    facts |= {"held_out_receivers": list(held_out.out), "paths": len(final.misfit.paths.row)}
    scores = {stage: result.score for stage, result in judged.items()}
    return Correction(state, deviation, scores, _kinds(Path(scene)), data, time.perf_counter() - begun, facts)


def _kinds(folder: Path) -> dict[str, Kind]:
    """Kinds of the surfaces of a scene folder; other scenes state none."""
    entries = read_scene_folder(folder).materials.surfaces if (folder / MATERIALS_FILE).is_file() else {}
    return {name: entry for name, entry in entries.items() if entry in KINDS}


def _checked(
    record: Record, split: Split, options: CorrectionOptions | None
) -> tuple[Record, Split, CorrectionOptions]:
    """The rows and receivers that may be used, and options that suit the task; an `InputError` where there are none."""
    record = record.seen(split)
    lacking = [receiver.name for receiver in record.receivers if not np.isfinite(receiver.position_m).all()]
    if lacking and task_of(record).in_decibel:
        text = f"position of receiver {listed(lacking)} unknown; give x, y, z"
        raise InputError(f"{record.source or record.name}: {text}, or wrf-mi train --scene, which estimates them")
    numbers, left_out = fitted_receivers(record, [split])
    warn_of_left_out(record, left_out)
    record, split = record.at_receivers(numbers), split.at_receivers(numbers)
    task = task_of(record)
    if not task.receiver_with_scene:
        raise InputError(f"{record.name}: no receiver model reports {task.name} from paths")
    check_observations(record, split, complete=task.image)
    options = options or default_options(record)
    if task.in_decibel and GAIN not in options.parts:
        options = replace(options, parts=(*options.parts, GAIN))
    # An image of each receiver and row has some hundred values: as many images as one receiver's rows tell as much.
    most = max(1, options.rows // (len(record.receivers) if task.image else 1))
    # Seeds of other purposes differ by their second number, so that subsets are independent.
    rows = np.random.default_rng([split.seed, 7]).permutation(split.all_train)[:most]
    split = replace(split, train=np.intersect1d(split.train, rows), validation=np.intersect1d(split.validation, rows))
    return record, split, options


class _TracedScene:
    """The stated scene with the faces that a scan may have missed, and posteriors of rows over the paths in it."""

    def __init__(
        self,
        scene: str | Path,
        record: Record,
        split: Split,
        options: CorrectionOptions,
        material: str | None,
        on_stage: OnStage,
    ) -> None:
        carrier_hz, self._on_stage = scene_carrier(record, split.all_train), on_stage
        completed = with_hidden_faces(scene) if HIDDEN in options.parts else nullcontext((scene, Boxes([], [])))
        with completed as (place, boxes):
            opened, self._copy = (open_scene(place, carrier_hz, material=material) for _ in range(2))
        self._boxes, self._hidden = boxes, frozenset(face.name for face in boxes.hidden)
        parts = tuple(part for part in options.parts if part != HIDDEN or self._hidden)
        self.options = replace(options, parts=parts)
        check_materials(opened)
        self._prepared = Prepared(opened)
        self._prepared.check(record.tx_pos_m, record.receivers)
        # Surfaces of hidden faces have parameters before any path is known to meet them.
        named = [name.rpartition("/")[::2] for name in self._prepared.tables("surface").slabs.names]
        slabs = np.array([slab for slab, (thing, _) in enumerate(named) if thing in self._hidden], np.int64)
        planes = np.array([int(named[slab][1]) for slab in slabs], np.int64)
        self._hidden_surfaces = planes, slabs

    def posterior(self, record: Record, rows: IntArray, state: State | None = None) -> ScenePosterior:
        """Posterior of rows over the paths of the stated scene, or of one whose planes a state has moved."""
        self._on_stage("tracing", 0.0)
        searched, surfaces = None, self._hidden_surfaces
        if state:
            # What is known of surfaces stays known where no path meets them any more, such as absent ones.
            surfaces = state.posterior.misfit.planes, state.posterior.misfit.slabs
            if _moves(state.stage):
                parameters = {name: values.astype(np.float32) for name, values in state.scene_parameters().items()}
                searched = moved_search(self._copy, self._prepared.surfaces, parameters, state.absent())
        misfit = Misfit(record, rows, self._prepared, self.options, searched, surfaces)
        return ScenePosterior(misfit, self.options, self._on_stage, self._hidden, self._boxes.members)


class _Judged(NamedTuple):
    """A state of a stage, the misfit of rows held out of it, and their scores."""

    state: State
    unseen: Misfit
    score: FloatArray


def _judged_stages(trial: ScenePosterior, traced: _TracedScene, held_out: _HeldOut) -> dict[str, _Judged]:
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
        if _moves(stage) and _last_is_best(units, held_out.higher_is_better):
            along_moved = traced.posterior(held_out.known, held_out.known_rows, state)
            state = Moves(along_moved, stage).continued(state)
            judged[stage] = held_out.judged(state, traced.posterior(held_out.record, held_out.rows, state).misfit)
    return judged


def _by_uncertain_phases(
    trial: ScenePosterior, traced: _TracedScene, held_out: _HeldOut, judged: dict[str, _Judged], kept: str
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


def _by_all_rows(best: State, final: ScenePosterior) -> tuple[State, FloatArray, FloatArray]:
    """A state fitted to all rows, standard deviations [p], and residuals of each row by a fit to the others."""
    if PHASES in best.stage.split("+"):
        fit = UncertainPhases(final)
        state = fit.refined(best.at(final))
        # Residuals of unknown phases are those of all channels: a row that is left out changes them little.
        return state, fit.deviation(state), final.misfit.residual(state.vector)
    state, deviation = best.at(final).solved(), np.zeros(len(final.stated))
    deviation[state.free], left_out = state.uncertainty()
    return state, deviation, left_out


def _moves(stage: str) -> bool:
    """Whether a stage moves planes, so that other paths may exist."""
    return not {PLANES, FRAME}.isdisjoint(stage.split("+"))


def _error_ratio(unseen: Misfit, before: FloatArray, final: Misfit, vector: FloatArray, left_out: FloatArray) -> float:
    """Error of reports that a correction does not know over that of the same reports once it does, 1 or more."""
    # The larger of two ratios of quantiles: of the rows that were held out of every choice, which are few, and of all
    # rows by least squares without each of them, after choices that knew them all.
    count = len(final.record.receivers)
    fitted = np.abs(final.residual(vector))
    rows = fitted.reshape(count, len(final.rows), -1)[:, np.isin(final.rows, unseen.rows)]
    errors = (np.abs(unseen.residual(before)).reshape(rows.shape), rows), (np.abs(left_out), fitted)
    ratios = [1.0]
    for without, with_rows in errors:
        observed = np.isfinite(without) & np.isfinite(with_rows)
        larger, smaller = (float(np.quantile(values[observed], LEVEL)) for values in (without, with_rows))
        ratios.append(larger / max(smaller, float(np.finfo(np.float32).tiny)))
    return max(ratios)


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
