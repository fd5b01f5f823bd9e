"""Bands and array of an uplink, and wave models: coefficients of a propagation path at every antenna and subcarrier.

With f0 the middle of the uplink, p_a the elements and g_k complex gains,

- array: h_af = sum_k g_k (d_k / s_ka) exp(-j 2 pi / c ((f - f0) d_k + f (s_ka - d_k))), where s_ka is the distance of
  element a from the path's image source at distance d_k in the direction with cosines psi_k along the array's axes:
  s = d - p . psi for a plane wave (no amplitude factor), s^2 = d^2 - 2 d p . psi + |p|^2 for a spherical one;
- free: h_af = sum_k g_ka exp(-j 2 pi / c (f - f0) d_k), with a gain for each antenna.

Both are linear in the gains, which are eliminated (variable projection: Golub and Pereyra, "The differentiation of
pseudo-inverses and nonlinear least squares problems whose variables separate", 1973, with Kaufman's simplification).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..model import Model, received_rows

# Share of an array's largest extent along an axis below which phases of a few degrees do not resolve the direction.
FLAT = 0.01


@dataclass(frozen=True)
class Bands:
    """Two bands and the array that observes them."""

    uplink_hz: FloatArray  # frequency of each uplink subcarrier [f]
    downlink_hz: FloatArray  # frequency of each downlink subcarrier [g]
    antennas: int
    known: bool  # whether the frequencies come with the data
    # Positions of the antennas about the centre of the array, along its q principal axes [antennas, q], metres; None:
    # unknown
    elements_m: FloatArray | None = None

    @property
    def reference_hz(self) -> float:
        """Middle of the uplink, the reference of phases over frequency."""
        return float(self.uplink_hz.mean())

    @property
    def spacing_hz(self) -> float:
        """Smallest distance of two uplink subcarriers; infinite with a single subcarrier."""
        return float(np.diff(np.sort(self.uplink_hz)).min(initial=np.inf))


def bands_of(record: Record, spacing_hz: float, gap: int = 1) -> Bands:
    """The bands of a record.

    Without known frequencies, subcarriers are taken to be ``spacing_hz`` apart around 0 Hz, the downlink ``gap``
    spacings above the uplink, and the array's elements are not used, since the wavelength is unknown.

    Raises:
        InputError: a single uplink subcarrier, or an array of another size.
    """
    assert record.uplink is not None
    (antennas, up), down = record.uplink.shape[1:], record.observation.shape[3]
    if up < 2:
        raise InputError(f"{record.name}: {up} uplink subcarrier; delays show in two or more")
    has_frequencies = _knows_frequencies(record)
    if has_frequencies:
        uplink_hz, downlink_hz = np.asarray(record.uplink_hz, float), np.asarray(record.frequencies_hz, float)
    else:
        uplink_hz = spacing_hz * (np.arange(up) - up - (gap - 1) / 2 + 0.5)
        downlink_hz = spacing_hz * (np.arange(down) + (gap - 1) / 2 + 0.5)
    array_m = record.receivers[0].array_m
    elements = None if array_m is None or not has_frequencies else np.asarray(array_m, float)
    if elements is not None:
        if elements.shape != (antennas, 3):
            raise InputError(f"{record.name}: array {elements.shape} for {antennas} antennas; give x, y, z of each")
        elements = (elements - elements.mean(axis=0)) @ principal_axes(elements).T
    return Bands(uplink_hz, downlink_hz, antennas, has_frequencies, elements)


def _knows_frequencies(record: Record) -> bool:
    return record.uplink_hz is not None and record.frequencies_hz is not None


def unused_spacing(record: Record) -> dict[str, str]:
    """``spacing_hz`` where the data state their frequencies (`wrf_mi.estimators.model.Model.unused_settings`)."""
    return {"spacing_hz": "the data state their frequencies"} if _knows_frequencies(record) else {}


def principal_axes(elements_m: FloatArray) -> FloatArray:
    """Unit vectors [q, 3] of the principal axes along which an array is not flat (`FLAT`): a plane array has two."""
    _, extent, axes = np.linalg.svd(elements_m - elements_m.mean(axis=0), full_matrices=False)
    return np.asarray(axes[extent > FLAT * max(float(extent[0]), np.finfo(float).tiny)])


class UplinkModel(Model):
    """A model of the downlink from the uplink of an array."""

    tasks = ("csi",)
    uplink, headings = "required", True

    def known_rows(self, record: Record, split: Split) -> tuple[IntArray, IntArray]:
        """Rows that train, and rows that choose settings (`received_rows`); InputError: not one array of antennas."""
        shape = record.observation.shape
        if len(shape) != 4 or shape[0] != 1:
            raise InputError(
                f"{record.name}: channel coefficients {list(shape)}; {self.name} needs one receiver with the antennas "
                "that the uplink has, [1, rows, antennas, subcarriers]"
            )
        return received_rows(record, split, 0, self.name)


def relative_error(prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
    """Squared error over energy of coefficients, summed over the last axis: CEA in linear units."""
    power = np.square(np.abs(truth)).sum(axis=-1)
    error = np.square(np.abs(prediction - truth)).sum(axis=-1)
    return np.asarray(error / np.maximum(power, np.finfo(np.float32).tiny))


Complex = NDArray[np.complex128]
Mask = NDArray[np.bool_]

AXIS_POINTS = 64  # most points of the first search along one axis of the array: larger arrays start from a coarser grid
FINE = 4  # grid points of the first search in one resolution cell of distance
UNIFORM = 1e-9
"""Distance from a grid, in spacings, of uniform subcarriers: a phase below the rounding of a path of 100 m."""
SINGULAR = 1e-12  # added to normal matrices, of the power of one path: two equal paths then share their gain


@dataclass
class Solved:
    """Best gains for some paths."""

    gains: Complex  # complex gains [n, paths, antennas], or [n, paths, 1] for all antennas
    residual: Complex  # uplink minus the paths [n, antennas, f]
    atoms: Complex  # `Waves.unit` of the paths, 0 for absent ones
    gram: Complex  # products of the atoms [n, paths, paths]

    @property
    def energy(self) -> FloatArray:
        """Squared residual [n]."""
        return np.asarray(np.square(np.abs(self.residual)).sum(axis=(1, 2)))


def strongest(waves: Waves, residual: Complex) -> FloatArray:
    """The path [n, p] on a wave model's grid that explains most of a residual."""
    power = waves.power(residual)
    best = power.reshape(len(power), -1).argmax(axis=1)
    at, direction = np.unravel_index(best, power.shape[1:])
    return np.concatenate([waves.grid[at][:, None], waves.cosines[direction]], axis=1)


def products(atoms: Complex, h: Complex) -> Complex:
    """Products of atoms [n, paths, m] with uplinks [n, antennas, f]: [n, paths, antennas], or 1 where m is all."""
    parts = h.reshape(len(h), h.shape[1] * h.shape[2] // atoms.shape[2], atoms.shape[2])
    return np.asarray(atoms.conj() @ parts.transpose(0, 2, 1))


def _solve(gram: Complex, right: Complex, size: float) -> Complex:
    return np.asarray(np.linalg.solve(gram + SINGULAR * size * np.eye(gram.shape[-1]), right))


def _turn(angle: FloatArray) -> Complex:  # exp(-j angle), twice as fast as the exponential of complex numbers
    turned = np.empty(angle.shape, complex)
    np.cos(angle, out=turned.real)
    np.sin(-angle, out=turned.imag)
    return turned


class Waves:
    """Paths with a delay that all antennas share and a gain for each antenna; base of waves at known elements.

    Parameters of paths are [n, paths, p], present paths marked in [n, paths].
    """

    spherical = False  # whether waves are spherical

    def __init__(self, bands: Bands, max_distance_m: float) -> None:
        self.slope = -2j * np.pi / speed_of_light * (bands.uplink_hz - bands.reference_hz)
        self.reference_hz = bands.reference_hz
        # Distances of the first search, also negative ones, within the range that the spacing resolves.
        width = float(np.ptp(bands.uplink_hz)) + bands.spacing_hz
        reach = min(max_distance_m, speed_of_light / bands.spacing_hz / 2)
        count = max(int(np.ceil(reach / (speed_of_light / width / FINE))), 1)
        self.grid = np.linspace(-reach, reach, 2 * count + 1)
        # Directions of the grid [cells, p - 1], and their indices on the lattice of directions.
        self.cosines, self.lattice = np.zeros((1, 0)), np.zeros((1, 0), np.int64)
        self.steering = np.exp(self.grid[:, None] * self.slope)
        self.freedom = 1 + 2 * bands.antennas  # real numbers that describe a path, gains included

    @cached_property
    def around(self) -> NDArray[np.int64]:
        """Cells around each cell of directions and the cell itself, [3^axes, cells]; ``cells`` outside the lattice."""
        index = {tuple(point): number for number, point in enumerate(self.lattice)}
        steps = np.array(list(np.ndindex(*(3,) * self.lattice.shape[1])), int) - 1
        return np.array([[index.get(tuple(point + step), len(index)) for point in self.lattice] for step in steps])

    def power(self, residual: Complex) -> FloatArray:
        """Power of a residual in each cell of the grid, [n, distances, cells]: a matched filter."""
        return np.asarray(np.square(np.abs(residual @ self.steering.conj().T)).sum(axis=1)[:, :, None])

    def unit(self, theta: FloatArray) -> Complex:
        """Uplink coefficients of paths of unit gain, [n, paths, f] or, with one gain for all antennas, antennas * f."""
        return np.asarray(np.exp(theta * self.slope))

    def solve(self, theta: FloatArray, present: Mask, h: Complex) -> Solved:
        """Gains that fit an uplink [n, antennas, f] best."""
        atoms = self.unit(theta) * present[..., None]
        gram, diagonal = atoms.conj() @ atoms.transpose(0, 2, 1), np.arange(atoms.shape[1])
        # The atoms of absent paths are zero: 1 on the diagonal keeps the matrix regular and their gains zero.
        gram[:, diagonal, diagonal] += ~present
        gains = _solve(gram, products(atoms, h), atoms.shape[2])
        return Solved(gains, h - (gains.transpose(0, 2, 1) @ atoms).reshape(h.shape), atoms, gram)

    def normal(self, theta: FloatArray, solved: Solved) -> tuple[FloatArray, FloatArray]:
        """Normal matrix [n, m, m] and right side [n, m] of a Gauss-Newton step of all m = paths * p parameters."""
        tilt = solved.atoms * self.slope
        cross = solved.atoms.conj() @ tilt.transpose(0, 2, 1)
        products = tilt.conj() @ tilt.transpose(0, 2, 1)
        # Kaufman's variable projection: derivatives of the atoms without their share in the span of the atoms.
        projected = products - cross.conj().transpose(0, 2, 1) @ _solve(solved.gram, cross, len(self.slope))
        shared = solved.gains.conj() @ solved.gains.transpose(0, 2, 1)
        right = (solved.gains.conj() * (tilt.conj() @ solved.residual.transpose(0, 2, 1))).sum(axis=-1)
        return (projected * shared).real, right.real

    def limit(self, theta: FloatArray) -> FloatArray:
        """Parameters limited to the domain of the model."""
        return np.asarray(theta.clip(self.grid[0], self.grid[-1]))

    def evaluate(self, theta: FloatArray, gains: Complex, frequencies_hz: FloatArray) -> Complex:
        """Coefficients [n, antennas, frequencies]."""
        slope = -2j * np.pi / speed_of_light * (frequencies_hz - self.reference_hz)
        return np.asarray(gains.transpose(0, 2, 1) @ np.exp(theta * slope))


class ArrayWaves(Waves):
    """Paths with a gain, a distance and a direction, at an array of known elements."""

    def __init__(self, bands: Bands, max_distance_m: float, spherical: bool) -> None:
        super().__init__(bands, max_distance_m)
        assert bands.elements_m is not None
        self.elements, self.spherical = bands.elements_m, spherical
        self.square = np.square(self.elements).sum(axis=1)
        self.frequencies = bands.uplink_hz
        axes = self.elements.shape[1]
        self.freedom = 3 + axes
        self.far = max_distance_m
        # An image source inside the array would make the distance's slope infinite.
        self.near = 0.6 * 2 * float(np.sqrt(self.square.max(initial=0.0)))
        wavelength = speed_of_light / self.reference_hz
        half_cells = 2 * np.ptp(self.elements, axis=0) / wavelength
        points = [np.linspace(-1, 1, int(min(2 * np.ceil(half) + 1, AXIS_POINTS))) for half in half_cells]
        where = np.array(list(np.ndindex(*(len(p) for p in points))), np.int64).reshape(-1, axes)
        cosines = np.stack([p[where[:, axis]] for axis, p in enumerate(points)], axis=-1) if axes else np.zeros((1, 0))
        visible = np.square(cosines).sum(axis=1) <= 1.01  # directions of real angles, those of the grid's rim included
        self.cosines, self.lattice = cosines[visible], where[visible]
        if spherical:
            # Curvature changes with 1 / d near the array, delay with d far from it.
            bends = 1 / np.linspace(1 / max_distance_m, 1 / max(self.near, 1e-3), 9)[1:]
            self.grid = np.sort(np.concatenate([self.grid[self.grid > max(self.near, 1e-3)], bends]))
        self._steering = []  # matched filters at each distance in all directions, [antennas, directions], of length 1
        for distance_m in self.grid if spherical else self.grid[:1]:
            theta = np.concatenate([np.full((1, len(self.cosines), 1), distance_m), self.cosines[None]], axis=-1)
            steering = self.atoms(theta, np.array([self.reference_hz]))[0, :, :, 0].conj().T
            self._steering.append(np.asarray(steering / np.linalg.norm(steering, axis=0)))

    def _phase(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Distance, projections p . psi [n, k, a] and, of spherical waves, distances s from the elements."""
        d = theta[..., :1]
        along = theta[..., 1:] @ self.elements.T
        # Not below a tenth of the distance: within the array the amplitude d / s would grow without bound.
        root = np.sqrt(np.maximum(d * d - 2 * d * along + self.square, (0.1 * d) ** 2)) if self.spherical else None
        return d, along, root

    def atoms(self, theta: FloatArray, frequencies_hz: FloatArray) -> Complex:
        """Coefficients of paths of unit gain, [n, k, antennas, frequencies]."""
        d, along, s = self._phase(theta)
        # s - d by the difference of squares: for distant sources both have more digits in common than float64 has.
        excess = -along if s is None else (self.square - 2 * d * along) / (s + d)
        k = 2 * np.pi / speed_of_light
        carrier = _turn(k * self.reference_hz * excess)
        if s is not None:
            carrier *= d / s
        offset = frequencies_hz - self.reference_hz
        spacing = float(np.diff(np.sort(offset)).min()) if len(offset) > 1 else 1.0
        steps = (offset - offset.min()) / spacing
        grid_steps = steps.round()
        length = k * (d + excess)
        if np.abs(steps - grid_steps).max() > UNIFORM or grid_steps.max() > AXIS_POINTS:
            return np.asarray(carrier[..., None] * _turn(length[..., None] * offset))
        # Subcarriers on a grid, split into eights and ones: a third of the sines.
        order = grid_steps.astype(int)
        carrier *= _turn(length * offset.min())
        ones = _turn(length[..., None] * (spacing * np.arange(8)))
        eights = _turn(length[..., None] * (spacing * 8 * np.arange(order.max() // 8 + 1))) * carrier[..., None]
        beat = (eights[..., None] * ones[..., None, :]).reshape(*length.shape, 8 * eights.shape[-1])
        return np.asarray(beat[..., : len(order)] if (np.diff(order) == 1).all() else beat[..., order])

    def _slopes(self, theta: FloatArray) -> tuple[Complex, FloatArray]:
        """Logarithmic derivatives of atoms as c + m f for each parameter: constants and f's factors [n, k, p, a]."""
        d, along, s = self._phase(theta)
        n, k, _ = theta.shape
        axes, antennas = self.elements.shape[1], len(self.elements)
        excess, amplitude = np.zeros((2, n, k, 1 + axes, antennas))
        if s is None:
            excess[:, :, 1:] = -self.elements.T
        else:
            by_d = (d - along) / s  # ds / dd, and -(d / s) p = ds / dpsi, of s^2 = d^2 - 2 d p . psi + |p|^2
            excess[:, :, 0] = by_d - 1
            amplitude[:, :, 0] = 1 / d - by_d / s
            excess[:, :, 1:] = -(d / s)[:, :, None] * self.elements.T
            amplitude[:, :, 1:] = (d / (s * s))[:, :, None] * self.elements.T
        factor = excess * (-2 * np.pi / speed_of_light)
        factor[:, :, 0] -= 2 * np.pi / speed_of_light
        constant = amplitude.astype(complex)
        constant[:, :, 0] += 2j * np.pi / speed_of_light * self.reference_hz
        return constant, factor

    def power(self, residual: Complex) -> FloatArray:
        """Power of a residual in each cell of the grid, [n, distances, cells]."""
        # Excess lengths over the array are short: they turn the carrier, and not the subcarriers against each other.
        k = 2 * np.pi / speed_of_light
        beat = np.exp(-1j * k * self.grid[:, None] * (self.frequencies - self.reference_hz))
        combined = residual @ beat.conj().T
        power = np.empty((len(residual), len(self.grid), len(self.cosines)))
        for index in range(len(self.grid)):
            steering = self._steering[index if self.spherical else 0]
            power[:, index] = np.square(np.abs(combined[:, :, index] @ steering))
        return power

    def unit(self, theta: FloatArray) -> Complex:
        """Uplink coefficients of paths of unit gain, [n, paths, antennas * f]."""
        return self.atoms(theta, self.frequencies).reshape(*theta.shape[:2], -1)

    def normal(self, theta: FloatArray, solved: Solved) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and right side of a Gauss-Newton step."""
        n, k, p = theta.shape
        antennas, subcarriers = solved.residual.shape[1:]
        constant, factor = self._slopes(theta)
        slopes = constant[..., None] + 1j * factor[..., None] * self.frequencies
        moved = (solved.atoms * solved.gains).reshape(n, k, 1, antennas, subcarriers)
        tilt = (moved * slopes).reshape(n, k * p, -1)
        cross = solved.atoms.conj() @ tilt.transpose(0, 2, 1)
        # Only the real part of the products is needed: half the work.
        pairs, residual = tilt.view(float), solved.residual.reshape(n, -1, 1).view(float).reshape(n, -1, 1)
        products = pairs @ pairs.transpose(0, 2, 1)
        size = antennas * subcarriers
        shadow = cross.conj().transpose(0, 2, 1) @ _solve(solved.gram, cross, size)
        return products - shadow.real, (pairs @ residual)[..., 0]

    def limit(self, theta: FloatArray) -> FloatArray:
        """Parameters limited to the domain of the model."""
        limited = theta.copy()
        limited[..., 0] = theta[..., 0].clip(max(self.near, 1e-3) if self.spherical else -self.far, self.far)
        length = np.linalg.norm(theta[..., 1:], axis=-1, keepdims=True)
        limited[..., 1:] /= np.maximum(length, 1)
        return limited

    def evaluate(self, theta: FloatArray, gains: Complex, frequencies_hz: FloatArray) -> Complex:
        """Coefficients [n, antennas, frequencies]."""
        return np.asarray(np.einsum("nk,nkaf->naf", gains[..., 0], self.atoms(theta, frequencies_hz)))


def waves_of(kind: str, bands: Bands, max_distance_m: float) -> Waves:
    """A wave model by name: ``plane``, ``spherical`` or ``free``."""
    if kind == "free":
        return Waves(bands, max_distance_m)
    return ArrayWaves(bands, max_distance_m, spherical=kind == "spherical")
