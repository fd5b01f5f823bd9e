"""WRF-GS and WRF-GS+ for signal strengths and channels, as the two case studies of their paper use them.

The field is summed over the directions of the full sphere by an antenna without pattern, s = sum_u w(u) R(u), w(u) the
solid angle. A signal strength is 10 log10 of its power and one offset a receiver; a channel is s itself on each
subcarrier.

What the paper leaves open, and what was chosen:

- Signal strengths. It trains one field for each receiver; so does the default, ``shared`` makes one for all. Its loss
  is not stated: here the mean absolute error in dB, as errors are reported, over the rows that were received.
- Channels. "The input is changed from the TX's location to the uplink CSI": each antenna's uplink, normalised as
  `wrf_mi.baselines.conditions.normalised_uplink`, is a condition of its own, and the downlink, divided by the same, is
  compared by its squared error. A Gaussian has a few complex signals, coefficients of the principal components of the
  training rows' downlink over subcarriers, all receivers' together: 26 subcarriers in one band are far from
  independent, and noise that the components leave out is not learned. Without an uplink the position is the condition,
  as for spectra.
- Sizes: networks and pictures are smaller than for spectra, since all directions end in one number.

Source: Wen, Tong, Hu, Lin and Zhang, "Neural representation for wireless radiation field reconstruction: a 3D Gaussian
splatting approach" (WRF-GS+), its two case studies.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_tensor
from ..core import Record, Split
from ..core.types import IntArray
from ..field import random_gaussians
from ..field.encoding import telling_scale
from ..field.network import Weights
from ..tasks import task_of
from .conditions import (
    Outputs,
    channel_scales,
    channels_from,
    conditions_of,
    normalised_uplink,
    outputs_of,
    placed_receivers,
    truth_of,
    uplink_of,
)
from .gaussian_evaluation import AT_ONCE, Evaluation, Frame, GaussianSettings, frame_of
from .method import Inputs, Listen, Method, inputs_of
from .tensors import columns
from .training import Descent, Training, epochs, fit_network, keyed, opaque_rows, positions, under, usable_rows

DB_UNIT = 10.0
"""Decibels that make one unit of the loss of signal strengths."""
SHARES: Mapping[str, float] = {
    "position": 5.0,
    "log_scale": 5.0,
    "rotation": 2.0,
    "opacity": 20.0,
    "signal": 5.0,
    "offset": 20.0,
}
"""Learning rates of Gaussians in units of the networks' rate, those of `wrf_mi.fit.config.OptimiserConfig`."""


def components_of(channels: NDArray[np.complex128], most: int) -> NDArray[np.complex128]:
    """Principal components [components, outputs] of channels [n, outputs], without their mean taken off."""
    power = channels.conj().T @ channels
    _, vectors = np.linalg.eigh(power)
    # Rows v^H so that a channel's coefficients are h v and the channel is their sum with v^H.
    return np.ascontiguousarray(vectors[:, ::-1][:, :most].conj().T)


class FittedGaussians:
    """Fields that were fitted.

    Args:
        settings: of the fields.
        frame: of the fields.
        features: see `Evaluation`.
        fields: weights of each field, one for all receivers or one for each.
        shape: of one observation.
    """

    def __init__(
        self, settings: GaussianSettings, frame: Frame, features: int, fields: list[Weights], shape: tuple[int, ...]
    ) -> None:
        self._settings, self._frame, self._features, self._fields = settings, frame, features, fields
        self._shape = shape
        self._evaluation = Evaluation(settings, frame, features)
        self._params = [{name: to_tensor(w) for name, w in weights.items()} for weights in fields]

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """Powers [m] in dBm, or channels [m, subcarriers] or [m, antennas, subcarriers].

        Raises:
            InputError: fitted to uplink channels, and there are none.
        """
        frame = self._frame
        condition, divisor = condition_of(frame, inputs, receiver)
        params = self._params[receiver if len(self._params) > 1 else 0]
        values = self._evaluation.predict(params, condition, receiver).astype(float)
        shape = (len(inputs), *self._shape)
        if frame.task.in_decibel:
            return values.astype(np.float32).reshape(shape)
        half = frame.components
        channel = (values[:, :half] + 1j * values[:, half:]) @ frame.basis
        return channels_from(np.concatenate([channel.real, channel.imag], axis=1), divisor, shape)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Settings, frame and weights."""
        own = {
            "settings": np.asarray(json.dumps(asdict(self._settings))),
            "basis": self._frame.basis,
            "scales": self._frame.scales,
            "features": np.asarray(self._features),
        }
        for number, weights in enumerate(self._fields):
            own |= keyed(f"field{number}", weights)
        return own


def condition_of(frame: Frame, inputs: Inputs, receiver: int) -> tuple[Any, NDArray[Any] | float]:
    """What the field is told of transmitters [features or 3, m], and what channels are multiplied by.

    Raises:
        InputError: no uplink, where one is needed.
    """
    if frame.outputs.by_uplink:
        features, divisor = normalised_uplink(uplink_of(inputs))
        return to_tensor(features.T), divisor
    return to_tensor(np.asarray(inputs.tx_pos_m, float).T), float(frame.scales[receiver])


def fit(model: str, record: Record, split: Split, s: GaussianSettings, seed: int, listen: Listen) -> FittedGaussians:
    """Fit the fields.

    Raises:
        InputError: positions or poses that the data do not tell, a receiver without training rows, or an uplink of
            others.
    """
    outputs, known = outputs_of(record), split.all_train
    scales, basis = channel_scales(record, known), np.ones((1, 1), complex)
    if task_of(record).is_complex:
        basis = components_of(_observed(record, split, outputs, model), s.components)
    if not outputs.by_uplink:
        positions(record, model)
        s = replace(s, tx_scale_m=s.tx_scale_m or telling_scale(record.tx_pos_m[known], s.scale_m))
    frame = frame_of(model, record, basis, scales)
    condition, _ = condition_of(frame, inputs_of(record, known), 0)
    features = condition.shape[0] if outputs.by_uplink else 0
    everyone = tuple(range(len(record.receivers)))
    groups = [everyone] if s.shared else [(r,) for r in everyone]
    fields = []
    for number, members in enumerate(groups):

        def part(what: str, share: float, first: int = number) -> None:
            listen(what, (first + share) / len(groups))

        evaluation = Evaluation(s, frame, features)
        fields.append(_fit_group(record, split, evaluation, condition, seed, part, members))
    return FittedGaussians(s, frame, features, fields, record.observation.shape[2:])


def _observed(record: Record, split: Split, outputs: Outputs, model: str) -> NDArray[np.complex128]:
    """Channels [n, outputs] of the training rows that were received, those of all receivers one after the other."""
    channels, one = [], np.ones(len(record.receivers))
    for r in range(len(record.receivers)):
        parts = truth_of(record, outputs, r, np.concatenate(usable_rows(record, split, r, model)), one).astype(float)
        own = parts[:, : outputs.count] + 1j * parts[:, outputs.count :]
        # Scores are relative, so receivers count alike, however far away or seldom heard.
        size = np.sqrt(np.square(np.abs(own)).sum())
        channels.append(own / (size or 1.0))
    return np.concatenate(channels)


def _truth(record: Record, frame: Frame, receiver: int, rows: IntArray) -> NDArray[np.float32]:
    """What reports are compared with, a row for each condition: powers in dBm or coefficients of the components."""
    parts = truth_of(record, frame.outputs, receiver, rows, frame.scales)
    if frame.task.in_decibel:
        return parts
    half = frame.outputs.count
    found = (parts[:, :half] + 1j * parts[:, half:]) @ frame.basis.conj().T
    return np.concatenate([found.real, found.imag], axis=1).astype(np.float32)


def _fit_group(
    record: Record,
    split: Split,
    evaluation: Evaluation,
    condition: Any,
    seed: int,
    listen: Listen,
    members: tuple[int, ...],
) -> Weights:
    s, frame, model = evaluation.settings, evaluation.frame, evaluation.frame.model
    known, outputs = split.all_train, frame.outputs
    # From here on rows count within the training rows.
    rows = {r: tuple(np.searchsorted(known, part) for part in usable_rows(record, split, r, model)) for r in members}
    rng = np.random.default_rng([seed, *members])
    receivers = placed_receivers(record, outputs)
    start = random_gaussians(
        [receivers[r] for r in members],
        s.gaussians,
        rng,
        (s.near_m, s.far_m),
        s.size_deg,
        signal=0.1,
        sphere=True,
    )
    weights = evaluation.field.init(start, rng)
    truth = {r: _truth(record, frame, r, known) for r in members}
    count = condition.shape[1]
    weights["offset"] = np.zeros((1, len(record.receivers)), np.float32)
    if frame.task.in_decibel:
        params = {name: to_tensor(values) for name, values in weights.items()}
        for r in members:
            own = np.concatenate(rows[r])[:AT_ONCE]
            found = evaluation.predict(params, columns(condition, opaque_rows(own)), r)[:, 0]
            weights["offset"][0, r] = np.median(record.observation[r, known[np.concatenate(rows[r])]]) - np.median(
                found
            )
    unused = np.zeros_like(truth[members[0]])
    kept = np.nan_to_num(np.concatenate([truth.get(r, unused) for r in range(len(record.receivers))]))
    data = evaluation.data | {"condition": condition, "truth": to_tensor(kept)}
    dr.make_opaque(data)

    def draw(everything: bool) -> Iterator[Any]:
        batches = {
            r: epochs(
                conditions_of(np.concatenate(rows[r]) if everything else rows[r][0], outputs), s.training.batch, rng
            )
            for r in members
        }
        while True:
            for r in rng.permutation(members):
                yield {"rows": opaque_rows(next(batches[r])), "receiver": dr.opaque(mi.UInt32, int(r))}

    def loss(params: Mapping[str, Any], data: Mapping[str, Any], given: Mapping[str, Any]) -> Any:
        chosen = columns(data["condition"], given["rows"])
        found = evaluation.report(params, data, chosen, given["receiver"])
        batch, values = found.shape
        slot = dr.arange(type(given["rows"]), batch * values)
        row = dr.gather(type(slot), given["rows"], slot // values) + given["receiver"] * count
        error = found.array - dr.gather(type(found.array), data["truth"].array, row * values + slot % values)
        return dr.mean(dr.abs(error)) / DB_UNIT if frame.task.in_decibel else dr.mean(error * error)

    def score(params: Mapping[str, Any]) -> float:
        errors = []
        for r in members:
            validation = conditions_of(rows[r][1], outputs)
            if len(validation):
                found = evaluation.predict(params, columns(condition, opaque_rows(validation)), r)
                error = found - truth[r][validation]
                errors.append(np.abs(error).mean(axis=1) if frame.task.in_decibel else np.square(error).mean(axis=1))
        return float(np.mean(np.concatenate(errors)))

    able = any(len(rows[r][1]) for r in members)
    what = model if len(members) > 1 or len(record.receivers) == 1 else f"{model} {record.receivers[members[0]].name}"
    descent = Descent(weights, loss, s.training.averaging, shares=SHARES)
    return fit_network(descent, data, draw, score if able else None, s.training, listen, what)[0]


def load(model: str, arrays: dict[str, NDArray[Any]], record: Record) -> FittedGaussians:
    """What `FittedGaussians.arrays` described."""
    plain = json.loads(str(arrays["settings"]))
    settings = GaussianSettings(**plain | {"training": Training(**plain["training"])})
    frame = frame_of(model, record, np.asarray(arrays["basis"]), arrays["scales"])
    count = 1 if settings.shared else len(record.receivers)
    fields = [under(f"field{number}", arrays) for number in range(count)]
    return FittedGaussians(settings, frame, int(arrays["features"]), fields, record.observation.shape[2:])


def method_of(model: str) -> Method:
    """The method of a model of the paper, for tasks other than spectra."""
    source = "Wen et al., WRF-GS+, case studies I (RSSI) and II (CSI)"
    return Method(model, ("rssi", "csi"), GaussianSettings, partial(fit, model), partial(load, model), source)
