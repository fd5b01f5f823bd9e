"""Materials and shifts of planes by exhaustive choice, one surface after another.

Least squares start near the solution: within a quarter of a wavelength of each path's length and with roughly the right
materials. Here each surface tries every common building material, and "absent"; each plane tries shifts. A choice
is kept where it raises the likelihood by more than `GAIN`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.material_parameters import (
    EXPONENT,
    LEAST_CONDUCTIVITY,
    LEAST_SUSCEPTIBILITY,
    SURFACE,
    name_of,
)
from ..tracing.materials import itu_constants, itu_exponent
from ..tracing.plane_parameters import SHIFT, TILT
from .least_squares import Noise
from .misfit import Misfit
from .path_sum import PathSum, near

COMMON = ("concrete", "brick", "plasterboard", "ceiling_board", "wood", "chipboard", "glass", "metal")
"""Materials of ITU-R P.2040 that surfaces in buildings have; others lie between them."""
CONSTANTS = ("permittivity", "conductivity", "thickness")
QUANTITIES = (*CONSTANTS, EXPONENT)
"""Parameters of a surface's material, in the order of a choice's values."""
ABSENT = "absent"
"""Choice of a surface that waves do not notice."""
ABSENT_VALUES = np.append(np.log([LEAST_SUSCEPTIBILITY, LEAST_CONDUCTIVITY, 0.001]), 0.0)
"""Its entries of the vector, in the order of `QUANTITIES`; 1 mm of almost nothing."""
GAIN = 0.5
"""Least increase of the log-likelihood for which a choice changes."""
SWEEPS = 3
JOINT = 10
"""Number of planes whose material and shift are chosen together."""
REFINED = 8
"""Number of shifts, the best with their best materials, that are compared after least-squares steps."""
SHIFTS_EACH = 3
"""Number of shifts of each material that are compared so, where materials are in doubt."""
STEP = 1 / 16
"""Step of the shifts, wavelengths: paths change by up to an eighth."""
FARTHEST = 2.0
"""Largest shift tried, in standard deviations of the prior."""


@dataclass(frozen=True)
class Choice:
    """Alternatives of one surface or plane.

    Attributes:
        what: name for reports.
        places: entries of the vector that it has.
        values: alternatives by name, values of these entries; NaN: as the other planes let expect.
        of_plane: whether each entry is of a plane, not of a material.
    """

    what: str
    places: IntArray
    values: Mapping[str, FloatArray]
    of_plane: NDArray[np.bool_]

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


def material_choices(misfit: Misfit, hit: IntArray, frequency_hz: float) -> list[Choice]:
    """Choices of materials of the slabs ``hit``, those with most paths first."""
    known = {name: values for name, values in itu_constants(frequency_hz).items() if name in COMMON}
    values = {
        name: np.append(
            np.log([max(permittivity - 1, LEAST_SUSCEPTIBILITY), max(conductivity, LEAST_CONDUCTIVITY), thickness]),
            itu_exponent(name, frequency_hz),
        )
        for name, (permittivity, conductivity, thickness) in known.items()
    }
    values[ABSENT] = ABSENT_VALUES
    names, of_plane = misfit.sides[0].slabs.names, np.zeros(len(QUANTITIES), bool)
    return [Choice(names[slab], material_places(misfit, slab), values, of_plane) for slab in hit]


def material_places(misfit: Misfit, slab: int) -> IntArray:
    """Entries of the vector that the material of a slab has, in the order of `QUANTITIES`."""
    return np.array([misfit.parts[name_of(SURFACE, quantity)].start + slab for quantity in QUANTITIES])


def shift_choices(misfit: Misfit, hit: IntArray, sd_m: float, frequency_hz: float) -> list[Choice]:
    """Choices of shifts of planes, with the tilts of the frame, within `FARTHEST` standard deviations of the prior."""
    step_m = STEP * speed_of_light / frequency_hz
    most = int(FARTHEST * sd_m / step_m)
    shifts = step_m * np.arange(-most, most + 1)
    values = {f"{1e3 * shift:+.0f} mm": np.array([shift, np.nan, np.nan]) for shift in shifts}
    shift, tilt = (misfit.parts[name].start for name in (SHIFT, TILT))
    places = {plane: np.array([shift + plane, tilt + 2 * plane, tilt + 2 * plane + 1]) for plane in hit}
    of_plane, names = np.ones(3, bool), [f"plane {number}" for number in misfit.planes]
    return [Choice(names[plane], place, values, of_plane) for plane, place in places.items()] if most else []


def joint_choices(
    materials: Sequence[Choice], shifts: Sequence[Choice], plane_of: Mapping[str, int], supposed: Collection[str]
) -> list[Choice]:
    """Choices of material and shift together, for the surface with most paths of each of the first `JOINT` planes and
    for supposed faces, and all other choices by themselves.

    At a wavelength of the size of the shifts, a wrong material makes the right shift look wrong, and conversely.
    """
    with_material = {f"plane {plane_of[one.what]}": one for one in reversed(materials)}
    every = [(with_material[one.what], one) for one in shifts if one.what in with_material]
    pairs = [pair for place, pair in enumerate(every) if place < JOINT or pair[0].what in supposed]
    joined = [
        Choice(
            material.what,
            np.concatenate([material.places, shift.places]),
            {
                f"{kind}, {there}": np.concatenate([values, moved])
                for there, moved in shift.values.items()
                for kind, values in material.values.items()
            },
            np.concatenate([material.of_plane, shift.of_plane]),
        )
        for material, shift in pairs
    ]
    done = {one.what for pair in pairs for one in pair}
    return [*joined, *(one for one in (*shifts, *materials) if one.what not in done)]


class Rules(Protocol):
    """What is known of a vector apart from observations."""

    misfit: Misfit

    def planes_cost(self, vector: FloatArray) -> float:
        """Negative logarithm of the planes' prior, without its constant."""

    def expected(self, vector: FloatArray, places: IntArray) -> FloatArray:
        """Entries ``places`` by all others, in place of alternatives' NaN."""

    def refined(self, trials: Misfit | PathSum, vector: FloatArray, places: IntArray) -> FloatArray:
        """The vector after some least-squares steps of the entries ``places`` on the residuals of ``trials``."""


def choose(
    rules: Rules,
    vector: FloatArray,
    choices: Sequence[Choice],
    on_choice: Callable[[int, int], None],
) -> tuple[FloatArray, dict[str, str]]:
    """Coordinate descent over choices, in sweeps until none changes.

    Args:
        rules: residuals and prior of a vector.
        vector: start [p].
        choices: choices in the order in which they are tried.
        on_choice: called with the number of choices tried and their number.

    Returns:
        The vector, and the material or shift taken by each choice that changed.
    """
    vector, taken = np.array(vector, float), dict[str, str]()
    for sweep in range(SWEEPS):
        trials = near(rules.misfit, vector)
        noise, changed = Noise.of(trials.residual(vector)), False
        for number, choice in enumerate(choices):
            on_choice(sweep * len(choices) + number, SWEEPS * len(choices))
            least, name, there = alternatives(rules, trials, noise, choice, vector)[0]
            if least < cost(rules, trials, noise, vector) - GAIN:
                taken[choice.what], vector, changed = name.partition(",")[0], there, True
                if isinstance(trials, PathSum):
                    trials.accept(there)
        if not changed:
            break
    return vector, taken


def cost(rules: Rules, trials: Misfit | PathSum, noise: Noise, vector: FloatArray) -> float:
    """Negative logarithm of the likelihood of a vector and of the planes' prior, without its constant."""
    return noise.cost(trials.residual(vector)) + rules.planes_cost(vector)


def alternatives(
    rules: Rules,
    trials: Misfit | PathSum,
    noise: Noise,
    choice: Choice,
    vector: FloatArray,
    of_materials: bool = False,
) -> list[tuple[float, str, FloatArray]]:
    """Alternatives of a choice, those with the least cost first: cost, name and vector.

    Of a material and a shift together, the best of some shifts, or with ``of_materials`` those of each material and the
    plane where it is, are compared after least squares, too.
    """
    tried, expected = list[tuple[float, str, FloatArray]](), rules.expected(vector, choice.places)
    for name, values in choice.values.items():
        there = vector.copy()
        there[choice.places] = np.where(np.isnan(values), expected, values)
        tried.append((cost(rules, trials, noise, there), name, there))
    tried.sort(key=itemgetter(0))
    if choice.joint:
        # A plane that is tilted, too, fits at the right shift only once its tilts do.
        kind, each, most = (0, SHIFTS_EACH, len(tried)) if of_materials else (2, 1, REFINED)
        count, few = Counter[str](), list[tuple[str, FloatArray]]()
        for _, name, there in tried:
            key = name.partition(",")[kind]
            if count[key] < each and len(few) < most:
                count[key] += 1
                few.append((name, there))
        if of_materials:  # also where the plane is, as the shifts above are those of a lattice
            for name in count:
                there = next(there for other, there in few if other.partition(",")[0] == name).copy()
                there[choice.plane] = vector[choice.plane]
                few.append((name, there))
        places = choice.places if trials is rules.misfit else choice.plane
        for name, there in few:
            better = rules.refined(trials, there, places)
            tried.append((cost(rules, trials, noise, better), name, better))
    return sorted(tried, key=itemgetter(0))
