"""Moves of a state between local minima of its posterior.

Least squares reach the solution from within a quarter of a wavelength of each path's length and with roughly the right
materials. So alternatives are tried: common building materials, absence, and shifts of planes on a lattice. Rounds take
the best alternative of one surface after another, and then least squares. Afterwards, all faces of a box take one
material, and what is least certain is chosen anew: choices that were made while others were still wrong may hold these
where they are, as either fits only beside the other. A move counts where it makes the state more probable (`gains`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, starmap
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core.types import FloatArray, IntArray
from ..parallel.threads import on_threads
from ..tracing.paths.scene_parameters import LEAST_CONDUCTIVITY, LEAST_SUSCEPTIBILITY, QUANTITIES, SHIFT, TILT
from ..tracing.sionna.materials import itu_constants, itu_exponent
from .least_squares import Noise
from .misfit import Misfit
from .options import FRAME, FRAME_SD, MATERIALS, PLANES
from .path_sum import PathSum, near
from .state import ABSENT, ABSENT_VALUES, SceneEdit, ScenePosterior, State, material_places

COMMON = ("concrete", "brick", "plasterboard", "ceiling_board", "wood", "chipboard", "glass", "metal")
"""Materials of ITU-R P.2040 that surfaces in buildings have; others lie between them."""
JOINT = 10  # number of planes whose material and shift are chosen together
STEP = 1 / 16  # step of the shifts, wavelengths: paths change by up to an eighth
FARTHEST = 2.0  # largest shift tried, in standard deviations of the prior
GAIN = 0.5  # least increase of the log-posterior for which a state changes: that of a standard deviation of a parameter
SWEEPS, ROUNDS = 3, 3
"""Most sweeps over choices, and rounds: planes that are off hide the right material, and conversely."""
ROUND_STEPS = 3  # largest number of least-squares steps between choices
REFINED = 8  # number of shifts, the best with their best materials, that are compared after least-squares steps
SHIFTS_EACH = 3  # number of shifts of each material that are compared so, where materials are in doubt
LIKELY = 3.0  # log-likelihood for each face that becomes of the material of the others: most boxes are of one
RECONSIDERED = 4  # largest number of times that doubtful surfaces are chosen anew
ELSEWHERE, MINIMA = 3, 2  # least plausible planes or materials that are tried otherwise, other choices of each
APART = 1 / 8  # least distance of minima, wavelengths: paths change by up to a quarter


@dataclass(frozen=True)
class SurfaceChoice:
    """Alternatives of one surface or plane."""

    what: str  # name of the surface or plane
    places: IntArray  # its entries of the vector
    values: Mapping[str, FloatArray]  # by ``material``, ``shift`` or both, joined by ", "; NaN: as other planes predict
    of_plane: NDArray[np.bool_]  # whether each entry is of a plane, not of a material

    @property
    def material(self) -> IntArray:
        """Entries of a material."""
        return self.places[~self.of_plane]

    @property
    def plane(self) -> IntArray:
        """Entries of a plane."""
        return self.places[self.of_plane]

    @property
    def joint(self) -> bool:
        """Whether material and shift are chosen together."""
        return bool(self.material.size and self.plane.size)

    @property
    def shifts(self) -> SurfaceChoice:
        """The shifts of a joint choice, for any material."""
        values = {name.partition(", ")[2]: values[self.of_plane] for name, values in self.values.items()}
        return replace(self, places=self.plane, values=values, of_plane=self.of_plane[self.of_plane])


class Alternative(NamedTuple):
    """An alternative of a choice, and its cost with all other entries as they are."""

    cost: float
    name: str
    vector: FloatArray

    @property
    def material(self) -> str:
        """Name of the material."""
        return self.name.partition(",")[0]


BY_COST = attrgetter("cost")


def material_choices(posterior: ScenePosterior, slabs: IntArray) -> list[SurfaceChoice]:
    """Choices of the materials of some surfaces, in their order."""
    hz, misfit = posterior.frequency_hz, posterior.misfit
    values = dict[str, FloatArray]()
    for name, (permittivity, conductivity, thickness) in itu_constants(hz).items():
        if name in COMMON:
            least = max(permittivity - 1, LEAST_SUSCEPTIBILITY), max(conductivity, LEAST_CONDUCTIVITY)
            values[name] = np.append(np.log([*least, thickness]), itu_exponent(name, hz))
    values[ABSENT] = ABSENT_VALUES
    names, of_plane = misfit.traced_fields[0].slabs.names, np.zeros(len(QUANTITIES), bool)
    return [SurfaceChoice(names[slab], material_places(misfit, slab), values, of_plane) for slab in slabs]


def shift_choices(posterior: ScenePosterior, sd_m: float) -> list[SurfaceChoice]:
    """Choices of shifts of planes, with the tilts of the frame, within `FARTHEST` standard deviations of the prior."""
    misfit, step_m = posterior.misfit, STEP * speed_of_light / posterior.frequency_hz
    most = int(FARTHEST * sd_m / step_m)
    shifts = step_m * np.arange(-most, most + 1)
    values = {f"{1e3 * shift:+.0f} mm": np.array([shift, np.nan, np.nan]) for shift in shifts}
    shift, tilt = (misfit.slices[name].start for name in (SHIFT, TILT))
    places = [np.array([shift + plane, tilt + 2 * plane, tilt + 2 * plane + 1]) for plane in posterior.planes]
    names = [f"plane {number}" for number in misfit.planes[posterior.planes]]
    pairs = zip(names, places, strict=True)
    return [SurfaceChoice(name, place, values, np.ones(3, bool)) for name, place in pairs] if most else []


def joint_choices(
    materials: Sequence[SurfaceChoice], shifts: Sequence[SurfaceChoice], posterior: ScenePosterior
) -> list[SurfaceChoice]:
    """Choices of material and shift together, and all other choices by themselves."""
    # Together for the surface with most paths of each of the first `JOINT` planes, and for supposed faces.
    # At a wavelength of the size of the shifts, a wrong material makes the right shift look wrong, and conversely.
    # In reverse order, so that of several surfaces in a plane that with most paths stays.
    of_plane = {f"plane {material.what.rpartition('/')[2]}": material for material in reversed(materials)}
    every = [(of_plane[shift.what], shift) for shift in shifts if shift.what in of_plane]
    pairs = every[:JOINT] + [pair for pair in every[JOINT:] if pair[0].what in posterior.supposed]
    done = {choice.what for choice in chain.from_iterable(pairs)}
    return [*starmap(_joint, pairs), *(choice for choice in (*shifts, *materials) if choice.what not in done)]


def _joint(material: SurfaceChoice, shift: SurfaceChoice) -> SurfaceChoice:
    values = {
        f"{kind}, {place}": np.concatenate([constants, moved])
        for place, moved in shift.values.items()
        for kind, constants in material.values.items()
    }
    places, mask = np.concatenate([material.places, shift.places]), np.concatenate([material.of_plane, shift.of_plane])
    return SurfaceChoice(material.what, places, values, mask)


def gains(before: float, after: float, bonus: float = 0.0) -> bool:
    """Whether a move is accepted, of costs before and after it: the one rule for all moves."""
    return before - after + bonus > GAIN


class Moves:
    """Search for the most probable choices of a stage, whose parameter groups are joined by "+"."""

    def __init__(self, posterior: ScenePosterior, stage: str) -> None:
        self.posterior, self.stage, self.title = posterior, stage, f"{stage.replace('+', ', ')}: choices"
        parameter_groups, options = stage.split("+"), posterior.options
        shifts, materials = list[SurfaceChoice](), list[SurfaceChoice]()
        if SHIFT in posterior.misfit.slices and (PLANES in parameter_groups or FRAME in parameter_groups):
            sd_m = float(
                np.hypot(options.shift_sd_m * (PLANES in parameter_groups), FRAME_SD[0] * (FRAME in parameter_groups))
            )
            shifts = shift_choices(posterior, sd_m)
        if MATERIALS in parameter_groups:
            materials = material_choices(posterior, posterior.slabs)
        self.choices = joint_choices(materials, shifts, posterior)
        self.joint = [choice for choice in self.choices if choice.joint]
        self.material = [choice for choice in self.choices if choice.material.size]

    def best(self) -> State:
        """The most probable state that is found from the stated one."""
        state, _ = self._chosen(self.posterior.start(self.stage), self.choices, f"{self.title}, round 1")
        state = self._rounds(state.solved(ROUND_STEPS), range(2, ROUNDS + 1))
        moves: list[Callable[[State], State]] = [self._boxes]
        if len(self.joint) > 1:  # a single one has nothing that could hold it in the wrong place
            moves += [self._doubted_anew, self._otherwise]
        for move in moves:
            state = move(state)
        return state

    def continued(self, edit: SceneEdit) -> State:
        """The most probable state that is found from one over other paths."""
        state = self._rounds(edit.at(self.posterior).solved(), range(1, ROUNDS + 1))
        return self._otherwise(state, of_materials=True) if self.material else state

    def _solved_if_better(self, state: State, other: State, bonus: float = 0.0) -> State:
        """Another state after least squares, or the present one where that gains nothing by the present noise."""
        other = other.solved(ROUND_STEPS)
        return other if gains(state.cost(state.noise), other.cost(state.noise), bonus) else state

    def _rounds(self, state: State, numbers: Iterable[int]) -> State:
        """Rounds of choices and least squares, until a round changes no choice."""
        for number in numbers:
            state, changed = self._chosen(state, self.choices, f"{self.title}, round {number}")
            if not changed:
                break
            state = state.solved(ROUND_STEPS)
        return state

    def _chosen(self, state: State, choices: Sequence[SurfaceChoice], what: str) -> tuple[State, bool]:
        """Coordinate descent over choices, in sweeps until none changes; and whether one has."""
        posterior, vector, materials = self.posterior, state.vector.copy(), dict[str, str]()
        last = 0  # the choice that was changed last, or the first
        for sweep in range(SWEEPS):
            trials = near(posterior.misfit, vector)
            noise, changed = Noise.of(trials.residual(vector)), False
            for number, choice in enumerate(choices):
                if sweep and not changed and number >= last:
                    break  # the alternatives of the others were tried beside what is chosen now
                posterior.on_stage(what, (sweep + number / len(choices)) / SWEEPS)
                best = self._alternatives(trials, noise, choice, vector)[0]
                if gains(posterior.trial_costs(trials, noise, vector[None])[0], best.cost):
                    materials[choice.what], vector, changed, last = best.material, best.vector, True, number
                    trials.accept(vector)
            if not changed:
                break
        state = replace(state, vector=vector)
        for choice in choices:
            if choice.what in materials and choice.material.size:
                state = state.chosen(choice.what, materials[choice.what], choice.material, vector)
        return state, bool(materials)

    def _alternatives(
        self,
        trials: Misfit | PathSum,
        noise: Noise,
        choice: SurfaceChoice,
        vector: FloatArray,
        of_materials: bool = False,
    ) -> list[Alternative]:
        """Alternatives of a choice, those with the least cost first; some of joint ones after least squares, too."""
        expected = self.posterior.expected(vector, choice.places)
        vectors = np.tile(vector, (len(choice.values), 1))
        for other, values in zip(vectors, choice.values.values(), strict=True):
            other[choice.places] = np.where(np.isnan(values), expected, values)
        costs = self.posterior.trial_costs(trials, noise, vectors)
        tried = sorted(map(Alternative, costs, choice.values, vectors), key=BY_COST)
        if not choice.joint:
            return tried
        # A plane that is tilted, too, fits at the right shift only once its tilts do.
        starts = _starts(choice, tried, vector, of_materials)
        places = choice.places if trials is self.posterior.misfit else choice.plane
        work, vectors_of = partial(self.posterior.refined, trials, noise, places), [start.vector for start in starts]
        # Recordings of Dr.Jit, by which a misfit is evaluated, serve one thread at a time.
        refined = on_threads(work, vectors_of) if isinstance(trials, PathSum) else [work(start) for start in vectors_of]
        costs = self.posterior.trial_costs(trials, noise, np.stack(refined))
        tried += map(Alternative, costs, [start.name for start in starts], refined)
        return sorted(tried, key=BY_COST)

    def _boxes(self, state: State) -> State:
        """All faces of a box of one material, supposed ones at their best shifts, where that is likely."""
        # Waves that pass a cabinet lose what its front and its back do. As long as the back is missing, the front is
        # taken to lose both, and then neither fits without the other.
        posterior = self.posterior
        for number, slabs in enumerate(posterior.bodies, 1):
            posterior.on_stage(f"{self.title} of boxes", number / len(posterior.bodies))
            faces, trials = material_choices(posterior, slabs), near(posterior.misfit, state.vector)
            materials = [material for material in faces[0].values if material != ABSENT]
            best = min((self._of_one_material(trials, state, faces, name) for name in materials), key=BY_COST)
            changed = [face for face in faces if state.materials.get(face.what) != best.name]
            other = state
            for face in changed:
                other = other.chosen(face.what, best.name, face.places, best.vector)
            if changed:
                state = self._solved_if_better(state, other, LIKELY * len(changed))
        return state

    def _of_one_material(
        self, trials: Misfit | PathSum, state: State, faces: Sequence[SurfaceChoice], material: str
    ) -> Alternative:
        """All faces of a box of a material, and the supposed ones among them where they fit best."""
        vector, supposed = state.vector.copy(), self.posterior.supposed
        for face in faces:
            vector[face.places] = face.values[material]
        shifts = {choice.what: choice.shifts for choice in self.joint if choice.what in supposed}
        for face in faces:
            if face.what in shifts:
                vector = self._alternatives(trials, state.noise, shifts[face.what], vector)[0].vector
        return Alternative(self.posterior.trial_costs(trials, state.noise, vector[None])[0], material, vector)

    def _doubted_anew(self, state: State) -> State:
        """Doubtful surfaces are chosen anew, until each reason for doubt has failed."""
        doubts = [(self._implausible, self.joint), (self._unsupported, self.material)]
        failed, number = 0, 0
        while failed < len(doubts) and number < RECONSIDERED:
            doubt, choices = doubts[number % len(doubts)]
            number += 1
            # The half that is doubted most is left out, and then chosen beside the others.
            most = np.argsort(-doubt(choices, state), kind="stable")[: (len(choices) + 1) // 2]
            doubted, other = [choices[place] for place in np.sort(most)], state
            for choice in doubted:
                without = self._without(choice, other.vector)
                other = other.chosen(choice.what, ABSENT, choice.material, without)
            other, _ = self._chosen(other, doubted, f"{self.title} in doubt, {number} of {RECONSIDERED}")
            other = self._solved_if_better(state, other)
            failed = failed + 1 if other is state else 0
            state = other
        return state

    def _otherwise(self, state: State, of_materials: bool = False) -> State:
        """The least plausible planes in other minima, or materials replaced by others, one after another."""
        # Least squares of all parameters before a comparison: what the others have adapted to the wrong choice makes
        # the right one look worse until they may change.
        choices, doubt_of, elsewhere = self.joint, self._implausible, "in other minima"
        if of_materials:
            choices, doubt_of, elsewhere = self.material, self._far_from_prior, "of other materials"
        apart_m = APART * speed_of_light / self.posterior.frequency_hz
        doubt, what = doubt_of(choices, state), f"{self.title} {elsewhere}"
        doubtful = [choices[place] for place in np.argsort(-doubt, kind="stable")[:ELSEWHERE]]
        for number, choice in enumerate(doubtful, 1):
            self.posterior.on_stage(f"{what}, {number} of {len(doubtful)}", 0.0)
            trials = near(self.posterior.misfit, state.vector)
            tried = [Alternative(0.0, state.materials.get(choice.what, ""), state.vector)]
            for other in self._alternatives(trials, state.noise, choice, state.vector, of_materials):
                if of_materials:
                    same = [other.material == before.material for before in tried]
                else:
                    same = [abs((other.vector - before.vector)[choice.plane[0]]) < apart_m for before in tried]
                if len(tried) > MINIMA or any(same):
                    continue
                tried.append(other)
                present = state
                candidate = state.chosen(choice.what, other.material, choice.material, other.vector)
                state = self._solved_if_better(state, candidate)
                if state is not present:
                    break  # the other alternatives are beside what was found before
        return state

    def _far_from_prior(self, choices: Sequence[SurfaceChoice], state: State) -> FloatArray:
        """Squared distances of materials from their prior, in standard deviations."""
        away = (state.vector - state.mean) / self.posterior.prior_deviation
        return np.asarray(np.square(away[np.array([choice.material for choice in choices])]).sum(axis=-1))

    def _implausible(self, choices: Sequence[SurfaceChoice], state: State) -> FloatArray:
        """Squared distances of planes from the positions predicted by the other planes, in standard deviations."""
        posterior, vector, places = self.posterior, state.vector, [choice.plane for choice in choices]
        away = [(vector[at] - posterior.expected(vector, at)) / posterior.prior_deviation[at] for at in places]
        return np.asarray(np.square(away).sum(axis=1))

    def _unsupported(self, choices: Sequence[SurfaceChoice], state: State) -> FloatArray:
        """Log-likelihoods without each surface, the higher the less observations tell of it."""
        trials = near(self.posterior.misfit, state.vector)
        noise = Noise.of(trials.residual(state.vector))
        return -noise.costs(trials.mean_squares(np.stack([self._without(choice, state.vector) for choice in choices])))

    def _without(self, choice: SurfaceChoice, vector: FloatArray) -> FloatArray:
        """A vector [p] without the surface of a choice; its plane is where the other planes predict it."""
        absent = next(values for name, values in choice.values.items() if name.startswith(ABSENT))
        result = vector.copy()
        result[choice.places] = np.where(choice.of_plane, self.posterior.expected(vector, choice.places), absent)
        return result


def _starts(
    choice: SurfaceChoice, tried: Sequence[Alternative], vector: FloatArray, of_materials: bool
) -> list[Alternative]:
    """Alternatives of a joint choice, of ascending cost, from which least squares start."""
    # The best materials of the `REFINED` best shifts, or the `SHIFTS_EACH` best shifts of each material: before least
    # squares, the right one may lie behind others.
    groups = dict[str, list[Alternative]]()  # by material or by shift
    for other in tried:
        groups.setdefault(other.name.partition(",")[0 if of_materials else 2], []).append(other)
    if not of_materials:
        return [group[0] for group in groups.values()][:REFINED]
    starts = [other for group in groups.values() for other in group[:SHIFTS_EACH]]
    for material, group in groups.items():  # also where the plane is: the shifts are those of a lattice
        in_place = group[0].vector.copy()
        in_place[choice.plane] = vector[choice.plane]
        starts.append(Alternative(np.nan, material, in_place))
    return starts
