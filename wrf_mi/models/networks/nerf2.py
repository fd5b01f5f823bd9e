"""NeRF2: two networks and a march along rays, for spectra, signal strengths and channels.

Source: Zhao, An, Pan and Yang, "NeRF2: neural radio-frequency radiance fields" (MobiCom 2023), and the authors' code
(XPengZhao/NeRF2, MIT). The networks and the march are in `wrf_mi.models.networks.nerf2_march`. As in that code all
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

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...backend.device import to_tensor
from ...core import Record, Split
from ...core.types import IntArray
from ...tasks.conditions import channel_scales, conditions_of, outputs_of, placed_receivers, truth_of
from ...training.session import FitSession
from ..model import (
    Arrays,
    Model,
    Problem,
    from_field_arrays,
    inputs_of,
    known_positions,
    received_rows,
    stored_settings,
    under,
)
from .layers import Coordinates, columns
from .nerf2_field import Field, Nerf2Settings, step_loss
from .nerf2_march import Nerf2Network
from .training import Network, opaque_rows, train_network

SCORED_RAYS = 512
"""Pixels of each validation spectrum by which steps are chosen."""
FAR_M = 10.0
"""Length of rays if positions are not known: the size of a large room."""


def fit(problem: Problem, split: Split, session: FitSession) -> Field:
    """Fit the networks.

    Raises:
        InputError: unknown positions or poses, a receiver without training rows, or an uplink of other antennas.
    """
    record, known = problem.record, split.all_train
    outputs, settings = outputs_of(record), problem.settings
    where = record.tx_pos_m[known] if outputs.by_uplink else known_positions(record, known, "nerf2")
    known_rx = np.stack([receiver.position_m for receiver in record.receivers])
    rx = np.stack([receiver.position_m for receiver in placed_receivers(record, outputs.by_uplink)])
    if np.isfinite(where).all() and np.isfinite(known_rx).all():
        farthest = float(np.linalg.norm(where[:, None] - rx, axis=2).max())
    else:
        where, farthest = rx, FAR_M
    scales = channel_scales(record, known)
    field = Field(record, settings, Coordinates.of(where), settings.far_m or farthest, scales)
    field.networks = [_fit_group(record, split, field, problem.seed, session, members) for members in field.groups]
    return field


def _fit_group(
    record: Record, split: Split, field: Field, seed: int, session: FitSession, members: tuple[int, ...]
) -> Nerf2Network:
    s, outputs = field.settings, field.outputs
    known = split.all_train
    # From here on rows count within the training rows.
    rows = {
        r: tuple(np.searchsorted(known, part) for part in received_rows(record, split, r, "nerf2")) for r in members
    }
    rng = np.random.default_rng([seed, *members])
    condition, _ = field.condition_of(inputs_of(record, known), members[0])
    truth = np.concatenate([truth_of(record, outputs, r, known, field.scales) for r in range(len(record.receivers))])
    data = field.data | {"condition": condition, "truth": to_tensor(np.nan_to_num(truth))}
    dr.make_opaque(data)
    initial = field.initial(rng)
    if field.task.in_decibel:
        for r in members:
            initial.offset[r] = np.mean(record.observation[r, known[np.concatenate(rows[r])]])
    n_rays, spectrum = field.n_rays, field.task.image
    config = s if spectrum else replace(s, batch=s.sphere_batch)
    all_rays = opaque_rows(np.arange(n_rays))

    def draw(chosen: IntArray, member: int, rng: np.random.Generator) -> Any:
        rays = opaque_rows(rng.choice(n_rays, min(s.rays, n_rays), replace=False)) if spectrum else all_rays
        return {"rows": opaque_rows(chosen), "rays": rays, "receiver": dr.opaque(mi.UInt32, members[member])}

    scored = np.sort(np.random.default_rng(0).choice(n_rays, min(SCORED_RAYS, n_rays), replace=False))

    def score(network: Nerf2Network) -> float:
        errors = []
        for r in members:
            validation = conditions_of(rows[r][1], outputs)
            if len(validation):
                seen = field.look(network, r, scored if spectrum else None)
                found = field.march(network, seen, columns(condition, opaque_rows(validation)), r)
                wanted = truth[r * condition.shape[1] + validation]
                errors.append(np.square(found - (wanted[:, scored] if spectrum else wanted)).mean(axis=1))
        return float(np.mean(np.concatenate(errors)))

    train = [conditions_of(rows[r][0], outputs) for r in members]
    everything = [conditions_of(np.concatenate(rows[r]), outputs) for r in members]
    able = any(len(rows[r][1]) for r in members)
    name = "nerf2" if s.shared else f"nerf2 {record.receivers[members[0]].name}"
    rows_of = draw, train, everything, score if able else None
    network = Network(name, initial, partial(step_loss, field=field), data, *rows_of, "mean squared error")
    trained: Nerf2Network = train_network(network, config, (seed, *members), session)[0]
    return trained


def load(arrays: Arrays, problem: Problem, folder: Path) -> Field:
    """The fields that `Field.arrays` described."""
    settings = stored_settings(Nerf2Settings, arrays, "nerf2")
    coordinates = from_field_arrays(Coordinates, arrays, "frame/")
    field = Field(problem.record, settings, coordinates, float(arrays["far_m"]), arrays["scales"])
    field.networks = [field.network.on_device(under(f"group{g}/", arrays)) for g in range(len(field.groups))]
    return field


SOURCE = "Zhao, An, Pan and Yang, 'NeRF2: neural radio-frequency radiance fields' (MobiCom 2023) and its code"
TASKS = "spectrum", "rssi", "csi"
MODEL = Model("nerf2", TASKS, Nerf2Settings, fit, load, SOURCE, uplink="optional", headings=True)
