"""The linear map from the Gaussians' signals to an antenna array, or to sectors of directions, built once.

For Gaussians that stand still, blending is R = B S with sparse weights B [directions, n] (`wrf_mi.gaussians.operator`).
What a receiver takes up of R is linear too, a quadrature P over directions u with solid angles w(u), so the whole map
is one dense matrix of few rows, A = P B:

| | row of P | then |
| --- | --- | --- |
| array | w(u) exp(+j k p_m . u) of element m, over the upper hemisphere | Bartlett spectrum of h = A S |
| sectors | w(u) F(u) inside the sector, else 0, over the full sphere | power sum_s abs(h_s)^2 |
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.angles import FloatArray, azimuth_elevation, pixel_directions, solid_angles
from ..gaussians.footprint import Pose
from ..gaussians.operator import Images, in_blocks, magnitudes, weight_strips
from ..gaussians.parameters import Gaussians
from ..gaussians.tiles import Plane
from ..receivers.array import array_response
from ..receivers.beams import mirror_order

ComplexArray = NDArray[np.complex64]

LEAST_POWER = 1e-20
"""Added to a power before its logarithm: the report ends at -200 dB, as that of `wrf_mi.graph.combine`."""


def port_matrix(gaussians: Gaussians, pose: Pose, plane: Plane, ports: ArrayLike, sphere: bool = False) -> ComplexArray:
    """A = P B: what each port takes up of each Gaussian's signal, [m, n].

    Summed in double precision, over one row of tiles of the plane at a time.

    Args:
        gaussians: for one transmitter; signals are not read.
        pose: of the receiver.
        plane: pixels of a hemisphere.
        ports: P, [m, pixels]; with ``sphere`` [m, 2 * pixels], the upper hemisphere, then the lower one as seen by
            the receiver turned about its x axis by half a turn.
        sphere: the lower hemisphere too.
    """
    weight = np.asarray(ports, complex)
    matrix = np.zeros((gaussians.count, len(weight)), complex)
    turned = Pose(pose.position, [[row[0], -row[1], -row[2]] for row in pose.to_world])
    for half, own in enumerate((pose, turned) if sphere else (pose,)):
        for first, strip in weight_strips(gaussians, own, plane):
            begin = half * plane.pixels + first
            matrix += strip.T.astype(complex) @ weight[:, begin : begin + strip.shape[0]].T
    return np.ascontiguousarray(matrix.T, np.complex64)


class _MirroredSteering(Images):
    """The processor's steering vectors of an array that is its own mirror image: half of the work.

    Elements at p and -p add up to (h + h') cos - j (h - h') sin of the phase k p . u.

    Args:
        response: of the elements in the pixels, [pixels, m].
        opposite: number of each element's mirror image, [m].
        height: rows.
        width: columns.
    """

    def __init__(self, response: NDArray[Any], opposite: NDArray[Any], height: int, width: int) -> None:
        self._first = np.flatnonzero(np.arange(len(opposite)) <= opposite)
        self._second = opposite[self._first]
        own = response[:, self._first].T
        self._weight = np.where(self._first == self._second, 0.5, 1).astype(np.float32)
        self.table = np.concatenate([own.real, own.imag]).astype(np.float32)
        self.height, self.width = height, width

    def rows(self, coefficients: NDArray[Any]) -> NDArray[Any]:
        """See `Images.rows`."""
        a, b = coefficients[:, self._first], coefficients[:, self._second]
        # An element in the middle is its own mirror image and would count twice.
        even, odd = (a + b) * self._weight, a - b
        return np.block([[even.real, odd.imag], [even.imag, -odd.real]])


def steering(elements_m: FloatArray, frequency_hz: float, height: int, width: int) -> Images:
    """From element signals to the processor's Bartlett spectrum, up to a phase in each pixel.

    Phases are those to the array's centre, wherever its origin is: magnitudes are the same, and an array that is its
    own mirror image is one about its centre.
    """
    centred, directions = elements_m - elements_m.mean(axis=0), pixel_directions(height, width).reshape(-1, 3)
    response = array_response(centred, directions, frequency_hz)
    opposite = mirror_order(elements_m)
    if opposite is not None:
        return _MirroredSteering(response, opposite, height, width)
    return Images(response.T.conj().astype(np.complex64), height, width)


class ArrayOperator:
    """From signals to an array's elements, and on to its spectrum.

    Args:
        matrix: [m, n].
        elements_m: positions of the array's elements [m, 3], metres.
        frequency_hz: carrier frequency.
        height: elevations of the spectrum, over the upper hemisphere.
        width: azimuths.
    """

    def __init__(self, matrix: ArrayLike, elements_m: FloatArray, frequency_hz: float, height: int, width: int) -> None:
        self.matrix: ComplexArray = np.ascontiguousarray(matrix, np.complex64)
        self._spectrum_of = elements_m, frequency_hz, height, width
        self._steering = steering(*self._spectrum_of)

    @classmethod
    def of(
        cls, gaussians: Gaussians, pose: Pose, plane: Plane, elements_m: FloatArray, frequency_hz: float
    ) -> ArrayOperator:
        """The operator of Gaussians that stand still; quadrature and spectrum both on the directions of ``plane``."""
        directions = pixel_directions(plane.height, plane.width).reshape(-1, 3)
        ports = array_response(elements_m, directions, frequency_hz).T * solid_angles(plane.height, plane.width)
        return cls(port_matrix(gaussians, pose, plane, ports), elements_m, frequency_hz, plane.height, plane.width)

    def signals(self, signals: ArrayLike) -> ComplexArray:
        """Element signals [batch, m] of the Gaussians' complex signals [batch, n]."""
        given = np.asarray(signals, np.complex64)
        out = np.empty((len(given), len(self.matrix)), np.complex64)

        def block(part: NDArray[np.complex64], to: NDArray[np.complex64]) -> None:
            to[:] = (self.matrix @ part[0])[None] if len(part) == 1 else part @ self.matrix.T

        in_blocks(block, given, out)
        return out

    def spectrum(self, signals: ArrayLike, scale: bool = False) -> NDArray[np.float32]:
        """Bartlett spectra [batch, height, width] of the Gaussians' complex signals [batch, n].

        Args:
            signals: of each transmitter.
            scale: each spectrum to its own minimum and maximum, as the instrument does (`minmax_scale`).
        """
        return magnitudes(self._steering, self.signals(signals), 0.0, scale)

    def composed(self, factors: ArrayLike) -> ArrayOperator:
        """The operator of signals S = C c, for factors C [n, K]: it takes c [batch, K]."""
        return ArrayOperator(self.matrix @ np.asarray(factors, np.complex64), *self._spectrum_of)


def sector_of(directions: ArrayLike, azimuths: int, elevations: int) -> NDArray[np.int64]:
    """Number of the sector, ``elevation * azimuths + azimuth``, of unit vectors [..., 3].

    Args:
        directions: receiver's frame.
        azimuths: equal sectors of the full circle, the first from azimuth 0.
        elevations: equal sectors from -90 to 90 degrees.
    """
    azimuth, elevation = azimuth_elevation(directions)
    column = np.minimum((azimuth * (azimuths / (2 * np.pi))).astype(np.int64), azimuths - 1)
    row = np.clip(((elevation / np.pi + 0.5) * elevations).astype(np.int64), 0, elevations - 1)
    sector: NDArray[np.int64] = row * azimuths + column
    return sector


class SectorOperator:
    """From signals to the amplitude that arrives from each sector of directions, and to received power.

    Inside a sector waves add as complex numbers, between sectors as powers. One sector is all of it coherently, as
    `wrf_mi.graph.combine.PowerReceiver` has it; more forget the interference of waves from different directions, which
    a transmitter's way of a fraction of a wavelength changes.

    Args:
        matrix: [sectors, n].
    """

    def __init__(self, matrix: ArrayLike) -> None:
        self.matrix: ComplexArray = np.ascontiguousarray(matrix, np.complex64)

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
        """The operator of Gaussians that stand still, over the full sphere.

        Args:
            gaussians: for one transmitter.
            pose: of the receiver.
            plane: pixels of each hemisphere.
            azimuths: see `sector_of`.
            elevations: likewise.
            pattern: the antenna's amplitude for unit vectors [..., 3] in the receiver's frame; None: isotropic.
        """
        upper = pixel_directions(plane.height, plane.width).reshape(-1, 3)
        directions = np.concatenate([upper, upper * [1, -1, -1]])
        weight = np.tile(solid_angles(plane.height, plane.width), 2)
        if pattern is not None:
            weight = weight * np.asarray(pattern(directions))
        inside = sector_of(directions, azimuths, elevations) == np.arange(azimuths * elevations)[:, None]
        return cls(port_matrix(gaussians, pose, plane, inside * weight, sphere=True))

    def amplitudes(self, signals: ArrayLike) -> ComplexArray:
        """Complex amplitude [batch, sectors] of the Gaussians' complex signals [batch, n]."""
        given = np.asarray(signals, np.complex64)
        out = np.empty((len(given), len(self.matrix)), np.complex64)
        in_blocks(lambda part, to: np.matmul(part, self.matrix.T, out=to), given, out)
        return out

    def power_db(self, signals: ArrayLike) -> FloatArray:
        """Received power [batch] in dB, sum over sectors of abs(amplitude)^2; -200 where nothing arrives."""
        power = np.square(np.abs(self.amplitudes(signals).astype(complex))).sum(axis=1)
        return 10 * np.log10(power + LEAST_POWER)

    def composed(self, factors: ArrayLike) -> SectorOperator:
        """The operator of signals S = C c, for factors C [n, K]: it takes c [batch, K]."""
        return SectorOperator(self.matrix @ np.asarray(factors, np.complex64))
