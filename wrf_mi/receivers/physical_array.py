"""An antenna array as it is built: where its elements are, how each departs from the ideal one, how it is mounted.

`wrf_mi.receivers.array` is the ideal array, which is also what an instrument's processor assumes: equal isotropic
elements and the stated orientation. `Array` is what the waves meet; its spectrum is the processor's view of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import sph_harm_y

from ..core import InputError, Paths, Receiver, rotation_matrix
from ..core.angles import UNIT_QUATERNION_TOLERANCE, FloatArray
from .array import array_response, bartlett_spectrum, minmax_scale
from .channel import element_signals

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Pattern:
    """An antenna's complex amplitude over direction: F(u) = max(u_z, 0)^exponent exp(sum (a_lm + j b_lm) Y_lm(u)).

    The second factor is the one that `wrf_mi.tracing.pattern_parameters` trains, degree 1 and up, with the same
    coefficients.

    Attributes:
        exponent: of the cosine from the boresight +z; 0 is isotropic, behind the antenna too. A patch has 1 to 1.5.
        coefficients: real, [2, (degree + 1)^2 - 1], of real and imaginary part, by degree and order; None for none.
    """

    exponent: float = 0.0
    coefficients: FloatArray | None = None

    def __post_init__(self) -> None:
        """Refuse exponents below 0 and coefficients of no whole degree.

        Raises:
            InputError: naming what is wrong.
        """
        if not (np.isfinite(self.exponent) and self.exponent >= 0):
            raise InputError(f"pattern: exponent {self.exponent}; choose a finite number from 0")
        if self.coefficients is not None:
            shape = np.shape(self.coefficients)
            if len(shape) != 2 or shape[0] != 2 or (self.degree + 1) ** 2 - 1 != shape[1] or not shape[1]:
                raise InputError(f"pattern: coefficients {shape}; give [2, (degree + 1)^2 - 1] of a degree from 1")

    @property
    def degree(self) -> int:
        """Of the harmonics; 0 without."""
        return 0 if self.coefficients is None else int(np.sqrt(np.shape(self.coefficients)[1] + 1)) - 1

    def __call__(self, directions: ArrayLike) -> ComplexArray:
        """F at unit vectors [..., 3] in the antenna's own frame, shape [...]."""
        u = np.asarray(directions, float)
        amplitude = np.ones(u.shape[:-1], complex)
        if self.exponent:
            amplitude *= np.maximum(u[..., 2], 0) ** self.exponent
        if self.coefficients is not None:
            a, b = np.asarray(self.coefficients, float)
            amplitude *= np.exp(real_harmonics(u, self.degree)[..., 1:] @ (a + 1j * b))
        return amplitude


def real_harmonics(directions: ArrayLike, degree: int) -> FloatArray:
    """Real spherical harmonics of unit vectors [..., 3], shape [..., (degree + 1)^2], by degree, order -l to l.

    Source: as in Sloan, "Efficient spherical harmonic evaluation" (2013), with the Condon-Shortley phase.
    """
    u = np.asarray(directions, float)
    polar, azimuth = np.arctan2(np.hypot(u[..., 0], u[..., 1]), u[..., 2]), np.arctan2(u[..., 1], u[..., 0])
    columns = []
    for level in range(degree + 1):
        for order in range(-level, level + 1):
            value = sph_harm_y(level, abs(order), polar, azimuth)
            columns.append(value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real))
    return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Array:
    """An antenna array.

    Attributes:
        elements_m: positions [m, 3] in the array's own frame, metres.
        frequency_hz: of the carrier.
        gain: complex amplitude of each element [m], its cable and its receiver included; None: 1.
        pattern: of each element, in the array's own frame.
        mount_xyzw: unit quaternion, array's own frame to the receiver's stated frame: what the stated pose is off by.
    """

    elements_m: FloatArray
    frequency_hz: float
    gain: ComplexArray | None = None
    pattern: Pattern = Pattern()
    mount_xyzw: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        """Refuse shapes and numbers that are no array.

        Raises:
            InputError: naming what is wrong.
        """
        shape = np.shape(self.elements_m)
        if len(shape) != 2 or shape[1] != 3 or not shape[0] or not np.isfinite(self.elements_m).all():
            raise InputError(f"array: elements of shape {shape}; give finite [m, 3] in metres")
        if not (np.isfinite(self.frequency_hz) and self.frequency_hz > 0):
            raise InputError(f"array: carrier {self.frequency_hz} Hz; give a positive one")
        if self.gain is not None and (np.shape(self.gain) != shape[:1] or not np.isfinite(self.gain).all()):
            raise InputError(
                f"array: gains of shape {np.shape(self.gain)}; give a finite one for each of {shape[0]} elements"
            )
        length = np.linalg.norm(self.mount_xyzw)
        if np.shape(self.mount_xyzw) != (4,) or not abs(length - 1) < UNIT_QUATERNION_TOLERANCE:
            raise InputError(f"array: mount {self.mount_xyzw}; give a quaternion x, y, z, w of length one")

    @property
    def gains(self) -> ComplexArray:
        """Complex amplitude of each element, [m]."""
        return np.ones(len(self.elements_m), complex) if self.gain is None else np.asarray(self.gain, complex)

    def response(self, directions: ArrayLike) -> ComplexArray:
        """Signals g_m F(u) exp(+j k p_m . u) of plane waves of unit amplitude.

        Args:
            directions: unit vectors [..., 3] towards where they come from, in the receiver's stated frame.

        Returns:
            Shape [..., m].
        """
        own = np.asarray(directions, float) @ rotation_matrix(self.mount_xyzw)
        return array_response(self.elements_m, own, self.frequency_hz) * self.pattern(own)[..., None] * self.gains

    def signals(self, amplitude: ArrayLike, directions: ArrayLike) -> ComplexArray:
        """Element signals [..., m] of plane waves with complex amplitudes [..., n] from directions [n, 3]."""
        signals: ComplexArray = np.asarray(amplitude) @ self.response(directions)
        return signals

    def of_paths(self, paths: Paths, receivers: Receiver | Sequence[Receiver]) -> ComplexArray:
        """Element signals [n_rx, n_tx, m] of traced paths, near field included (`channel.element_signals`).

        The pattern is taken in the direction of the array's origin.
        """
        everyone = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
        mount = rotation_matrix(self.mount_xyzw)
        to_own = np.stack([(receiver.to_world @ mount).T for receiver in everyone])
        own = np.einsum("pij,pj->pi", to_own[paths.rx], paths.arrival)
        seen = replace(paths, gain=paths.gain * self.pattern(own))
        return element_signals(seen, everyone, self.elements_m @ mount.T, self.frequency_hz) * self.gains

    def image(self, signals: ArrayLike, height: int, width: int) -> FloatArray:
        """The processor's Bartlett spectrum [..., height, width] of element signals [..., m].

        It knows where elements should be, but neither gains nor patterns nor mount.
        """
        return bartlett_spectrum(signals, self.elements_m, self.frequency_hz, height, width)

    def power(self, signals: ArrayLike) -> FloatArray:
        """Mean power [...] over the elements of signals [..., m]; 10 log10 of it is the array's RSSI in dB."""
        return np.square(np.abs(np.asarray(signals))).mean(axis=-1)


def instrument_report(image: ArrayLike, bits: int | None = 8) -> FloatArray:
    """What an instrument stores of a magnitude: scaled to its own minimum and maximum, cut to whole grey levels.

    Measured spectra show both (docs/receivers.md): magnitudes are scaled, not powers, and digits are cut off, not
    rounded, so that a stored grey is half a level too dark on average.

    Args:
        image: magnitudes [..., height, width].
        bits: of a grey level; None: not cut.

    Returns:
        Shape [..., height, width], 0 to 1.
    """
    scaled = minmax_scale(image)
    levels = 0 if bits is None else 2**bits - 1
    # The largest is 1 but for rounding, and must stay the highest level.
    return np.floor(scaled * levels * (1 + 4 * np.finfo(float).eps)) / levels if levels else scaled
