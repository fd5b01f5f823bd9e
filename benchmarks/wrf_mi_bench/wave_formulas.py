"""Closed forms of wave propagation in float64, for the time factor exp(+j omega t).

Fields of diffraction are those of a point source in
the plane across the edge, soft (electric field along the edge, zero on a conductor) and hard (across it), relative to
exp(-j k) at a distance of 1 m from the source.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.special import fresnel, hankel2e, wofz

from wrf_mi.core.types import FloatArray

ComplexArray = NDArray[np.complex128]
NODES = 200  # of Gauss and Legendre's rule, for smooth integrands: relative errors below 1e-12
DECAYED = 7.0  # where exp(-t^2) is below 1e-21


def free_space(distance_m: ArrayLike, frequency_hz: float) -> ComplexArray:
    """Channel of isotropic antennas [...]: Friis' lambda / (4 pi d) with the phase exp(-j k d)."""
    wavelength, distance = speed_of_light / frequency_hz, np.asarray(distance_m, float)
    return np.asarray(wavelength / (4 * np.pi * distance) * np.exp(-2j * np.pi * distance / wavelength))


def slab(
    cosine: FloatArray, eta: ArrayLike, thickness_m: ArrayLike, frequency_hz: float
) -> tuple[tuple[ComplexArray, ComplexArray], tuple[ComplexArray, ComplexArray]]:
    """Reflected and transmitted share [p] of TE, then of TM waves: an Airy sum over both interfaces of a slab in air.

    ``eta`` is the complex relative permittivity. Source: Born and Wolf, "Principles of Optics" (1999), section 1.6.4;
    the sign of TM is that of ITU-R P.2040.
    """
    inside = np.sqrt(np.asarray(eta) - 1 + cosine**2)
    phase = np.exp(-2j * np.pi * frequency_hz / speed_of_light * np.asarray(thickness_m) * inside)
    result = []
    for first, second in ((cosine, inside), (cosine, inside / np.asarray(eta))):
        into, out = 2 * first / (first + second), 2 * second / (first + second)
        back = (first - second) / (first + second)
        series = 1 / (1 - (back * phase) ** 2)
        result.append((back - into * out * back * phase**2 * series, into * out * phase * series))
    return result[0], result[1]


def transition(x: FloatArray) -> ComplexArray:
    """Transition function F(x) = 2 j sqrt(x) exp(j x) times the integral of exp(-j t^2) from sqrt(x) to infinity.

    Source: Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction" (1974), Proc. IEEE 62(11), eq. 26.
    """
    # The integral is an error function, which `wofz` gives without the factor exp(-j x).
    turn = np.exp(1j * np.pi / 4)
    return np.asarray(np.sqrt(np.pi * x) * turn * wofz(1j * turn * np.sqrt(x)))


def wedge(
    n: float, wavenumber: float, near_m: float, far_m: float, incidence_rad: float, angle_rad: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Diffracted fields [p], soft and hard, behind the perfectly conducting wedge of exterior angle n pi.

    Source at ``near_m`` from the edge at the angle ``incidence_rad`` from the face 0, receivers at ``far_m`` at
    ``angle_rad`` [p], in the plane across the edge. Half plane: n = 2. Source: Kouyoumjian and Pathak (1974), eq. 25.
    """
    distance = near_m * far_m / (near_m + far_m)

    def terms(beta: FloatArray) -> ComplexArray:
        total = np.zeros(beta.shape, complex)
        for sign in (1, -1):
            turns = np.round((beta + sign * np.pi) / (2 * np.pi * n))
            a = 2 * np.cos((2 * np.pi * n * turns - beta) / 2) ** 2
            total += transition(wavenumber * distance * a) / np.tan((np.pi + sign * beta) / (2 * n))
        return total

    incident, reflected = terms(angle_rad - incidence_rad), terms(angle_rad + incidence_rad)
    factor = -np.exp(-1j * (np.pi / 4 + wavenumber * (near_m + far_m))) / (2 * n * np.sqrt(2 * np.pi * wavenumber))
    factor /= np.sqrt(near_m * far_m * (near_m + far_m))
    return factor * (incident - reflected), factor * (incident + reflected)


def half_plane(
    wavenumber: float, near_m: float, far_m: float, incidence_rad: float, angle_rad: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Exact total fields [p], soft and hard, at the perfectly conducting half plane; arguments as of `wedge`.

    Macdonald's extension of Sommerfeld's solution to a point source: the source's and its image's wave exp(-j k R) / R,
    each times the integral of H_1(k R + t^2) / sqrt(t^2 + 2 k R) from -m to infinity over that from -infinity, with
    m = 2 sqrt(k r r' / (R + r + r')) cos(psi / 2).

    Source: Macdonald, "A class of diffraction problems" (1915), Proc. London Math. Soc. 14; Bowman, Senior and
    Uslenghi, "Electromagnetic and acoustic scattering by simple shapes" (1969), chapter 8.
    """
    node, weight = np.polynomial.legendre.leggauss(NODES)
    # Along the direction of steepest descent the integrand decays as exp(-t^2).
    turn, t, weight = np.exp(-1j * np.pi / 4), DECAYED / 2 * (node + 1), DECAYED / 2 * weight

    def wave(psi: FloatArray) -> ComplexArray:
        distance = np.sqrt(near_m**2 + far_m**2 - 2 * near_m * far_m * np.cos(psi))
        m = 2 * np.sqrt(wavenumber * near_m * far_m / (distance + near_m + far_m)) * np.cos(psi / 2)
        kr = wavenumber * distance[:, None]

        def tail(lower: FloatArray) -> ComplexArray:
            path = lower[:, None] + turn * t
            hankel = hankel2e(1, kr + path**2) * np.exp(-1j * path**2)  # without the common factor exp(-j k R)
            return np.asarray((hankel / np.sqrt(path**2 + 2 * kr)) @ weight)

        share = tail(np.abs(m)) / (2 * tail(np.zeros_like(m)))
        return np.asarray(np.where(m > 0, 1 - share, share) * np.exp(-1j * wavenumber * distance) / distance, complex)

    incident, reflected = wave(angle_rad - incidence_rad), wave(angle_rad + incidence_rad)
    return incident - reflected, incident + reflected


def knife_edge(height_m: FloatArray, near_m: float, far_m: float, frequency_hz: float) -> FloatArray:
    """Amplitude [p] behind a knife edge ``height_m`` above the line between two antennas, relative to free space.

    Distances are those along the line. Source: ITU-R P.526-15, equations 26 and 30.
    """
    v = height_m * np.sqrt(2 / (speed_of_light / frequency_hz) * (1 / near_m + 1 / far_m))
    sine, cosine = fresnel(v)
    return np.asarray(np.hypot(1 - cosine - sine, cosine - sine) / 2)


def lambertian_power(
    tx_m: FloatArray, rx_m: FloatArray, low_m: ArrayLike, high_m: ArrayLike, coefficient: float, frequency_hz: float
) -> float:
    """Power gain of isotropic antennas by a perfectly conducting wall at x = 0 that scatters diffusely.

    The integral of (lambda S / (4 pi))^2 cos(theta_i) cos(theta_s) / (pi r_i^2 r_s^2) over the wall's y and z, from
    ``low_m`` to ``high_m``. Source: Degli-Esposti et al., "Measurement and modelling of scattering from buildings"
    (2007), IEEE Trans. Antennas Propag. 55(1), the Lambertian model.
    """
    node, weight = np.polynomial.legendre.leggauss(NODES)
    low, high = np.asarray(low_m, float), np.asarray(high_m, float)
    points, half = (low + high) / 2 + np.multiply.outer(node, (high - low) / 2), (high - low) / 2
    place = np.stack(np.broadcast_arrays(0.0, points[:, None, 0], points[None, :, 1]), axis=-1)
    density = np.full(place.shape[:2], (speed_of_light / frequency_hz * coefficient / (4 * np.pi)) ** 2 / np.pi)
    for end in (tx_m, rx_m):
        density *= abs(end[0]) / np.linalg.norm(place - end, axis=-1) ** 3
    return float(half.prod() * weight @ density @ weight)
