"""Conditions and observations of a record for a fit, and the form of the observations.

A *condition* is the input of a field: a row's transmitter position, or the uplink channel of one antenna of a row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Record
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..receivers.registry import AUTO, ObservationSpec, receiver_model
from ..tasks.conditions import normalised_uplink, outputs_of
from .config import TrainConfig


@dataclass(frozen=True)
class Targets:
    """Conditions and observations of a record.

    A port is a receiver at a carrier (`wrf_mi.graph.graph`).
    """

    condition: FloatArray  # positions [3, c] in metres or features [features, c]
    observed: NDArray[np.float32]  # observations [n_rx, c, *shape of an observation], NaN where nothing was received
    unit: FloatArray  # unit of each receiver's differences in the loss, [n_rx]
    per_row: int = 1  # number of consecutive conditions of a row
    weight: FloatArray | None = None  # factor of each observation's difference in the loss [n_rx, c]; None: 1
    carriers_hz: FloatArray | None = None  # carriers of the training rows, ascending; None: rows have a single carrier
    carrier: IntArray | None = None  # number of each row's carrier [c], -1 for carriers without training rows

    @property
    def ports(self) -> int:
        """Number of receivers times that of carriers."""
        return len(self.observed) * self.carriers

    @property
    def carriers(self) -> int:
        """Number of carriers of the training rows."""
        return 1 if self.carriers_hz is None else len(self.carriers_hz)

    def at_carrier(self, port: int, rows: IntArray) -> IntArray:
        """Those of some rows that have a port's carrier."""
        return rows if self.carrier is None else rows[self.carrier[rows] == port % self.carriers]

    def received(self, rows: IntArray) -> list[IntArray]:
        """Numbers of the conditions of those rows that each port's receiver observed at its carrier."""
        received = list[IntArray]()
        for port in range(self.ports):
            at_carrier = self.at_carrier(port, rows)
            conditions = (at_carrier[:, None] * self.per_row + np.arange(self.per_row)).ravel()
            received.append(conditions[self._complete[port // self.carriers, conditions]])
        return received

    @cached_property
    def _complete(self) -> NDArray[np.bool_]:
        """Whether each receiver observed each condition [n_rx, c]; of images it takes long, and is asked for often."""
        return np.asarray(np.isfinite(self.observed).all(axis=tuple(range(2, self.observed.ndim))))


def targets_of(record: Record, rows: IntArray, with_scene: bool = False) -> Targets:
    """Conditions and observations of a record; units are measured on training rows.

    An uplink is the condition where there is one, except beside paths of a scene, which are traced from positions.

    Raises:
        InputError: an unknown position, or an uplink without a signal or with a different number of antennas.
    """
    observed = np.asarray(record.observation)
    if record.uplink is not None and not with_scene:
        outputs = outputs_of(record)
        features, divisor = normalised_uplink(record.uplink)
        # Divided as the uplink is: path loss and the radios' phases are equal in both links and need not be learned.
        channels = observed[0].reshape(len(record), outputs.antennas, -1) / divisor[..., None]
        observed = _real(channels.reshape(1, -1, outputs.count).astype(np.complex64))
        targets = Targets(np.asarray(features.T, float), observed, np.ones(1), outputs.antennas)
        # Root mean square of the complex numbers, whose two parts have half of the mean square each.
        mean_square = float(np.mean(np.square(observed[0, targets.received(rows)[0]], dtype=float)))
        return replace(targets, unit=np.array([np.sqrt(2 * mean_square) or 1.0]))
    if not np.isfinite(record.tx_pos_m[rows]).all():
        row = int(rows[~np.isfinite(record.tx_pos_m[rows]).all(axis=1)][0])
        raise InputError(f"{record.name} has no position in row {row}; choose a model that needs none")
    unit = np.array([record.task.unit(values[rows]) for values in observed])
    targets = Targets(np.ascontiguousarray(record.tx_pos_m.T, float), _real(observed), unit)
    if (precision := record.precision(rows)) is not None:
        # Inverse standard deviation of the noise, 1 in other rows: differences become standardised residuals, an
        # absolute error is weighted by 1 / std, a squared one by 1 / variance.
        weight, inverse = np.ones(observed.shape[:2]), np.sqrt(precision)
        # A mean of 1, so that learning rates and losses compare with those of unweighted rows.
        weight[:, rows] = inverse / inverse[np.isfinite(observed[:, rows])].mean()
        targets = replace(targets, weight=weight)
    if record.carriers_hz is None:
        return targets
    carriers_hz = np.unique(record.carriers_hz[rows])
    carrier = np.searchsorted(carriers_hz, record.carriers_hz)
    carrier = np.where(np.isin(record.carriers_hz, carriers_hz), carrier, -1)
    return replace(targets, carriers_hz=carriers_hz, carrier=carrier)


def _real(values: NDArray[np.generic]) -> NDArray[np.float32]:
    """Complex values with a last axis of real and imaginary part."""
    if not np.iscomplexobj(values):
        return np.ascontiguousarray(values, np.float32)
    single = np.ascontiguousarray(values, np.complex64)
    return single.view(np.float32).reshape(*single.shape, 2)


def form_of(record: Record, rows: IntArray, config: TrainConfig, targets: Targets, with_scene: bool) -> ObservationSpec:
    """Form of a record's observations, whose basis is computed from training ``rows``.

    Raises:
        InputError: no receiver model has the observations, or one that does not suit them.
    """
    task, shape = record.task, record.observation.shape[2:]
    default, outputs = task.receiver_with_scene if with_scene else task.receiver, task.outputs(shape)
    if not default:
        raise InputError(f"{record.name}: no receiver model observes {task.name}; choose another model")
    name = default if config.receiver == AUTO else config.receiver
    receiver_model(name, task.name)
    if with_scene and len(outputs) > 1 and any(receiver.array_m is None for receiver in record.receivers):
        raise InputError(f"{record.name}: antennas' positions unknown; state base_station in base-station.yml")
    size = task.image_size(shape) or (config.view.height, config.view.columns)
    basis = _basis(targets, rows, config.view.components) if outputs else None
    features = 0 if record.uplink is None or with_scene else len(targets.condition)
    headings = with_scene and config.traced.pattern_degree > 0 and record.tx_heading_rad is not None
    floor_db = task.floor_db(record.observation[:, rows]) if with_scene else np.nan
    return ObservationSpec(
        name, size, record.frequencies_hz, outputs, basis, features, headings, floor_db, targets.carriers_hz
    )


def _basis(targets: Targets, rows: IntArray, most: int) -> NDArray[np.complex128]:
    """Principal components [components, outputs] of the training rows' channels, without subtraction of the mean."""
    # Receivers have equal weight, as scores are relative.
    power: NDArray[np.complex128] | float = 0.0
    for observed, received in zip(targets.observed, targets.received(rows), strict=True):
        parts = observed[received].astype(float)
        channels = (parts[..., 0] + 1j * parts[..., 1]).reshape(len(parts), -1)
        power = power + channels.conj().T @ channels / (np.square(np.abs(channels)).sum() or 1.0)
    _, vectors = np.linalg.eigh(power)
    # Rows v^H: a channel h has coefficients h v and is their sum with v^H.
    return np.ascontiguousarray(vectors[:, ::-1][:, :most].conj().T)
