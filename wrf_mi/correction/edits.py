"""Edits of a scene by measurements, fitted along the paths of the stated scene or of an edited one.

Paths are found with the stated scene; choice (`wrf_mi.correction.moves`) and least squares
(`wrf_mi.correction.least_squares`) are done in rounds on training rows, once more with the paths of the scene that they
found where planes have moved.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
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
from ..tasks.conditions import scene_carrier
from ..tasks.scores import LEVEL
from ..tracing import open_scene
from ..tracing.paths.corrected_scene import check_materials, moved_search
from ..tracing.paths.solve import Prepared
from .misfit import Misfit
from .moves import Moves
from .options import DEFAULTS, FRAME, GAIN, HIDDEN, PHASES, PLANES, STRENGTHS, CorrectionOptions, OnStage
from .state import LEAST_PATHS, SceneEdit, ScenePosterior, State
from .uncertain_phases import UncertainPhases


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
        """Parameter groups that were changed, joined by "+"; "" for none."""
        return self.state.stage

    @property
    def vector(self) -> FloatArray:
        """Parameters [p] of `misfit`."""
        return self.state.vector


def default_options(record: Record, n_train: int | float | None = None) -> CorrectionOptions:
    """Options for a record where none are given; all rows are compared if their number ``n_train`` is stated."""
    options = DEFAULTS if record.task.tells_phases else STRENGTHS
    return options if n_train is None else replace(options, rows=max(1, len(record) * len(record.receivers)))


@threadpool_limits.wrap(1, "blas")  # type: ignore[untyped-decorator]
def fit_edit(posterior: ScenePosterior, groups: Collection[str], edit: SceneEdit | None = None) -> State:
    """Some parameter groups of the options fitted to the rows of a posterior, whether they gain or not.

    Given an ``edit`` that was found along other paths, such as those of the stated scene, the search goes on from it.
    """
    search = Moves(posterior, "+".join(group for group in posterior.options.groups if group in groups))
    return search.continued(edit) if edit else search.best()


@threadpool_limits.wrap(1, "blas")  # type: ignore[untyped-decorator]
def refit_edit(
    traced: TracedScene, edit: SceneEdit, scores: Mapping[str, FloatArray], facts: Mapping[str, Any]
) -> Correction:
    """An ``edit`` that was found and judged by some rows, fitted to all training rows along the paths of its scene.

    ``scores`` are those of the rows that judged it, by what was changed, "" for nothing, and ``facts`` what the page
    states of these rows: their number ``held_out``, and names of the receivers that did, ``held_out_receivers``.
    """
    begun, record, rows = time.perf_counter(), traced.record, traced.split.all_train
    final = traced.posterior(record, rows, edit if edit.stage else None)
    state, data, deviation = final.start(""), None, np.zeros(len(final.stated))
    if edit.stage:
        state, deviation, left_out = by_all_rows(edit, final)
        ratio = error_ratio(left_out, final.misfit.residual(state.vector))
        data = CorrectionData(record.name, rows, ratio)
    facts = {"rows": len(rows), **facts, "paths": len(final.misfit.paths.row)}
    return Correction(state, deviation, scores, traced.kinds, data, time.perf_counter() - begun, facts)


def checked(record: Record, split: Split, options: CorrectionOptions | None) -> tuple[Record, Split, CorrectionOptions]:
    """The rows and receivers that may be used, and options that suit the task; an `InputError` where there are none."""
    record = record.seen(split)
    lacking = [receiver.name for receiver in record.receivers if not np.isfinite(receiver.position_m).all()]
    if lacking and record.task.shares_law:
        text = f"position of receiver {listed(lacking)} unknown; give x, y, z"
        raise InputError(f"{record.source or record.name}: {text}, or wrf-mi train --scene, which estimates them")
    numbers, left_out = fitted_receivers(record, [split])
    warn_of_left_out(record, left_out)
    record, split = record.at_receivers(numbers), split.at_receivers(numbers)
    task = record.task
    if not task.receiver_with_scene:
        raise InputError(f"{record.name}: no receiver model observes {task.name} from paths")
    check_observations(record, split, complete=task.complete)
    options = options or default_options(record)
    if task.has_offsets and GAIN not in options.groups:
        options = replace(options, groups=(*options.groups, GAIN))
    # An image of each receiver and row has some hundred values: as many images as one receiver's rows tell as much.
    most = max(1, options.rows // (len(record.receivers) if task.image_size(record.observation.shape) else 1))
    # Seeds of other purposes differ by their second number, so that subsets are independent.
    rows = np.random.default_rng([split.seed, 7]).permutation(split.all_train)[:most]
    split = replace(split, train=np.intersect1d(split.train, rows), validation=np.intersect1d(split.validation, rows))
    return record, split, options


class TracedScene:
    """The stated scene with the faces that a scan may have missed, and posteriors of rows over the paths in it.

    Arguments and errors are those of `wrf_mi.stages.correct.correct_scene`.

    Attributes:
        record: observations that may be used, of the receivers with enough training rows.
        split: split of that record, with at most the rows of the options.
        options: options that suit the task and the scene.
        kinds: kinds of the scene's objects.
    """

    def __init__(
        self,
        scene: str | Path,
        record: Record,
        split: Split,
        options: CorrectionOptions | None,
        material: str | None,
        on_stage: OnStage,
    ) -> None:
        record, split, options = checked(record, split, options)
        self.record, self.split = record, split
        self._scene, self._on_stage, folder = scene, on_stage, Path(scene)
        # A scene folder states kinds; other scenes state none.
        entries = read_scene_folder(folder).materials.surfaces if (folder / MATERIALS_FILE).is_file() else {}
        self.kinds: dict[str, Kind] = {name: entry for name, entry in entries.items() if entry in KINDS}
        carrier_hz = scene_carrier(record, split.all_train)
        completed = with_hidden_faces(scene) if HIDDEN in options.groups else nullcontext((scene, Boxes([], [])))
        with completed as (place, boxes):
            opened, self._copy = (open_scene(place, carrier_hz, material=material) for _ in range(2))
        self._boxes, self._hidden = boxes, frozenset(face.name for face in boxes.hidden)
        groups = tuple(group for group in options.groups if group != HIDDEN or self._hidden)
        self.options = replace(options, groups=groups)
        check_materials(opened)
        self._prepared = Prepared(opened)
        self._prepared.check(record.tx_pos_m, record.receivers)
        # Surfaces of hidden faces have parameters before any path is known to meet them.
        named = [name.rpartition("/")[::2] for name in self._prepared.tables("surface").slabs.names]
        slabs = np.array([slab for slab, (thing, _) in enumerate(named) if thing in self._hidden], np.int64)
        planes = np.array([int(named[slab][1]) for slab in slabs], np.int64)
        self._hidden_surfaces = planes, slabs

    def posterior(self, record: Record, rows: IntArray, edit: SceneEdit | None = None) -> ScenePosterior:
        """Posterior of rows over the paths of the stated scene, or of one whose planes an edit has moved."""
        self._on_stage("tracing", 0.0)
        searched, surfaces = None, self._hidden_surfaces
        if edit:
            # What is known of surfaces stays known where no path meets them any more, such as absent ones.
            surfaces = edit.planes, edit.slabs
            if moves_planes(edit.stage):
                parameters = {name: values.astype(np.float32) for name, values in edit.parameters.items()}
                searched = moved_search(self._copy, self._prepared.surfaces, parameters, edit.absent.tolist())
        misfit = Misfit(record, rows, self._prepared, self.options, searched, surfaces)
        return ScenePosterior(misfit, self.options, self._on_stage, self._hidden, self._boxes.members)

    def fitted_posterior(self, record: Record, rows: IntArray, edit: SceneEdit | None = None) -> ScenePosterior:
        """The `posterior` of rows that are fitted to (InputError: no path reaches them, or none tells of a surface)."""
        posterior = self.posterior(record, rows, edit)
        if not any(field.exists.any() for field in posterior.misfit.traced_fields):
            raise InputError(f"{record.name}: no path reaches a receiver in {self._scene}; trace more interactions")
        if not len(posterior.free("+".join(posterior.options.groups))):
            text = f"no surface is met by {LEAST_PATHS} paths; give more training rows or interactions"
            raise InputError(f"{record.name}: {text}")
        return posterior


def by_all_rows(best: SceneEdit, final: ScenePosterior) -> tuple[State, FloatArray, FloatArray]:
    """A state fitted to all rows, standard deviations [p], and residuals of each row by a fit to the others."""
    if PHASES in best.stage.split("+"):
        fit = UncertainPhases(final)
        state = fit.refined(best.at(final))
        # Residuals of unknown phases are those of all channels: a row that is left out changes them little.
        return state, fit.deviation(state), final.misfit.residual(state.vector)
    state, deviation = best.at(final).solved(), np.zeros(len(final.stated))
    deviation[state.free], left_out = state.uncertainty()
    return state, deviation, left_out


def moves_planes(stage: str) -> bool:
    """Whether a stage moves planes, so that other paths may exist."""
    return not {PLANES, FRAME}.isdisjoint(stage.split("+"))


def error_ratio(without: FloatArray, with_rows: FloatArray) -> float:
    """Ratio of held-out to training error of a correction, 1 or more.

    Quantiles of errors of the same shape, of fits without and with these rows, NaN for no observation.
    """
    observed = np.isfinite(without) & np.isfinite(with_rows)
    larger, smaller = (float(np.quantile(np.abs(values[observed]), LEVEL)) for values in (without, with_rows))
    return max(1.0, larger / max(smaller, float(np.finfo(np.float32).tiny)))
