"""Materials and shifts of planes by exhaustive choice, one surface after another.

Least squares start near the solution: within a quarter of a wavelength of each path's length and with roughly the right
materials. Here each surface tries every common building material, and "absent"; each plane tries shifts. A choice
is kept where it raises the likelihood by more than `GAIN`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
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
ABSENT_THICKNESS_M = 0.001
GAIN = 0.5
"""Least increase of the log-likelihood for which a choice changes."""
SWEEPS = 3
JOINT = 10
"""Number of planes whose material and shift are chosen together."""
REFINED = 8
"""Number of shifts, the best with their best materials, that are compared after least-squares steps."""
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
        deviation: standard deviation of each entry's prior about zero; infinite: alternatives are equally likely.
    """

    what: str
    places: IntArray
    values: Mapping[str, FloatArray]
    deviation: FloatArray

    @property
    def joint(self) -> bool:
        """Whether material and shift are chosen together."""
        return bool(np.isinf(self.deviation).any() and np.isfinite(self.deviation).any())

    def cost(self, vector: FloatArray) -> float:
        """Negative logarithm of the prior of a vector's values, without its constant."""
        return float(np.square(vector[self.places] / self.deviation).sum() / 2)


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
    values[ABSENT] = np.append(np.log([LEAST_SUSCEPTIBILITY, LEAST_CONDUCTIVITY, ABSENT_THICKNESS_M]), 0.0)
    first = [misfit.parts[name_of(SURFACE, quantity)].start for quantity in QUANTITIES]
    names = misfit.sides[0].slabs.names
    return [Choice(names[slab], np.add(first, slab), values, np.full(len(first), np.inf)) for slab in hit]


def shift_choices(misfit: Misfit, hit: IntArray, sd_m: float, sd_rad: float, frequency_hz: float) -> list[Choice]:
    """Choices of shifts of planes, with the tilts of the frame, within `FARTHEST` standard deviations of the prior."""
    step_m = STEP * speed_of_light / frequency_hz
    most = int(FARTHEST * sd_m / step_m)
    shifts = step_m * np.arange(-most, most + 1)
    values = {f"{1e3 * shift:+.0f} mm": np.array([shift, np.nan, np.nan]) for shift in shifts}
    shift, tilt = (misfit.parts[name].start for name in (SHIFT, TILT))
    deviation = np.array([sd_m, sd_rad, sd_rad])
    places = {plane: np.array([shift + plane, tilt + 2 * plane, tilt + 2 * plane + 1]) for plane in hit}
    return [Choice(f"plane {plane}", place, values, deviation) for plane, place in places.items()] if most else []


def joint_choices(materials: Sequence[Choice], shifts: Sequence[Choice], plane_of: Mapping[str, int]) -> list[Choice]:
    """Choices of material and shift together, for the surface with most paths of each of the first `JOINT` planes, and
    all other choices by themselves.

    At a wavelength of the size of the shifts, a wrong material makes the right shift look wrong, and conversely.
    """
    with_material = {f"plane {plane_of[one.what]}": one for one in reversed(materials)}
    pairs = [(with_material[one.what], one) for one in shifts if one.what in with_material][:JOINT]
    joined = [
        Choice(
            material.what,
            np.concatenate([material.places, shift.places]),
            {
                f"{kind}, {there}": np.concatenate([values, moved])
                for there, moved in shift.values.items()
                for kind, values in material.values.items()
            },
            np.concatenate([material.deviation, shift.deviation]),
        )
        for material, shift in pairs
    ]
    done = {one.what for pair in pairs for one in pair}
    return [*joined, *(one for one in (*shifts, *materials) if one.what not in done)]


def choose(
    misfit: Misfit,
    vector: FloatArray,
    choices: Sequence[Choice],
    expect: Callable[[FloatArray, IntArray], FloatArray],
    refine: Callable[[Misfit | PathSum, FloatArray, IntArray], FloatArray],
    on_choice: Callable[[int, int], None],
) -> tuple[FloatArray, dict[str, str]]:
    """Coordinate descent over choices, in sweeps until none changes.

    Args:
        misfit: residuals of a vector.
        vector: start [p].
        choices: choices in the order in which they are tried.
        expect: ``expect(vector, places)``: entries ``places`` by all others, in place of alternatives' NaN.
        refine: ``refine(trials, vector, places)``: the vector after some least-squares steps of the entries ``places``
            on the residuals of ``trials``.
        on_choice: called with the number of choices tried and their number.

    Returns:
        The vector, and the alternative taken by each choice that changed.
    """
    vector, taken, first = np.array(vector, float), dict[str, str](), itemgetter(0)
    for sweep in range(SWEEPS):
        trials = near(misfit, vector)
        residual, changed = trials.residual(vector), False
        noise = Noise.of(residual)
        for number, choice in enumerate(choices):
            on_choice(sweep * len(choices) + number, SWEEPS * len(choices))
            tried, expected = [], expect(vector, choice.places)
            for name, values in choice.values.items():
                there = vector.copy()
                there[choice.places] = np.where(np.isnan(values), expected, values)
                tried.append((noise.cost(trials.residual(there)) + choice.cost(there), name, there))
            if choice.joint:
                # A plane that is tilted, too, fits at the right shift only once its tilts do.
                by_shift = {
                    name.rpartition(",")[2]: (cost, name, there) for cost, name, there in sorted(tried, key=first)[::-1]
                }
                places = choice.places if trials is misfit else choice.places[np.isfinite(choice.deviation)]
                for _, name, there in sorted(by_shift.values(), key=first)[:REFINED]:
                    better = refine(trials, there, places)
                    tried.append((noise.cost(trials.residual(better)) + choice.cost(better), name, better))
            least, name, there = min(tried, key=first)
            if least < noise.cost(residual) + choice.cost(vector) - GAIN:
                taken[choice.what], vector, residual, changed = name, there, trials.residual(there), True
                if isinstance(trials, PathSum):
                    trials.accept(there)
        if not changed:
            break
    return vector, taken
