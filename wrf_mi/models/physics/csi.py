"""Complex channels: image sources in a scene's planes, corrected by measurements (``docs/physics.md`` has the steps).

With measured channels three steps alternate: the probability of each path is inferred from a row's channel (`csi_fit`),
planes are shifted and tilted until all phases fit (`csi_paths`), and visibility elsewhere is learned from these paths
(`csi_visibility`). Without measurements this is the image method on the mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core import InputError, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tasks import require
from ...tracing.search import shoot
from ...tracing.surfaces import scene_surfaces
from ...tracing.walls import Walls, walls_of
from ...training.session import OnProgress, quiet
from ..interpolation.diffuse import DiffuseField, fit_diffuse
from ..model import Arrays, field_arrays, from_field_arrays
from .csi_fit import SHARPNESS, CsiSettings, Fit, Rows, mixed, paths_of_rows
from .csi_paths import MOUNTED_M, NUMBERS, Model, images_of
from .csi_visibility import Visibility
from .selection import PhysicsModel, physics_model

DEFAULTS = CsiSettings()
CLEAR_M = 0.05
"""Distance from a wall with an antenna mounted on it at which the search by rays begins."""


@dataclass(eq=False, repr=False)
class CsiPhysics(PhysicsModel):
    """A fitted CSI physics model; made by `fit_csi`.

    Antennas are isotropic, so headings change nothing.

    Attributes:
        receivers: in the record's order.
        model: image sources.
        visibility: predicts which of their paths exist.
        residual: the diffuse field of each receiver.
        sharpness: factor of the log odds in the predicted mean.
        covariance: covariance of all planes' parameters.
        fit_facts: entries of `summary` about the fit.
    """

    receivers: tuple[Receiver, ...]
    model: Model
    visibility: Visibility
    residual: tuple[DiffuseField, ...]
    sharpness: float
    covariance: FloatArray
    fit_facts: dict[str, float]

    def _predict(self, tx_pos_m: FloatArray, receiver: int) -> tuple[Any, Any]:
        rows = Rows(np.zeros((len(tx_pos_m), 0), complex), tx_pos_m, np.full(len(tx_pos_m), receiver))
        paths = paths_of_rows(self.model, rows)
        odds = self.visibility.log_odds(self.model.walls, self.model.images, paths)
        mean, variance = mixed(self.model, rows, paths, odds, self.sharpness, self.covariance)
        field, field_variance = self.residual[receiver].predict(tx_pos_m)
        return mean + field, np.sqrt(variance + field_variance[:, None])

    def arrays(self) -> Arrays:
        """Arrays for `from_arrays`."""
        model = self.model
        arrays = {
            **receiver_arrays(self.receivers),
            **{name: getattr(model, name) for name in ("change", "source", "k", "reflection", "gain")},
            "chain": model.images.plane,
            "sharpness": self.sharpness,
            "covariance": self.covariance,
            "fact.name": np.array(list(self.fit_facts)),
            "fact.value": np.array(list(self.fit_facts.values()), float),
            **field_arrays(model.scan, "scan."),
            **field_arrays(self.visibility, "visibility."),
        }
        for index, field in enumerate(self.residual):
            arrays |= field_arrays(field, f"rest.{index}.")
        return {name: np.asarray(value) for name, value in arrays.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> CsiPhysics:
        """The model that `arrays` stored."""
        receivers = stored_receivers(arrays)
        scan = from_field_arrays(Walls, arrays, "scan.")
        plane, source, source_m, k = (arrays[name] for name in ("chain", "source", "receiver_position_m", "k"))
        model = _model(scan, plane, source, source_m, k, complex(arrays["reflection"]))
        model = replace(model, gain=arrays["gain"]).changed(arrays["change"])
        visibility = from_field_arrays(Visibility, arrays, "visibility.")
        residual = tuple(from_field_arrays(DiffuseField, arrays, f"rest.{index}.") for index in range(len(receivers)))
        facts = dict(zip(map(str, arrays["fact.name"]), map(float, arrays["fact.value"]), strict=True))
        return cls(receivers, model, visibility, residual, float(arrays["sharpness"]), arrays["covariance"], facts)

    def summary(self) -> dict[str, Any]:
        """Numbers of planes and chains, their largest changes, and accuracy on held-out rows."""
        change = self.model.change
        return {
            "planes": len(self.model.scan),
            "chains": len(self.model.images),
            "largest_shift_m": float(np.abs(change[:, 0]).max(initial=0)),
            "largest_tilt_rad": float(np.abs(change[:, 1:3]).max(initial=0)),
            "sharpness": self.sharpness,
            "gain_db": [float(20 * np.log10(np.abs(gain))) for gain in self.model.gain],
            "gain_phase_rad": [float(np.angle(gain)) for gain in self.model.gain],
            "diffuse_share": [field.share for field in self.residual],
            "rest_power_db": [float(10 * np.log10(max(field.power, 1e-300))) for field in self.residual],
            **self.fit_facts,
        }


def fit_csi(
    record: Record,
    rows: IntArray,
    scene: Any,
    settings: CsiSettings = DEFAULTS,
    seed: int = 0,
    on_progress: OnProgress = quiet,
) -> CsiPhysics:
    """Fit a CSI physics model to ``rows`` of a record; arguments as ``fit`` of `physics_model`.

    Without rows it is the image method on the scene as given. ``seed`` is that of rays, folds and grids of cells.

    Raises:
        InputError: a record of another task, or without frequencies.
    """
    require(record, "csi", why="this physics model predicts channels")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: frequencies unknown, which the physics model needs; state them in the data")
    rows = np.asarray(rows, np.int64)
    on_progress("searching for paths", 0.0)
    model = _start(record, scene, settings, seed)
    measured = _measured(record, rows)
    fit = Fit(model, measured, settings, seed)
    sharpness, residual = SHARPNESS[-1], measured.channel
    if len(residual):
        stages = [("repairing planes", fit.repair)] * settings.repair_rounds
        stages += [("learning visibility", fit.learn)] * settings.visibility_rounds
        for number, (stage, step) in enumerate(stages):
            on_progress(stage, number / len(stages))
            step()
        sharpness, residual = fit.finish()
    on_progress("kriging of residuals", 1.0)
    k = float(model.k.mean())
    fields = tuple(
        fit_diffuse(measured.position_m[chosen], residual[chosen], k)
        for chosen in (measured.source == index for index in range(len(record.receivers)))
    )
    return CsiPhysics(record.receivers, fit.model, fit.visibility, fields, sharpness, fit.covariance, fit.facts)


MODEL = physics_model("csi", CsiSettings, fit_csi, CsiPhysics.from_arrays, uses_antennas=False)


def _measured(record: Record, rows: IntArray) -> Rows:
    """Received channels, receiver by receiver."""
    values = np.asarray(record.observation[:, rows], complex)
    source, row = np.nonzero(np.isfinite(values).all(axis=2))
    return Rows(values[source, row], record.tx_pos_m[rows[row]], source)


def _start(record: Record, scene: Any, settings: CsiSettings, seed: int) -> Model:
    """Planes of the scene as given, and the chains that rays from each receiver find."""
    assert record.frequencies_hz is not None
    source_m = np.stack([receiver.position_m for receiver in record.receivers]).astype(float)
    depth = settings.reflections
    line_of_sight = np.full((1, depth), -1)
    surfaces, chains = scene_surfaces(scene), []
    walls = walls_of(surfaces)
    for antenna_m in source_m:
        reached = shoot(scene, surfaces, _off_walls(walls, antenna_m), settings.rays, depth, depth, seed)
        reached = reached.reshape(len(reached), depth)
        chains.append(np.concatenate([line_of_sight, reached[~_mounted(walls, antenna_m, reached)]]))
    source = np.repeat(np.arange(len(source_m)), [len(chain) for chain in chains])
    k = 2 * np.pi * np.asarray(record.frequencies_hz, float) / speed_of_light
    subcarriers = record.observation.shape[2]
    if len(k) not in (1, subcarriers):
        raise InputError(f"{record.name}: {len(k)} frequencies for {subcarriers} subcarriers; give one for each")
    k = np.broadcast_to(k, subcarriers).copy()
    return _model(walls, np.concatenate(chains), source, source_m, k, settings.reflection)


def _model(
    scan: Walls, plane: IntArray, source: IntArray, source_m: FloatArray, k: FloatArray, reflection: complex
) -> Model:
    images = images_of(scan, source_m[source], plane)
    change = np.zeros((len(scan), NUMBERS))
    return Model(scan, change, scan, images, source, source_m, k, reflection, np.ones(len(source_m), complex))


def _mounted(walls: Walls, antenna_m: FloatArray, plane: IntArray) -> NDArray[np.bool_]:
    """Chains [c, b] that begin at a plane on which the antenna is mounted: it does not mirror the antenna."""
    if not plane.shape[1] or not len(walls):
        return np.zeros(len(plane), bool)
    near = np.abs(walls.normal @ antenna_m - walls.offset_m) < MOUNTED_M
    return np.asarray(near[plane[:, 0]] & (plane[:, 0] >= 0))


def _off_walls(walls: Walls, antenna_m: FloatArray) -> FloatArray:
    """Position [3], moved into the room to `CLEAR_M` from planes on which the antenna is mounted."""
    centre = np.average(walls.centre_m, axis=0, weights=np.maximum(walls.area_m2, 1e-12)) if len(walls) else antenna_m
    for n, d in zip(walls.normal, walls.offset_m, strict=True):
        if abs(n @ antenna_m - d) < MOUNTED_M:
            side = np.sign(n @ centre - d) or 1.0
            antenna_m = antenna_m + (side * CLEAR_M - (n @ antenna_m - d)) * n
    return antenna_m
