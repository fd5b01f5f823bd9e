"""Traced side of the joint graph and reports of receivers in NumPy, complex128.

The reference of `wrf_mi.tracing.paths.field_calculator` shares the chains of planes and constants with the graph, but
no device code. The direction of a leg is that from an image of the transmitter to an image of the receiver; slabs are
Airy sums, patterns SciPy's spherical harmonics.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from wrf_mi.core import pixel_directions
from wrf_mi.core.angles import FloatArray, solid_angles
from wrf_mi.receivers import array_response, bartlett_spectrum, minmax_scale
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PowerReceiver
from wrf_mi.receivers.reports import LEAST_POWER, SQUARED_MAGNITUDE_EPS
from wrf_mi.tracing.paths.instrument_parameters import TX_PATTERN, pattern_name
from wrf_mi.tracing.paths.scene_parameters import SURFACE, name_of
from wrf_mi.tracing.paths.traced_field import TracedField

from .stress_rows import relative

ComplexArray = NDArray[np.complex128]
Values = Mapping[str, FloatArray]
Planes = tuple[FloatArray, FloatArray]  # unit normals [q, 3] and offsets [q] of planes
ACROSS = 1e-6  # sine of the angle to a wall's normal below which the polarisation basis is arbitrary


@dataclass(frozen=True)
class OraclePaths:
    """p paths of a batch of transmitters, ordered by transmitter, ``each`` paths per transmitter.

    Gains [p] have no phase exp(-j k length) and are 0 for padding; arrival [p, 3] points towards the source in the
    receiver's frame.
    """

    gain: ComplexArray
    length_m: FloatArray
    arrival: FloatArray
    each: int

    def at(self, offset_m: FloatArray, frequency_hz: FloatArray) -> ComplexArray:
        """Sums [batch, m] of the paths at ports [m, 3] with frequencies [m]; see `combine.path_sum`."""
        away = (self.arrival * self.length_m[:, None])[:, None] - offset_m
        distance = np.linalg.norm(away, axis=-1)
        wave = np.exp(-2j * np.pi / speed_of_light * frequency_hz * distance)
        terms = self.gain[:, None] * self.length_m[:, None] / distance * wave
        return terms.reshape(-1, self.each, len(offset_m)).sum(axis=1)


class TracedOracle:
    """Paths of a traced field as a function of its parameters."""

    def __init__(self, traced: TracedField) -> None:
        self._traced = traced
        chains = traced.chains
        self._source = np.stack([c.numpy() for c in chains.source_m], axis=-1)
        self._heading = np.stack([c.numpy() for c in chains.heading], axis=-1)
        self._exists = chains.exists.numpy()
        self._levels = [
            (level.plane.numpy(), level.material.numpy(), level.reflects.numpy(), level.transmits.numpy())
            for level in chains.levels
        ]

    def __call__(self, values: Values) -> OraclePaths:
        """Paths with parameters ``values``; missing parameters keep their stated values."""
        traced, planes = self._traced, self._moved(values)
        receiver = traced.receiver
        turn = values.get(f"receiver.{receiver.name}.turn", np.zeros(3))
        to_world = receiver.to_world @ Rotation.from_quat([*(0.5 * turn), 1.0]).as_matrix()
        position = receiver.position_m + values.get(f"receiver.{receiver.name}.position", np.zeros(3))

        images, mirrored = [self._source], [np.broadcast_to(position, self._source.shape)]
        for plane, _, reflects, _ in self._levels:
            images.append(_mirror(planes, plane, reflects, images[-1]))
        for plane, _, reflects, _ in reversed(self._levels):
            mirrored.insert(0, _mirror(planes, plane, reflects, mirrored[0]))
        length = np.linalg.norm(mirrored[-1] - images[-1], axis=-1)
        ways = [(end - start) / length[:, None] for start, end in zip(images, mirrored, strict=True)]

        cosine, sine = self._heading.T
        none, unit = np.zeros_like(cosine), np.ones_like(cosine)
        turned = np.array([[cosine, sine, none], [-sine, cosine, none], [none, none, unit]])
        departure = np.einsum("ijp,pj->pi", turned, ways[0])
        sent = np.einsum("ijp,pi->pj", turned, traced.options.tx_antenna.field(departure)).astype(complex)
        for level, before, after in zip(self._levels, ways, ways[1:], strict=False):
            sent = self._interact(planes, level, before, after, sent, values)
        antenna = receiver.antenna.to_world(Rotation.from_matrix(to_world).as_quat())
        received = receiver.antenna.field(-ways[-1] @ antenna) @ antenna.T
        loss = self._exists * speed_of_light / traced.frequency_hz / (4 * np.pi * length)
        gain = (received * sent).sum(axis=-1) * loss
        amplitude, phase = values.get(traced.gain_name, np.zeros(2))
        gain = gain * np.exp(amplitude + 1j * phase)
        arrival = -ways[-1] @ to_world
        for name, direction in ((pattern_name(receiver), arrival), (TX_PATTERN, departure)):
            if name in values:
                gain = gain * pattern(values[name], direction)
        return OraclePaths(gain, length, arrival, len(length) // len(traced))

    def _moved(self, values: Values) -> Planes:
        surfaces = self._traced.surfaces
        count = len(surfaces.normal)
        shift, tilt = values.get("plane.shift", np.zeros(count)), values.get("plane.tilt", np.zeros((count, 2)))
        return surfaces.moved_planes(shift, tilt)

    def _constant(self, quantity: str, stated: FloatArray, least: float, values: Values) -> FloatArray:
        slabs = self._traced.slabs
        if slabs.grouping == "surface":
            entry = values.get(name_of(SURFACE, quantity))
            return stated if entry is None else least + np.exp(entry)
        entries = [values.get(name_of(name, quantity)) for name in slabs.names]
        return np.array(
            [s if entry is None else least + np.exp(entry[0]) for s, entry in zip(stated, entries, strict=True)], float
        )

    def _interact(
        self, planes: Planes, level: Any, before: FloatArray, after: FloatArray, sent: ComplexArray, values: Values
    ) -> ComplexArray:
        plane, material, reflects, transmits = level
        slabs, met = self._traced.slabs, reflects | transmits
        normal = planes[0][plane]
        permittivity = self._constant("permittivity", slabs.permittivity, 1.0, values)[material]
        conductivity = self._constant("conductivity", slabs.conductivity, 0.0, values)[material]
        hz = self._traced.frequency_hz
        eta = permittivity - 1j * conductivity / (2 * np.pi * hz * epsilon_0)
        cosine = np.where(met, np.abs((before * normal).sum(axis=-1)), 1)
        through = slab(cosine, eta, slabs.thickness[material], hz)
        share = slabs.reflected[material]
        te, tm = (np.where(reflects, r * share, t) for r, t in through)
        across = np.cross(before, normal)
        size = np.linalg.norm(across, axis=-1, keepdims=True)
        other = np.cross(before, np.eye(3)[np.abs(before).argmin(axis=-1)])
        other /= np.linalg.norm(other, axis=-1, keepdims=True)
        across = np.where(size > ACROSS, across / np.where(size > ACROSS, size, 1), other)
        along = np.cross(across, before), np.cross(across, after)
        s, p = ((sent * axis).sum(axis=-1, keepdims=True) for axis in (across, along[0]))
        return np.where(met[:, None], te[:, None] * s * across + tm[:, None] * p * along[1], sent)


@dataclass(frozen=True)
class ReportOracle:
    """Reports of receivers in NumPy."""

    size: tuple[int, int]  # rows and columns of a hemisphere's directions
    elements_m: FloatArray  # positions of the array's elements [m, 3]
    frequency_hz: float  # carrier frequency of spectra

    def learned(self, model: Any, field: ComplexArray) -> ComplexArray:
        """Signals of complex fields [n, directions]: the same, or at an antenna, for each frequency, their sum."""
        if not isinstance(model, CsiReceiver):
            return field
        return np.repeat(field @ np.tile(solid_angles(*self.size), 2)[:, None], len(model.frequencies_hz), axis=1)

    def report(self, model: Any, traced: ComplexArray, learned: ComplexArray) -> FloatArray:
        """Flat report of signals of paths at the ports [n, m] and of what `learned` returns."""
        if isinstance(model, PowerReceiver):
            return np.asarray(10 * np.log10((np.abs(traced + learned) ** 2).mean(axis=1) + LEAST_POWER))
        if isinstance(model, CsiReceiver):
            both = traced + learned
            return np.stack([both.real, both.imag], axis=-1).ravel()
        steering = array_response(self.elements_m, pixel_directions(*self.size).reshape(-1, 3), self.frequency_hz)
        if not isinstance(model, ArrayReceiver):
            return np.sqrt(np.abs(traced @ steering.conj().T + learned) ** 2 + SQUARED_MAGNITUDE_EPS).ravel()
        h = traced + (learned * solid_angles(*self.size)) @ steering
        bartlett = bartlett_spectrum(h, self.elements_m, self.frequency_hz, *self.size)
        spectrum = np.sqrt(bartlett**2 + SQUARED_MAGNITUDE_EPS)
        return np.asarray(minmax_scale(spectrum) if model.instrument_scale else spectrum).ravel()


def report_error(model: Any, report: FloatArray, truth: FloatArray, waves: FloatArray) -> float:
    """Error of a report, relative to its norm, or at an antenna to the sums [n] of the waves' magnitudes."""
    if not isinstance(model, CsiReceiver):
        return relative(report - truth, truth)
    if isinstance(model, PowerReceiver):
        report, truth = 10 ** (report / 20), 10 ** (truth / 20)
        waves = np.maximum(waves, truth)
    return float((np.abs(report - truth).reshape(len(waves), -1) / waves[:, None]).max())


def _mirror(planes: Planes, plane: NDArray[Any], reflects: NDArray[np.bool_], points: FloatArray) -> FloatArray:
    """Points [p, 3] mirrored in planes [p] where they reflect."""
    normal, offset = planes[0][plane], planes[1][plane]
    height = (points * normal).sum(axis=-1) - offset
    return points - 2 * np.where(reflects, height, 0)[:, None] * normal


def slab(
    cosine: FloatArray, eta: ComplexArray, thickness_m: FloatArray, frequency_hz: float
) -> tuple[tuple[ComplexArray, ComplexArray], tuple[ComplexArray, ComplexArray]]:
    """Reflected and transmitted share [p] of TE, then of TM waves: an Airy sum over both interfaces of a slab in air.

    Source: Born and Wolf, "Principles of Optics" (1999), section 1.6.4; the sign of TM is that of ITU-R P.2040.
    """
    inside = np.sqrt(eta - 1 + cosine**2)
    phase = np.exp(-2j * np.pi * frequency_hz / speed_of_light * thickness_m * inside)
    result = []
    for first, second in ((cosine, inside), (cosine, inside / eta)):
        into, out = 2 * first / (first + second), 2 * second / (first + second)
        back = (first - second) / (first + second)
        series = 1 / (1 - (back * phase) ** 2)
        result.append((back - into * out * back * phase**2 * series, into * out * phase * series))
    return result[0], result[1]


def pattern(coefficients: FloatArray, direction: FloatArray) -> ComplexArray:
    """Factor [p] of an antenna pattern in directions [p, 3], see `wrf_mi.tracing.paths.instrument_parameters`."""
    polar, azimuth = np.arccos(np.clip(direction[:, 2], -1, 1)), np.arctan2(direction[:, 1], direction[:, 0])
    series, weights = np.zeros(len(direction), complex), coefficients[0] + 1j * coefficients[1]
    index = 0
    for degree in range(1, int(np.sqrt(len(weights) + 1))):
        for order in range(-degree, degree + 1):
            harmonic = sph_harm_y(degree, abs(order), polar, azimuth)
            part = harmonic.real if order >= 0 else harmonic.imag
            series = series + weights[index] * part * (np.sqrt(2) if order else 1)
            index += 1
    return np.exp(series)


def slopes(of: Callable[[Values], FloatArray], values: Values, steps: Mapping[str, float]) -> dict[str, FloatArray]:
    """Derivatives [m, ...] of functionals [m] by the parameters in ``steps``, by fourth-order central differences."""
    derivatives = {}
    for name, step in steps.items():
        shape = values[name].shape
        columns = []
        for way in np.eye(int(np.prod(shape))).reshape(-1, *shape):
            near, far = (
                (of({**values, name: values[name] + h * way}) - of({**values, name: values[name] - h * way})) / (2 * h)
                for h in (step / 2, step)
            )
            columns.append((4 * near - far) / 3)
        derivatives[name] = np.transpose(columns).reshape(-1, *shape)
    return derivatives
