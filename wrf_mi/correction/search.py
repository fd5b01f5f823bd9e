"""Materials and shifts of planes by exhaustive choice, one surface after another.

Least squares start near the solution: within a quarter of a wavelength of each path's length and with roughly the right
materials. Here each surface tries every common building material, and "absent"; each plane tries shifts. A choice
is kept where it raises the likelihood by more than `GAIN`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.material_parameters import LEAST_CONDUCTIVITY, LEAST_SUSCEPTIBILITY, SURFACE, name_of
from ..tracing.materials import itu_constants
from ..tracing.plane_parameters import SHIFT
from .least_squares import Noise
from .misfit import Misfit

COMMON = ("concrete", "brick", "plasterboard", "ceiling_board", "wood", "chipboard", "glass", "metal")
"""Materials of ITU-R P.2040 that surfaces in buildings have; others lie between them."""
ABSENT = "absent"
"""Choice of a surface that waves do not notice."""
ABSENT_THICKNESS_M = 0.001
GAIN = 0.5
"""Least increase of the log-likelihood for which a choice changes."""
SWEEPS = 3
JOINT = 10
"""Number of planes whose material and shift are chosen together."""
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
        values: alternatives by name, values of these entries.
        deviation: standard deviation of each entry's prior about zero; infinite: alternatives are equally likely.
    """

    what: str
    places: IntArray
    values: Mapping[str, FloatArray]
    deviation: FloatArray

    def cost(self, vector: FloatArray) -> float:
        """Negative logarithm of the prior of a vector's values, without its constant."""
        return float(np.square(vector[self.places] / self.deviation).sum() / 2)


def material_choices(misfit: Misfit, hit: IntArray, frequency_hz: float) -> list[Choice]:
    """Choices of materials of the slabs ``hit``, those with most paths first."""
    known = {name: values for name, values in itu_constants(frequency_hz).items() if name in COMMON}
    values = {
        name: np.log([max(permittivity - 1, LEAST_SUSCEPTIBILITY), max(conductivity, LEAST_CONDUCTIVITY), thickness])
        for name, (permittivity, conductivity, thickness) in known.items()
    }
    values[ABSENT] = np.log([LEAST_SUSCEPTIBILITY, LEAST_CONDUCTIVITY, ABSENT_THICKNESS_M])
    first = [misfit.parts[name_of(SURFACE, q)].start for q in ("permittivity", "conductivity", "thickness")]
    names = misfit.sides[0].slabs.names
    return [Choice(names[slab], np.add(first, slab), values, np.full(3, np.inf)) for slab in hit]


def shift_choices(misfit: Misfit, hit: IntArray, sd_m: float, frequency_hz: float) -> list[Choice]:
    """Choices of shifts of the planes ``hit`` within `FARTHEST` standard deviations of the prior."""
    step_m = STEP * speed_of_light / frequency_hz
    most = int(FARTHEST * sd_m / step_m)
    shifts = step_m * np.arange(-most, most + 1)
    values = {f"{1e3 * shift:+.0f} mm": np.array([shift]) for shift in shifts}
    first = misfit.parts[SHIFT].start
    deviation = np.array([sd_m])
    return [Choice(f"plane {plane}", np.array([first + plane]), values, deviation) for plane in hit] if most else []


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
                for kind, values in material.values.items()
                for there, moved in shift.values.items()
            },
            np.concatenate([material.deviation, shift.deviation]),
        )
        for material, shift in pairs
    ]
    done = {one.what for pair in pairs for one in pair}
    return [*joined, *(one for one in (*shifts, *materials) if one.what not in done)]


def choose(
    misfit: Misfit, vector: FloatArray, choices: Sequence[Choice], on_choice: Callable[[int, int], None]
) -> tuple[FloatArray, dict[str, str]]:
    """Coordinate descent over choices, in sweeps until none changes.

    Args:
        misfit: residuals of a vector.
        vector: start [p].
        choices: choices in the order in which they are tried.
        on_choice: called with the number of choices tried and their number.

    Returns:
        The vector, and the alternative taken by each choice that changed.
    """
    vector, taken = np.array(vector, float), dict[str, str]()
    residual = misfit.residual(vector)
    for sweep in range(SWEEPS):
        noise, changed = Noise.of(residual), False
        for number, choice in enumerate(choices):
            on_choice(sweep * len(choices) + number, SWEEPS * len(choices))
            least, found = noise.cost(residual) + choice.cost(vector) - GAIN, None
            for name, values in choice.values.items():
                there = vector.copy()
                there[choice.places] = values
                tried = misfit.residual(there)
                cost = noise.cost(tried) + choice.cost(there)
                if cost < least:
                    least, found = cost, (name, there, tried)
            if found is not None:
                taken[choice.what], vector, residual = found
                changed = True
        if not changed:
            break
    return vector, taken
