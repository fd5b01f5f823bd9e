"""Complex channels: image sources in a scene's planes, which measurements set right.

A mesh from LiDAR tells which planes there are to millimetres or centimetres, and roughly how far they reach. Phases
need tenths of millimetres, and whether a path is there decides more than all else. So, with measured channels:

1. each row tells which of its paths are there (`csi_decode`): gains differ in amplitude and phase;
2. planes are shifted and tilted until all phases fit (`csi_repair`); both in turn, the noise being a mixture of scales
   that narrows by itself;
3. what the known paths show of the room, outlines that are further out or in, things that hide and parts that do not
   mirror, is learned and predicts which paths are there elsewhere (`csi_visible`); 1 to 3 in turn;
4. what is left is a diffuse field (`csi_rest`), of use where measurements are within half a wavelength.

Without measurements it is the image method on the mesh; without a mesh the line of sight and the diffuse field, which
interpolates over fractions of a wavelength and no further.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ...core import InputError, Prediction, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.receivers import receiver_index
from ...core.types import IntArray
from ...tasks import require
from ...tracing.walls import Walls, no_walls, walls_of
from .csi_fit import SHARPNESS, CsiSettings, Fit, Rows, mixed, prior_sd, seen_by_rows
from .csi_paths import MOUNTED_M, images_of
from .csi_repair import NUMBERS, Model
from .csi_residual import Diffuse, fit_diffuse
from .csi_visibility import Visibility

Complex = NDArray[np.complex128]
OnProgress = Callable[[str, float], None]

DEFAULTS = CsiSettings()
CHUNK_SIZE = 1024
"""Positions that are predicted together: each has hundreds of candidates for paths."""
CLEAR_M = 0.05
"""Rays search from so far off a wall that the antenna is mounted on."""


class CsiPhysics:
    """A fitted CSI physics model; made by `fit_csi`.

    Attributes:
        task: ``"csi"``.
        receivers: in the record's order.
        model: image sources.
        visibility: what tells which are seen.
        rest: the diffuse field of each receiver.
        sharpness: factor of the log odds in the mean that is predicted.
        covariance: of all planes' parameters.
    """

    task: ClassVar[str] = "csi"
    uses_heading: ClassVar[bool] = False

    def __init__(
        self,
        receivers: tuple[Receiver, ...],
        model: Model,
        visibility: Visibility,
        rest: tuple[Diffuse, ...],
        sharpness: float,
        covariance: FloatArray,
        facts: Mapping[str, float],
    ) -> None:
        self.receivers, self.model, self.visibility, self.rest = receivers, model, visibility, rest
        self.sharpness, self.covariance, self._facts = sharpness, covariance, dict(facts)

    def predict(self, tx_pos_m: ArrayLike, receiver: int | str, tx_heading_rad: ArrayLike | None = None) -> Prediction:
        """Channels [m, subcarriers] from transmitters [m, 3] to one receiver; antennas are isotropic: no heading.

        The receiver is given by its name, or by its number from 0.

        Raises:
            InputError: positions of another shape, or no such receiver.
        """
        position = np.atleast_2d(np.asarray(tx_pos_m, float))
        if position.ndim != 2 or position.shape[1] != 3 or not np.isfinite(position).all():
            raise InputError(f"predict: tx_pos_m has shape {np.shape(tx_pos_m)}; give finite [m, 3]")
        index = receiver_index(self.receivers, receiver)
        first = range(0, max(len(position), 1), CHUNK_SIZE)
        mean, std = zip(*(self._part(position[begin : begin + CHUNK_SIZE], index) for begin in first), strict=True)
        return Prediction(np.concatenate(mean), np.concatenate(std))

    def _part(self, position: FloatArray, receiver: int) -> tuple[Complex, FloatArray]:
        rows = Rows(np.zeros((len(position), 0), complex), position, np.full(len(position), receiver))
        seen = seen_by_rows(self.model, rows)
        odds = self.visibility.log_odds(self.model.walls, self.model.images, seen)
        mean, variance = mixed(self.model, rows, seen, odds, self.sharpness, self.covariance)
        more, left = self.rest[receiver].predict(position)
        return mean + more, np.sqrt(variance + left[:, None])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again, as plain arrays."""
        model, visibility = self.model, self.visibility
        scan = {f"scan.{name}": getattr(model.scan, name) for name in Walls.__dataclass_fields__}
        fitted = {f"visibility.{name}": getattr(visibility, name) for name in Visibility.__dataclass_fields__}
        rest = {
            f"rest.{index}.{name}": getattr(one, name)
            for index, one in enumerate(self.rest)
            for name in Diffuse.__dataclass_fields__
        }
        arrays = {
            **receiver_arrays(self.receivers),
            "change": model.change,
            "chain": model.images.plane,
            "source": model.source,
            "k": model.k,
            "reflection": model.reflection,
            "gain": model.gain,
            "sharpness": self.sharpness,
            "covariance": self.covariance,
            "fact.name": np.array(list(self._facts)),
            "fact.value": np.array(list(self._facts.values()), float),
        }
        return {name: np.asarray(value) for name, value in {**arrays, **scan, **fitted, **rest}.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], scene: Any | None = None) -> CsiPhysics:
        """What `arrays` returned; the scene is not needed."""
        receivers = stored_receivers(arrays)
        scan = Walls(*(arrays[f"scan.{name}"] for name in Walls.__dataclass_fields__))
        model = _model(
            scan,
            arrays["chain"],
            arrays["source"],
            arrays["receiver_position_m"],
            arrays["k"],
            complex(arrays["reflection"]),
        )
        model = replace(model, gain=arrays["gain"]).changed(arrays["change"])
        own = {name: arrays[f"visibility.{name}"] for name in Visibility.__dataclass_fields__}
        sd_m, seed = float(own["outline_sd_m"]), int(own["seed"])
        visibility = Visibility(own["edge_m"], own["margin"], own["key"], own["weight"], sd_m, seed)
        rest = []
        for index in range(len(receivers)):
            values = [arrays[f"rest.{index}.{name}"] for name in Diffuse.__dataclass_fields__]
            rest.append(Diffuse(values[0], values[1], *(float(value) for value in values[2:])))
        facts = dict(zip(map(str, arrays["fact.name"]), map(float, arrays["fact.value"]), strict=True))
        sharpness = float(arrays["sharpness"])
        return cls(receivers, model, visibility, tuple(rest), sharpness, arrays["covariance"], facts)

    def summary(self) -> dict[str, Any]:
        """What was fitted, in plain numbers."""
        change = self.model.change
        return {
            "planes": len(self.model.scan),
            "chains": len(self.model.images),
            "largest_shift_m": float(np.abs(change[:, 0]).max(initial=0)),
            "largest_tilt_rad": float(np.abs(change[:, 1:3]).max(initial=0)),
            "sharpness": self.sharpness,
            "gain_db": [float(20 * np.log10(np.abs(one))) for one in self.model.gain],
            "gain_phase_rad": [float(np.angle(one)) for one in self.model.gain],
            "diffuse_share": [one.share for one in self.rest],
            "rest_power_db": [float(10 * np.log10(max(one.power, 1e-300))) for one in self.rest],
            **self._facts,
        }


def fit_csi(
    record: Record,
    rows: IntArray,
    scene: Any | None,
    settings: CsiSettings = DEFAULTS,
    seed: int = 0,
    on_progress: OnProgress = lambda what, share: None,
) -> CsiPhysics:
    """Fit a CSI physics model.

    Args:
        record: of complex channels.
        rows: training rows; none: the image method on the scene as it is.
        scene: from `wrf_mi.tracing.open_scene`, or None: the line of sight and a diffuse field.
        settings: see `CsiSettings`.
        seed: of the rays, and of folds and cells.
        on_progress: hears what is being done, and how far it is from 0 to 1.

    Raises:
        InputError: a record of another task, without frequencies, or neither rows nor a scene.
    """
    require(record, "csi", why="this physics model predicts channels")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: frequencies unknown, which the physics model needs; state them in the data")
    rows = np.asarray(rows, np.int64)
    if not len(rows) and scene is None:
        raise InputError(f"{record.name}: neither training rows nor a scene; give one of them")
    on_progress("searching for paths", 0.0)
    model = _start(record, scene, settings, seed)
    measured = _measured(record, rows)
    visibility = Visibility.of_scene(len(model.scan.edge_m), settings.outline_sd_m, seed)
    covariance = np.diag(np.square(prior_sd(model, settings)).reshape(-1))
    sharpness, facts, left = SHARPNESS[-1], {"rows": float(len(measured.channel))}, measured.channel
    if len(measured.channel):
        fit = Fit(model, measured, settings, seed)
        total = settings.repair_rounds + settings.visibility_rounds
        for number in range(settings.repair_rounds):
            on_progress("repairing planes", number / total)
            fit.repair()
        for number in range(settings.visibility_rounds):
            on_progress("learning what is seen", (settings.repair_rounds + number) / total)
            fit.learn()
        model, visibility, covariance = fit.model, fit.visibility, fit.covariance
        sharpness, left = fit.finish()
        facts |= fit.facts
    on_progress("kriging the rest", 1.0)
    k = float(model.k.mean())
    rest = tuple(
        fit_diffuse(measured.position_m[own], left[own], k)
        for own in (measured.source == index for index in range(len(record.receivers)))
    )
    return CsiPhysics(record.receivers, model, visibility, rest, sharpness, covariance, facts)


def _measured(record: Record, rows: IntArray) -> Rows:
    """What was received, receivers one after the other."""
    channel, position, source = [], [], []
    for index in range(len(record.receivers)):
        values = np.asarray(record.observation[index, rows], complex)
        known = np.isfinite(values).all(axis=1)
        channel.append(values[known])
        position.append(record.tx_pos_m[rows[known]])
        source.append(np.full(np.count_nonzero(known), index))
    return Rows(np.concatenate(channel), np.concatenate(position), np.concatenate(source))


def _start(record: Record, scene: Any | None, settings: CsiSettings, seed: int) -> Model:
    """Planes as the scene has them, and the chains that rays from each receiver find."""
    assert record.frequencies_hz is not None
    source_m = np.stack([one.position_m for one in record.receivers]).astype(float)
    depth = settings.reflections
    line_of_sight = np.full((1, depth), -1)
    walls, chains = no_walls(), [line_of_sight] * len(source_m)
    if scene is not None:
        from ...tracing.search import shoot
        from ...tracing.surfaces import scene_surfaces

        surfaces = scene_surfaces(scene)
        walls = walls_of(surfaces)
        for index, place in enumerate(source_m):
            found = shoot(scene, surfaces, _off_walls(walls, place), settings.rays, depth, depth, seed)
            found = found.reshape(len(found), depth)
            chains[index] = np.concatenate([line_of_sight, found[~_mounted(walls, place, found)]])
    plane = np.concatenate(chains)
    source = np.repeat(np.arange(len(source_m)), [len(part) for part in chains])
    k = 2 * np.pi * np.asarray(record.frequencies_hz, float) / speed_of_light
    subcarriers = record.observation.shape[2]
    if len(k) not in (1, subcarriers):
        raise InputError(f"{record.name}: {len(k)} frequencies for {subcarriers} subcarriers; give one for each")
    return _model(walls, plane, source, source_m, np.broadcast_to(k, subcarriers).copy(), settings.reflection)


def _model(
    scan: Walls, plane: IntArray, source: IntArray, source_m: FloatArray, k: FloatArray, reflection: complex
) -> Model:
    images = images_of(scan, source_m[source], plane)
    change = np.zeros((len(scan), NUMBERS))
    return Model(scan, change, scan, images, source, source_m, k, reflection, np.ones(len(source_m), complex))


def _mounted(walls: Walls, place: FloatArray, plane: IntArray) -> NDArray[np.bool_]:
    """Chains [c, b] that begin at a plane that the antenna is mounted on: it mirrors nothing of it."""
    if not plane.shape[1] or not len(walls):
        return np.zeros(len(plane), bool)
    near = np.abs(walls.normal @ place - walls.offset_m) < MOUNTED_M
    return np.asarray(near[plane[:, 0]] & (plane[:, 0] >= 0))


def _off_walls(walls: Walls, place: FloatArray) -> FloatArray:
    """A place [3], moved into the room where it is nearer than `CLEAR_M` to planes."""
    middle = np.average(walls.centre_m, axis=0, weights=np.maximum(walls.area_m2, 1e-12)) if len(walls) else place
    for n, d in zip(walls.normal, walls.offset_m, strict=True):
        if abs(n @ place - d) < MOUNTED_M:
            side = np.sign(n @ middle - d) or 1.0
            place = place + (side * CLEAR_M - (n @ place - d)) * n
    return place
