"""The linear map from the Gaussians' signals to an antenna array, or to sectors of directions, built once.

For Gaussians of static geometry blending is R = B S with sparse weights B [directions, n]
(`wrf_mi.gaussians.operator`). A receiver takes a linear functional of R too, a quadrature P over directions u with
solid angles w(u), so the whole map is one dense matrix of few rows, A = P B:

| | row of P | then |
| --- | --- | --- |
| array | w(u) exp(+j k p_m . u) of element m, over the upper hemisphere | Bartlett spectrum of h = A S |
| sectors | w(u) F(u) inside the sector, else 0, over the full sphere | power sum_s abs(h_s)^2 |
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.angles import FloatArray, azimuth_elevation, pixel_directions, solid_angles
from ..gaussians.footprint import Pose
from ..gaussians.operator import Images, in_blocks, weight_strips
from ..gaussians.parameters import Gaussians
from ..gaussians.tiles import Plane
from ..receivers.array import array_response, mirror_order
from .combine import LEAST_POWER
from .evaluations import facing_down, hemisphere_pair

ComplexArray = NDArray[np.complex64]


def port_matrix(gaussians: Gaussians, pose: Pose, plane: Plane, ports: ArrayLike, sphere: bool = False) -> ComplexArray:
    """A = P B, the response of each port to each Gaussian's signal, [m, n].

    Summed in double precision, over one row of tiles of the plane at a time.

    Args:
        gaussians: Gaussians for one transmitter; signals are not read.
        pose: pose of the receiver.
        plane: pixels of a hemisphere.
        ports: P, [m, pixels]; with ``sphere`` [m, 2 * pixels], directions of `hemisphere_pair`.
        sphere: the lower hemisphere too.
    """
    weight = np.asarray(ports, complex)
    matrix = np.zeros((gaussians.count, len(weight)), complex)
    for half, view in enumerate((pose, facing_down(pose)) if sphere else (pose,)):
        for first, strip in weight_strips(gaussians, view, plane):
            begin = half * plane.pixels + first
            matrix += strip.T.astype(complex) @ weight[:, begin : begin + strip.shape[0]].T
    return np.ascontiguousarray(matrix.T, np.complex64)


class _MirroredSteering(Images):
    """Steering vectors of an array that is its own mirror image, at half of the work.

    Elements at p and -p add up to (h + h') cos - j (h - h') sin of the phase k p . u. Takes the elements' response in
    the pixels [pixels, m], the number of each element's mirror image [m], rows and columns.
    """

    def __init__(self, response: NDArray[Any], opposite: NDArray[Any], height: int, width: int) -> None:
        self._first = np.flatnonzero(np.arange(len(opposite)) <= opposite)
        self._second = opposite[self._first]
        # An element in the middle is its own mirror image and would count twice.
        self._weight = np.where(self._first == self._second, 0.5, 1).astype(np.float32)
        super().__init__(response[:, self._first].T.astype(np.complex64), height, width)

    def rows(self, coefficients: NDArray[Any]) -> NDArray[Any]:
        a, b = coefficients[:, self._first], coefficients[:, self._second]
        even, odd = (a + b) * self._weight, a - b
        return np.block([[even.real, odd.imag], [even.imag, -odd.real]])


def steering(elements_m: FloatArray, frequency_hz: float, height: int, width: int) -> Images:
    """Map from element signals to the Bartlett spectrum, up to a phase in each pixel.

    Phases are those to the array's centre, wherever its origin is: magnitudes are equal, and an array that is its
    own mirror image is symmetric about its centre.
    """
    centred, directions = elements_m - elements_m.mean(axis=0), pixel_directions(height, width).reshape(-1, 3)
    response = array_response(centred, directions, frequency_hz)
    opposite = mirror_order(elements_m)
    if opposite is not None:
        return _MirroredSteering(response, opposite, height, width)
    return Images(response.T.conj().astype(np.complex64), height, width)


class _PortOperator:
    """A dense matrix from signals to ports.

    Args:
        matrix: response of each port to each Gaussian's signal, [m, n].
    """

    def __init__(self, matrix: ArrayLike) -> None:
        self.matrix: ComplexArray = np.ascontiguousarray(matrix, np.complex64)

    def signals(self, signals: ArrayLike) -> ComplexArray:
        """Complex signals [batch, m] at the ports of the Gaussians' complex signals [batch, n]."""
        rows = np.asarray(signals, np.complex64)
        out = np.empty((len(rows), len(self.matrix)), np.complex64)

        def block(part: ComplexArray, to: ComplexArray) -> None:
            to[:] = (self.matrix @ part[0])[None] if len(part) == 1 else part @ self.matrix.T

        in_blocks(block, rows, out)
        return out

    def composed(self, factors: ArrayLike) -> Self:
        """The operator of signals S = C c, for factors C [n, K]: its input is c [batch, K]."""
        result = copy(self)
        result.matrix = np.ascontiguousarray(self.matrix @ np.asarray(factors, np.complex64))
        return result


class ArrayOperator(_PortOperator):
    """Map from signals to an array's elements, and to its spectrum.

    Args:
        matrix: response of the elements, [m, n].
        elements_m: positions of the array's elements [m, 3], metres.
        frequency_hz: carrier frequency.
        height: elevations of the spectrum, over the upper hemisphere.
        width: azimuths.
    """

    def __init__(self, matrix: ArrayLike, elements_m: FloatArray, frequency_hz: float, height: int, width: int) -> None:
        super().__init__(matrix)
        self._steering = steering(elements_m, frequency_hz, height, width)

    @classmethod
    def of(
        cls, gaussians: Gaussians, pose: Pose, plane: Plane, elements_m: FloatArray, frequency_hz: float
    ) -> ArrayOperator:
        """The operator of Gaussians of static geometry; quadrature and spectrum on the directions of ``plane``."""
        directions = pixel_directions(plane.height, plane.width).reshape(-1, 3)
        ports = array_response(elements_m, directions, frequency_hz).T * solid_angles(plane.height, plane.width)
        return cls(port_matrix(gaussians, pose, plane, ports), elements_m, frequency_hz, plane.height, plane.width)

    def spectrum(self, signals: ArrayLike, scale: bool = False) -> NDArray[np.float32]:
        """Bartlett spectra [batch, height, width] of the Gaussians' complex signals [batch, n].

        Args:
            signals: signals for each transmitter.
            scale: each spectrum to its own minimum and maximum, as the instrument does (`minmax_scale`).
        """
        return self._steering.magnitude(self.signals(signals), scale=scale)


def sector_of(directions: ArrayLike, azimuths: int, elevations: int) -> NDArray[np.int64]:
    """Number of the sector, ``elevation * azimuths + azimuth``, of unit vectors [..., 3].

    Args:
        directions: unit vectors in the receiver's frame.
        azimuths: number of equal sectors of the full circle, the first from azimuth 0.
        elevations: number of equal sectors from -90 to 90 degrees.
    """
    azimuth, elevation = azimuth_elevation(directions)
    column = np.minimum((azimuth * (azimuths / (2 * np.pi))).astype(np.int64), azimuths - 1)
    row = np.clip(((elevation / np.pi + 0.5) * elevations).astype(np.int64), 0, elevations - 1)
    sector: NDArray[np.int64] = row * azimuths + column
    return sector


class SectorOperator(_PortOperator):
    """Map from signals to the amplitude from each sector of directions, and to received power.

    Inside a sector waves add as complex numbers, between sectors as powers. With one sector the whole sum is coherent,
    as in `wrf_mi.graph.combine.PowerReceiver`; with more, waves from different directions do not interfere, which
    averages over positions of the transmitter within a fraction of a wavelength.
    """

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        pose: Pose,
        plane: Plane,
        azimuths: int = 1,
        elevations: int = 1,
        pattern: Callable[[FloatArray], ArrayLike] | None = None,
    ) -> SectorOperator:
        """The operator of Gaussians of static geometry, over the full sphere.

        Args:
            gaussians: Gaussians for one transmitter.
            pose: pose of the receiver.
            plane: pixels of each hemisphere.
            azimuths: number of sectors in azimuth, see `sector_of`.
            elevations: number of sectors in elevation.
            pattern: the antenna's amplitude for unit vectors [..., 3] in the receiver's frame; None: isotropic.
        """
        directions = hemisphere_pair(plane.height, plane.width)
        weight = np.tile(solid_angles(plane.height, plane.width), 2)
        if pattern is not None:
            weight = weight * np.asarray(pattern(directions))
        inside = sector_of(directions, azimuths, elevations) == np.arange(azimuths * elevations)[:, None]
        return cls(port_matrix(gaussians, pose, plane, inside * weight, sphere=True))

    def power_db(self, signals: ArrayLike) -> FloatArray:
        """Received power [batch] in dB, sum over sectors of abs(amplitude)^2; -200 where nothing arrives."""
        power = np.square(np.abs(self.signals(signals).astype(complex))).sum(axis=1)
        return 10 * np.log10(power + LEAST_POWER)
