"""NeRF2: two networks and a march along rays, for spectra, signal strengths and channels.

Source: Zhao, An, Pan and Yang, "NeRF2: neural radio-frequency radiance fields" (MobiCom 2023), and the authors' code
(XPengZhao/NeRF2, MIT). The networks and the march are in `wrf_mi.estimators.networks.nerf2_march`. As in that code all
receivers of a record share a pair of networks, unless ``shared`` is false. Chosen here:

- A step draws some transmitters and some rays and pairs each with each, because the attenuation network, most of the
  work, does not depend on the transmitter. The authors take 64 samples along a ray and 30,000 steps. Signal strengths
  and channels take rays of equal solid angle over the full sphere.
- Rays end at the farthest training transmitter (the authors': at 5 m or 60 m by data set).
- Encodings have fewer octaves than the authors' ten, whose shortest period of 12 mm makes spectra between training
  positions noise.
- The loss is the squared error of greys; of powers in dB, with an offset for each receiver; of channels.
- With an uplink, that is the condition in place of the position, antenna by antenna, divided by its size and mean
  phase; all rays start at the array's centre. Without an uplink, antennas are outputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.device import Recorded, to_tensor
from ...core import InputError, Prediction, Record, Split
from ...core.angles import FloatArray, fibonacci_sphere, pixel_directions
from ...core.settings import Count
from ...core.stored import NOT_STORED
from ...core.types import IntArray
from ...tasks import conditions
from ...training.config import AdamConfig, unused_of_loop, validates
from ...training.session import FitSession
from ..model import Arrays, Fitted, Inputs, Model, Problem, known_positions, received_rows, slices
from .layers import Coordinates, columns, feature_count
from .nerf2_march import Nerf2Network, Networks, RayPoints, constant_parts, look, march
from .training import Network, NetworkSettings, network_adam, opaque_rows, train_network

POINTS_PER_CHUNK = 1 << 15  # points whose attenuation is evaluated together in predictions
PAIRS_PER_CHUNK = 1 << 18
"""Pairs of a point and a condition that are evaluated together in predictions: bounds the memory."""


@dataclass(frozen=True)
class Nerf2Settings(NetworkSettings):
    """Settings of NeRF2 and of the training loop."""

    steps: int = 5000
    batch: int = 16  #: spectra of a step, at most
    validate_every: int = 500
    optimiser: AdamConfig = field(default_factory=lambda: network_adam(2e-3))
    networks: Networks = field(default_factory=Networks)  #: sizes of the networks
    rays: Count = 256  #: pixels of a spectrum in a step
    sphere_rays: Count = 64  #: rays over the full sphere, for signal strengths and channels
    #: transmitters of a step, at most, for signal strengths and channels; with an uplink, antennas of transmitters
    sphere_batch: Count = 128
    samples: Count = 4  #: points along a ray
    near_m: float = 0.0  #: distance from the receiver at which rays start, metres
    #: distance at which rays end, metres; 0: that of the farthest training transmitter, or 10 m where positions are not
    #: known
    far_m: float = 0.0
    tx_octaves: int = 4  #: octaves of the encoding of transmitter positions
    shared: bool = True  #: whether all receivers share a pair of networks

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.far_m and self.far_m <= self.near_m:
            raise InputError(f"setting far_m: {self.far_m} is not beyond near_m, {self.near_m}; choose more, or 0")


def rays_of(data: Mapping[str, Any], receiver: Any, picked: Any, count: int) -> dict[str, Any]:
    """Rays of a receiver: its index, the rays' indices, and how many rays a receiver has."""
    direction, origin = columns(data["direction"], picked + receiver * count), columns(data["origin"], receiver)
    return {**data, "direction": direction, "origin": origin}


@dataclass(eq=False)
class Nerf2Field(Fitted):
    """A fitted field, evaluated in two steps that are recorded once.

    Rays go through the pixels of spectra (`wrf_mi.core.angles`), or cover the full sphere.

    Attributes:
        far_m: distance from the receiver at which rays end, metres.
        scales: units of the receivers' channels [n_rx].
        weights: weights of the networks of each group; none during the fit.
        by_pixel: whether rays go through the pixels of spectra.
        groups: indices of the receivers that share networks.
        data: constants of every evaluation on the device: rays of all receivers, and `constant_parts`.
        network: networks whose weights are to be replaced.

    Raises:
        InputError: a receiver without a pose that is needed.
    """

    problem: Problem = field(metadata=NOT_STORED)
    settings: Nerf2Settings
    coordinates: Coordinates
    far_m: float
    scales: FloatArray
    weights: list[Arrays]

    def __post_init__(self) -> None:
        record, settings, coordinates, far_m = self.problem.record, self.settings, self.coordinates, self.far_m
        self.outputs, self.task = conditions.outputs_of(record), record.task
        self._shape = record.observation.shape[2:]
        self._points: tuple[int, list[RayPoints]] | None = None
        receivers = conditions.placed_receivers(record, self.outputs.by_uplink)
        everyone = tuple(range(len(receivers)))
        self.groups: tuple[tuple[int, ...], ...] = (everyone,) if settings.shared else tuple((r,) for r in everyone)
        size = self.task.image_size(self._shape)
        self.by_pixel = bool(size)
        rays = pixel_directions(*size).reshape(-1, 3) if size else fibonacci_sphere(settings.sphere_rays)
        self.n_rays = len(rays)
        self._condition = feature_count(settings.tx_octaves) if record.uplink is None else 2 * record.uplink.shape[-1]
        origins = np.stack([receiver.position_m for receiver in receivers]) - coordinates.centre_m
        extent_m, frequencies_hz = float(np.abs(origins).max()) + far_m, self.outputs.frequencies_hz
        parts = dict(constant_parts(extent_m, settings.near_m, far_m, settings.samples, frequencies_hz))
        parts["origin"] = origins.T
        parts["direction"] = np.concatenate([rays @ receiver.to_world.T for receiver in receivers]).T
        self.data = {name: to_tensor(values) for name, values in parts.items()}
        dr.make_opaque(self.data)  # literals would be compiled into the kernels of each receiver anew
        self.network = self.initial(np.random.default_rng(0))
        network, s = self.network, settings

        @Recorded
        def looked(params: dict[str, Any], rays: dict[str, Any]) -> Any:
            with dr.suspend_grad():
                return look(network.with_state(params), rays)

        @Recorded
        def marched(params: dict[str, Any], points: RayPoints, condition: Any, receiver: Any) -> Any:
            with dr.suspend_grad():
                batch, rays = condition.shape[1], points.first.shape[1] // s.samples
                parts = march(network.with_state(params), points, condition, s.samples)
                return self.task.of_rays(parts, (self.outputs.count, batch, rays), params["offset"], receiver)

        self._looked, self._marched = looked, marched

    def initial(self, rng: np.random.Generator) -> Nerf2Network:
        """Networks with random weights."""
        receivers = sum(len(members) for members in self.groups)
        return Nerf2Network(self.settings.networks, self._condition, self.outputs.count, receivers, rng)

    @cached_property
    def networks(self) -> list[Nerf2Network]:
        """Networks of each group with the fitted weights."""
        return [self.network.on_device(weights) for weights in self.weights]

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Spectra [m, height, width], powers [m] in dBm, or channels [m, subcarriers] or [m, antennas, subcarriers]."""
        network = next(n for n, members in zip(self.networks, self.groups, strict=True) if receiver in members)
        if self._points is None or self._points[0] != receiver:
            # One receiver's at a time: 270 MB for a spectrum of 32,400 pixels.
            self._points = receiver, self.look(network, receiver)
        condition, divisor = self.condition_of(inputs, receiver)
        values, shape = self.march(network, self._points[1], condition, receiver), (len(inputs), *self._shape)
        return Prediction(conditions.observations_from(self.task, values, divisor, shape))

    def look(self, network: Nerf2Network, receiver: int, rays: IntArray | None = None) -> list[RayPoints]:
        """Points of a receiver's rays, all by default, evaluated: in parts for spectra, else in one."""
        index = dr.opaque(mi.UInt32, receiver)
        everything = np.arange(self.n_rays) if rays is None else rays
        most = max(1, POINTS_PER_CHUNK // self.settings.samples)
        chunks = np.array_split(everything, -(-len(everything) // most) if self.by_pixel else 1)
        parts = [rays_of(self.data, index, opaque_rows(chunk), self.n_rays) for chunk in chunks]
        # Shapes of results are recorded for the shapes of tensors, and not of arrays.
        dr.eval(parts)
        return [self._looked(network.state(), part) for part in parts]

    def march(self, network: Nerf2Network, rays: list[RayPoints], condition: Any, receiver: int) -> NDArray[np.float32]:
        """Observations of the instrument for conditions [features, m]: [m, values]."""
        index, blocks = dr.opaque(mi.UInt32, receiver), []
        at_once = max(1, PAIRS_PER_CHUNK // max(part.first.shape[1] for part in rays))
        for rows in slices(condition.shape[1], at_once):
            chosen = columns(condition, opaque_rows(np.arange(rows.start, rows.stop)))
            dr.eval(chosen)
            observations = [self._marched(network.state(), part, chosen, index).numpy() for part in rays]
            blocks.append(np.concatenate(observations, axis=1))
        return np.concatenate(blocks)

    def condition_of(self, inputs: Inputs, receiver: int) -> tuple[Any, NDArray[Any] | float]:
        """Features of transmitters for the radiance network [features, m], and the factor of predicted channels."""
        if self.outputs.by_uplink:
            features, divisor = conditions.normalised_uplink(inputs.uplink)
            return to_tensor(features.T), divisor
        s = self.settings
        where = self.coordinates.features(inputs.tx_pos_m, s.tx_octaves, s.networks.scale_m)
        return where, float(self.scales[receiver])


def step_loss(network: Nerf2Network, data: Mapping[str, Any], drawn: Mapping[str, Any], field: Nerf2Field) -> Any:
    """Mean squared error of a batch of transmitters at one receiver, over the rays of the step.

    ``data`` has that of the field, ``condition`` [features, n] and ``truth`` [n_rx * n, values]; ``drawn`` has indices:
    ``rows``, ``rays`` and ``receiver``.
    """
    tensor, rays = type(data["direction"]), dr.width(drawn["rays"])
    points = look(network, rays_of(data, drawn["receiver"], drawn["rays"], field.n_rays))
    condition = columns(data["condition"], drawn["rows"])
    batch = condition.shape[1]
    parts = march(network, points, condition, field.settings.samples)
    predicted = field.task.of_rays(parts, (field.outputs.count, batch, rays), network.offset, drawn["receiver"])
    # Truths of the batch: spectra at the step's rays, other observations in whole.
    values = data["truth"].shape[1]
    predicted_values = predicted.shape[1]
    slot = dr.arange(type(drawn["rows"]), batch * predicted_values)
    row = (
        dr.gather(type(slot), drawn["rows"], slot // predicted_values) + drawn["receiver"] * data["condition"].shape[1]
    )
    column = (
        dr.gather(type(slot), drawn["rays"], slot % predicted_values) if field.by_pixel else slot % predicted_values
    )
    truth = tensor(
        dr.gather(type(data["truth"].array), data["truth"].array, row * values + column), (batch, predicted_values)
    )
    error = predicted - truth
    error = error * (1 / field.task.loss_unit)  # of size one, as greys are: one learning rate serves all
    return dr.mean(error * error, axis=None).array


SCORED_RAYS = 512  # pixels of each validation spectrum by which steps are chosen
FAR_M = 10.0  # length of rays if positions are not known: the size of a large room


def _fit_group(
    record: Record, split: Split, field: Nerf2Field, seed: int, session: FitSession, members: tuple[int, ...]
) -> Nerf2Network:
    s, outputs = field.settings, field.outputs
    training_rows = split.all_train
    # From here on rows count within the training rows.
    received = {r: received_rows(record, split, r, "nerf2") for r in members}
    rows = {r: tuple(np.searchsorted(training_rows, part) for part in parts) for r, parts in received.items()}
    rng = np.random.default_rng([seed, *members])
    condition, _ = field.condition_of(record.inputs(training_rows), members[0])
    truth = np.concatenate(
        [conditions.truth_of(record, outputs, r, training_rows, field.scales) for r in range(len(record.receivers))]
    )
    data = field.data | {"condition": condition, "truth": to_tensor(np.nan_to_num(truth))}
    dr.make_opaque(data)
    initial = field.initial(rng)
    if field.task.has_offsets:
        # Offsets start at the mean level: the networks then learn differences of a few dB.
        for r in members:
            initial.offset[r] = np.mean(record.observation[r, training_rows[np.concatenate(rows[r])]])
    n_rays, spectrum = field.n_rays, field.by_pixel
    config = s if spectrum else replace(s, batch=s.sphere_batch)
    all_rays = opaque_rows(np.arange(n_rays))

    def draw(chosen: IntArray, member: int, rng: np.random.Generator) -> Any:
        rays = opaque_rows(rng.choice(n_rays, min(s.rays, n_rays), replace=False)) if spectrum else all_rays
        return {"rows": opaque_rows(chosen), "rays": rays, "receiver": dr.opaque(mi.UInt32, members[member])}

    # The same pixels at every validation, as scores are compared between steps.
    scored = np.sort(np.random.default_rng(0).choice(n_rays, min(SCORED_RAYS, n_rays), replace=False))

    def score(network: Nerf2Network) -> float:
        errors = []
        for r in members:
            validation = conditions.conditions_of(rows[r][1], outputs)
            if len(validation):
                points = field.look(network, r, scored if spectrum else None)
                predicted = field.march(network, points, columns(condition, opaque_rows(validation)), r)
                wanted = truth[r * condition.shape[1] + validation]
                errors.append(np.square(predicted - (wanted[:, scored] if spectrum else wanted)).mean(axis=1))
        return float(np.mean(np.concatenate(errors)))

    train = [conditions.conditions_of(rows[r][0], outputs) for r in members]
    everything = [conditions.conditions_of(np.concatenate(rows[r]), outputs) for r in members]
    able = any(len(rows[r][1]) for r in members)
    name = "nerf2" if s.shared else f"nerf2 {record.receivers[members[0]].name}"
    rows_of = draw, train, everything, score if able else None
    network = Network(name, initial, partial(step_loss, field=field), data, *rows_of, "mean squared error")
    trained: Nerf2Network = train_network(network, config, (seed, *members), session)[0]
    return trained


class Nerf2Model(Model):
    """NeRF2."""

    name, settings, fitted = "nerf2", Nerf2Settings, Nerf2Field
    source = "Zhao, An, Pan and Yang, 'NeRF2: neural radio-frequency radiance fields' (MobiCom 2023) and its code"
    summary = "neural field of voxels, marched along rays"
    tasks = ("spectrum", "rssi", "csi")
    uplink, headings = "optional", True

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of rays of another task, of validation without rows, of positions beside an uplink."""
        s, record, unused = problem.settings, problem.record, unused_of_loop(problem.settings, validates(splits))
        if record.task.image_size(record.observation.shape):
            unused |= dict.fromkeys(("sphere_rays", "sphere_batch"), "rays are pixels of spectra")
        else:
            unused |= {"rays": "of spectra; give sphere_rays", "batch": "of spectra; give sphere_batch"}
        if s.networks.skip >= s.networks.layers:
            unused["networks.skip"] = f"there are {s.networks.layers} layers"
        if record.uplink is not None:
            unused["tx_octaves"] = "transmitters are described by their uplink"
        return unused | ({"shared": "there is one receiver"} if len(record.receivers) == 1 else {})

    def fit(self, problem: Problem, split: Split, session: FitSession) -> Nerf2Field:
        """Fit the networks (InputError: unknown positions or poses, or a receiver without training rows)."""
        record, training_rows = problem.record, split.all_train
        outputs, settings = conditions.outputs_of(record), problem.settings
        where = record.tx_pos_m[training_rows] if outputs.by_uplink else known_positions(record, training_rows, "nerf2")
        known_rx = np.stack([receiver.position_m for receiver in record.receivers])
        rx = np.stack([receiver.position_m for receiver in conditions.placed_receivers(record, outputs.by_uplink)])
        if np.isfinite(where).all() and np.isfinite(known_rx).all():
            farthest = float(np.linalg.norm(where[:, None] - rx, axis=2).max())
        else:
            where, farthest = rx, FAR_M
        scales = conditions.channel_scales(record, training_rows)
        field = Nerf2Field(problem, settings, Coordinates.of(where), settings.far_m or farthest, scales, [])
        for members in field.groups:
            field.weights.append(_fit_group(record, split, field, problem.seed, session, members).arrays())
        return field


MODEL = Nerf2Model()
