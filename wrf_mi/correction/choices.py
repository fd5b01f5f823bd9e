"""Alternatives of surfaces and planes: common building materials, absence, and shifts on a lattice.

Least squares start near the solution: within a quarter of a wavelength of each path's length and with roughly the right
materials. `wrf_mi.correction.moves` tries these alternatives.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.paths.material_parameters import LEAST_CONDUCTIVITY, LEAST_SUSCEPTIBILITY, QUANTITIES, SURFACE, name_of
from ..tracing.paths.plane_parameters import SHIFT, TILT
from ..tracing.sionna.materials import itu_constants, itu_exponent
from .misfit import Misfit

COMMON = ("concrete", "brick", "plasterboard", "ceiling_board", "wood", "chipboard", "glass", "metal")
"""Materials of ITU-R P.2040 that surfaces in buildings have; others lie between them."""
ABSENT = "absent"
"""Choice of a surface that waves do not notice."""
ABSENT_VALUES = np.append(np.log([LEAST_SUSCEPTIBILITY, LEAST_CONDUCTIVITY, 0.001]), 0.0)
"""Its entries of the vector, in the order of `QUANTITIES`; 1 mm of almost nothing."""
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

    @property
    def shifts(self) -> Choice:
        """The shifts of a joint choice, for any material."""
        values = {name.partition(", ")[2]: values[self.of_plane] for name, values in self.values.items()}
        return replace(self, places=self.plane, values=values, of_plane=self.of_plane[self.of_plane])


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


def joint_choices(materials: Sequence[Choice], shifts: Sequence[Choice], supposed: Collection[str]) -> list[Choice]:
    """Choices of material and shift together, for the surface with most paths of each of the first `JOINT` planes and
    for supposed faces, and all other choices by themselves.

    At a wavelength of the size of the shifts, a wrong material makes the right shift look wrong, and conversely.
    """
    with_material = {f"plane {one.what.rpartition('/')[2]}": one for one in reversed(materials)}
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
