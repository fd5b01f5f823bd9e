"""Local mean of traced power on a grid, and power traced at positions themselves.

For a position known to a decimetre ray tracing gives the mean over some wavelengths, so powers are averaged over the
neighbourhood before they are converted to decibels. The scene is traced once on a grid and needed only then. Where
positions are exact, edges of shadows are sharper than such means.

Fits of the same scene with other rows trace the same grid. Powers are kept in the user's cache by a digest of all that
determines them: faces and materials of the scene, carrier, positions, receivers, antennas, options, and the code.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter

from ..core import Antenna, InputError, Receiver, Record, receiver_arrays
from ..core.array_files import stored_arrays, write_arrays
from ..core.digest import content_digest
from ..core.types import FloatArray, IntArray
from ..datasets import user_cache
from ..receivers import rssi_dbm
from .options import TraceOptions
from .paths.scene_parameters import slabs_of_faces
from .paths.solve import Prepared, trace_paths
from .search.devices import solid_around
from .sionna.scattering import scattering_of

FOLDER, POWER = "powers", "power_dbm"
PACKAGES = ("mitsuba", "drjit", "sionna-rt", "numpy")
MOST_POINTS = 6000  # most traced positions; the grid becomes wider for larger scenes
PAIRS_TOGETHER = 1 << 16  # pairs of a position and a receiver whose paths are traced together
LAYER_M = 0.5  # greatest distance of the grid's layers over the transmitter's heights
SAME_HEIGHT_M = 0.02  # range of heights that one layer serves: survey of a mast or trolley on a floor
LEAST_SHARE = 1e-3  # least share of a neighbourhood outside of solids; below, the nearest point with more is used
OnShare = Callable[[float], object]
"""Called with the share of a trace that is done, 0 to 1."""


def _quiet(share: float) -> None:
    """Show no progress."""


@dataclass(frozen=True)
class PowerMap:
    """Local mean of traced power on a grid [n_rx, x, y, z], dBm for 0 dBm sent; one layer serves all heights.

    Paths have at most so many ``reflections``; 0: the direct path alone, through what is in its way.
    """

    exact: ClassVar[Literal[False]] = False
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    power_dbm: FloatArray
    reflections: int

    def __call__(self, position_m: FloatArray, receiver: int) -> FloatArray:
        """Power in dBm at positions [m, 3], linear between the grid's points; outside that of its nearest edge."""
        axes = [(k, axis) for k, axis in enumerate((self.x_m, self.y_m, self.z_m)) if len(axis) > 1]
        inside = [np.clip(position_m[:, k], axis[0], axis[-1]) for k, axis in axes]
        grid = RegularGridInterpolator([axis for _, axis in axes], self.power_dbm[receiver].squeeze())
        return np.asarray(grid(np.stack(inside, axis=-1)))

    @cached_property
    def level_dbm(self) -> float:
        """Median power."""
        return float(np.median(self.power_dbm))

    def at(self, places: IntArray) -> PowerMap:
        """The map at some of the receivers."""
        return replace(self, power_dbm=self.power_dbm[places])


Tracer = Callable[[FloatArray, IntArray | None], FloatArray]
"""Power [k, m] in dBm at positions [m, 3] of k receivers, by their places, or of all; NaN: the local mean is better."""


class TracedPower:
    """Power traced at each position itself, and the local mean where no path arrives and inside solids.

    ``local`` are means at n_rx receivers, which have the ``places`` [n_rx] among those of the tracer, ``known`` powers
    at all receivers of the tracer by position. A new position is traced for all receivers and kept, as further fits ask
    for it again, or without ``keeps`` for the receiver that is asked for.
    """

    exact: ClassVar[Literal[True]] = True

    def __init__(
        self, local: PowerMap, trace: Tracer, places: IntArray, known: dict[bytes, FloatArray], keeps: bool = True
    ) -> None:
        self.local, self._trace, self._places, self._known, self._keeps = local, trace, places, known, keeps

    @property
    def level_dbm(self) -> float:
        """Median power of the local means."""
        return self.local.level_dbm

    def traced_dbm(self, position_m: FloatArray) -> FloatArray:
        """Power [n_rx, m] at positions [m, 3], each traced once and kept."""
        keys = [row.tobytes() for row in position_m]
        new = [place for place, key in enumerate(keys) if key not in self._known]
        if new:
            traced = self._trace(position_m[new], None).T
            self._known |= dict(zip([keys[place] for place in new], traced, strict=True))
        return np.stack([self._known[key][self._places] for key in keys], axis=1)

    def __call__(self, position_m: FloatArray, receiver: int) -> FloatArray:
        """Power in dBm at positions [m, 3]."""
        if not len(position_m):
            return np.zeros(0)
        new = np.array([not self._keeps and row.tobytes() not in self._known for row in position_m])
        power = np.empty(len(position_m))
        if new.any():
            power[new] = self._trace(position_m[new], self._places[[receiver]])[0]
        if not new.all():
            power[~new] = self.traced_dbm(position_m[~new])[receiver]
        return np.where(np.isnan(power), self.local(position_m, receiver), power)

    def keeping(self) -> TracedPower:
        """The power that keeps what it traces from now on; itself where it does."""
        return self if self._keeps else TracedPower(self.local, self._trace, self._places, dict(self._known))

    def of_predictions(self, position_m: FloatArray) -> TracedPower:
        """The power for predictions, which keeps nothing but what is known at some positions [k, 3]."""
        self.traced_dbm(position_m)
        power_of_position = {row.tobytes(): self._known[row.tobytes()] for row in position_m}
        return TracedPower(self.local, self._trace, self._places, power_of_position, keeps=False)

    def at(self, places: IntArray) -> TracedPower:
        """Power at some of the receivers, which shares what is known."""
        return TracedPower(self.local.at(places), self._trace, self._places[places], self._known, self._keeps)


Traced = PowerMap | TracedPower  # mean of signal strengths


def power_tracer(scene: Any, record: Record, options: TraceOptions) -> Tracer:
    """Function of `TracedPower` that traces a scene for a record's receivers."""
    prepared = Prepared(scene)

    def trace(position_m: FloatArray, places: IntArray | None) -> FloatArray:
        receivers = record.receivers if places is None else [record.receivers[place] for place in places]
        power = np.full((len(receivers), len(position_m)), np.nan)
        outside = solid_around(prepared.surfaces, position_m) < 0
        if outside.any():
            how = receivers, options, record.tx_antenna
            power[:, outside] = traced_powers(prepared, position_m[outside], *how, kept=False)
        return power

    return trace


def trace_map(
    scene: Any, record: Record, spacing_m: float, smooth_m: float, options: TraceOptions, on_share: OnShare = _quiet
) -> PowerMap:
    """Trace a scene on a grid over its extent and all of a record's positions, at heights of its transmitter.

    Points of the grid inside closed solids (`wrf_mi.tracing.search.devices.solid_around`) are not traced: they take the
    mean of the points around them that are outside, or the nearest such mean. Means are over a Gaussian of the standard
    deviation ``smooth_m``; 0: none. ``on_share`` is called with the share that is traced. `InputError` for a receiver
    that no path reaches, or a scene filled by a solid.
    """
    # The grid covers the scene and all positions; storeys of the transmitter's heights are layers of it.
    box = scene.mi_scene.bbox()
    low = np.minimum([box.min.x, box.min.y], record.tx_pos_m[:, :2].min(axis=0))
    high = np.maximum([box.max.x, box.max.y], record.tx_pos_m[:, :2].max(axis=0))
    bottom, top = record.tx_pos_m[:, 2].min(), record.tx_pos_m[:, 2].max()
    layers = 1 if top - bottom < SAME_HEIGHT_M else 2 + int((top - bottom) // LAYER_M)
    z_m = np.linspace(bottom, top, layers) if layers > 1 else np.array([(bottom + top) / 2])
    spacing = max(spacing_m, float(np.sqrt(np.prod(high - low) * layers / MOST_POINTS)))
    x_m, y_m = (np.linspace(a, b, 2 + int((b - a) / spacing)) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x_m, y_m, z_m, indexing="ij"), axis=-1)
    # Antennas inside solids have no path: nobody has stated these positions, so they are no error.
    points, prepared = grid.reshape(-1, 3), Prepared(scene)
    outside = solid_around(prepared.surfaces, points) < 0
    if not outside.any():
        raise InputError("the scene: a solid fills it at all heights of the transmitter; check the mesh and positions")
    traced = np.full((len(record.receivers), len(points)), np.nan)
    how = record.receivers, options, record.tx_antenna, on_share
    traced[:, outside] = traced_powers(prepared, points[outside], *how)
    power = np.where(np.isnan(traced), 0, 10 ** (traced / 10)).reshape(len(record.receivers), *grid.shape[:3])
    steps = [(axis[1] - axis[0]) if len(axis) > 1 else np.inf for axis in (x_m, y_m, z_m)]
    # Not across layers, which lie further apart than the neighbourhood and may be on different floors.
    sigma = (0, smooth_m / steps[0], smooth_m / steps[1], 0)
    power = _means_outside(power, outside.reshape(grid.shape[:3]), sigma, steps)
    for receiver, grid_mw in zip(record.receivers, power, strict=True):
        if not (grid_mw > 0).any():
            raise InputError(f"{receiver.name}: no path from anywhere in the scene; check its position, or depth")
        grid_mw[grid_mw <= 0] = grid_mw[grid_mw > 0].min()  # no path: as weak as the weakest point with one
    return PowerMap(x_m, y_m, z_m, 10 * np.log10(power), options.most_reflections)


def _means_outside(
    power: FloatArray, outside: NDArray[np.bool_], sigma: tuple[float, ...], steps_m: list[float]
) -> FloatArray:
    """Local means of power [n_rx, x, y, z] over points outside of solids; where there are none, the nearest mean."""
    share = gaussian_filter(outside[None].astype(float), sigma, mode="nearest")
    mean = gaussian_filter(power, sigma, mode="nearest") / np.maximum(share, LEAST_SHARE)
    sampling = [step if np.isfinite(step) else 1.0 for step in steps_m]
    nearest = distance_transform_edt(share[0] < LEAST_SHARE, sampling, return_distances=False, return_indices=True)
    return np.asarray(mean[:, *nearest])


def traced_powers(
    prepared: Prepared,
    tx_pos_m: FloatArray,
    receivers: Sequence[Receiver],
    options: TraceOptions,
    tx_antenna: Antenna,
    on_share: OnShare = _quiet,
    kept: bool = True,
) -> FloatArray:
    """Received power [n_rx, m] in dBm for 0 dBm sent from points [m, 3] outside of solids, NaN without a path.

    Those ``kept`` are in the user's cache.
    """
    # The key holds all that determines the powers, code and versions included; a stale file is never read.
    scene = prepared.scene
    slabs, slab_of_face = slabs_of_faces(scene, prepared.surfaces, "named")
    path = None
    if kept and (slab_of_face >= 0).all():  # other materials have no digest
        package = Path(__file__).parents[1]
        folders = package / "tracing", package / "receivers"
        code = {str(file.relative_to(package)): file for folder in folders for file in folder.rglob("*.py")}
        versions = [importlib.metadata.version(name) for name in PACKAGES]
        scattering = list(map(scattering_of, scene.radio_materials.values()))
        faces = prepared.surfaces.triangles, slab_of_face, slabs, scattering, float(scene.frequency[0])
        asked = tx_pos_m, receiver_arrays(receivers), asdict(options), tx_antenna
        path = user_cache() / FOLDER / f"{content_digest(code, versions, faces, asked)}.npz"
        if path.exists():
            return np.asarray(stored_arrays(path)[POWER], float)
    how: dict[str, Any] = {"prepared": prepared, "tx_antenna": tx_antenna, "check": False}
    # In chunks: a path takes a kilobyte, and what is kept of it here is its power. Chains of reflections are kept.
    chunks = np.array_split(tx_pos_m, max(1, len(tx_pos_m) * len(receivers) // PAIRS_TOGETHER))
    powers = list[FloatArray]()
    for number, chunk in enumerate(chunks):
        on_share(number / len(chunks))
        powers.append(np.asarray(rssi_dbm(trace_paths(scene, chunk, receivers, options, **how).paths), float))
    power = np.concatenate(powers, axis=1)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {POWER: power})
    return power
