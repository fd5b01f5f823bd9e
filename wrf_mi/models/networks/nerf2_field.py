"""A field of NeRF2 for a record's receivers: where its rays are, what they bring, what it is fitted to.

Source: see `wrf_mi.models.networks.nerf2`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_tensor
from ...backend.recorded import Recorded
from ...core import InputError, Receiver, Record
from ...core.angles import FloatArray, fibonacci_sphere, pixel_directions
from ...core.settings import Count
from ...core.types import SQUARED_MAGNITUDE_EPS, IntArray
from ...tasks import Task, task_of
from ...tasks.conditions import Outputs, known_uplink, normalised_uplink, outputs_of, placed_receivers
from ...training.loop_config import AdamConfig
from ..method import Inputs
from .coordinates import Coordinates
from .nerf2_march import Networks, Rays, Seen, constant_parts, look, march
from .tensors import columns
from .training import NetworkSettings, network_adam, opaque_rows

DB_UNIT = 10.0
"""Decibels that make one unit of the loss of signal strengths."""
POINTS_PER_CHUNK = 1 << 15
"""Points whose attenuation is evaluated together in predictions."""
PAIRS_PER_CHUNK = 1 << 18
"""Pairs of a point and a condition that are evaluated together in predictions: bounds the memory."""


@dataclass(frozen=True)
class Nerf2Settings(NetworkSettings):
    """Settings of NeRF2, beside those of the loop.

    Attributes:
        batch: spectra of a step, at most.
        networks: sizes of the networks.
        rays: pixels of a spectrum in a step.
        sphere_rays: rays over the full sphere, for signal strengths and channels.
        sphere_batch: transmitters of a step, at most, for these two; with an uplink, antennas of transmitters.
        samples: points along a ray.
        near_m: distance at which rays start.
        far_m: distance at which they end; 0: that of the farthest training transmitter, or where positions are
            not known `FAR_M`.
        tx_octaves: of the encoding of transmitter positions.
        shared: one pair of networks for all receivers, or else one for each.
    """

    steps: int = 5000
    batch: int = 16
    validate_every: int = 500
    optimiser: AdamConfig = field(default_factory=lambda: network_adam(2e-3))
    networks: Networks = field(default_factory=Networks)
    rays: Count = 256
    sphere_rays: Count = 64
    sphere_batch: Count = 128
    samples: Count = 4
    near_m: float = 0.0
    far_m: float = 0.0
    tx_octaves: int = 4
    shared: bool = True

    def __post_init__(self) -> None:
        """Refuse what is no march.

        Raises:
            InputError: naming the setting.
        """
        super().__post_init__()
        if self.far_m and self.far_m <= self.near_m:
            raise InputError(f"setting far_m: {self.far_m} is not beyond near_m, {self.near_m}; choose more, or 0")


@dataclass(frozen=True)
class Frame:
    """All of a fitted field but its weights.

    Attributes:
        coordinates: frame of positions.
        far_m: where rays end.
        scales: channels of each receiver are in units of it [n_rx].
        outputs: what rays bring.
        task: of the record.
        directions: of rays in the world [n_rx, rays, 3].
        origins: of rays [n_rx, 3].
        groups: indices of the receivers that share networks.
    """

    coordinates: Coordinates
    far_m: float
    scales: FloatArray
    outputs: Outputs
    task: Task
    directions: NDArray[np.float64]
    origins: NDArray[np.float64]
    groups: tuple[tuple[int, ...], ...]


def world_directions(record: Record, receivers: Sequence[Receiver], sphere_rays: int) -> FloatArray:
    """Unit vectors of each receiver's rays in the world's frame, [n_rx, rays, 3].

    Those of the pixels for spectra (`wrf_mi.core.angles`), else ``sphere_rays`` over the full sphere.
    """
    if task_of(record).image:
        height, width = record.observation.shape[-2:]
        own = pixel_directions(height, width).reshape(-1, 3)
    else:
        own = fibonacci_sphere(sphere_rays)
    return np.stack([own @ receiver.to_world.T for receiver in receivers])


def frame_of(
    record: Record, settings: Nerf2Settings, coordinates: Coordinates, far_m: float, scales: FloatArray
) -> Frame:
    """The frame for a record's receivers.

    Raises:
        InputError: a receiver without a pose that is needed.
    """
    everyone = tuple(range(len(record.receivers)))
    outputs = outputs_of(record)
    receivers = placed_receivers(record, outputs.by_uplink)
    return Frame(
        coordinates,
        far_m,
        scales,
        outputs,
        task_of(record),
        world_directions(record, receivers, settings.sphere_rays),
        np.stack([receiver.position_m for receiver in receivers]),
        (everyone,) if settings.shared else tuple((r,) for r in everyone),
    )


def device_data(frame: Frame, settings: Nerf2Settings) -> dict[str, Any]:
    """What every evaluation needs, on the device: rays of all receivers, and the parts of `Rays` that all share."""
    c = frame.coordinates
    parts = constant_parts(
        frame.origins[0],
        c.centre_m,
        float(np.abs(frame.origins - c.centre_m).max()) + frame.far_m,
        settings.near_m,
        frame.far_m,
        settings.samples,
        frame.outputs.frequencies_hz,
    )
    data = {name: to_tensor(values) for name, values in parts.items()}
    data["origin"] = to_tensor((frame.origins - c.centre_m).T)
    data["direction"] = to_tensor(frame.directions.reshape(-1, 3).T)
    dr.make_opaque(data)
    return data


def rays_of(data: Mapping[str, Any], receiver: Any, picked: Any, count: int) -> Rays:
    """Rays of a receiver: its index, the rays' indices, and how many rays a receiver has."""
    shared = {name: data[name] for name in ("distance", "cell", "before", "wave_re", "wave_im", "extent")}
    return Rays(columns(data["direction"], picked + receiver * count), columns(data["origin"], receiver), **shared)


def report(params: Mapping[str, Any], parts: tuple[Any, Any], task: Task, shape: tuple[int, int, int], rx: Any) -> Any:
    """What the instrument reports, from the rays' flat parts [outputs * batch * rays]; a tensor.

    Greys [batch, rays]; powers in dBm [batch, 1]; channels' real parts, then imaginary ones, [batch, 2 outputs].
    """
    outputs, batch, rays = shape
    re, im = parts
    tensor = type(params["offset"])
    if task.image:
        return tensor(dr.sqrt(re * re + im * im + SQUARED_MAGNITUDE_EPS), (batch, rays))
    # Of equal solid angle; the root keeps incoherent sums at one size for any number of rays.
    re, im = (dr.block_sum(part, rays) * (1 / np.sqrt(rays)) for part in (re, im))
    if task.in_decibel:
        offset = dr.gather(type(re), params["offset"].array, rx)
        power = offset + float(10 / np.log(10)) * dr.log(re * re + im * im + SQUARED_MAGNITUDE_EPS)
        return tensor(power, (batch, 1))
    both = tensor(dr.concat([re, im]), (2 * outputs, batch))
    return dr.moveaxis(both, 0, 1)


def step_loss(
    params: Mapping[str, Any], data: Mapping[str, Any], given: Mapping[str, Any], frame: Frame, s: Nerf2Settings
) -> Any:
    """Mean squared error of a batch of transmitters at one receiver, over the rays of the step.

    Args:
        params: weights.
        data: of `device_data`, with ``condition`` [features, n] and ``truth`` [n_rx * n, values].
        given: ``rows``, ``rays`` and ``receiver``, indices.
        frame: of the field.
        s: settings.
    """
    tensor, rays = type(data["direction"]), dr.width(given["rays"])
    seen = look(s.networks, params, rays_of(data, given["receiver"], given["rays"], frame.directions.shape[1]))
    condition = columns(data["condition"], given["rows"])
    batch = condition.shape[1]
    parts = march(params, seen, condition, s.samples)
    predicted = report(params, parts, frame.task, (frame.outputs.count, batch, rays), given["receiver"])
    values = data["truth"].shape[1]
    asked = predicted.shape[1]
    slot = dr.arange(type(given["rows"]), batch * asked)
    row = dr.gather(type(slot), given["rows"], slot // asked) + given["receiver"] * data["condition"].shape[1]
    column = dr.gather(type(slot), given["rays"], slot % asked) if frame.task.image else slot % asked
    truth = tensor(dr.gather(type(data["truth"].array), data["truth"].array, row * values + column), (batch, asked))
    error = predicted - truth
    if frame.task.in_decibel:
        error = error * (1 / DB_UNIT)
    return dr.mean(error * error, axis=None).array


class Field:
    """A field that predicts: networks with their rays, and what its points were found to be.

    Args:
        settings: of NeRF2.
        frame: of the field.
    """

    def __init__(self, settings: Nerf2Settings, frame: Frame) -> None:
        self.settings, self.frame = settings, frame
        self.data = device_data(frame, settings)
        s, count = settings, frame.directions.shape[1]

        @Recorded
        def looked(params: dict[str, Any], data: dict[str, Any], receiver: Any, picked: Any) -> Any:
            with dr.suspend_grad():
                return look(s.networks, params, rays_of(data, receiver, picked, count))

        @Recorded
        def marched(params: dict[str, Any], seen: Seen, condition: Any, receiver: Any) -> Any:
            with dr.suspend_grad():
                batch, rays = condition.shape[1], seen.own.shape[1] // s.samples
                parts = march(params, seen, condition, s.samples)
                return report(params, parts, frame.task, (frame.outputs.count, batch, rays), receiver)

        self._looked, self._marched = looked, marched

    def look(self, params: Mapping[str, Any], receiver: int, rays: IntArray | None = None) -> list[Seen]:
        """What the points of a receiver's rays, all by default, are: in parts for spectra, else in one."""
        everything = np.arange(self.frame.directions.shape[1]) if rays is None else rays
        most = max(1, POINTS_PER_CHUNK // self.settings.samples)
        count = -(-len(everything) // most) if self.frame.task.image else 1
        index = dr.opaque(mi.UInt32, receiver)
        return [
            self._looked(dict(params), self.data, index, opaque_rows(part))
            for part in np.array_split(everything, count)
        ]

    def march(self, params: Mapping[str, Any], seen: list[Seen], condition: Any, receiver: int) -> NDArray[np.float32]:
        """What the instrument reports for conditions [features, m]: [m, values]."""
        m, index = condition.shape[1], dr.opaque(mi.UInt32, receiver)
        blocks = []
        at_once = max(1, PAIRS_PER_CHUNK // max(part.own.shape[1] for part in seen))
        for first in range(0, m, at_once):
            chosen = columns(condition, opaque_rows(np.arange(first, min(m, first + at_once))))
            dr.eval(chosen)
            reports = [self._marched(dict(params), part, chosen, index).numpy() for part in seen]
            blocks.append(np.concatenate(reports, axis=1))
        return np.concatenate(blocks)


def condition_of(
    frame: Frame, settings: Nerf2Settings, inputs: Inputs, receiver: int
) -> tuple[Any, NDArray[Any] | float]:
    """What the radiance network knows of transmitters [features, m], and what channels are multiplied by.

    Raises:
        InputError: no uplink, where one is needed.
    """
    if frame.outputs.by_uplink:
        features, divisor = normalised_uplink(known_uplink(inputs.uplink))
        return to_tensor(features.T), divisor
    where = frame.coordinates.features(inputs.tx_pos_m, settings.tx_octaves, settings.networks.scale_m)
    return where, float(frame.scales[receiver])
