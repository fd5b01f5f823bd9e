"""NeRF2: two networks and a march along rays, for spectra, signal strengths and channels.

Source: Zhao, An, Pan and Yang, "NeRF2: neural radio-frequency radiance fields" (MobiCom 2023), and the authors' code
(XPengZhao/NeRF2, MIT). The networks and the march are in `wrf_mi.models.networks.nerf2_march`. As in that code there
is one pair of networks for all receivers of a record, whose rays start where each receiver is; ``shared`` says
otherwise.

What the authors leave open, and what was chosen:

- Work. They take 8192 rays of 64 samples and 30,000 steps (spectra), 324 rays of 32 samples for signal strengths and
  channels, hours on a GPU. Here a step draws some transmitters and some rays and pairs each with each, because the
  attenuation network, most of the work, sees no transmitter: by default 16 spectra x 256 rays x 4 samples. From one
  receiver the samples of a ray tell nothing about depth, so few are enough. Signal strengths and channels take 64 rays
  over the full sphere (theirs cover the upper half), of equal solid angle.
- How far rays go: as far as the farthest training transmitter (theirs: 5 m, 60 m by data set).
- Encodings: their ten octaves have periods down to 12 mm, and spectra between training positions are then noise. Fewer
  here, over coordinates and their sines as theirs.
- Loss: squared error, as theirs, of greys; of powers in dB (they fit the amplitude to 1 + dBm / 100, which is a linear
  scale of dB too; here the amplitude is physical, and one offset a receiver is fitted with it); of channels.
- Channels: with an uplink, that takes the transmitter's place, antenna by antenna, the array's centre being where all
  rays start (theirs start at each antenna, millimetres beside). Each uplink is normalised by its own size and mean
  phase (theirs: by the largest value of all data, held-out rows included). Without one, the position is the condition
  and antennas are outputs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_tensor
from ...core import Record, Split
from ...core.settings import settings_from
from ...core.types import IntArray
from ...gaussians.network import Weights
from ...tasks.conditions import channel_scales, channels_from, conditions_of, outputs_of, placed_receivers, truth_of
from ...training.session import FitSession
from ..method import Inputs, Method, inputs_of
from .coordinates import Coordinates
from .nerf2_field import Field, Frame, Nerf2Settings, condition_of, frame_of, step_loss
from .nerf2_march import Seen
from .tensors import columns
from .training import Network, keyed, opaque_rows, positions, train_network, under, usable_rows

SCORED_RAYS = 512
"""Pixels of each validation spectrum by which steps are chosen."""
FAR_M = 10.0
"""Where rays end if positions are not known: the size of a large room."""


class FittedNerf2:
    """Fields that were fitted.

    Args:
        settings: of NeRF2.
        frame: of the fields.
        networks: weights of each group of receivers.
        shape: of one observation.
    """

    def __init__(self, settings: Nerf2Settings, frame: Frame, networks: list[Weights], shape: tuple[int, ...]) -> None:
        self._settings, self._frame, self._networks, self._shape = settings, frame, networks, shape
        self._field = Field(settings, frame)
        self._params = [{name: to_tensor(w) for name, w in weights.items()} for weights in networks]
        self._seen: tuple[int, list[Seen]] | None = None

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """Spectra [m, height, width], powers [m] in dBm, or channels [m, subcarriers] or [m, antennas, subcarriers].

        Raises:
            InputError: fitted to uplink channels, and there are none.
        """
        group = next(g for g, members in enumerate(self._frame.groups) if receiver in members)
        params = self._params[group]
        if self._seen is None or self._seen[0] != receiver:
            # One receiver's at a time: 270 MB for a spectrum of 32,400 pixels.
            self._seen = receiver, self._field.look(params, receiver)
        condition, divisor = condition_of(self._frame, self._settings, inputs, receiver)
        values = self._field.march(params, self._seen[1], condition, receiver)
        shape = (len(inputs), *self._shape)
        if self._frame.task.is_complex:
            return channels_from(values, divisor, shape)
        return values.reshape(shape)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Settings, frame and weights."""
        own = {
            "settings": np.asarray(json.dumps(asdict(self._settings))),
            "far_m": np.asarray(self._frame.far_m),
            "scales": self._frame.scales,
        }
        own |= keyed("frame", self._frame.coordinates.arrays())
        for g, weights in enumerate(self._networks):
            own |= keyed(f"group{g}", weights)
        return own


def fit(record: Record, split: Split, settings: Nerf2Settings, seed: int, session: FitSession) -> FittedNerf2:
    """Fit the networks.

    Raises:
        InputError: positions or poses that the data do not tell, a receiver without training rows, or an uplink of
            others.
    """
    known = split.all_train
    outputs = outputs_of(record)
    where = record.tx_pos_m[known] if outputs.by_uplink else positions(record, "nerf2")[known]
    known_rx = np.stack([receiver.position_m for receiver in record.receivers])
    rx = np.stack([receiver.position_m for receiver in placed_receivers(record, outputs.by_uplink)])
    if np.isfinite(where).all() and np.isfinite(known_rx).all():
        farthest = float(np.linalg.norm(where[:, None] - rx, axis=2).max())
    else:
        where, farthest = rx, FAR_M
    scales = channel_scales(record, known)
    frame = frame_of(record, settings, Coordinates.of(where), settings.far_m or farthest, scales)
    field = Field(settings, frame)
    networks = [_fit_group(record, split, field, seed, session, members) for members in frame.groups]
    return FittedNerf2(settings, frame, networks, record.observation.shape[2:])


def _fit_group(
    record: Record, split: Split, field: Field, seed: int, session: FitSession, members: tuple[int, ...]
) -> Weights:
    s, frame, outputs = field.settings, field.frame, field.frame.outputs
    known = split.all_train
    # From here on rows count within the training rows.
    rows = {r: tuple(np.searchsorted(known, part) for part in usable_rows(record, split, r, "nerf2")) for r in members}
    rng = np.random.default_rng([seed, *members])
    condition, _ = condition_of(frame, s, inputs_of(record, known), members[0])
    truth = np.concatenate([truth_of(record, outputs, r, known, frame.scales) for r in range(len(record.receivers))])
    data = field.data | {"condition": condition, "truth": to_tensor(np.nan_to_num(truth))}
    dr.make_opaque(data)
    weights = s.networks.init(condition.shape[0], outputs.count, rng)
    weights["offset"] = np.zeros(len(record.receivers), np.float32)
    if frame.task.in_decibel:
        for r in members:
            weights["offset"][r] = np.mean(record.observation[r, known[np.concatenate(rows[r])]])
    n_rays, spectrum = frame.directions.shape[1], frame.task.image
    config = s if spectrum else replace(s, batch=s.sphere_batch)
    all_rays = opaque_rows(np.arange(n_rays))

    def draw(chosen: IntArray, member: int, rng: np.random.Generator) -> Any:
        rays = opaque_rows(rng.choice(n_rays, min(s.rays, n_rays), replace=False)) if spectrum else all_rays
        return {"rows": opaque_rows(chosen), "rays": rays, "receiver": dr.opaque(mi.UInt32, members[member])}

    def loss(params: Mapping[str, Any], data: Any, given: Any) -> Any:
        return step_loss(params, data, given, frame, s)

    scored = np.sort(np.random.default_rng(0).choice(n_rays, min(SCORED_RAYS, n_rays), replace=False))

    def score(params: Mapping[str, Any]) -> float:
        errors = []
        for r in members:
            validation = conditions_of(rows[r][1], outputs)
            if len(validation):
                seen = field.look(params, r, scored if spectrum else None)
                found = field.march(params, seen, columns(condition, opaque_rows(validation)), r)
                wanted = truth[r * condition.shape[1] + validation]
                errors.append(np.square(found - (wanted[:, scored] if spectrum else wanted)).mean(axis=1))
        return float(np.mean(np.concatenate(errors)))

    train = [conditions_of(rows[r][0], outputs) for r in members]
    everything = [conditions_of(np.concatenate(rows[r]), outputs) for r in members]
    able = any(len(rows[r][1]) for r in members)
    name = "nerf2" if s.shared else f"nerf2 {record.receivers[members[0]].name}"
    ends = train, everything, score if able else None, "mean squared error"
    network = Network(name, weights, loss, data, draw, *ends)
    return train_network(network, config, (seed, *members), session)[0]


def load(arrays: dict[str, NDArray[Any]], record: Record) -> FittedNerf2:
    """What `FittedNerf2.arrays` described."""
    settings = settings_from(Nerf2Settings, json.loads(str(arrays["settings"])), "nerf2")
    coordinates = Coordinates.load(under("frame", arrays))
    frame = frame_of(record, settings, coordinates, float(arrays["far_m"]), arrays["scales"])
    networks = [under(f"group{g}", arrays) for g in range(len(frame.groups))]
    return FittedNerf2(settings, frame, networks, record.observation.shape[2:])


METHOD = Method(
    "nerf2",
    ("spectrum", "rssi", "csi"),
    Nerf2Settings,
    fit,
    load,
    "Zhao, An, Pan and Yang, 'NeRF2: neural radio-frequency radiance fields' (MobiCom 2023) and its code",
)
