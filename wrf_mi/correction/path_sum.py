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

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.sparse import csr_array

from ..core.types import FloatArray, IntArray
from ..parallel.threads import on_threads, processors
from ..receivers.registry import ComplexArray as Complex
from ..receivers.registry import Slopes, Sums
from ..tracing.paths.scene_parameters import PREFIX, SHIFT, TILT
from .least_squares import Derivatives, Jacobian, Residuals
from .path_lengths import lengths_and_slopes

if TYPE_CHECKING:
    from .misfit import Misfit

MOST_WAVES = 1 << 24  # most element signals of paths, of 16 bytes each, that are kept for spectra
TOGETHER = 512  # rows, over all vectors, of which trials are computed at once: their spectra fit into a cache
MOST_KEPT = 256  # sets of paths that are kept for trials: each takes up to a megabyte
STEP = 1e-4
"""Difference of a logarithm of permittivity, conductivity or thickness over which gains are compared: walls of tens of
centimetres resonate within a few per cent of their thickness."""


@dataclass(frozen=True, eq=False)
class _Touched:
    """The n paths that meet one of some planes and surfaces, in the order of `wrf_mi.correction.misfit.PathTable`."""

    key: bytes  # identifies the planes and surfaces
    paths: IntArray  # numbers of the paths [n]
    rows: IntArray  # their rows, each once and in the order of the paths [k]
    adding: csr_array  # sums over the paths of each row [k, n]
    slope: csr_array  # derivatives of their lengths by shifts and tilts [n, 3 q]

    def sums(self, waves: Complex) -> Complex:
        """Sums [k, ...] of waves [n, ...] over the paths of each row."""
        # Products of real matrices take a third of the time of `numpy.add.reduceat`.
        flat = np.ascontiguousarray(waves).reshape(len(waves), int(np.prod(waves.shape[1:]))).view(float)
        return np.asarray(self.adding @ flat).view(complex).reshape(-1, *waves.shape[1:])


def _follows(name: str, moving: bool) -> bool:
    # Constants of materials, gains of receivers, and, where planes may be ``moving``, their shifts and tilts.
    is_gain = name.startswith("receiver.") and name.endswith(".gain")
    return name.startswith(PREFIX) or is_gain or (moving and name in (SHIFT, TILT))


def _serves_observations(misfit: Misfit, carriers: int) -> bool:
    sums = sums_of(misfit)
    if sums == "elements":
        # Element signals of all paths, of arrays of one size.
        sizes = {len(port.model.elements_m) for port in misfit.ports}
        return 0 not in sizes and len(sizes) == 1 and max(sizes) * len(misfit.paths.row) <= MOST_WAVES
    return sums == "powers" or (sums == "fields" and SHIFT in misfit.slices and carriers == 1)


def sums_of(misfit: Misfit) -> Sums | None:
    """What all receivers observe sums of (`wrf_mi.receivers.registry.ReceiverModel.sums`); None: they differ."""
    kinds = {port.model.sums for port in misfit.ports}
    return kinds.pop() if len(kinds) == 1 else None


class PathSum:
    """Residuals of a misfit that it `serves`, near a vector [p] about which lengths are linear; for several threads."""

    def __init__(self, misfit: Misfit, vector: FloatArray) -> None:
        self.misfit, self.at, self._start = misfit, np.array(vector, float), np.array(vector, float)
        self._paths, self._plane_places = misfit.paths, misfit.plane_entries
        self._coherent = sums_of(misfit) != "powers"
        material = [np.arange(span.start, span.stop) for name, span in misfit.slices.items() if name.startswith(PREFIX)]
        self._material = np.array(material, np.int64).reshape(len(material), len(misfit.slabs))
        gains = [(port.traced_field.gain_name, port.places) for port in misfit.ports]
        self._factors = [(misfit.slices[name], places) for name, places in gains if name in misfit.slices]
        # Receiver models with different observations of signals, and the number of that of each row.
        models, self._model_of = dict[Any, Any](), np.zeros(len(misfit.observed), np.int64)
        for port in misfit.ports:
            models.setdefault(port.model.signal_key, port.model)
            self._model_of[port.places] = list(models).index(port.model.signal_key)
        self._models = list(models.values())
        # What does not change with materials: lengths of paths, and the waves of gains of one.
        self._mirrors = np.where(self._paths.reflects, self._paths.plane, -1)
        self._slope, length = csr_array((len(self._paths.row), 0)), np.zeros(0)
        if len(self._plane_places):
            length, self._slope = lengths_and_slopes(misfit, self._mirrors, vector)
        if self._coherent:
            self._k, self._unit = _unit_waves(misfit, vector, length)
        self._gains: dict[tuple[bytes, bytes], Complex] = {}
        self._touched: dict[bytes, _Touched] = {}
        self._unit_of: tuple[bytes, Complex] = b"", np.zeros((0, 0), complex)
        self._tracing = Lock()  # recordings of Dr.Jit serve one thread at a time
        # The present state, which trials differ from: gains, waves and sums over the paths of each row.
        self._every = self._of_paths(b"every", np.arange(len(self._paths.row)))
        self._gain = self.misfit.gains(self.at, self._every.paths)
        self._waves = self._waves_of(self._every, self._gain[None], np.zeros((1, len(self._plane_places))))[:, 0]
        self._total = np.zeros((len(misfit.observed), self._waves.shape[1]), complex)
        self._total[self._every.rows] = self._every.sums(self._waves)
        self._keep(self._residual_of(self._total * self._factor(self.at), np.arange(len(misfit.observed))))

    @staticmethod
    def serves(misfit: Misfit) -> bool:
        """Whether a misfit is of channels or spectra by materials, planes and gains, or of strengths without planes."""
        gains = {port.traced_field.gain_name for port in misfit.ports}
        carriers = len(misfit.ports) // len(misfit.receivers)
        # Receivers of one name share parameters: their sums would not be told apart.
        apart, moving = len(gains) * carriers >= len(misfit.ports), sums_of(misfit) != "powers"
        follows = all(_follows(name, moving) for name in misfit.slices)
        return apart and follows and _serves_observations(misfit, carriers)

    def residual(self, vector: FloatArray) -> FloatArray:
        """Residuals as `Misfit.residual`, lengths linear in planes, gains at the angles of the first vector."""
        rows, changed = self._trials(vector[None])
        residual = self._residual.copy()
        residual[rows] = changed[:, 0]
        return residual

    def mean_squares(self, vectors: FloatArray) -> FloatArray:
        """Means of each row's squares of `residual` at vectors [v, p], [v, n_rx * rows]; on all processors."""
        means = np.tile(self._mean_squares, (len(vectors), 1))
        # Several vectors at once: products of few rows take less time than the calls around them.
        each = max(1, TOGETHER // max(1, len(self._touched_by(self._differs(vectors, self.at)).rows)))
        parts = [np.arange(first, min(first + each, len(vectors))) for first in range(0, len(vectors), each)]

        def fill(part: IntArray) -> None:
            rows, changed = self._trials(vectors[part])
            means[np.ix_(part, rows)] = np.square(changed).mean(axis=2).T

        on_threads(fill, parts)
        return means

    def within(self, start: FloatArray, places: IntArray) -> tuple[Residuals, Derivatives]:
        """`residual` and `jacobian` of some rows: those of paths that entries of planes or materials ``places`` change,
        or that differ between the present vector and ``start``.
        """
        beside = start.copy()
        beside[places] += STEP
        touched = self._touched_by(self._differs(np.stack([start, beside]), self.at))

        def residual(vector: FloatArray) -> FloatArray:
            return self._trials(vector[None], touched)[1][:, 0]

        return residual, lambda vector: self._derivatives(vector, places, touched.rows)

    def _trials(self, vectors: FloatArray, touched: _Touched | None = None) -> tuple[IntArray, FloatArray]:
        """Rows [k] with a path or gain that a vector of [v, p] changes, and their residuals [k, v, values]."""
        touched, waves = self._changed(vectors, touched)
        # The sums of all paths less those that change, plus these as they are now: other paths are not evaluated.
        total = (self._total[touched.rows] - touched.sums(self._waves[touched.paths]))[:, None] + touched.sums(waves)
        factor, rows = np.stack([self._factor(vector) for vector in vectors], axis=1), touched.rows
        if (factor != self._factor(self.at)[:, None]).any():
            rows, every = np.arange(len(factor)), np.repeat(self._total[:, None], len(vectors), axis=1)
            every[touched.rows] = total
            total = every
        flat = (total * factor[rows]).reshape(-1, total.shape[2])
        residual = self._residual_of(flat, np.repeat(rows, len(vectors)))
        return rows, residual.reshape(*total.shape[:2], residual.shape[1])

    def _residual_of(self, signal: Complex, rows: IntArray) -> FloatArray:
        predicted = [self._models[number].signal_observation(signal[run]) for number, run in self._runs(rows)]
        return _joined(predicted, self.misfit) / self.misfit.unit[rows, None] - self.misfit.observed[rows]

    def _runs(self, rows: IntArray) -> list[tuple[int, slice]]:
        """Numbers of receiver models and ranges of ``rows`` that they observe."""
        # Rows of paths lie side by side, so that there are few ranges, and slices need no copies.
        number = self._model_of[rows]
        bounds = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(rows)]
        return [(int(number[begin]), slice(begin, end)) for begin, end in pairwise(bounds) if begin < end]

    def _slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivatives of the observations of the signals of some rows."""
        parts: list[list[Complex]] = [[] for _ in self._models]
        place = np.zeros(len(rows), np.int64)
        for number, run in self._runs(rows):
            place[run] = sum(map(len, parts[number])) + np.arange(run.stop - run.start)
            parts[number].append(signal[run])
        of_model = [model.signal_slopes(parts[number]) for number, model in enumerate(self._models)]

        def slopes(change: Complex, which: IntArray) -> FloatArray:
            runs = self._runs(rows[which])
            return _joined([of_model[number](change[run], place[which[run]]) for number, run in runs], self.misfit)

        return slopes

    def _keep(self, residual: FloatArray) -> None:
        self._residual, self._mean_squares = residual, np.square(residual).mean(axis=1)

    def jacobian(self, vector: FloatArray, columns: IntArray) -> Jacobian:
        """Derivatives of `residual` by some entries; by materials over `STEP`."""
        return self._derivatives(vector, columns, np.arange(len(self.misfit.observed)))

    def _derivatives(self, vector: FloatArray, columns: IntArray, rows: IntArray) -> Jacobian:
        """`jacobian` of rows ``rows``, ascending, outside of which no column changes any."""
        touched, waves = self._changed(vector[None])
        present, total = self._waves.copy(), self._total.copy()
        present[touched.paths] = waves[:, 0]
        total[touched.rows] += touched.sums(waves[:, 0] - self._waves[touched.paths])
        # Rows that each column changes, and derivatives of their sums.
        changes = self._gain_changes(total) | self._material_changes(columns, vector, present)
        for column in np.intersect1d(columns, self._plane_places).tolist():
            changes[column] = self._plane_change(column, present)
        factor, observed = self._factor(vector), np.isfinite(self.misfit.observed).all(axis=1)
        scale = np.where(observed, 1 / self.misfit.unit, 0).astype(np.float32)[:, None]
        slopes = self._slopes((total * factor)[rows], rows)
        basis, coefficients = None, None
        width, values = 2 * total.shape[1], self.misfit.observed.shape[1]
        if len(columns) > width and values > width:
            # An observation changes by the real and imaginary parts of few signals: by far less than by values.
            units = [*np.eye(width // 2), *(1j * np.eye(width // 2))]
            parts = on_threads(lambda unit: slopes(np.tile(unit, (len(rows), 1)), np.arange(len(rows))), units)
            of_row = np.stack(parts, axis=-1).astype(np.float32)
            factors = on_threads(np.linalg.qr, np.array_split(of_row, processors()))
            basis, coefficients = (np.concatenate(each) for each in zip(*factors, strict=True))
        result = np.zeros((len(columns), len(rows), values if basis is None else width), np.float32)

        def fill(number: int) -> None:
            # Gains of receivers without any observation change nothing.
            changed, change = changes.get(int(columns[number]), (rows[:0], total[:0]))
            which, signal = np.searchsorted(rows, changed), change * factor[changed]
            if coefficients is None:
                derivative = slopes(signal, which)
            else:
                pairs = np.concatenate([signal.real, signal.imag], axis=1).astype(np.float32)
                derivative = np.matmul(coefficients[which], pairs[:, :, None])[:, :, 0]
            result[number][which] = derivative * scale[changed]

        on_threads(fill, range(len(columns)))
        return Jacobian(result, basis)

    def _gain_changes(self, total: Complex) -> dict[int, tuple[IntArray, Complex]]:
        """Derivatives of the sums ``total`` by the gains of receivers."""
        # Of exp(x + j y) for fields, and of exp(2 x) for powers.
        slopes = (1, 1j) if self._coherent else (2, 0)
        columns = [(span.start + k, rows, slope) for span, rows in self._factors for k, slope in enumerate(slopes)]
        return {column: (rows, slope * total[rows]) for column, rows, slope in columns}

    def _plane_change(self, column: int, present: Complex) -> tuple[IntArray, Complex]:
        """Rows whose paths an entry of a plane changes, and derivatives of their sums, of waves ``present``."""
        moved = self._touched_by(self._met_by(column))
        slope = moved.slope[:, [np.flatnonzero(self._plane_places == column)[0]]].toarray()
        return moved.rows, moved.sums(present[moved.paths] * (-1j * slope * self._wavenumber(moved.paths)))

    def _material_changes(
        self, columns: IntArray, vector: FloatArray, present: Complex
    ) -> dict[int, tuple[IntArray, Complex]]:
        """Rows whose paths each entry of a material among ``columns`` changes, and derivatives of their sums."""
        changes = dict[int, tuple[IntArray, Complex]]()
        # Surfaces that no path meets together change at once: a launch for each would take longer than all else.
        for constants in self._material:
            for group in self.misfit.apart:
                together = np.intersect1d(constants[group], columns)
                if not len(together):
                    continue
                beside = vector.copy()
                beside[together] += STEP
                moved, waves = self._changed(beside[None])
                for column in together.tolist():
                    touched = self._touched_by(self._met_by(column))
                    change = waves[np.searchsorted(moved.paths, touched.paths), 0] - present[touched.paths]
                    # Parameters are rounded to single precision, gains are not.
                    step = float(np.float32(beside[column])) - float(np.float32(vector[column]))
                    changes[column] = touched.rows, touched.sums(change / step)
        return changes

    def _met_by(self, column: int) -> NDArray[np.bool_]:
        """The plane or surface of an entry, as of `_differs`."""
        beside = self.at.copy()
        beside[column] += 1
        return self._differs(beside[None], self.at)

    def accept(self, vector: FloatArray) -> None:
        """Take a vector as the present one."""
        residual, (touched, waves) = self.residual(vector), self._changed(vector[None])
        self._gain[touched.paths] = self._gain_at(vector, touched)
        self._total[touched.rows] += touched.sums(waves[:, 0] - self._waves[touched.paths])
        self._waves[touched.paths] = waves[:, 0]
        self.at = np.array(vector, float)
        self._keep(residual)
        self._gains.clear()

    def _factor(self, vector: FloatArray) -> Complex:
        """Gains of the receivers relative to the first vector's, or their squared magnitudes for powers, [rows, 1]."""
        factor = np.ones((len(self.misfit.observed), 1), complex)
        for span, places in self._factors:
            amplitude, phase = (vector - self._start)[span]
            factor[places] = np.exp(amplitude + 1j * phase if self._coherent else 2 * amplitude)
        return factor

    def _of_paths(self, key: bytes, paths: IntArray) -> _Touched:
        row, count = self._paths.row[paths], len(paths)
        first = np.flatnonzero(np.diff(row, prepend=-1))
        adding = csr_array((np.ones(count), np.arange(count), np.append(first, count)), (len(first), count))
        return _Touched(key, paths, row[first], adding, self._slope[paths])

    def _differs(self, vectors: FloatArray, other: FloatArray) -> NDArray[np.bool_]:
        """Whether a parameter of each plane, then surface, differs in one of the vectors [v, p]."""
        differs = (vectors != other).any(axis=0)
        planes = np.zeros(len(self.misfit.planes), bool)
        if len(self._plane_places):
            shifts, tilts = np.split(differs[self._plane_places], [len(planes)])
            planes = shifts | tilts.reshape(-1, 2).any(axis=1)
        return np.concatenate([planes, differs[self._material].any(axis=0)])

    def _touched_by(self, differs: NDArray[np.bool_]) -> _Touched:
        key = differs.tobytes()
        touched = self._touched.get(key)
        if touched is None:
            if len(self._touched) >= MOST_KEPT:
                self._touched.clear()
            planes, slabs = (np.append(part, False) for part in np.split(differs, [len(self.misfit.planes)]))
            # The last entries are those of the place holder -1.
            met = planes[self._mirrors].any(axis=1) | slabs[self._paths.slab].any(axis=1)
            touched = self._touched[key] = self._of_paths(key, np.flatnonzero(met))
        return touched

    def _changed(self, vectors: FloatArray, touched: _Touched | None = None) -> tuple[_Touched, Complex]:
        """The n paths that meet a plane or surface that a vector of [v, p] changes, and waves as of `_waves_of`.

        ``touched`` are more paths than those, if stated.
        """
        touched = touched or self._touched_by(self._differs(vectors, self.at))
        gain = np.stack([self._gain_at(vector, touched) for vector in vectors])
        return touched, self._waves_of(touched, gain, (vectors - self._start)[:, self._plane_places])

    def _wavenumber(self, which: IntArray) -> FloatArray:
        """Wavenumbers of some paths, [paths or 1, frequencies or 1]."""
        return self._k if len(self._k) == 1 else self._k[which]

    def _waves_of(self, touched: _Touched, gain: Complex, shifts: FloatArray) -> Complex:
        """Waves [n, v, frequencies or elements] for gains [v, n] and shifts [v, 3 q], or powers [n, v, 1]."""
        if not self._coherent:
            return (np.abs(gain.T[:, :, None]) ** 2).astype(complex)
        key, unit = self._unit_of
        if key != touched.key:  # kept for the next call
            unit = self._unit[touched.paths]
            self._unit_of = touched.key, unit
        if not shifts.any():
            return gain.T[:, :, None] * unit[:, None]
        # Alternatives of a material share their shifts: exponentials of the distinct ones serve all.
        number_of = dict[bytes, int]()
        which = [number_of.setdefault(row.tobytes(), len(number_of)) for row in shifts]
        distinct = shifts[np.unique(which, return_index=True)[1]]
        length = (touched.slope @ distinct.T)[:, :, None]
        phase = np.exp(-1j * length * self._wavenumber(touched.paths)[:, None])[:, which]
        return np.asarray((gain.T[:, :, None] * phase) * unit[:, None])

    def _gain_at(self, vector: FloatArray, touched: _Touched) -> Complex:
        materials = self._material.ravel()
        if not (vector != self.at)[materials].any():
            return self._gain[touched.paths]
        with_materials = self._start.copy()  # angles of all gains are those of the first vector
        with_materials[materials] = vector[materials]
        key = touched.key, with_materials[materials].tobytes()
        with self._tracing:
            if key not in self._gains:
                self._gains[key] = self.misfit.gains(with_materials, touched.paths)
        return self._gains[key]


def _unit_waves(misfit: Misfit, vector: FloatArray, length_m: FloatArray) -> tuple[FloatArray, Complex]:
    """Wavenumbers [paths or 1, frequencies or 1] and waves [paths, frequencies or elements] for gains of one."""
    if sums_of(misfit) == "elements":
        hz = np.array([port.traced_field.frequency_hz for port in misfit.ports])
        return (2 * np.pi * hz / speed_of_light)[misfit.paths.port, None], misfit.unit_signals(vector)
    assert misfit.record.frequencies_hz is not None
    k = 2 * np.pi * np.asarray(misfit.record.frequencies_hz, float)[None] / speed_of_light
    return k, np.exp(-1j * length_m[:, None] * k)


def _joined(parts: Sequence[FloatArray], misfit: Misfit) -> FloatArray:
    """Observations of consecutive rows [n, values]; without a copy of the only part."""
    return parts[0] if len(parts) == 1 else np.concatenate([np.zeros((0, misfit.observed.shape[1])), *parts])


def near(misfit: Misfit, vector: FloatArray) -> Misfit | PathSum:
    """What gives residuals and derivatives near a vector fastest: a sum over paths where one serves."""
    return PathSum(misfit, vector) if PathSum.serves(misfit) else misfit
