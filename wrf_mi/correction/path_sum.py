"""Channels of single antennas as sums over paths, for trial values of a few parameters at a time.

A channel is the sum of g exp(-j k L) over paths. A shift s and tilts t of a plane change the length L of a path that
travels along u and meets the plane at p by 2 u . n (s - t . a (p - c)), with the normal n, the axes a and the centre c:
by Fermat's principle the displacement of the plane at the point counts. Materials change g, which is traced once for
each alternative of a surface. So a trial costs one exponential for each path that meets the plane, and no trace.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import task_of
from ..tracing.image_method import mirrored
from ..tracing.material_parameters import PREFIX
from ..tracing.plane_parameters import SHIFT, TILT
from ..tracing.walls import moved_planes, plane_centres

if TYPE_CHECKING:
    from .misfit import Misfit

Complex = NDArray[np.complex128]
STEP = 3e-3
"""Difference of a logarithm of permittivity, conductivity or thickness over which gains are compared: 0.3 %, where
rounding to single precision is below 1e-3 of it."""


class PathSum:
    """Residuals of a misfit near one vector.

    Args:
        misfit: residuals of channels of single antennas; only materials and planes are parameters (`serves`).
        vector: vector [p] about which lengths are linear.
    """

    def __init__(self, misfit: Misfit, vector: FloatArray) -> None:
        self.misfit, self.at = misfit, np.array(vector, float)
        hz = misfit.record.frequencies_hz
        assert hz is not None
        self._k = 2 * np.pi * np.asarray(hz, float) / speed_of_light
        sides = [_geometry(misfit, number, vector) for number in range(len(misfit.sides))]
        joined = (np.concatenate(each) for each in zip(*sides, strict=True))
        self._length, self.slope, self._planes, self._slabs, self._row = joined
        self._gains: dict[bytes, Complex] = {}
        self._touched: dict[tuple[bytes, bytes], IntArray] = {}
        self._phase: tuple[tuple[bytes, ...], Complex] = (), np.zeros((0, 0), complex)
        count = len(misfit.sides[0].surfaces.normal)
        self._plane_places = misfit.plane_entries
        self._plane_of = np.concatenate([np.arange(count), np.repeat(np.arange(count), 2)])
        material = [part for name, part in misfit.parts.items() if name.startswith(PREFIX)]
        self._material = np.array([np.arange(part.start, part.stop) for part in material]).reshape(len(material), -1)
        self._start = self.at.copy()
        self._gain = self.misfit.gains(self.at)
        self._waves = self._gain[:, None] * np.exp(-1j * self._length[:, None] * self._k)
        self._total = self._sums(self._waves, np.arange(len(self._row)))

    @staticmethod
    def serves(misfit: Misfit) -> bool:
        """Whether a misfit is of channels of single antennas, with materials and planes as its only parameters."""
        known = all(name in (SHIFT, TILT) or name.startswith(PREFIX) for name in misfit.parts)
        record = misfit.record
        return known and SHIFT in misfit.parts and task_of(record).is_complex and record.observation.ndim == 3

    def residual(self, vector: FloatArray) -> FloatArray:
        """Residuals as `Misfit.residual`, lengths linear in planes, gains at the angles of the first vector."""
        touched, waves = self._changed(vector)
        return self._residual(self._total + self._sums(waves - self._waves[touched], touched))

    def jacobian(
        self, vector: FloatArray, columns: IntArray, on_column: Callable[[int], None] = lambda place: None
    ) -> NDArray[np.float32]:
        """Derivatives of `residual`, 0 where nothing was received; those by materials are differences over `STEP`."""
        touched, waves = self._changed(vector)
        present = self._waves.copy()
        present[touched] = waves
        slopes = np.zeros((*self.misfit.observed.shape, len(columns)), np.float32)
        for number, column in enumerate(columns):
            if column in self._plane_places:
                slope = self.slope[:, np.flatnonzero(self._plane_places == column)[0]]
                moved = np.flatnonzero(slope)
                change = present[moved] * (-1j * slope[moved, None] * self._k)
            else:
                there = vector.copy()
                there[column] += STEP
                moved, waves = self._changed(there)
                change = (waves - present[moved]) / STEP
            slopes[..., number] = _pairs(self._sums(change, moved))
            on_column(number)
        slopes /= self.misfit.unit[:, None, None]
        slopes[~np.isfinite(self.misfit.observed).all(axis=1)] = 0
        return slopes

    def accept(self, vector: FloatArray) -> None:
        """Take a vector as the present one."""
        touched, waves = self._changed(vector)
        self._gain[touched] = self._gain_at(vector, touched)
        self._total = self._total + self._sums(waves - self._waves[touched], touched)
        self._waves[touched] = waves
        self.at = np.array(vector, float)
        self._gains.clear()

    def _residual(self, channel: Complex) -> FloatArray:
        return _pairs(channel) / self.misfit.unit[:, None] - self.misfit.observed

    def _sums(self, waves: Complex, which: IntArray) -> Complex:
        """Sums [rows, frequencies] of waves of some paths."""
        total = np.zeros((len(self.misfit.observed), len(self._k)), complex)
        if len(which):
            row = self._row[which]
            first = np.flatnonzero(np.diff(row, prepend=-1))
            total[row[first]] = np.add.reduceat(waves, first, axis=0)
        return total

    def _changed(self, vector: FloatArray) -> tuple[IntArray, Complex]:
        """Paths that meet a changed plane or surface, and their waves."""
        differs = vector != self.at
        planes = np.unique(self._plane_of[differs[self._plane_places]])
        slabs = np.flatnonzero(differs[self._material].any(axis=0))
        key = planes.tobytes(), slabs.tobytes()
        if key not in self._touched:
            met = np.isin(self._planes, planes).any(axis=1) | np.isin(self._slabs, slabs).any(axis=1)
            self._touched[key] = np.flatnonzero(met)
        touched = self._touched[key]
        shifts = (vector - self._start)[self._plane_places]
        name = (*key, shifts.tobytes())
        if self._phase[0] != name:
            length = self._length[touched] + self.slope[touched] @ shifts
            self._phase = name, np.exp(-1j * length[:, None] * self._k)
        return touched, self._gain_at(vector, touched)[:, None] * self._phase[1]

    def _gain_at(self, vector: FloatArray, touched: IntArray) -> Complex:
        materials = self._material.ravel()
        if not (vector != self.at)[materials].any():
            return self._gain[touched]
        there = self._start.copy()  # angles of all gains are those of the first vector
        there[materials] = vector[materials]
        key = there[materials].tobytes()
        if key not in self._gains:
            self._gains[key] = self.misfit.gains(there)
        return self._gains[key][touched]


def near(misfit: Misfit, vector: FloatArray) -> Misfit | PathSum:
    """What gives residuals and derivatives near a vector fastest: a sum over paths where one serves."""
    return PathSum(misfit, vector) if PathSum.serves(misfit) else misfit


def _pairs(channel: Complex) -> FloatArray:
    """Real and imaginary parts in turn."""
    return np.ascontiguousarray(channel).view(float)


def _geometry(
    misfit: Misfit, number: int, vector: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray, IntArray, IntArray]:
    """Paths of one receiver.

    Returns:
        Lengths [n], their derivatives by shifts, then tilts [n, 3 q], reflecting planes and slabs met at each
        interaction [n, depth], -1 for none, and rows of `Misfit.residual` [n].
    """
    side, receiver = misfit.sides[number], misfit.receivers[number]
    surfaces, count, exists = side.surfaces, len(side.surfaces.normal), np.flatnonzero(side.exists)
    centre = plane_centres(surfaces)[0]
    shift, tilt = (vector[misfit.parts[name]] for name in (SHIFT, TILT))
    change = np.column_stack([shift, tilt.reshape(count, 2)])
    normal, offset = moved_planes(surfaces.normal, surfaces.axes, centre, change)

    def taken(values: Any) -> NDArray[Any]:
        return np.asarray(values)[exists]

    plane, slab = list[IntArray](), list[IntArray]()
    for level in side.chains.levels:
        reflects, passes = taken(level.reflects), taken(level.transmits)
        plane.append(np.where(reflects, taken(level.plane).astype(np.int64), -1))
        slab.append(np.where(reflects | passes, taken(level.material).astype(np.int64), -1))
    point = np.stack([taken(c) for c in side.chains.source_m], axis=-1)
    image = np.repeat(np.asarray(receiver.position_m, float)[None], len(point), axis=0)
    for at in plane[::-1]:
        row = np.flatnonzero(at >= 0)
        image[row] = mirrored(image[row], normal[at[row]], offset[at[row]])
    length = np.linalg.norm(image - point, axis=1)
    way, slope = (image - point) / length[:, None], np.zeros((len(point), 3 * count))
    for at in plane:
        row = np.flatnonzero(at >= 0)
        q, n = at[row], normal[at[row]]
        along = (way[row] * n).sum(axis=1)
        point[row] += way[row] * ((offset[q] - (point[row] * n).sum(axis=1)) / along)[:, None]
        flat = np.einsum("nad,nd->na", surfaces.axes[q], point[row] - centre[q])
        slope[row, q] += 2 * along
        for axis in range(2):
            slope[row, count + 2 * q + axis] -= 2 * along * flat[:, axis]
        way[row] = mirrored(way[row], n)
    each = len(side.exists) // len(misfit.rows)
    empty = np.zeros((len(point), 0), np.int64)
    planes, slabs = (np.column_stack([empty, *columns]) for columns in (plane, slab))
    return length, slope, planes, slabs, exists // each + number * len(misfit.rows)
