"""Rounds of choices and least squares over the rows of one misfit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.material_parameters import EXPONENT, PREFIX
from ..tracing.plane_parameters import SHIFT, TILT
from .bodies import Bodies
from .doubts import Doubts
from .frame import rigid_motions, scene_entries
from .least_squares import Noise, Prior, Solution, left_out_residuals, minimised, solve
from .misfit import Misfit
from .options import FRAME, MATERIALS, PLANES, CorrectionOptions, OnStage
from .path_sum import PathSum, near
from .search import (
    ABSENT,
    ABSENT_VALUES,
    Choice,
    choose,
    joint_choices,
    material_choices,
    material_places,
    shift_choices,
)

LEAST_PATHS = 10
"""Fewest paths of a surface or plane that is changed."""
ROUNDS = 3
"""Largest number of rounds: planes that are off hide the right material, and conversely."""
ROUND_STEPS = 3
"""Largest number of least-squares steps between choices."""
STILL_ABSENT = 0.1
"""Susceptibility up to which a surface that was chosen to be absent is, after least squares."""
REFINING_STEPS = 3
"""Largest number of least-squares steps of one plane while shifts are compared."""


@dataclass(frozen=True)
class Known:
    """Choices of a stage.

    Attributes:
        stage: the stage.
        mean: means of the parameters' prior [p].
        materials: material of each surface that was chosen, by its name.
    """

    stage: str
    mean: FloatArray
    materials: Mapping[str, str]

    def with_material(self, choice: Choice, material: str, vector: FloatArray) -> Known:
        """With the material of a choice, whose constants a vector [p] has; least squares stay near them."""
        mean = self.mean.copy()
        mean[choice.material] = vector[choice.material]
        return Known(self.stage, mean, {**self.materials, choice.what: material})


class Found(NamedTuple):
    """Least squares and the choices before."""

    solution: Solution
    known: Known

    @property
    def vector(self) -> FloatArray:
        """Parameters [p]."""
        return self.solution.vector


def _title(stage: str) -> str:
    return f"{stage.replace('+', ', ')}: choices"


class Fit:
    """Choice and least squares over the rows of one misfit."""

    def __init__(
        self,
        misfit: Misfit,
        options: CorrectionOptions,
        on_stage: OnStage,
        supposed: frozenset[str] = frozenset(),
        bodies: Sequence[frozenset[str]] = (),
    ) -> None:
        self.misfit, self.options, self.on_stage = misfit, options, on_stage
        names = misfit.sides[0].slabs.names
        own = [[slab for slab, name in enumerate(names) if name.partition("/")[0] in body] for body in bodies]
        self.bodies = [np.array(slabs) for slabs in own if len(slabs) > 1]
        self.supposed = {name: slab for slab, name in enumerate(names) if name.partition("/")[0] in supposed}
        self.stated = misfit.start.copy()
        self.frequency_hz = float(misfit.sides[0].scene.frequency[0])
        planes, slabs = misfit.counts()
        # Entries by their places in `Misfit.planes` and `Misfit.slabs`.
        self.planes, self.slabs = (np.flatnonzero(count >= LEAST_PATHS) for count in (planes, slabs))
        self.slabs = self.slabs[np.argsort(-slabs[self.slabs], kind="stable")]
        self.planes = self.planes[np.argsort(-planes[self.planes], kind="stable")]
        self.prior_deviation = np.ones(len(self.stated))
        for name, part in misfit.parts.items():
            self.prior_deviation[part] = options.deviation(name)
        for slab in self.supposed.values():
            self.stated[material_places(misfit, slab)] = ABSENT_VALUES
        self._match_gains()

    def _match_gains(self) -> None:
        """Stated gains match mean magnitudes over a receiver's carriers, as least squares of a phase need."""
        misfit, missing = self.misfit, dict[str, list[float]]()
        if not any(side.gain_name in misfit.parts for side in misfit.sides):
            return
        whole = misfit.residual(self.stated) + misfit.observed
        for side, model, places in zip(misfit.sides, misfit.models, misfit.places, strict=True):
            known = places[np.isfinite(misfit.observed[places]).all(axis=1)]
            if len(known):
                pair = (values[known].reshape(-1, *model.shape) for values in (whole, misfit.observed))
                missing.setdefault(side.gain_name, []).append(model.missing_gain(*pair))
        for name, found in missing.items():
            self.stated[misfit.parts[name].start] += np.mean(found)

    def free(self, kept: str) -> IntArray:
        """Entries of the vector that a stage changes: those of surfaces and planes that enough paths meet."""
        parts = kept.split("+")
        free = []
        for name, part in self.misfit.parts.items():
            entries = np.arange(part.start, part.stop)
            if name.startswith(PREFIX):
                known = MATERIALS in parts and (self.misfit.several_carriers or not name.endswith(EXPONENT))
                free.append(entries[self.slabs] if known else entries[:0])
            elif name in (SHIFT, TILT):
                size = len(entries) // len(self.misfit.planes)
                moved = entries.reshape(-1, size)[self.planes].ravel()
                free.append(moved if PLANES in parts or FRAME in parts else entries[:0])
            else:
                free.append(entries)
        return np.sort(np.concatenate(free))

    def prior(self, mean: FloatArray, free: IntArray) -> Prior:
        """Prior of some entries about ``mean`` [p]; planes share the motions of the frame."""
        covariance = np.diag(np.square(self.prior_deviation[free]))
        if FRAME in self.options.parts and SHIFT in self.misfit.parts:
            deviation = np.repeat([self.options.frame_sd_m, self.options.frame_sd_rad], 3)
            _, among, which = np.intersect1d(free, self.misfit.plane_entries, return_indices=True)
            motions = self.misfit.motions[which]
            covariance[np.ix_(among, among)] += (motions * deviation**2) @ motions.T
        return Prior(mean[free], np.linalg.inv(covariance))

    def absent(self, known: Known, vector: FloatArray) -> frozenset[int]:
        """Surfaces that are left out of the scene of a vector [p], by their numbers in the scene."""
        names = self.misfit.sides[0].slabs.names
        taken = [slab for slab, name in enumerate(names) if known.materials.get(name) == ABSENT]
        thin = {slab for slab in taken if vector[material_places(self.misfit, slab)[0]] < np.log(STILL_ABSENT)}
        absent = thin.union(set(self.supposed.values()).intersection(taken))
        return frozenset(self.misfit.slabs[sorted(absent)].tolist())

    def all_parts(self) -> dict[str, Found]:
        """Results by the names of their parts: with materials alone, and with planes."""
        parts, frame = self.options.parts, [part for part in (PLANES, FRAME) if part in self.options.parts]
        stages = ["+".join(parts)]
        if MATERIALS in parts and frame:
            stages.insert(0, "+".join(part for part in parts if part not in frame))
        return {stage: self._alternate(stage) for stage in stages}

    def _alternate(self, stage: str) -> Found:
        """Rounds of choices and least squares, until a round changes no choice; then doubtful surfaces once more."""
        choices, title = self._choices(stage), _title(stage)
        known = Known(stage, self.stated, dict.fromkeys(self.supposed, ABSENT))
        vector, known, _ = self.chosen(known, self.stated, choices, f"{title}, round 1")
        found = self._rounds(self.solved(vector, known), choices, range(2, ROUNDS + 1))
        found = Bodies(self, choices, title).settled(found)
        return Doubts(self, choices, title).settled(found)

    def _rounds(self, found: Found, choices: Sequence[Choice], numbers: Iterable[int]) -> Found:
        """Rounds of choices and least squares, until a round changes no choice."""
        for number in numbers:
            what = f"{_title(found.known.stage)}, round {number}"
            vector, known, changed = self.chosen(found.known, found.vector, choices, what)
            if not changed:
                break
            found = self.solved(vector, known)
        return found

    def continued(self, found: Found, by: Fit) -> Found:
        """Rounds of choices and least squares from what a fit to other paths has found."""
        found = self.carried_over(found, by)
        choices, stage = self._choices(found.known.stage), found.known.stage
        found = Found(self.solve(stage, found.vector, found.known.mean), found.known)
        found = self._rounds(found, choices, range(1, ROUNDS + 1))
        return Doubts(self, choices, _title(stage)).with_other_materials(found)

    def _choices(self, stage: str) -> list[Choice]:
        """Choices of a stage."""
        parts, options, misfit = stage.split("+"), self.options, self.misfit
        shifts, materials = list[Choice](), list[Choice]()
        if SHIFT in misfit.parts and (PLANES in parts or FRAME in parts):
            alone, common = PLANES in parts, FRAME in parts
            sd_m = float(np.hypot(options.shift_sd_m * alone, options.frame_sd_m * common))
            shifts = shift_choices(misfit, self.planes, sd_m, self.frequency_hz)
        if MATERIALS in parts:
            materials = material_choices(misfit, self.slabs, self.frequency_hz)
        return joint_choices(materials, shifts, misfit.plane_of_slab, self.supposed)

    def chosen(
        self, known: Known, start: FloatArray, choices: Sequence[Choice], what: str
    ) -> tuple[FloatArray, Known, bool]:
        """Vector and materials that choices find from ``start``, and whether one has changed."""
        vector, taken = choose(self, start, choices, self._progress(what))
        for choice in choices:
            if choice.what in taken and choice.material.size:
                known = known.with_material(choice, taken[choice.what], vector)
        return vector, known, bool(taken)

    def solved(self, vector: FloatArray, known: Known) -> Found:
        """A few least-squares steps from a vector [p]."""
        return Found(self.solve(known.stage, vector, known.mean, ROUND_STEPS), known)

    def cost(self, found: Found, noise: Noise) -> float:
        """Negative logarithm of likelihood and prior, without its constant."""
        free = self.free(found.known.stage)
        prior = self.prior(found.known.mean, free)
        return noise.cost(self.misfit.residual(found.vector)) + prior.cost(found.vector[free])

    def planes_cost(self, vector: FloatArray) -> float:
        """Cost of planes by their prior, in which they share the motions of the frame."""
        free, prior = self._planes_prior
        return prior.cost(vector[free])

    @cached_property
    def _planes_prior(self) -> tuple[IntArray, Prior]:
        free = np.intersect1d(self.misfit.plane_entries, self.free(PLANES))
        return free, self.prior(self.stated, free)

    def expected(self, vector: FloatArray, places: IntArray) -> FloatArray:
        """Entries by the rigid motion of the other planes that enough paths meet; those of materials as they are."""
        expected = vector[places].copy()
        if FRAME in self.options.parts and SHIFT in self.misfit.parts:
            here = dict(zip(self.misfit.plane_entries, self.misfit.motions @ self._motion(vector, places), strict=True))
            expected = np.array([here.get(place, value) for place, value in zip(places, expected, strict=True)])
        return expected

    def _motion(self, vector: FloatArray, without: IntArray) -> FloatArray:
        """Rigid motion [6] of the planes that enough paths meet, but for those of some entries."""
        planes, motions = self.misfit.plane_entries, self.misfit.motions
        known = np.isin(planes, np.setdiff1d(self.free(PLANES), without))
        weight = known / np.square(self.prior_deviation[planes])
        before = np.repeat([self.options.frame_sd_m, self.options.frame_sd_rad], 3)
        information = motions.T @ (weight[:, None] * motions) + np.diag(before**-2.0)
        return np.asarray(np.linalg.solve(information, motions.T @ (weight * vector[planes])), float)

    def of_scene(self, found: Found) -> dict[str, FloatArray]:
        """Parameters by name for all planes and surfaces of the scene: planes that no path meets move with the frame,
        their materials are as stated.
        """
        misfit, parameters = self.misfit, self.misfit.of_scene(found.vector)
        if FRAME in found.known.stage.split("+"):
            surfaces = misfit.sides[0].surfaces
            count = len(surfaces.normal)
            moved = rigid_motions(surfaces) @ self._motion(found.vector, misfit.plane_entries[:0])
            moved[scene_entries(misfit.planes, count)] = found.vector[misfit.plane_entries]
            parameters |= {SHIFT: moved[:count], TILT: moved[count:].reshape(count, 2)}
        return parameters

    def carried_over(self, found: Found, by: Fit) -> Found:
        """What a fit to other paths, which meet other surfaces, has found: vector and means of this fit's entries."""
        vector, mean = map(self.misfit.vector_of, (by.of_scene(found), by.misfit.of_scene(found.known.mean)))
        return Found(replace(found.solution, vector=vector), replace(found.known, mean=mean))

    def refined(self, trials: Misfit | PathSum, start: FloatArray, places: IntArray) -> FloatArray:
        """Some least-squares steps of the entries of one choice; materials stay near those of ``start``."""
        places = places[np.isin(places, self.free("+".join(self.options.parts)))]
        misfit, vector, mean = self.misfit, start.copy(), start.copy()
        planes = misfit.plane_entries
        mean[planes] = self.stated[planes]

        def whole(part: FloatArray) -> FloatArray:
            vector[places] = part
            return vector

        found, _ = minimised(
            lambda part: trials.residual(whole(part)),
            lambda part: trials.jacobian(whole(part), places),
            start[places],
            self.prior(mean, places),
            REFINING_STEPS,
        )
        return whole(found)

    def _progress(self, what: str) -> Callable[[int, int], None]:
        return lambda done, of: self.on_stage(what, done / max(of, 1))

    def solve(self, stage: str, start: FloatArray, mean: FloatArray, most_steps: int | None = None) -> Solution:
        """Least squares of a stage's entries, in at most ``most_steps`` steps; the whole vector."""
        free, misfit = self.free(stage), self.misfit
        prior = self.prior(mean, free)
        what = f"least squares of {len(free)} parameters"
        steps = self.options.steps if most_steps is None else min(most_steps, self.options.steps)

        def whole(part: FloatArray) -> FloatArray:
            vector = start.copy()
            vector[free] = part
            return vector

        done = 0

        def jacobian(part: FloatArray) -> NDArray[np.float32]:
            def column(place: int) -> None:
                self.on_stage(what, min((done + place / max(len(free), 1)) / (steps + 1), 1.0))

            return near(misfit, whole(part)).jacobian(whole(part), free, column)

        def on_step(step: int, cost: float) -> None:
            nonlocal done
            done = step

        found = solve(lambda part: misfit.residual(whole(part)), jacobian, start[free], prior, steps, on_step)
        vector = whole(found.vector)
        others = np.setdiff1d(misfit.plane_entries, free)
        if FRAME in stage.split("+"):  # too few paths meet them
            vector[others] = self.expected(vector, others)
        return replace(found, vector=vector)

    def left_out_residuals(self, stage: str, solution: Solution) -> FloatArray:
        """Residuals [n_rx * rows, values] of each row by a fit to the others, see `left_out_residuals`."""
        free, vector = self.free(stage), solution.vector
        derivative = near(self.misfit, vector).jacobian(vector, free)
        return left_out_residuals(derivative, self.misfit.residual(vector), solution.covariance, solution.noise)
