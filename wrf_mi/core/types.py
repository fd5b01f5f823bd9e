"""Plain types that all packages share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import NDArray

from .angles import FloatArray as FloatArray
from .angles import IntArray as IntArray
from .angles import rotation_matrix
from .antenna import ANTENNA, Antenna, AntennaOptions
from .task import CONVERSIONS, Task, task_named

T = TypeVar("T")
Observations = NDArray[np.float32 | np.complex64]
"""Grey values, powers in dBm or channel coefficients (`Record.observation`)."""


@dataclass(frozen=True)
class Inputs:
    """Known quantities of m rows to predict; never their observations."""

    tx_pos_m: FloatArray  # positions of the transmitter [m, 3], metres; NaN where unknown
    tx_heading_rad: FloatArray | None = None  # headings of the transmitter [m], or None
    uplink: NDArray[Any] | None = None  # uplink channel coefficients [m, antennas, subcarriers], complex64, or None
    first_row: int = 0  # number of the first row, for messages
    carriers_hz: FloatArray | None = None  # carrier of each row [m], Hz, or None where the data have a single carrier
    #: run of the measurement of each row [m], see `Record.runs`; None: another one than those of the data
    runs: NDArray[np.str_] | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.tx_pos_m)

    def rows(self, chosen: slice | IntArray) -> Inputs:
        """Inputs of some rows; ``first_row`` of an array is that of all rows."""
        start = (chosen.start or 0) if isinstance(chosen, slice) else 0
        names = ("tx_pos_m", "tx_heading_rad", "uplink", "carriers_hz", "runs")
        columns: dict[str, Any] = {name: getattr(self, name) for name in names}
        of_rows: dict[str, Any] = {name: None if values is None else values[chosen] for name, values in columns.items()}
        return replace(self, **of_rows, first_row=self.first_row + start)


@dataclass(frozen=True)
class Receiver:
    """Pose and antenna of a receiver.

    Attributes:
        name: name in the measurement files.
        position_m: shape [3], world frame, metres; NaN where unknown.
        orientation_xyzw: unit quaternion, receiver's frame to world.
        antenna: antenna of the receiver, or of each element of its array.
        array_m: elements of its antenna array [m, 3], receiver's frame, metres; None: a single antenna or unknown.
        frequency_hz: carrier of all that it receives, Hz, where receivers of signal strengths have different carriers;
            None: that of the record or of each row.
        position_std_m: standard deviations [3] of a position that is estimated, metres; None: it is stated.

    A receiver whose frame is turned by 90 degrees about the vertical:

    >>> receiver = Receiver("anchor1", np.array([0.0, 0, 2]), np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)]))
    >>> (receiver.to_world @ [1, 0, 0]).round(6) + 0.0
    array([0., 1., 0.])
    """

    name: str
    position_m: FloatArray
    orientation_xyzw: FloatArray
    antenna: Antenna = ANTENNA
    array_m: FloatArray | None = None
    frequency_hz: float | None = None
    position_std_m: FloatArray | None = None

    @property
    def is_surveyed(self) -> bool:
        """Whether its position is stated."""
        return self.position_std_m is None and bool(np.isfinite(self.position_m).all())

    @property
    def to_world(self) -> FloatArray:
        """Rotation [3, 3] from the receiver's frame to the world's."""
        return rotation_matrix(self.orientation_xyzw)


# Type checkers heed what an attribute of a data class may be set to, a task or its name, only where the decorator is
# declared so.
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def _frozen(kind: type[T]) -> type[T]:
    return dataclass(frozen=True)(kind)


class TaskOrName:
    """Attribute of a record that is set to a task or its name and read as the task."""

    # The record keeps the name: a pickled record is read in a process where packages register their tasks anew.

    def __get__(self, record: Record | None, owner: type[Record] | None = None) -> Task:
        if record is None:
            raise AttributeError("task")  # what a data class has no default for
        return task_named(vars(record)["task"], record.source or record.name)

    def __set__(self, record: Record, task: Task | str) -> None:
        vars(record)["task"] = task if isinstance(task, str) else task.name


@_frozen
class Record:
    """A set of measurements: transmitter positions, receivers and what each receiver observed.

    Attributes:
        name: name of the data set.
        task: kind of ``observation`` (`wrf_mi.core.Task`), stated by its name or as an object. ``"spectrum"``: grey
            values [n_rx, n, height, width] in 0..1, float32. ``"rssi"``: received power [n_rx, n] in dBm, float32, NaN
            where nothing was received. ``"csi"``: channel coefficients [n_rx, n, subcarriers] of receivers with one
            antenna or [n_rx, n, antennas, subcarriers], complex64. `InputError` where it is read: an unknown task.
        tx_pos_m: positions of the moving end [n, 3], world frame, metres; by reciprocity it is the transmitter. NaN
            where unknown.
        receivers: the ``n_rx`` static receivers.
        observation: measurements with first axes [n_rx, n].
        official: training and test rows (from 0) that came with the data, or None.
        folds: the spatial block of each row, shape [n], or None.
        frequencies_hz: frequency of the carrier, shape [1], or of each subcarrier of ``observation``; None where
            unknown, and with ``carriers_hz``. Where receivers state their carriers, the middle one of these.
        tx_heading_rad: yaw of the transmitter's body about +z, from +x towards +y, shape [n], or None.
        tx_antenna: antenna of the transmitter.
        uplink: channel coefficients at the uplink's frequencies, known for every row, from which the downlink's in
            ``observation`` are predicted: [n, antennas, uplink subcarriers], complex64; or None.
        uplink_hz: frequency of each subcarrier of ``uplink``, or None.
        truth: ``observation`` without its noise, where it is synthetic, or None. For scores (`scored`) only: models may
            not use it.
        n_readings: number of readings of which each signal strength is the mean, [n_rx, n], 0 where nothing was
            received; None where unknown.
        std: standard deviation of the noise of each signal strength in dB, [n_rx, n], NaN where nothing was received;
            for a mean of readings the standard deviation of the mean. None where unknown.
        carriers_hz: carrier of each row in Hz, [n], of spectra and signal strengths that were measured at several
            carriers; None where all rows have the same.
        runs: run of the measurement, such as a walk, a day or a device, in which each row was taken, texts [n]; None
            where unknown. Signal strengths of a run may have an offset of their own.
        source: file or folder of the data.

    Signal strengths of two transmitter positions at one receiver:

    >>> receiver = Receiver("anchor1", np.zeros(3), np.array([0.0, 0, 0, 1]))
    >>> strengths = np.array([[-40.0, -46.0]], np.float32)
    >>> record = Record("made-up", "rssi", np.array([[1.0, 0, 0], [2, 0, 0]]), (receiver,), strengths)
    >>> len(record), record.observation.shape
    (2, (1, 2))
    """

    name: str
    task: TaskOrName
    tx_pos_m: FloatArray
    receivers: tuple[Receiver, ...]
    observation: Observations
    official: tuple[IntArray, IntArray] | None = None
    folds: IntArray | None = None
    frequencies_hz: FloatArray | None = None
    tx_heading_rad: FloatArray | None = None
    tx_antenna: Antenna = ANTENNA
    uplink: NDArray[np.complex64] | None = None
    uplink_hz: FloatArray | None = None
    truth: Observations | None = None
    n_readings: IntArray | None = None
    std: FloatArray | None = None
    carriers_hz: FloatArray | None = None
    runs: NDArray[np.str_] | None = None
    source: str = field(default="", compare=False)

    def __len__(self) -> int:
        """Number of transmitter positions (rows)."""
        return len(self.tx_pos_m)

    def inputs(self, rows: slice | IntArray = slice(None)) -> Inputs:
        """Inputs of some rows."""
        return Inputs(self.tx_pos_m, self.tx_heading_rad, self.uplink, 0, self.carriers_hz, self.runs).rows(rows)

    @property
    def scored(self) -> Observations:
        """Values that predictions are scored against: the truth where it is known, else the observation."""
        return self.observation if self.truth is None else self.truth

    def with_array(self, array_m: FloatArray | None) -> Record:
        """The record with the same array, elements [m, 3] in metres or None, at every receiver."""
        return replace(self, receivers=tuple(replace(receiver, array_m=array_m) for receiver in self.receivers))

    def with_antennas(self, options: AntennaOptions) -> Record:
        """The record with the antennas' attributes that options state; `InputError`: names that `Antenna` refuses."""
        if not options:
            return self
        receivers = (replace(each, antenna=options.replaced(each.antenna, "rx")) for each in self.receivers)
        return replace(self, receivers=tuple(receivers), tx_antenna=options.replaced(self.tx_antenna, "tx"))

    def seen(self, split: Split) -> Record:
        """The record as if the receivers that a split holds out had received nothing but the rows it leaves them."""
        if not split.held_receivers:
            return self
        receiver, row = split.left.T

        def hidden(values: NDArray[Any]) -> NDArray[Any]:
            visible = values.copy()
            visible[list(split.held_receivers)] = 0 if values.dtype.kind in "iu" else np.nan  # no readings, or unknown
            visible[receiver, row] = values[receiver, row]
            return visible

        return replace(self, **self._of_receivers(hidden))

    def _of_receivers(self, function: Callable[[NDArray[Any]], NDArray[Any]]) -> dict[str, Any]:
        # Of the arrays whose first axis counts receivers, by the names of the attributes.
        arrays = {name: getattr(self, name) for name in ("observation", "truth", "std", "n_readings")}
        return {name: None if values is None else function(values) for name, values in arrays.items()}

    def at_receivers(self, receivers: Sequence[int] | IntArray) -> Record:
        """The record with some receivers alone, by their numbers."""
        chosen = tuple(self.receivers[number] for number in receivers)
        return replace(self, receivers=chosen, **self._of_receivers(lambda values: values[list(receivers)]))

    def at_carrier(self, carrier_hz: float) -> Record:
        """The record with one carrier in Hz for every row and receiver."""
        receivers = tuple(replace(receiver, frequency_hz=None) for receiver in self.receivers)
        return replace(self, receivers=receivers, frequencies_hz=np.array([float(carrier_hz)]), carriers_hz=None)

    def at_carriers(self, carriers_hz: FloatArray | None) -> Record:
        """The record with the carrier in Hz of each row, [n]; None: the record as it is."""
        if carriers_hz is None:
            return self
        if len(np.unique(carriers_hz)) == 1:
            return self.at_carrier(carriers_hz[0])
        return replace(self, frequencies_hz=None, carriers_hz=carriers_hz)

    def at_receiver_carriers(self, carriers_hz: FloatArray | None) -> Record:
        """The record with the carrier in Hz of each receiver, [n_rx]; None: the record as it is."""
        if carriers_hz is None:
            return self
        distinct = np.unique(carriers_hz)
        record = self.at_carrier(distinct[len(distinct) // 2])
        if len(distinct) == 1:
            return record
        pairs = zip(self.receivers, carriers_hz, strict=True)
        return replace(record, receivers=tuple(replace(rx, frequency_hz=float(carrier)) for rx, carrier in pairs))

    @property
    def receiver_carriers_hz(self) -> FloatArray | None:
        """Carrier in Hz of each receiver, [n_rx], where receivers state their carriers; else None."""
        carriers = [receiver.frequency_hz for receiver in self.receivers]
        carriers_hz = np.array([np.nan if carrier is None else carrier for carrier in carriers])
        return None if np.isnan(carriers_hz).all() else carriers_hz

    def precision(self, rows: IntArray) -> FloatArray | None:
        """Inverse variance [n_rx, m] of the noise of m rows' observations, relative to a typical reading's.

        (median of ``std`` / ``std``)^2 where the data state ``std``, with the median over the observations received in
        these rows; else ``n_readings``: a mean of n independent readings has an n-th of their variance. 1 where nothing
        was received; None where the data state neither.
        """
        if self.std is None:
            return None if self.n_readings is None else np.maximum(self.n_readings[:, rows], 1).astype(float)
        std = self.std[:, rows]
        finite = np.isfinite(std)
        relative = std / (np.median(std[finite]) if finite.any() else 1.0)
        return np.where(finite, relative, 1.0) ** -2

    def to_xarray(self) -> Any:
        """The record as an `xarray.Dataset` with named dimensions, which `wrf_mi.load` reads.

        ``observation`` has the dimensions ``row``, ``receiver`` and ``elevation`` and ``azimuth``, ``subcarrier``, or
        ``antenna`` and ``subcarrier``. `InputError`: xarray is not installed.
        """
        return CONVERSIONS["xarray"](self)

    @property
    def has_positions(self) -> bool:
        """Whether every row's position is known."""
        return bool(np.isfinite(self.tx_pos_m).all())


# After the class, as a value in its body would be a default of the argument.
Record.task = TaskOrName()


@dataclass(frozen=True)
class Split:
    """Rows for training, for the choice of settings and for scores; rows count from 0.

    With ``held_receivers``, numbers of receivers, models see no observation of these but those of ``left``, pairs of
    such a receiver and a training row [q, 2], and scores are of these receivers alone.
    ``validation`` rows are training data, kept apart from ``train`` while settings are chosen; the final fit uses both
    (``all_train``). ``wanted_m`` are positions where predictions are wanted [k, 3], metres, by which held-out training
    rows are chosen; without any those of the test rows are.

    >>> Split("mine", 0, train=np.array([0, 3]), validation=np.array([1]), test=np.array([2])).all_train
    array([0, 1, 3])
    """

    name: str
    seed: int
    train: IntArray
    validation: IntArray
    test: IntArray
    held_receivers: tuple[int, ...] = ()
    left: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    wanted_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def at_receivers(self, receivers: Sequence[int] | IntArray) -> Split:
        """The split of `Record.at_receivers`, for numbers of receivers in ascending order.

        >>> split = Split("mine", 0, np.array([0]), np.array([1]), np.array([2]), held_receivers=(0, 2))
        >>> split.at_receivers([1, 2]).held_receivers
        (1,)
        """
        numbers = np.asarray(receivers, np.int64)
        held_receivers = np.searchsorted(numbers, np.intersect1d(self.held_receivers, numbers).astype(np.int64))
        left = self.left[np.isin(self.left[:, 0], numbers)]
        pairs = np.stack([np.searchsorted(numbers, left[:, 0]), left[:, 1]], axis=1)
        return replace(self, held_receivers=tuple(held_receivers.tolist()), left=pairs)

    @property
    def all_train(self) -> IntArray:
        """Training and validation rows together, sorted."""
        return np.sort(np.concatenate([self.train, self.validation]))
