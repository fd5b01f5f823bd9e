"""Inputs and targets of fields for spectra, signal strengths and channels, as NumPy arrays.

With an uplink each antenna of each row is a condition, as in NeRF2's code; else each position is one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Receiver, Record, Task
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.carriers import middle_carrier
from ..core.types import IntArray
from . import instrument_of


def real_parts(values: NDArray[Any]) -> NDArray[np.float32]:
    """Real parts, then imaginary ones, of complex numbers [m, ...], [m, 2 k]."""
    flat = values.reshape(len(values), -1)
    return np.concatenate([flat.real, flat.imag], axis=1).astype(np.float32)


def normalised_uplink(uplink: NDArray[Any] | None) -> tuple[NDArray[np.float32], NDArray[np.complex128]]:
    """Uplink channels [m, antennas, subcarriers] as features, and the complex divisor of each.

    Every antenna's channel is divided by its root mean square and by the phase of its mean over subcarriers, which
    removes the radios' amplitude and phase, equal in both links.

    Returns:
        Real parts, then imaginary ones, of each row's antennas one after the other, [m * antennas, 2 subcarriers], and
        the divisors [m, antennas].

    Raises:
        InputError: no uplink, or an antenna without any signal in some row.
    """
    if uplink is None:
        raise InputError("fitted to uplink channels, but the rows to predict have none; give `uplink`")
    h = np.asarray(uplink, np.complex128)
    rms = np.sqrt(np.square(np.abs(h)).mean(axis=-1))
    if not (np.isfinite(rms) & (rms > 0)).all():
        row, antenna = np.argwhere(~(np.isfinite(rms) & (rms > 0)))[0]
        raise InputError(f"uplink of row {row}, antenna {antenna} is zero or not finite; leave that row out")
    mean = h.mean(axis=-1)
    size = np.abs(mean)
    turn = np.where(size > 0, mean / np.where(size > 0, size, 1), 1)  # no phase to remove where the mean is zero
    divisor = rms * turn
    return real_parts((h / divisor[..., None]).reshape(-1, h.shape[-1])), divisor


@dataclass(frozen=True)
class Outputs:
    """Complex numbers of a ray."""

    by_uplink: bool  # whether the uplink channel is the condition instead of the position
    antennas: int  # antennas of the base station; each is a condition with the uplink, else an output
    frequencies_hz: FloatArray  # frequency of each output, [outputs]; 0 where unknown

    @property
    def count(self) -> int:
        """Number of complex numbers of a ray."""
        return len(self.frequencies_hz)


def conditions_of(rows: IntArray, outputs: Outputs) -> IntArray:
    """Numbers of the conditions of rows: with an uplink those of each antenna."""
    per_row = outputs.antennas if outputs.by_uplink else 1
    return np.asarray((rows[:, None] * per_row + np.arange(per_row)).ravel())


def outputs_of(record: Record) -> Outputs:
    """The outputs for a record (InputError: other antennas than the uplink's, or several receivers beside one)."""
    if not record.task.is_complex:
        frequencies_hz = record.frequencies_hz
        return Outputs(False, 1, np.zeros(1) if frequencies_hz is None else np.asarray(frequencies_hz, float)[:1])
    shape = record.observation.shape
    antennas, subcarriers = (1, shape[2]) if len(shape) == 3 else (shape[2], shape[3])
    # Narrow channels may come with their carrier alone.
    stated_hz = np.zeros(1) if record.frequencies_hz is None else np.asarray(record.frequencies_hz, float)
    frequencies_hz = np.broadcast_to(stated_hz, (subcarriers,))
    if record.uplink is None:
        return Outputs(False, antennas, np.tile(frequencies_hz, antennas))
    if record.uplink.shape[1] != antennas:
        raise InputError(
            f"{record.name}: has an uplink of {record.uplink.shape[1]} antennas and a downlink of {antennas}; "
            "give both for the same antennas"
        )
    if len(record.receivers) != 1:
        raise InputError(f"{record.name}: has one uplink for {len(record.receivers)} receivers; give one each")
    return Outputs(True, antennas, frequencies_hz)


def scene_carrier(record: Record, rows: IntArray | slice = slice(None)) -> float:
    """Carrier in Hz at which a scene is opened for a record: its own, or the middle one of some rows."""
    if record.carriers_hz is None:
        return instrument_of(record).carrier_hz
    return middle_carrier(record.carriers_hz[rows])


def placed_receivers(record: Record, by_uplink: bool) -> tuple[Receiver, ...]:
    """The receivers of a record, with finite poses.

    With an uplink as the condition a receiver of unknown position defines the world frame: at the origin, upright
    unless its orientation is known.

    Raises:
        InputError: an unknown pose, where transmitters are described by positions.
    """
    placed = []
    for receiver in record.receivers:
        position, turned = np.asarray(receiver.position_m, float), np.asarray(receiver.orientation_xyzw, float)
        if not (np.isfinite(position).all() and np.isfinite(turned).all()):
            if not by_uplink:
                raise InputError(
                    f"{record.name}: the pose of receiver {receiver.name} is not known, which fields over positions "
                    "need; give its position and orientation, or channels with an uplink"
                )
            position = position if np.isfinite(position).all() else np.zeros(3)
            turned = turned if np.isfinite(turned).all() else np.array(UPRIGHT)
        placed.append(replace(receiver, position_m=position, orientation_xyzw=turned))
    return tuple(placed)


def known_headings(heading_rad: ArrayLike | None, count: int, used: bool) -> FloatArray | None:
    """Headings [count] of transmitters, radians, None for models that use none (InputError: unsuitable ones)."""
    if (heading_rad is not None) != used:
        unused = "does not know how the transmitter is turned; omit heading_rad"
        raise InputError(f"transmitter: the model {'needs headings; give heading_rad' if used else unused}")
    if heading_rad is None:
        return None
    heading = np.asarray(heading_rad, float)
    if heading.shape != (count,) or not np.isfinite(heading).all():
        raise InputError(f"headings: shape {list(heading.shape)} or not finite; give one for each of {count} rows")
    return heading


def channel_scales(record: Record, rows: IntArray) -> FloatArray:
    """Units of each receiver's channels in given rows [n_rx] (`wrf_mi.tasks.Task.unit`); 1 for other tasks."""
    task = record.task
    if not task.is_complex:
        return np.ones(len(record.receivers))
    return np.array([task.unit(observed[rows]) for observed in record.observation])


def truth_of(
    record: Record, outputs: Outputs, receiver: int, rows: IntArray, scales: FloatArray
) -> NDArray[np.float32]:
    """Targets of the networks, one row for each condition.

    Greys [n, pixels]; powers [n, 1] in dBm; channels, real parts and then imaginary ones, [n, 2 outputs] in units of
    the receiver's ``scales``, or [n * antennas, 2 outputs] divided as in `normalised_uplink`.
    """
    observed = record.observation[receiver, rows]
    if not record.task.is_complex:
        return np.asarray(observed, np.float32).reshape(len(rows), -1)
    if outputs.by_uplink:
        assert record.uplink is not None
        divisor = normalised_uplink(record.uplink[rows])[1]
        channel = observed.reshape(len(rows), outputs.antennas, -1) / divisor[..., None]
    else:
        channel = observed / scales[receiver]
    return real_parts(channel.reshape(-1, outputs.count))


def observations_from(
    task: Task, targets: NDArray[Any], divisor: NDArray[Any] | float, shape: tuple[int, ...]
) -> NDArray[Any]:
    """Observations of ``shape`` from targets, the inverse of `truth_of`."""
    return channels_from(targets, divisor, shape) if task.is_complex else targets.reshape(shape)


def channels_from(parts: NDArray[Any], divisor: NDArray[Any] | float, shape: tuple[int, ...]) -> NDArray[np.complex64]:
    """Channels of ``shape`` from targets [conditions, 2 outputs], the inverse of `truth_of`."""
    half = parts.shape[1] // 2
    channel = np.asarray(parts[:, :half] + 1j * parts[:, half:])
    if isinstance(divisor, np.ndarray):
        channel = channel.reshape(*divisor.shape, -1) * divisor[..., None]
    else:
        channel = channel * divisor
    return channel.reshape(shape).astype(np.complex64)
