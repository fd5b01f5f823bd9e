"""Moves of a fit between local minima: each is kept where it makes a state more probable by more than `GAIN`.

Rounds take the best alternative of one surface after another, and then least squares. Afterwards, all faces of a box
take one material, and what is least certain is chosen anew: choices that were made while others were still wrong may
hold these where they are, as either fits only beside the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter

import numpy as np
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from ..parallel.threads import on_threads
from ..tracing.paths.plane_parameters import SHIFT
from .choices import ABSENT, Choice, joint_choices, material_choices, shift_choices
from .fit import Fit, State
from .least_squares import Noise
from .misfit import Misfit
from .options import FRAME, FRAME_SD, MATERIALS, PLANES
from .path_sum import PathSum, near

GAIN = 0.5
"""Least increase of the log-likelihood for which a choice changes."""
SWEEPS = 3
ROUNDS = 3
"""Largest number of rounds: planes that are off hide the right material, and conversely."""
ROUND_STEPS = 3
"""Largest number of least-squares steps between choices."""
REFINED = 8
"""Number of shifts, the best with their best materials, that are compared after least-squares steps."""
SHIFTS_EACH = 3
"""Number of shifts of each material that are compared so, where materials are in doubt."""
LIKELY = 3.0
"""Log-likelihood that counts for each face that becomes of the material of the others: most boxes are of one."""
RECONSIDERED = 4
"""Largest number of times that doubtful surfaces are chosen anew."""
ELSEWHERE, MINIMA = 3, 2
"""Number of the least plausible planes or materials that are tried otherwise, and of other choices of each."""
APART = 1 / 8
"""Least distance of minima, wavelengths: paths change by up to a quarter."""

Alternative = tuple[float, str, FloatArray]
"""Cost, name and vector [p] of an alternative of a choice."""


class Moves:
    """Search of a stage for the most probable choices.

    Args:
        fit: least squares and prior.
        stage: the stage, its parts joined by "+".
    """

    def __init__(self, fit: Fit, stage: str) -> None:
        self.fit, self.stage, self.title = fit, stage, f"{stage.replace('+', ', ')}: choices"
        parts, options, misfit = stage.split("+"), fit.options, fit.misfit
        shifts, materials = list[Choice](), list[Choice]()
        if SHIFT in misfit.parts and (PLANES in parts or FRAME in parts):
            sd_m = float(np.hypot(options.shift_sd_m * (PLANES in parts), FRAME_SD[0] * (FRAME in parts)))
            shifts = shift_choices(misfit, fit.planes, sd_m, fit.frequency_hz)
        if MATERIALS in parts:
            materials = material_choices(misfit, fit.slabs, fit.frequency_hz)
        self.choices = joint_choices(materials, shifts, fit.supposed)
        self.joint = [choice for choice in self.choices if choice.joint]
        self.material = [choice for choice in self.choices if choice.material.size]

    def best(self) -> State:
        """The most probable state that is found from the stated one."""
        fit = self.fit
        state, _ = self._chosen(fit.start(self.stage), self.choices, f"{self.title}, round 1")
        state = self._rounds(fit.solved(state, ROUND_STEPS), range(2, ROUNDS + 1))
        state = self._boxes(state)
        if len(self.joint) < 2:
            return state
        state = self._without_doubts(state)
        return self._otherwise(state, self.joint, self._implausible(self.joint, state.vector))

    def continued(self, state: State, by: Fit) -> State:
        """The most probable state that is found from one of a fit to other paths."""
        state = self._rounds(self.fit.solved(self.fit.carried_over(state, by)), range(1, ROUNDS + 1))
        if not self.material:
            return state
        places = np.array([choice.material for choice in self.material])
        away = (state.vector - state.mean) / self.fit.prior_deviation
        return self._otherwise(state, self.material, np.square(away[places]).sum(axis=-1), of_materials=True)

    def _better(self, state: State, other: State, bonus: float = 0.0) -> bool:
        """Whether another state is more probable by `GAIN`, less a bonus, with the noise of the present one."""
        gain = self.fit.cost(state, state.noise) - self.fit.cost(other, state.noise)
        return gain + bonus > GAIN

    def _rounds(self, state: State, numbers: Iterable[int]) -> State:
        """Rounds of choices and least squares, until a round changes no choice."""
        for number in numbers:
            state, changed = self._chosen(state, self.choices, f"{self.title}, round {number}")
            if not changed:
                break
            state = self.fit.solved(state, ROUND_STEPS)
        return state

    def _chosen(self, state: State, choices: Sequence[Choice], what: str) -> tuple[State, bool]:
        """Coordinate descent over choices, in sweeps until none changes; and whether one has."""
        fit, vector, chosen = self.fit, state.vector.copy(), dict[str, str]()
        last = 0  # the choice that was changed last, or the first
        for sweep in range(SWEEPS):
            trials = near(fit.misfit, vector)
            noise, changed = Noise.of(trials.residual(vector)), False
            for number, choice in enumerate(choices):
                if sweep and not changed and number >= last:
                    break  # the alternatives of the others were tried beside what is chosen now
                fit.on_stage(what, (sweep + number / len(choices)) / SWEEPS)
                least, name, other = self._alternatives(trials, noise, choice, vector)[0]
                if least < fit.trial_costs(trials, noise, vector[None])[0] - GAIN:
                    chosen[choice.what], vector, changed = name.partition(",")[0], other, True
                    last = number
                    trials.accept(other)
            if not changed:
                break
        state = replace(state, vector=vector)
        for choice in choices:
            if choice.what in chosen and choice.material.size:
                state = state.changed(choice, chosen[choice.what], vector)
        return state, bool(chosen)

    def _alternatives(
        self, trials: Misfit | PathSum, noise: Noise, choice: Choice, vector: FloatArray, of_materials: bool = False
    ) -> list[Alternative]:
        """Alternatives of a choice, those with the least cost first.

        Of a material and a shift together, the best of some shifts, or with ``of_materials`` those of each material and
        the plane where it is, are compared after least squares, too.
        """
        expected = self.fit.expected(vector, choice.places)
        vectors = np.tile(vector, (len(choice.values), 1))
        for other, values in zip(vectors, choice.values.values(), strict=True):
            other[choice.places] = np.where(np.isnan(values), expected, values)
        costs = self.fit.trial_costs(trials, noise, vectors)
        tried = sorted(zip(costs, choice.values, vectors, strict=True), key=itemgetter(0))
        if choice.joint:
            # A plane that is tilted, too, fits at the right shift only once its tilts do.
            groups = dict[str, list[tuple[str, FloatArray]]]()  # by material or by shift
            for _, name, other in tried:
                groups.setdefault(name.partition(",")[0 if of_materials else 2], []).append((name, other))
            few = [group[0] for group in groups.values()][:REFINED]
            if of_materials:
                few = [one for group in groups.values() for one in group[:SHIFTS_EACH]]
                for material, group in groups.items():  # also where the plane is: the shifts are those of a lattice
                    in_place = group[0][1].copy()
                    in_place[choice.plane] = vector[choice.plane]
                    few.append((material, in_place))
            places = choice.places if trials is self.fit.misfit else choice.plane
            work = partial(self.fit.refined, trials, places=places)
            starts = [other for _, other in few]
            better = on_threads(work, starts) if isinstance(trials, PathSum) else [work(start) for start in starts]
            costs = self.fit.trial_costs(trials, noise, np.stack(better))
            tried += zip(costs, [name for name, _ in few], better, strict=True)
        return sorted(tried, key=itemgetter(0))

    def _boxes(self, state: State) -> State:
        """All faces of a box of one material, supposed ones at their best shifts, where that is likely.

        Waves that pass a cabinet lose what its front and its back do. As long as the back is missing, the front is
        taken to lose both, and then neither fits without the other.
        """
        fit = self.fit
        shifts = {choice.what: choice.shifts for choice in self.joint if choice.what in fit.supposed}
        for number, slabs in enumerate(fit.bodies, 1):
            fit.on_stage(f"{self.title} of boxes", number / len(fit.bodies))
            faces, trials = material_choices(fit.misfit, slabs, fit.frequency_hz), near(fit.misfit, state.vector)
            alternatives = list[Alternative]()
            for material in faces[0].values:
                if material == ABSENT:
                    continue
                vector = state.vector.copy()
                for face in faces:
                    vector[face.places] = face.values[material]
                for face in faces:
                    if face.what in shifts:
                        vector = self._alternatives(trials, state.noise, shifts[face.what], vector)[0][2]
                alternatives.append((fit.trial_costs(trials, state.noise, vector[None])[0], material, vector))
            _, material, vector = min(alternatives, key=itemgetter(0))
            changed = [face for face in faces if state.materials.get(face.what) != material]
            if not changed:
                continue
            other = state
            for face in changed:
                other = other.changed(face, material, vector)
            other = fit.solved(other, ROUND_STEPS)
            if self._better(state, other, LIKELY * len(changed)):
                state = other
        return state

    def _without_doubts(self, state: State) -> State:
        """Doubtful surfaces are chosen anew, until each reason for doubt has failed."""
        doubts = [(self._implausible, self.joint), (self._unsupported, self.material)]
        failed, number = 0, 0
        while failed < len(doubts) and number < RECONSIDERED:
            doubt, choices = doubts[number % len(doubts)]
            number += 1
            # The half that is doubted most is left out, and then chosen beside the others.
            most = np.argsort(-doubt(choices, state.vector), kind="stable")[: (len(choices) + 1) // 2]
            doubted, other = [choices[place] for place in np.sort(most)], state
            for choice in doubted:
                other = other.changed(choice, ABSENT, self._without(choice, other.vector))
            other, _ = self._chosen(other, doubted, f"{self.title} in doubt, {number} of {RECONSIDERED}")
            other = self.fit.solved(other, ROUND_STEPS)
            state, failed = (other, 0) if self._better(state, other) else (state, failed + 1)
        return state

    def _otherwise(
        self, state: State, choices: Sequence[Choice], doubt: FloatArray, of_materials: bool = False
    ) -> State:
        """One after another of the choices doubted most in another minimum of its plane, or of another material.

        All parameters are adapted to it: what the others have adapted to the wrong choice makes the right one look
        worse until they may change.
        """
        apart_m, fit = APART * speed_of_light / self.fit.frequency_hz, self.fit
        what = f"{self.title} {'of other materials' if of_materials else 'in other minima'}"
        doubtful = np.argsort(-doubt, kind="stable")[:ELSEWHERE]
        for number, choice in enumerate([choices[place] for place in doubtful], 1):
            fit.on_stage(f"{what}, {number} of {len(doubtful)}", 0.0)
            trials, tried = near(fit.misfit, state.vector), [(state.materials.get(choice.what), state.vector)]
            for _, name, vector in self._alternatives(trials, state.noise, choice, state.vector, of_materials):
                material = name.partition(",")[0]
                known = [
                    material == other if of_materials else abs((vector - tried_vector)[choice.plane[0]]) < apart_m
                    for other, tried_vector in tried
                ]
                if len(tried) > MINIMA or any(known):
                    continue
                tried.append((material, vector))
                other = fit.solved(state.changed(choice, material, vector), ROUND_STEPS)
                if self._better(state, other):
                    state = other
                    break  # the other alternatives are beside what was found before
        return state

    def _implausible(self, choices: Sequence[Choice], vector: FloatArray) -> FloatArray:
        """Squared distances of planes from where the others let expect them, in standard deviations."""
        fit, places = self.fit, [choice.plane for choice in choices]
        away = [(vector[place] - fit.expected(vector, place)) / fit.prior_deviation[place] for place in places]
        return np.square(away).sum(axis=1)

    def _unsupported(self, choices: Sequence[Choice], vector: FloatArray) -> FloatArray:
        """Log-likelihoods without each surface, the higher the less observations tell of it."""
        trials = near(self.fit.misfit, vector)
        noise = Noise.of(trials.residual(vector))
        return -noise.costs(trials.mean_squares(np.stack([self._without(choice, vector) for choice in choices])))

    def _without(self, choice: Choice, vector: FloatArray) -> FloatArray:
        """A vector [p] without the surface of a choice; its plane is where the others let expect it."""
        absent = next(values for name, values in choice.values.items() if name.startswith(ABSENT))
        result = vector.copy()
        result[choice.places] = np.where(choice.of_plane, self.fit.expected(vector, choice.places), absent)
        return result
