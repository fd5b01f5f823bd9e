"""Correction of a scene by measurements.

Paths are found once with the stated scene. Then, each on the training rows alone:

1. *choice*: every surface tries common materials, every plane shifts (`wrf_mi.correction.search`);
2. *least squares*: materials, planes and antennas, with priors (`wrf_mi.correction.least_squares`).

Both are done in rounds, first without a quarter of the training rows, held out in clusters. On these rows the stated
scene, changed materials alone, and materials with planes are compared; the best is kept and fitted again to all
training rows. A scene that measurements cannot improve is returned as it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.carriers import carriers_text
from ..core.settings import Positive
from ..core.types import IntArray
from ..datasets.observations import check_observations
from ..scene.folder import read_scene_folder
from ..scene.materials import FILE as MATERIALS_FILE
from ..scene.surfaces import KINDS, Kind
from ..tasks import instrument_of, task_of
from ..tracing import open_scene
from ..tracing.corrected_scene import check_materials
from ..tracing.material_parameters import PREFIX
from ..tracing.options import MAX_DEPTH, MAX_RAYS
from ..tracing.plane_parameters import SHIFT, TILT
from ..tracing.solve import Prepared
from ..tracing.traced_field import TX_PATTERN
from ..training.reach import hold_out_groups
from .frame import FRAME, rigid_motions
from .least_squares import Prior, Solution, solve
from .misfit import Misfit, search_options
from .search import Choice, choose, joint_choices, material_choices, shift_choices

MATERIALS, PLANES = "materials", "planes"
PARTS = (MATERIALS, PLANES, FRAME, "gain", "pose", "patterns")
"""What a correction may change."""
LEAST_PATHS = 10
"""Fewest paths of a surface or plane that is changed."""
ROUNDS = 4
"""Largest number of rounds: planes that are off hide the right material, and conversely."""
REFINING_STEPS = 3
"""Largest number of least-squares steps of one plane while shifts are compared."""
FLAT = 10.0
"""Standard deviation of the logarithm of a gain, and of its phase in rad: no prior knowledge."""

OnStage = Callable[[str, float], None]
"""``on_stage(what, share)``: what is done, and the share of it that is done, 0 to 1."""


@dataclass(frozen=True)
class CorrectionOptions:
    """Options of a correction.

    Attributes:
        parts: what is changed: any of `PARTS`.
        depth: largest number of interactions of a path, transmissions included.
        rays: number of rays that search from each receiver.
        faint: the weakest paths of a transmitter are dropped while their amplitudes add up to less than this share.
        steps: largest number of least-squares steps.
        pattern_degree: degree of the antennas' patterns, where they are changed.
        shift_sd_m: standard deviation of a plane's position before the correction, metres.
        tilt_sd_rad: that of its tilts, rad.
        frame_sd_m: that of the common displacement of all planes against the devices, metres.
        frame_sd_rad: that of their common rotation, rad.
        material_sd: that of the logarithm of a material's permittivity - 1; its conductivity has twice, its thickness
            half of it.
        pose_sd_m: that of a receiver's position, metres.
        pose_sd_rad: that of its orientation, rad.
        pattern_sd: that of a pattern's coefficient.
    """

    parts: tuple[str, ...] = (MATERIALS, PLANES, FRAME)
    depth: Annotated[int, Field(ge=1, le=MAX_DEPTH, description=f"1 to {MAX_DEPTH}")] = 3
    rays: Annotated[int, Field(ge=1, le=MAX_RAYS, description=f"1 to {MAX_RAYS}")] = 1 << 16
    faint: float = 1e-3
    steps: int = 8
    pattern_degree: int = 2
    shift_sd_m: Positive = 0.02
    tilt_sd_rad: Positive = 0.005
    frame_sd_m: Positive = 0.05
    frame_sd_rad: Positive = 0.02
    material_sd: Positive = 0.7
    pose_sd_m: Positive = 0.02
    pose_sd_rad: Positive = 0.02
    pattern_sd: Positive = 0.1

    def __post_init__(self) -> None:
        """Check the parts.

        Raises:
            InputError: no part or an unknown one.
        """
        if unknown := [part for part in self.parts if part not in PARTS]:
            raise InputError(f"correct: {unknown[0]!r} is not a part; choose of {', '.join(PARTS)}")
        if not self.parts:
            raise InputError(f"correct: nothing to change; choose of {', '.join(PARTS)}")

    def changes(self, name: str) -> bool:
        """Whether a parameter of `wrf_mi.tracing.traced_field.TracedField` is changed."""
        if name.startswith(PREFIX):
            return MATERIALS in self.parts
        if name in (SHIFT, TILT):
            return PLANES in self.parts or FRAME in self.parts
        last = name.rpartition(".")[2]
        kinds = {"gain": "gain", "position": "pose", "turn": "pose", "pattern": "patterns"}
        return (name == TX_PATTERN and "patterns" in self.parts) or kinds.get(last) in self.parts

    def deviation(self, name: str) -> float:
        """Standard deviation of the entries of a parameter before the correction; of planes without the frame's."""
        scale = {"permittivity": 1.0, "conductivity": 2.0, "thickness": 0.5}
        last = name.rpartition(".")[2]
        if name.startswith(PREFIX):
            return self.material_sd * scale[last]
        tight = PLANES not in self.parts
        found = {
            SHIFT: self.shift_sd_m * (0.01 if tight else 1),
            TILT: self.tilt_sd_rad * (0.01 if tight else 1),
            "gain": FLAT,
            "position": self.pose_sd_m,
            "turn": self.pose_sd_rad,
        }
        return found.get(name, found.get(last, self.pattern_sd))


@dataclass
class Correction:
    """A corrected scene.

    Attributes:
        scene: the stated scene (``sionna.rt.Scene``).
        misfit: residuals over all training rows.
        kept: what was kept: ``""`` (nothing), or the changed parts.
        vector: parameters [p] of `Misfit`.
        deviation: their standard deviations [p], 0 of those that were held.
        prior: standard deviations before the correction [p].
        free: indices of the changed entries.
        materials: material that each changed surface took first, by its name.
        scores: scores of the rows held out while choosing, by stage.
        kinds: kinds of the scene's objects.
        options: options.
        seconds: duration.
        facts: sizes for the page.
    """

    scene: Any
    misfit: Misfit
    kept: str
    vector: FloatArray
    deviation: FloatArray
    prior: FloatArray
    free: IntArray
    materials: Mapping[str, str]
    scores: Mapping[str, FloatArray]
    kinds: Mapping[str, Kind]
    options: CorrectionOptions
    seconds: float = 0.0
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Parameters by the names of `wrf_mi.tracing.traced_field.TracedField.parameters`."""
        return self.misfit.named(self.vector)


def correct_scene(
    scene: str | Path,
    record: Record,
    split: Split,
    options: CorrectionOptions = CorrectionOptions(),
    material: str | None = None,
    on_stage: OnStage = lambda what, share: None,
) -> Correction:
    """Correct a scene by the training rows of a split.

    Args:
        scene: see `wrf_mi.tracing.open_scene`.
        record: measurements of any task, positions known.
        split: its training and validation rows are used, its test rows are not.
        options: what is changed, and what is known before.
        material: radio material of a bare mesh.
        on_stage: called as the correction goes on.

    Raises:
        InputError: data or a scene that cannot be used, or no path to any receiver.
    """
    begun = time.perf_counter()
    task, name = task_of(record), record.name
    if not task.receiver_with_scene:
        raise InputError(f"{name}: no receiver model reports {task.name} from paths")
    if record.carriers_hz is not None:
        raise InputError(f"{name}: {carriers_text(record.carriers_hz)}; correct a scene at one carrier")
    check_observations(record, split, complete=task.image)
    if task.in_decibel and "gain" not in options.parts:
        options = replace(options, parts=(*options.parts, "gain"))
    opened = open_scene(scene, instrument_of(record).carrier_hz, material=material)
    check_materials(opened)
    prepared = Prepared(opened)
    prepared.check(record.tx_pos_m, record.receivers)
    groups = hold_out_groups(split, record.tx_pos_m)
    if groups is split:
        raise InputError(f"{name}: {len(split.train)} training rows are too few to hold some out; give more")
    held = np.setdiff1d(groups.validation, split.validation)
    known = np.setdiff1d(split.all_train, held)

    def misfit(rows: IntArray, what: str) -> Misfit:
        on_stage(what, 0.0)
        search = search_options(options.depth, options.rays, options.faint, options.pattern_degree)
        if "patterns" not in options.parts:
            search = replace(search, pattern_degree=0)
        return Misfit(record, rows, opened, search, options.changes, prepared)

    first = misfit(known, "tracing")
    if not any(side.exists.any() for side in first.sides):
        raise InputError(f"{name}: no path reaches a receiver in {scene}; trace more interactions")
    others = misfit(held, "tracing")
    trial = _Fit(first, options, on_stage)
    chosen = trial.all_parts()
    sign = 1 if task.higher_is_better else -1
    stages = {"": trial.stated, **{key: found.vector for key, found in chosen.items()}}
    scores = {key: others.scores(vector) for key, vector in stages.items()}
    kept = max(scores, key=lambda key: sign * float(np.nanmean(scores[key])))
    whole = misfit(split.all_train, "tracing")
    final = _Fit(whole, options, on_stage)
    vector, deviation = final.stated, np.zeros(len(final.stated))
    if kept:
        solution = final.refit(kept, chosen[kept].vector, trial.means[kept])
        vector = solution.vector
        deviation[final.free(kept)] = np.sqrt(np.diag(solution.covariance))
    kinds = _kinds(scene)
    return Correction(
        opened,
        whole,
        kept,
        vector,
        deviation,
        final.prior_deviation,
        final.free(kept) if kept else np.zeros(0, np.int64),
        {what: material for (stage, what), material in trial.taken.items() if stage == kept},
        scores,
        kinds,
        options,
        time.perf_counter() - begun,
        {"rows": len(split.all_train), "held_out": len(held), "paths": sum(int(s.exists.sum()) for s in whole.sides)},
    )


def _kinds(scene: str | Path) -> dict[str, Kind]:
    """Kinds of the surfaces of a scene folder by name; none for other scenes."""
    folder = Path(scene)
    if not (folder / MATERIALS_FILE).is_file():
        return {}
    entries = read_scene_folder(folder).materials.surfaces
    return {name: entry for name, entry in entries.items() if entry in KINDS}  # type: ignore[misc]


class _Fit:
    """Choice and least squares over the rows of one misfit."""

    def __init__(self, misfit: Misfit, options: CorrectionOptions, on_stage: OnStage) -> None:
        self.misfit, self.options, self.on_stage = misfit, options, on_stage
        self.stated = misfit.start.copy()
        self.taken: dict[tuple[str, str], str] = {}
        self.means: dict[str, FloatArray] = {}
        self.frequency_hz = misfit.sides[0].frequency_hz
        planes, slabs = misfit.counts()
        self.planes, self.slabs = (np.flatnonzero(count >= LEAST_PATHS) for count in (planes, slabs))
        self.slabs = self.slabs[np.argsort(-slabs[self.slabs], kind="stable")]
        self.planes = self.planes[np.argsort(-planes[self.planes], kind="stable")]
        self.prior_deviation = np.ones(len(self.stated))
        for name, part in misfit.parts.items():
            self.prior_deviation[part] = options.deviation(name)
        for r, side in enumerate(misfit.sides):
            if side.gain_name in misfit.parts:
                self._match_gain(r)

    def _match_gain(self, r: int) -> None:
        """The stated gain matches mean magnitudes, as least squares of a phase need."""
        misfit = self.misfit
        whole = misfit.residual(self.stated) + misfit.observed
        count = len(misfit.rows)
        report, seen = (values[r * count : (r + 1) * count] for values in (whole, misfit.observed))
        known = np.isfinite(seen).all(axis=1)
        shape = misfit.models[r].shape
        if known.any():
            pair = (values[known].reshape(-1, *shape) for values in (report, seen))
            self.stated[misfit.parts[misfit.sides[r].gain_name].start] += misfit.models[r].missing_gain(*pair)

    def free(self, kept: str) -> IntArray:
        """Entries of the vector that a stage changes: those of surfaces and planes that enough paths meet."""
        parts = kept.split("+")
        free = []
        for name, part in self.misfit.parts.items():
            entries = np.arange(part.start, part.stop)
            if name.startswith(PREFIX):
                free.append(entries[self.slabs] if MATERIALS in parts else entries[:0])
            elif name in (SHIFT, TILT):
                size = len(entries) // len(self.misfit.sides[0].surfaces.normal)
                moved = entries.reshape(-1, size)[self.planes].ravel()
                free.append(moved if PLANES in parts or FRAME in parts else entries[:0])
            else:
                free.append(entries)
        return np.sort(np.concatenate(free))

    def prior(self, mean: FloatArray, free: IntArray) -> Prior:
        """Prior of some entries about ``mean`` [p]; planes share the motions of the frame."""
        covariance = np.diag(np.square(self.prior_deviation))
        if FRAME in self.options.parts and SHIFT in self.misfit.parts:
            motions = rigid_motions(self.misfit.sides[0].surfaces)
            deviation = np.repeat([self.options.frame_sd_m, self.options.frame_sd_rad], 3)
            places = np.concatenate(
                [np.arange(p.start, p.stop) for p in map(self.misfit.parts.get, (SHIFT, TILT)) if p]
            )
            covariance[np.ix_(places, places)] += (motions * deviation**2) @ motions.T
        return Prior(mean[free], np.linalg.inv(covariance[np.ix_(free, free)]))

    def all_parts(self) -> dict[str, Solution]:
        """Solutions by the names of their parts: with materials alone, and with planes."""
        parts, frame = self.options.parts, [part for part in (PLANES, FRAME) if part in self.options.parts]
        stages = ["+".join(parts)]
        if MATERIALS in parts and frame:
            stages.insert(0, "+".join(part for part in parts if part not in frame))
        return {stage: self._alternate(stage) for stage in stages}

    def _alternate(self, stage: str) -> Solution:
        """Rounds of choices and least squares, until a round changes no choice."""
        vector, mean, parts = self.stated, self.stated.copy(), stage.split("+")
        options, misfit = self.options, self.misfit
        shifts, materials = list[Choice](), list[Choice]()
        if PLANES in parts or FRAME in parts:
            alone, common = PLANES in parts, FRAME in parts
            sd_m = float(np.hypot(options.shift_sd_m * alone, options.frame_sd_m * common))
            sd_rad = float(np.hypot(options.tilt_sd_rad * alone, options.frame_sd_rad * common))
            shifts = shift_choices(misfit, self.planes, sd_m, sd_rad, self.frequency_hz)
        if MATERIALS in parts:
            materials = material_choices(misfit, self.slabs, self.frequency_hz)
        choices = joint_choices(materials, shifts, misfit.plane_of_slab)
        for round_ in range(ROUNDS):
            what = f"{stage.replace('+', ', ')}: choices, round {round_ + 1}"
            vector, taken = choose(misfit, vector, choices, self._refined, self._progress(what))
            if round_ and not taken:
                break
            for choice in choices:
                # Least squares stay near the materials that were chosen, and near the planes as stated.
                chosen = choice.places[np.isinf(choice.deviation)]
                if choice.what in taken and len(chosen):
                    mean[chosen] = vector[chosen]
                    self.taken[stage, choice.what] = taken[choice.what].partition(",")[0]
            found = self._solve(stage, vector, mean)
            vector = found.vector
        self.means[stage] = mean
        return found

    def _refined(self, start: FloatArray, places: IntArray) -> FloatArray:
        """Some least-squares steps of the entries of one choice; materials stay near those of ``start``."""
        misfit, vector, mean = self.misfit, start.copy(), start.copy()
        for name in (SHIFT, TILT):
            mean[misfit.parts[name]] = self.stated[misfit.parts[name]]

        def whole(part: FloatArray) -> FloatArray:
            vector[places] = part
            return vector

        prior, nothing = self.prior(mean, places), lambda place: None
        found = solve(
            lambda part: misfit.residual(whole(part)),
            lambda part: misfit.jacobian(whole(part), places, nothing),
            start[places],
            prior,
            REFINING_STEPS,
        )
        return whole(found.vector)

    def _progress(self, what: str) -> Callable[[int, int], None]:
        return lambda done, of: self.on_stage(what, done / max(of, 1))

    def _solve(self, stage: str, start: FloatArray, mean: FloatArray) -> Solution:
        """Least squares of a stage's entries; the whole vector."""
        free, misfit = self.free(stage), self.misfit
        prior = self.prior(mean, free)
        what = f"least squares of {len(free)} parameters"
        steps = self.options.steps

        def whole(part: FloatArray) -> FloatArray:
            vector = start.copy()
            vector[free] = part
            return vector

        done = 0

        def jacobian(part: FloatArray) -> NDArray[np.float32]:
            def column(place: int) -> None:
                self.on_stage(what, min((done + place / max(len(free), 1)) / (steps + 1), 1.0))

            return misfit.jacobian(whole(part), free, column)

        def on_step(step: int, cost: float) -> None:
            nonlocal done
            done = step

        found = solve(lambda part: misfit.residual(whole(part)), jacobian, start[free], prior, steps, on_step)
        return replace(found, vector=whole(found.vector))

    def refit(self, stage: str, start: FloatArray, mean: FloatArray) -> Solution:
        """Least squares of a stage over these rows, from a solution over some of them."""
        return self._solve(stage, start, mean)
