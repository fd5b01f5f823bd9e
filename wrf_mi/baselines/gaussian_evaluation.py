"""A field of Gaussians as one antenna receives it: summed over the full sphere, for each transmitter of a batch.

Source: see `wrf_mi.baselines.gaussian_fields`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_tensor
from ..core import InputError, Record
from ..core.angles import solid_angles
from ..field import Encoding
from ..fit.recorded import Recorded
from ..hybrid.learned import learned_field
from ..project.footprint import Pose
from ..splat.tiles import perception_plane
from ..tasks import Task, task_of
from .band_fields import BAND_FIELDS, FeatureEncoding, spread
from .conditions import Outputs, outputs_of, placed_receivers
from .tensors import columns
from .training import Training, opaque_rows

LEAST_POWER = 1e-12
"""Added to a power before its logarithm: 120 dB below a signal of one."""
DECIBELS = 10 / math.log(10)
"""Of a power by its natural logarithm."""
AT_ONCE = 64
"""Conditions of one prediction: their number is a constant of the recorded kernels."""


@dataclass(frozen=True)
class GaussianSettings:
    """Settings of both fields.

    Attributes:
        training: how they learn; ``batch`` counts transmitters (with an uplink: transmitters times antennas).
        gaussians: of a field.
        layers: of the network (of WRF-GS: of its attenuation network).
        width: its neurons.
        height: elevations of each hemisphere.
        columns: azimuths.
        size_deg: standard deviation of a Gaussian at the start, degrees.
        near_m: nearest Gaussian at the start, metres.
        far_m: farthest.
        position_octaves: of the encoding of Gaussians.
        tx_octaves: of the encoding of transmitter positions.
        scale_m: metres that make the unit of Gaussians.
        tx_scale_m: metres that make the unit of transmitters; 0: ``scale_m``, doubled until it tells all training
            transmitters apart (`wrf_mi.field.encoding`).
        components: of a channel over subcarriers, at most.
        shared: one field for all receivers, or else one for each.
    """

    training: Training = field(default_factory=lambda: Training(steps=3000, batch=16, rate=1e-3))
    gaussians: int = 60
    layers: int = 4
    width: int = 64
    height: int = 9
    columns: int = 36
    size_deg: float = 15.0
    near_m: float = 1.0
    far_m: float = 8.0
    position_octaves: int = 4
    tx_octaves: int = 4
    scale_m: float = 4.0
    tx_scale_m: float = 0.0
    components: int = 6
    shared: bool = False

    def __post_init__(self) -> None:
        """Refuse numbers that make no field.

        Raises:
            InputError: naming the setting.
        """
        least = {"gaussians": 1, "layers": 1, "width": 1, "height": 1, "columns": 1, "components": 1}
        least |= {"position_octaves": 1, "tx_octaves": 0, "tx_scale_m": 0}
        for name, smallest in least.items():
            if not getattr(self, name) >= smallest:
                raise InputError(f"{name} {getattr(self, name)}: choose {smallest} or more")
        for name in ("size_deg", "near_m", "far_m", "scale_m"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} {getattr(self, name)}: choose more than 0")
        if self.near_m > self.far_m:
            raise InputError(f"near_m {self.near_m} is beyond far_m {self.far_m}; choose less")


@dataclass(frozen=True)
class Frame:
    """All of a fitted field but its weights.

    Attributes:
        model: name of the field.
        task: of the record.
        outputs: complex numbers that are asked for.
        basis: unit vectors [components, outputs] that channels are sums of; [1, 1] for powers.
        scales: channels of each receiver are in units of it [n_rx].
        position: of each receiver [n_rx, 3], metres.
        to_world: rotation of each receiver [n_rx, 3, 3].
    """

    model: str
    task: Task
    outputs: Outputs
    basis: NDArray[np.complex128]
    scales: NDArray[np.float64]
    position: NDArray[np.float64]
    to_world: NDArray[np.float64]

    @property
    def components(self) -> int:
        """Complex signals of a Gaussian."""
        return len(self.basis)


def frame_of(model: str, record: Record, basis: NDArray[np.complex128], scales: NDArray[np.float64]) -> Frame:
    """The frame for a record's receivers.

    Raises:
        InputError: a receiver without a pose that is needed.
    """
    outputs = outputs_of(record)
    receivers = placed_receivers(record, outputs)
    place = np.stack([receiver.position_m for receiver in receivers])
    turned = np.stack([receiver.to_world for receiver in receivers])
    return Frame(model, task_of(record), outputs, basis, scales, place, turned)


class Evaluation:
    """A field with its receivers' places on the device.

    Args:
        settings: of the field.
        frame: of the field.
        features: number of features of a condition; 0: positions, which the field encodes.
    """

    def __init__(self, settings: GaussianSettings, frame: Frame, features: int) -> None:
        self.settings, self.frame = settings, frame
        s = settings
        encoding = (
            FeatureEncoding(s.position_octaves, s.scale_m, s.tx_octaves, s.tx_scale_m, features)
            if features
            else Encoding(s.position_octaves, s.scale_m, s.tx_octaves, s.tx_scale_m)
        )
        sizes: dict[str, Any] = {"encoding": encoding, "layers": s.layers, "width": s.width}
        if frame.model == "wrf-gs":
            sizes["signal_widths"] = (s.width, max(1, s.width // 2))
        else:
            sizes["skip"] = max(1, s.layers // 2)
        self.field = BAND_FIELDS[frame.model](**sizes, components=frame.components)
        self.data: dict[str, Any] = {
            "plane": perception_plane(s.height, s.columns, mi.Float),
            "solid_angle": to_tensor(np.tile(solid_angles(s.height, s.columns), 2)[None]),
            "position": to_tensor(frame.position.T),
            "to_world": to_tensor(frame.to_world.reshape(-1, 9).T),
        }
        dr.make_opaque(self.data)

        @Recorded
        def predicted(params: dict[str, Any], data: dict[str, Any], condition: Any, receiver: Any) -> Any:
            with dr.suspend_grad():
                return self.report(params, data, condition, receiver)

        self._predicted = predicted

    def amplitudes(self, params: Mapping[str, Any], data: Mapping[str, Any], condition: Any, receiver: Any) -> Any:
        """S of each condition [features or 3, batch] and component: its parts, flat [batch * components]."""
        gaussians = spread(self.field.gaussians(params, condition), self.frame.components)

        def number(tensor: Any, row: int) -> Any:
            return dr.gather(type(tensor.array), tensor.array, receiver + row * tensor.shape[1])

        turned = [[number(data["to_world"], 3 * i + k) for k in range(3)] for i in range(3)]
        pose = Pose([number(data["position"], k) for k in range(3)], turned)
        parts = learned_field(gaussians, pose, data["plane"], sphere=True)
        weight = dr.tile(data["solid_angle"].array, gaussians.batch)
        return [dr.block_sum(part * weight, 2 * data["plane"].pixels) for part in parts]

    def report(self, params: Mapping[str, Any], data: Mapping[str, Any], condition: Any, receiver: Any) -> Any:
        """Powers in dBm [batch, 1], or coefficients, real parts, then imaginary ones, [batch, 2 components]."""
        re, im = self.amplitudes(params, data, condition, receiver)
        kind, batch = type(data["solid_angle"]), condition.shape[1]
        if self.frame.task.in_decibel:
            offset = dr.gather(type(re), params["offset"].array, receiver)
            return kind(offset + DECIBELS * dr.log(re * re + im * im + LEAST_POWER), (batch, 1))
        shape = (batch, self.frame.components)
        return dr.concat([kind(re, shape), kind(im, shape)], axis=1)

    def predict(self, params: Mapping[str, Any], condition: Any, receiver: int) -> NDArray[np.float32]:
        """Reports of conditions [features, m], as NumPy array [m, values]."""
        m, index = condition.shape[1], dr.opaque(mi.UInt32, receiver)
        blocks = []
        for first in range(0, m, AT_ONCE):
            # The last block is filled up with copies of the last row; few rows are predicted as few.
            count = AT_ONCE if m >= AT_ONCE else m
            rows = np.minimum(np.arange(first, first + count), m - 1)
            chosen = columns(condition, opaque_rows(rows))
            dr.eval(chosen)
            blocks.append(self._predicted(dict(params), self.data, chosen, index).numpy()[: min(count, m - first)])
        return np.concatenate(blocks)
