"""The plain types that the packages hand to each other."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .angles import FloatArray, rotation_matrix
from .antenna import ANTENNA, Antenna

IntArray = NDArray[np.int64]

SQUARED_MAGNITUDE_EPS = 1e-8
"""Added to |R|^2 under a root or a logarithm, whose gradient is unbounded at zero: the least magnitude is 1e-4."""


@dataclass(frozen=True)
class Receiver:
    """Pose and antenna of a receiver.

    Attributes:
        name: as in the measurement files.
        position_m: shape [3], world frame, metres.
        orientation_xyzw: unit quaternion, receiver's frame to world.
        antenna: of the receiver, or of each element of its array.
        array_m: elements of its antenna array [m, 3], receiver's frame, metres; None: one antenna, or the data do not
            tell.
    """

    name: str
    position_m: FloatArray
    orientation_xyzw: FloatArray
    antenna: Antenna = ANTENNA
    array_m: FloatArray | None = None

    @property
    def to_world(self) -> FloatArray:
        """Rotation [3, 3] from the receiver's frame to the world's."""
        return rotation_matrix(self.orientation_xyzw)


@dataclass(frozen=True)
class Record:
    """A set of measurements: transmitter positions, receivers and what each receiver observed.

    Attributes:
        name: of the data set.
        task: what ``observation`` holds. ``"spectrum"``: grey values [n_rx, n, height, width] in 0..1, float32.
            ``"rssi"``: received power [n_rx, n] in dBm, float32, NaN where nothing was received.
            ``"csi"``: channel coefficients [n_rx, n, subcarriers] of receivers with one antenna or
            [n_rx, n, antennas, subcarriers], complex64.
        tx_pos_m: positions of the moving end [n, 3], world frame, metres; by reciprocity it is the transmitter. NaN
            where the data do not tell.
        receivers: the ``n_rx`` receivers, which stand still.
        observation: first axes [n_rx, n].
        official: training and test rows (from 0) that came with the data, or None.
        folds: the spatial block of each row, shape [n], or None.
        frequencies_hz: of the carrier, shape [1], or of each subcarrier of ``observation``; None where the data do not
            tell, and with ``carriers_hz``.
        tx_heading_rad: yaw of the transmitter's body about +z, from +x towards +y, shape [n], or None.
        tx_antenna: antenna of the transmitter.
        uplink: channel coefficients at the uplink's frequencies, known for every row, from which those in
            ``observation``, the downlink's, are to be predicted: [n, antennas, uplink subcarriers], complex64; or None.
        uplink_hz: frequency of each subcarrier of ``uplink``, or None.
        truth: ``observation`` without its noise, where it is synthetic, or None. For scores alone (see `scored`): a
            method may not look at it.
        n_readings: number of readings of which each signal strength is the mean, [n_rx, n], 0 where nothing was
            received; None where the data do not tell.
        std: standard deviation of the noise of each signal strength in dB, [n_rx, n], NaN where nothing was received;
            of the mean itself (the readings' divided by the root of their number) where it is one of several readings.
            None where the data do not tell.
        carriers_hz: carrier of each row in Hz, [n], of spectra and signal strengths that were measured at several;
            None where all rows have one.
        source: where it was read from.
    """

    name: str
    task: str
    tx_pos_m: FloatArray
    receivers: tuple[Receiver, ...]
    observation: NDArray[np.float32] | NDArray[np.complex64]
    official: tuple[IntArray, IntArray] | None = None
    folds: IntArray | None = None
    frequencies_hz: FloatArray | None = None
    tx_heading_rad: FloatArray | None = None
    tx_antenna: Antenna = ANTENNA
    uplink: NDArray[np.complex64] | None = None
    uplink_hz: FloatArray | None = None
    truth: NDArray[np.float32] | NDArray[np.complex64] | None = None
    n_readings: IntArray | None = None
    std: FloatArray | None = None
    carriers_hz: FloatArray | None = None
    source: str = field(default="", compare=False)

    def __len__(self) -> int:
        """Number of transmitter positions (rows)."""
        return len(self.tx_pos_m)

    @property
    def scored(self) -> NDArray[np.float32] | NDArray[np.complex64]:
        """What predictions are held against: the truth where it is known, else the observation."""
        return self.observation if self.truth is None else self.truth

    def with_array(self, array_m: FloatArray | None) -> Record:
        """The same measurements by receivers that all have one array, elements [m, 3] in metres, or None."""
        return replace(self, receivers=tuple(replace(one, array_m=array_m) for one in self.receivers))

    def at_carrier(self, carrier_hz: float) -> Record:
        """The same record with one carrier in Hz for every row."""
        return replace(self, frequencies_hz=np.array([float(carrier_hz)]), carriers_hz=None)

    def at_carriers(self, carriers_hz: FloatArray) -> Record:
        """The same record with the carrier in Hz of each row, [n]; where all are equal, with one carrier."""
        if len(np.unique(carriers_hz)) == 1:
            return self.at_carrier(carriers_hz[0])
        return replace(self, frequencies_hz=None, carriers_hz=carriers_hz)

    def precision(self, rows: IntArray) -> FloatArray | None:
        """Inverse variance of the noise of some rows' observations, relative to that of a usual reading.

        It is (median of ``std`` / ``std``)^2 where the data state ``std``, the median over what was received in these
        rows, and else ``n_readings``: the noise of a mean of n independent readings has an n-th of their variance.

        Args:
            rows: numbers of rows [m].

        Returns:
            Shape [n_rx, m], 1 where nothing was received; None where the data state neither.
        """
        if self.std is None:
            return None if self.n_readings is None else np.maximum(self.n_readings[:, rows], 1).astype(float)
        std = self.std[:, rows]
        known = np.isfinite(std)
        relative = std / (np.median(std[known]) if known.any() else 1.0)
        return np.where(known, relative, 1.0) ** -2

    @property
    def has_positions(self) -> bool:
        """Whether every row's position is known."""
        return bool(np.isfinite(self.tx_pos_m).all())


@dataclass(frozen=True)
class Split:
    """Which rows train, which choose settings and which score; rows count from 0.

    ``validation`` rows are part of the training data and are disjoint from ``train`` only while settings
    are chosen; the final fit uses ``train`` and ``validation`` together (see ``all_train``).
    """

    name: str
    seed: int
    train: IntArray
    validation: IntArray
    test: IntArray

    @property
    def all_train(self) -> IntArray:
        """Training and validation rows together, sorted."""
        return np.sort(np.concatenate([self.train, self.validation]))
