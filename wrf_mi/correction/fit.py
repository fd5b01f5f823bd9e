"""Rounds of choices and least squares over the rows of one misfit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.material_parameters import EXPONENT, PREFIX
from ..tracing.plane_parameters import SHIFT, TILT
from .frame import rigid_motions
from .least_squares import Noise, Prior, Solution, solve
from .misfit import Misfit
from .options import FRAME, MATERIALS, PLANES, CorrectionOptions, OnStage
from .path_sum import PathSum, near
from .search import (
    ABSENT,
    ABSENT_VALUES,
    GAIN,
    Choice,
    alternatives,
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
RECONSIDERED = 4
"""Largest number of times that doubtful surfaces are chosen anew."""
ELSEWHERE, MINIMA = 3, 2
"""Number of the least plausible planes that are tried elsewhere, and of other minima of each."""
APART = 1 / 8
"""Least distance of minima, wavelengths: paths change by up to a quarter."""
REFINING_STEPS = 3
"""Largest number of least-squares steps of one plane while shifts are compared."""


@dataclass(frozen=True)
class _Known:
    """Choices of a stage.

    Attributes:
        stage: the stage.
        mean: means of the parameters' prior [p].
        materials: material of each surface that was chosen, by its name.
    """

    stage: str
    mean: FloatArray
    materials: Mapping[str, str]


class _Found(NamedTuple):
    """Least squares and the choices before."""

    solution: Solution
    known: _Known

    @property
    def vector(self) -> FloatArray:
        """Parameters [p]."""
        return self.solution.vector


class Fit:
    """Choice and least squares over the rows of one misfit."""

    def __init__(
        self,
        misfit: Misfit,
        options: CorrectionOptions,
        on_stage: OnStage,
        supposed: frozenset[str] = frozenset(),
    ) -> None:
        self.misfit, self.options, self.on_stage = misfit, options, on_stage
        names = misfit.sides[0].slabs.names
        self.supposed = {name: slab for slab, name in enumerate(names) if name.partition("/")[0] in supposed}
        self.stated = misfit.start.copy()
        self.taken: dict[tuple[str, str], str] = {}
        self.means: dict[str, FloatArray] = {}
        self.frequency_hz = float(misfit.sides[0].scene.frequency[0])
        self.apart_m = APART * speed_of_light / self.frequency_hz
        planes, slabs = misfit.counts()
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
            places = self.misfit.plane_entries
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
        """Rounds of choices and least squares, until a round changes no choice; then doubtful surfaces once more."""
        choices, title = self._choices(stage), f"{stage.replace('+', ', ')}: choices"
        vector, known, _ = self._chosen(
            _Known(stage, self.stated, dict.fromkeys(self.supposed, ABSENT)), self.stated, choices, f"{title}, round 1"
        )
        found = self._solved(vector, known)
        for round_ in range(2, ROUNDS + 1):
            vector, known, changed = self._chosen(found.known, found.vector, choices, f"{title}, round {round_}")
            if not changed:
                break
            found = self._solved(vector, known)
        found = self._after_doubts(found, choices, title)
        self.means[stage] = found.known.mean
        self.taken |= {(stage, surface): material for surface, material in found.known.materials.items()}
        return found.solution

    def _choices(self, stage: str) -> list[Choice]:
        """Choices of a stage."""
        parts, options, misfit = stage.split("+"), self.options, self.misfit
        shifts, materials = list[Choice](), list[Choice]()
        if PLANES in parts or FRAME in parts:
            alone, common = PLANES in parts, FRAME in parts
            sd_m = float(np.hypot(options.shift_sd_m * alone, options.frame_sd_m * common))
            shifts = shift_choices(misfit, self.planes, sd_m, self.frequency_hz)
        if MATERIALS in parts:
            materials = material_choices(misfit, self.slabs, self.frequency_hz)
        return joint_choices(materials, shifts, misfit.plane_of_slab, self.supposed)

    def _chosen(
        self, known: _Known, start: FloatArray, choices: Sequence[Choice], what: str
    ) -> tuple[FloatArray, _Known, bool]:
        """Vector and materials that choices find from ``start``, and whether one has changed."""
        vector, taken = choose(self, start, choices, self._progress(what))
        mean, materials = known.mean.copy(), dict(known.materials)
        for choice in choices:
            # Least squares stay near the materials that were chosen, and near the planes as stated.
            if choice.what in taken and choice.material.size:
                mean[choice.material], materials[choice.what] = vector[choice.material], taken[choice.what]
        return vector, _Known(known.stage, mean, materials), bool(taken)

    def _solved(self, vector: FloatArray, known: _Known) -> _Found:
        return _Found(self.solve(known.stage, vector, known.mean, ROUND_STEPS), known)

    def _after_doubts(self, found: _Found, choices: Sequence[Choice], title: str) -> _Found:
        """The best that is found where doubtful surfaces are chosen anew, until each reason for doubt has failed."""
        moved = [choice for choice in choices if choice.joint]
        doubts = [(self._implausible, moved), (self._unsupported, [one for one in choices if one.material.size])]
        failed, number = 0, 0
        while len(moved) > 1 and failed < len(doubts) and number < RECONSIDERED:
            doubt, those = doubts[number % len(doubts)]
            number += 1
            other = self._reconsidered(found, those, doubt, f"{title} in doubt, {number} of {RECONSIDERED}")
            noise = found.solution.noise
            better = self._cost(other, noise) < self._cost(found, noise) - GAIN
            found, failed = (other, 0) if better else (found, failed + 1)
        return self._with_planes_elsewhere(found, moved, title) if len(moved) > 1 else found

    def _with_planes_elsewhere(self, found: _Found, choices: Sequence[Choice], title: str) -> _Found:
        """The best that is found with one of the least plausible planes in another minimum, all others adapted to it.

        What the others have adapted to the wrong minimum makes the right one look worse until they may change.
        """
        doubtful = np.argsort(-self._implausible(choices, found.vector), kind="stable")[:ELSEWHERE]
        for number, choice in enumerate([choices[place] for place in doubtful], 1):
            self.on_stage(f"{title} in other minima, {number} of {len(doubtful)}", 0.0)
            noise, trials = found.solution.noise, near(self.misfit, found.vector)
            tried, shift = [found.vector[choice.plane[0]]], choice.plane[0]
            for _, name, there in alternatives(self, trials, noise, choice, found.vector):
                if len(tried) > MINIMA or np.abs(np.subtract(tried, there[shift])).min() < self.apart_m:
                    continue
                tried.append(there[shift])
                mean, materials = found.known.mean.copy(), dict(found.known.materials)
                mean[choice.material], materials[choice.what] = there[choice.material], name.partition(",")[0]
                other = self._solved(there, _Known(found.known.stage, mean, materials))
                if self._cost(other, noise) < self._cost(found, noise) - GAIN:
                    found = other
                    break  # the other alternatives are beside what was found before
        return found

    def _cost(self, found: _Found, noise: Noise) -> float:
        free = self.free(found.known.stage)
        prior = self.prior(found.known.mean, free)
        return noise.cost(self.misfit.residual(found.vector)) + prior.cost(found.vector[free])

    def _reconsidered(
        self,
        found: _Found,
        choices: Sequence[Choice],
        doubt: Callable[[Sequence[Choice], FloatArray], FloatArray],
        what: str,
    ) -> _Found:
        """The half of the surfaces that is doubted most, chosen anew beside the others.

        They were chosen while others were still wrong, and wrong ones hold each other where they are.
        """
        most = np.sort(np.argsort(-doubt(choices, found.vector), kind="stable")[: (len(choices) + 1) // 2])
        doubted, start = [choices[number] for number in most], found.vector.copy()
        mean, materials = found.known.mean.copy(), dict(found.known.materials)
        for choice in doubted:
            start[choice.places] = self._absent(choice, start)
            mean[choice.material], materials[choice.what] = start[choice.material], ABSENT
        vector, known, _ = self._chosen(_Known(found.known.stage, mean, materials), start, doubted, what)
        return self._solved(vector, known)

    def _implausible(self, choices: Sequence[Choice], vector: FloatArray) -> FloatArray:
        """Squared distances of planes from where the others let expect them, in standard deviations."""
        places = [choice.plane for choice in choices]
        away = [(vector[place] - self.expected(vector, place)) / self.prior_deviation[place] for place in places]
        return np.square(away).sum(axis=1)

    def _unsupported(self, choices: Sequence[Choice], vector: FloatArray) -> FloatArray:
        """Log-likelihoods without each surface, the higher the less observations tell of it."""
        trials, found = near(self.misfit, vector), np.zeros(len(choices))
        noise = Noise.of(trials.residual(vector))
        for number, choice in enumerate(choices):
            there = vector.copy()
            there[choice.places] = self._absent(choice, vector)
            found[number] = -noise.cost(trials.residual(there))
        return found

    def _absent(self, choice: Choice, vector: FloatArray) -> FloatArray:
        """Values of a choice whose surface is left out; its plane is where the others let expect it."""
        values = next(values for name, values in choice.values.items() if name.startswith(ABSENT))
        return np.where(choice.of_plane, self.expected(vector, choice.places), values)

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
            planes = self.misfit.plane_entries
            known = np.isin(planes, np.setdiff1d(self.free(PLANES), places))
            weight = known / np.square(self.prior_deviation[planes])
            motions = rigid_motions(self.misfit.sides[0].surfaces)
            before = np.repeat([self.options.frame_sd_m, self.options.frame_sd_rad], 3)
            information = motions.T @ (weight[:, None] * motions) + np.diag(before**-2.0)
            motion = np.linalg.solve(information, motions.T @ (weight * vector[planes]))
            here = dict(zip(planes, motions @ motion, strict=True))
            expected = np.array([here.get(place, value) for place, value in zip(places, expected, strict=True)])
        return expected

    def refined(self, trials: Misfit | PathSum, start: FloatArray, places: IntArray) -> FloatArray:
        """Some least-squares steps of the entries of one choice; materials stay near those of ``start``."""
        places = places[np.isin(places, self.free("+".join(self.options.parts)))]
        misfit, vector, mean = self.misfit, start.copy(), start.copy()
        planes = misfit.plane_entries
        mean[planes] = self.stated[planes]

        def whole(part: FloatArray) -> FloatArray:
            vector[places] = part
            return vector

        found = solve(
            lambda part: trials.residual(whole(part)),
            lambda part: trials.jacobian(whole(part), places),
            start[places],
            self.prior(mean, places),
            REFINING_STEPS,
        )
        return whole(found.vector)

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
