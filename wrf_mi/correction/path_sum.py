"""Channels, strengths and spectra as sums over paths, for trial values of a few parameters at a time.

A channel is the sum of g exp(-j k L) over paths. A shift s and tilts t of a plane change the length L of a path that
travels along u and meets the plane at p by 2 u . n (s - t . a (p - c)), with the normal n, the axes a and the centre c:
by Fermat's principle the displacement of the plane at the point counts. A spectrum is that of such sums at an array's
elements, whose lengths are taken to change alike. A strength is the sum of abs(g)^2, which has no phase; planes are no
parameters then. Materials change g, which is traced once for each alternative of a surface, along the paths that meet
it. So a trial costs one exponential for each of these paths, and no other path is evaluated. The gain of a receiver is
a factor of its sums.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.sparse import coo_array, csr_array

from ..core.angles import FloatArray, pixel_directions
from ..core.types import SQUARED_MAGNITUDE_EPS, IntArray
from ..graph.combine import LEAST_POWER, SILENCE, ArrayReceiver, PowerReceiver
from ..graph.ports import steering
from ..tasks import task_of
from ..tracing.images import mirrored
from ..tracing.material_parameters import PREFIX
from ..tracing.plane_parameters import SHIFT, TILT

if TYPE_CHECKING:
    from .misfit import Misfit

Complex = NDArray[np.complex128]
Slopes = Callable[[Complex, IntArray], FloatArray]
"""Derivatives of reports by changes of signals, and the places of their rows among those of the reports."""
MOST_WAVES = 1 << 24
"""Most element signals of paths, of 16 bytes each, that are kept for spectra."""
STEP = 1e-4
"""Difference of a logarithm of permittivity, conductivity or thickness over which gains are compared: walls of tens of
centimetres resonate within a few per cent of their thickness."""


class PathSum:
    """Residuals of a misfit near one vector.

    Args:
        misfit: residuals that are such sums (`serves`).
        vector: vector [p] about which lengths are linear.
    """

    def __init__(self, misfit: Misfit, vector: FloatArray) -> None:
        self.misfit, self.at, self._start = misfit, np.array(vector, float), np.array(vector, float)
        self._paths, task, self._plane_places = misfit.paths, task_of(misfit.record), misfit.plane_entries
        self._mirrors = np.where(self._paths.reflects, self._paths.plane, -1)
        if len(self._plane_places):
            length, self._slope = _geometry(misfit, self._mirrors, vector)
        self._unit: Complex | None = None
        if task.in_decibel:
            self._reports: Channels = Strengths(misfit)
        elif task.image:
            hz = np.array([side.frequency_hz for side in misfit.sides])
            self._reports, self._k = Spectra(misfit), (2 * np.pi * hz / speed_of_light)[self._paths.side, None]
            self._unit = misfit.unit_signals(self.at)
        else:
            assert misfit.record.frequencies_hz is not None
            hz = np.asarray(misfit.record.frequencies_hz, float)
            self._reports, self._k = Channels(), 2 * np.pi * hz[None] / speed_of_light
            self._unit = np.exp(-1j * length[:, None] * self._k)
        self._gains: dict[tuple[bytes, bytes], Complex] = {}
        self._touched: dict[tuple[bytes, bytes], tuple[IntArray, IntArray]] = {}
        self._phase: tuple[tuple[bytes, ...], Complex] = (), np.zeros((0, 0), complex)
        count = len(misfit.planes)
        self._plane_of = np.concatenate([np.arange(count), np.repeat(np.arange(count), 2)])[: len(self._plane_places)]
        material = [part for name, part in misfit.parts.items() if name.startswith(PREFIX)]
        places = np.array([np.arange(part.start, part.stop) for part in material], np.int64)
        self._material = places.reshape(len(material), len(misfit.sides[0].slabs.names))
        self._factors = [
            (misfit.parts[side.gain_name], places)
            for side, places in zip(misfit.sides, misfit.places, strict=True)
            if side.gain_name in misfit.parts
        ]
        every = np.arange(len(self._paths.row))
        self._gain = self.misfit.gains(self.at, every)
        self._waves = self._waves_of(every, self._gain, np.zeros(len(self._plane_places)), ())
        self._total = self._sums(self._waves, every)
        self._residual = self._residual_of(self._total * self._factor(self.at), np.arange(len(misfit.observed)))

    @staticmethod
    def serves(misfit: Misfit) -> bool:
        """Whether a misfit is of channels or spectra by materials, planes and gains, or of strengths by materials and
        gains.
        """
        record, task, gains = misfit.record, task_of(misfit.record), {side.gain_name for side in misfit.sides}
        carriers = len(misfit.sides) // len(misfit.receivers)
        known = set() if task.in_decibel else {SHIFT, TILT}
        others = {name for name in misfit.parts if not name.startswith((PREFIX, "receiver."))} - known
        devices = {name for name in misfit.parts if name.startswith("receiver.") and not name.endswith(".gain")}
        if others or devices or len(gains) * carriers < len(misfit.sides):
            return False
        if task.in_decibel:
            powers = (isinstance(model, PowerReceiver) and not model.interference for model in misfit.models)
            return all(powers)
        if task.image:
            arrays = [m for m in misfit.models if isinstance(m, ArrayReceiver) and m.instrument_scale]
            sizes, count = {len(m.elements_m) for m in arrays}, len(misfit.paths.row)
            return len(arrays) == len(misfit.models) and len(sizes) == 1 and max(sizes) * count <= MOST_WAVES
        channels = task.is_complex and record.observation.ndim == 3
        return channels and SHIFT in misfit.parts and carriers == 1

    def residual(self, vector: FloatArray) -> FloatArray:
        """Residuals as `Misfit.residual`, lengths linear in planes, gains at the angles of the first vector.

        Reports of rows without a changed path or gain are kept.
        """
        touched, rows, waves = self._changed(vector)
        total = self._total + self._sums(waves - self._waves[touched], touched)
        factor = self._factor(vector)
        rows = np.union1d(rows, np.flatnonzero((factor != self._factor(self.at))[:, 0]))
        residual = self._residual.copy()
        residual[rows] = self._residual_of((total * factor)[rows], rows)
        return residual

    def _residual_of(self, signal: Complex, rows: IntArray) -> FloatArray:
        return self._reports.report(signal, rows) / self.misfit.unit[rows, None] - self.misfit.observed[rows]

    def jacobian(self, vector: FloatArray, columns: IntArray) -> NDArray[np.float32]:
        """Derivatives of `residual` [columns, rows, values], 0 where nothing was received; those by materials are
        differences over `STEP`.
        """
        touched, _, waves = self._changed(vector)
        present = self._waves.copy()
        present[touched] = waves
        total = self._total + self._sums(waves - self._waves[touched], touched)
        receiver = {part.start + k: (k, places) for part, places in self._factors for k in range(2)}
        changes = list[tuple[IntArray, Complex]]()
        for column in columns:
            if column in receiver:
                imaginary, rows = receiver[column]
                by_gain = (1j if imaginary else 1) if self._unit is not None else (0 if imaginary else 2)
                changes.append((rows, by_gain * total[rows]))
            elif column in self._plane_places:
                slope = self._slope[:, [np.flatnonzero(self._plane_places == column)[0]]].toarray()[:, 0]
                moved = np.flatnonzero(slope)
                rows = np.unique(self._paths.row[moved])
                change = present[moved] * (-1j * slope[moved, None] * self._wavenumber(moved))
                changes.append((rows, self._sums(change, moved)[rows]))
            else:
                there = vector.copy()
                there[column] += STEP
                moved, rows, waves = self._changed(there)
                # Parameters are rounded to single precision, gains are not.
                step = float(np.float32(there[column])) - float(np.float32(vector[column]))
                changes.append((rows, self._sums((waves - present[moved]) / step, moved)[rows]))
        every = np.unique(np.concatenate([np.zeros(0, np.int64), *(rows for rows, _ in changes)]))
        factor = self._factor(vector)
        slopes = self._reports.slopes((total * factor)[every], every)
        result = np.zeros((len(columns), *self.misfit.observed.shape), np.float32)
        for by_column, (rows, change) in zip(result, changes, strict=True):
            of_signal = slopes(change * factor[rows], np.searchsorted(every, rows))
            by_column[rows] = of_signal / self.misfit.unit[rows, None]
        result[:, ~np.isfinite(self.misfit.observed).all(axis=1)] = 0
        return result

    def accept(self, vector: FloatArray) -> None:
        """Take a vector as the present one."""
        residual = self.residual(vector)
        touched, _, waves = self._changed(vector)
        self._gain[touched] = self._gain_at(vector, touched)
        self._total = self._total + self._sums(waves - self._waves[touched], touched)
        self._waves[touched] = waves
        self.at, self._residual = np.array(vector, float), residual
        self._gains.clear()

    def _factor(self, vector: FloatArray) -> Complex:
        """Gains of the receivers relative to the first vector's, or their squared magnitudes for powers, [rows, 1]."""
        factor = np.ones((len(self.misfit.observed), 1), complex)
        for part, places in self._factors:
            amplitude, phase = (vector - self._start)[part]
            factor[places] = np.exp(2 * amplitude if self._unit is None else amplitude + 1j * phase)
        return factor

    def _sums(self, waves: Complex, which: IntArray) -> Complex:
        """Sums [rows, frequencies or elements] of waves of some paths, in their order; of powers [rows, 1]."""
        total = np.zeros((len(self.misfit.observed), waves.shape[1]), complex)
        if len(which):
            row = self._paths.row[which]
            first = np.flatnonzero(np.diff(row, prepend=-1))
            total[row[first]] = np.add.reduceat(waves, first, axis=0)
        return total

    def _changed(self, vector: FloatArray) -> tuple[IntArray, IntArray, Complex]:
        """Paths that meet a changed plane or surface, their rows, and their waves."""
        differs = vector != self.at
        planes = np.unique(self._plane_of[differs[self._plane_places]])
        slabs = np.flatnonzero(differs[self._material].any(axis=0))
        key = planes.tobytes(), slabs.tobytes()
        if key not in self._touched:
            met = np.flatnonzero(
                np.isin(self._mirrors, planes).any(axis=1) | np.isin(self._paths.slab, slabs).any(axis=1)
            )
            self._touched[key] = met, np.unique(self._paths.row[met])
        touched, rows = self._touched[key]
        shifts = (vector - self._start)[self._plane_places]
        return touched, rows, self._waves_of(touched, self._gain_at(vector, touched), shifts, key)

    def _wavenumber(self, which: IntArray) -> FloatArray:
        """Wavenumbers of some paths, [paths or 1, frequencies or 1]."""
        return self._k if len(self._k) == 1 else self._k[which]

    def _waves_of(self, which: IntArray, gain: Complex, shifts: FloatArray, key: tuple[bytes, ...]) -> Complex:
        """Waves [paths, frequencies or elements] of some paths, which ``key`` identifies, or powers [paths, 1]."""
        if self._unit is None:
            return (np.abs(gain[:, None]) ** 2).astype(complex)
        name = (*key, shifts.tobytes())
        if self._phase[0] != name:  # kept for the next call
            unit = self._unit[which]
            if shifts.any():
                unit = unit * np.exp(-1j * (self._slope[which] @ shifts)[:, None] * self._wavenumber(which))
            self._phase = name, unit
        return gain[:, None] * self._phase[1]

    def _gain_at(self, vector: FloatArray, touched: IntArray) -> Complex:
        materials = self._material.ravel()
        if not (vector != self.at)[materials].any():
            return self._gain[touched]
        there = self._start.copy()  # angles of all gains are those of the first vector
        there[materials] = vector[materials]
        key = touched.tobytes(), there[materials].tobytes()
        if key not in self._gains:
            self._gains[key] = self.misfit.gains(there, touched)
        return self._gains[key]


def near(misfit: Misfit, vector: FloatArray) -> Misfit | PathSum:
    """What gives residuals and derivatives near a vector fastest: a sum over paths where one serves."""
    return PathSum(misfit, vector) if PathSum.serves(misfit) else misfit


def _geometry(misfit: Misfit, mirrors: IntArray, vector: FloatArray) -> tuple[FloatArray, csr_array]:
    """Lengths [n] of all paths, and their derivatives by shifts, then tilts, of the q planes [n, 3 q].

    ``mirrors``: plane that reflects each path at each interaction [n, depth], -1 for none.
    """
    surfaces, chosen, count = misfit.sides[0].surfaces, misfit.planes, len(misfit.planes)
    axes, centre = surfaces.axes[chosen], surfaces.plane_centres_m[chosen]
    shift, tilt = (vector[misfit.parts[name]] for name in (SHIFT, TILT))
    normal, offset = surfaces.moved_planes(shift, tilt.reshape(count, 2), chosen)
    sources = [np.stack([np.asarray(c) for c in side.chains.source_m], axis=-1) for side in misfit.sides]
    first = np.cumsum([0, *map(len, sources[:-1])])
    point = np.concatenate(sources)[first[misfit.paths.side] + misfit.paths.entry]
    image = np.array([side.receiver.position_m for side in misfit.sides], float)[misfit.paths.side]
    for at in mirrors.T[::-1]:
        row = np.flatnonzero(at >= 0)
        image[row] = mirrored(image[row], normal[at[row]], offset[at[row]])
    length = np.linalg.norm(image - point, axis=1)
    way, none = (image - point) / length[:, None], np.zeros(0, np.int64)
    slopes = [(none, none, np.zeros(0))]  # sparse: a path meets few planes
    for at in mirrors.T:
        row = np.flatnonzero(at >= 0)
        q, n = at[row], normal[at[row]]
        along = (way[row] * n).sum(axis=1)
        point[row] += way[row] * ((offset[q] - (point[row] * n).sum(axis=1)) / along)[:, None]
        flat = np.einsum("nad,nd->na", axes[q], point[row] - centre[q])
        slopes.append((row, q, 2 * along))
        slopes += [(row, count + 2 * q + axis, -2 * along * flat[:, axis]) for axis in range(2)]
        way[row] = mirrored(way[row], n)
    rows, columns, values = (np.concatenate(each) for each in zip(*slopes, strict=True))
    # Slopes of a plane that reflects a path twice are added.
    return length, coo_array((values, (rows, columns)), (len(point), 3 * count)).tocsr()


class Channels:
    """Reports of signals [n, values] of some rows [n], in ascending order: sums of waves or of powers, times gains.

    Here channels of a single antenna, real and imaginary part in turn.
    """

    def report(self, signal: Complex, rows: IntArray) -> FloatArray:
        """Reports [n, values] as those of `Misfit`, before the unit of each row."""
        return np.ascontiguousarray(signal).view(float)

    def slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivative of `report` by the signals."""
        return lambda change, which: self.report(change, rows[which])


class Strengths(Channels):
    """Powers in dB, as `wrf_mi.graph.combine.PowerReceiver` reports them."""

    def __init__(self, misfit: Misfit) -> None:
        self._floor = np.full((len(misfit.observed), 1), np.nan)
        for model, places in zip(misfit.models, misfit.places, strict=True):
            assert isinstance(model, PowerReceiver)
            self._floor[places] = model.floor

    def report(self, signal: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Channels`."""
        power = signal.real + LEAST_POWER
        return 10 * np.log10(np.where(power > SILENCE, power + LEAST_POWER, self._floor[rows]))

    def slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Channels`."""
        power = signal.real + LEAST_POWER
        weight = np.where(power > SILENCE, 10 / np.log(10) / (power + LEAST_POWER), 0)
        return lambda change, which: weight[which] * change.real


class Spectra(Channels):
    """Bartlett spectra of element signals, scaled as `wrf_mi.graph.combine.ArrayReceiver.instrument_scale` does."""

    def __init__(self, misfit: Misfit) -> None:
        self._matrices = list[NDArray[np.complex64]]()
        self._side = np.zeros(len(misfit.observed), np.int64)
        for side, (model, places) in enumerate(zip(misfit.models, misfit.places, strict=True)):
            assert isinstance(model, ArrayReceiver)
            directions = pixel_directions(model.height, model.width).reshape(-1, 3)
            matrix = steering(model.elements_m, directions, model.frequency_hz).values
            self._matrices.append(matrix.astype(np.complex64))
            self._side[places] = side

    def report(self, signal: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Channels`."""
        return np.asarray(_scaled(_magnitude(self._images(signal, rows)))[0], float)

    def slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Channels`."""
        image = self._images(signal, rows)
        spectrum = _magnitude(image)
        share, low, high, inverse = _scaled(spectrum)
        weight = image.conj() / spectrum

        def slope(change: Complex, which: IntArray) -> FloatArray:
            by_pixel = (weight[which] * self._images(change, rows[which])).real
            least, most = (np.take_along_axis(by_pixel, end[which], axis=1) for end in (low, high))
            return np.asarray((by_pixel - least - share[which] * (most - least)) * inverse[which], float)

        return slope

    def _images(self, signal: Complex, rows: IntArray) -> NDArray[np.complex64]:
        """Element signals of some rows in all directions, complex."""
        side, single = self._side[rows], signal.astype(np.complex64)
        if len(self._matrices) == 1:
            return single @ self._matrices[0]
        images = np.empty((len(rows), self._matrices[0].shape[1]), np.complex64)
        for number in np.unique(side):
            images[side == number] = single[side == number] @ self._matrices[number]
        return images


def _scaled(spectrum: NDArray[np.float32]) -> tuple[NDArray[np.float32], IntArray, IntArray, NDArray[np.float32]]:
    """Rows scaled to 0..1, places of their least and largest values [n, 1], and the factor by which they are scaled."""
    low, high = spectrum.argmin(axis=1)[:, None], spectrum.argmax(axis=1)[:, None]
    least = np.take_along_axis(spectrum, low, axis=1)
    span = np.take_along_axis(spectrum, high, axis=1) - least
    inverse = np.divide(1, span, out=np.zeros_like(span), where=span > 0)
    return (spectrum - least) * inverse, low, high, inverse


def _magnitude(image: NDArray[np.complex64]) -> NDArray[np.float32]:
    return np.sqrt(np.square(image.real) + np.square(image.imag) + np.float32(SQUARED_MAGNITUDE_EPS))
