"""Paths and positions of synthetic data: searches for specular and scattered paths, and places in the free volume."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from scipy.spatial import cKDTree

from ..core import Receiver
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..receivers.channel import array_channels
from ..tracing.options import TraceOptions
from ..tracing.paths.result import TraceResult
from ..tracing.paths.solve import trace_paths
from ..tracing.search.devices import solid_around
from ..tracing.search.surfaces import scene_surfaces

SCATTERING, DIFFRACTION = 2, 8  # kinds of interaction (`wrf_mi.core.Paths`) that emit a spherical wave
CHUNK_SIZE = 200  # transmitters that are traced together


@dataclass(frozen=True)
class Searches:
    """Searches for paths, and parameters that all synthetic data have."""

    depth: int = 5  # most interactions of a path
    reflections: int = 3  # most reflections among them
    scattered_depth: int | None = None  # most interactions of a scattered path; None: ``depth``
    rays: int = 1 << 17  # number of rays for specular paths and diffraction
    scattered_rays: int = 1 << 9  # number of rays for diffuse reflection
    scattering: float = 0.3  # share of the reflected amplitude that every surface scatters
    mesh_error_m: float = 0.02  # standard deviation of the measured surfaces' positions along each axis, metres
    seed: int = 1  # seed of positions, rays, noise, split and errors of the measured scene

    def options(self, diffraction: bool = False) -> tuple[TraceOptions, TraceOptions]:
        """Options of the search for specular, and perhaps diffracted, paths, and of that for scattered ones."""
        shared: dict[str, Any] = {"transmission": True, "seed": self.seed, "scattering_coefficient": self.scattering}
        specular: dict[str, Any] = {"depth": self.depth, "reflections": self.reflections, "diffraction": diffraction}
        scattered: dict[str, Any] = {"depth": self.scattered_depth or self.depth, "scattering": True}
        specular["rays"], scattered["rays"] = self.rays, self.scattered_rays
        return TraceOptions(**specular, **shared), TraceOptions(**scattered, **shared)


def free_positions(
    scene: Any,
    box_m: FloatArray,
    count: int,
    clear_m: float,
    rng: np.random.Generator,
    seed: int,
    apart: tuple[FloatArray, float] | None = None,
) -> FloatArray:
    """Positions [count, 3] in metres, uniform over the free part of a box in a ``sionna.rt.Scene``, to 0.1 mm.

    ``box_m`` [2, 3] are its lower and upper corner. Positions are more than ``clear_m`` away from surfaces, judged by
    points on these that are drawn with ``seed``, and lie ``apart`` from other positions, [3] or [k, 3], by more than a
    distance; all in metres.
    """
    surfaces = scene_surfaces(scene)
    mesh = trimesh.Trimesh(surfaces.triangles.reshape(-1, 3), np.arange(3 * len(surfaces.triangles)).reshape(-1, 3))
    # A point every 2 cm or so: much less than the clearance.
    tree = cKDTree(trimesh.sample.sample_surface(mesh, int(mesh.area / 4e-4), seed=seed)[0])
    # Rejection: draws are uniform over the box, so those that stay are uniform over its free part.
    positions = np.zeros((0, 3))
    while len(positions) < count:
        drawn = np.round(rng.uniform(box_m[0], box_m[1], (count, 3)), 4)
        free = tree.query(drawn)[0] > clear_m
        if apart is not None:
            others_m, distance_m = apart
            free &= np.linalg.norm(drawn[:, None] - np.atleast_2d(others_m), axis=-1).min(axis=1) > distance_m
        free &= solid_around(surfaces, drawn) < 0
        positions = np.concatenate([positions, drawn[free]])
    return positions[:count]


def trace_channels(
    scene: Any,
    receiver: Receiver,
    positions: FloatArray,
    frequencies_hz: FloatArray,
    options: Sequence[TraceOptions],
    opaque: Sequence[str] = (),
    **how: Any,
) -> NDArray[np.complex128]:
    """Channels [n, m, f] between positions [n, 3] and the m elements of a receiver, summed over `searched_paths`."""
    assert receiver.array_m is not None
    channel = np.zeros((len(positions), len(receiver.array_m), len(frequencies_hz)), complex)
    for rows, traced in searched_paths(scene, receiver, positions, options, opaque, **how):
        channel[rows] += array_channels(traced.paths, receiver, receiver.array_m, frequencies_hz)
    return channel


def searched_paths(
    scene: Any,
    receiver: Receiver,
    positions: FloatArray,
    options: Sequence[TraceOptions],
    opaque: Sequence[str] = (),
    chunk_size: int = CHUNK_SIZE,
    progress: str | None = None,
) -> Iterator[tuple[slice, TraceResult]]:
    """Paths from a receiver's array, as "transmitter", to chunks of positions [n, 3], as "receivers".

    A search with scattering counts its scattered paths, another search all but those diffracted at other edges than of
    the ``opaque`` objects. ``progress`` is the text of a progress bar on standard error.

    Yields:
        Rows of a chunk, and its paths by a search.
    """
    set_scattering(scene, options[0].scattering_coefficient)
    with Progress(console=Console(stderr=True), transient=True, disable=progress is None) as bar:
        for start in bar.track(range(0, len(positions), chunk_size), description=progress or ""):
            part = positions[start : start + chunk_size]
            ends = [Receiver(str(row), position, np.array(UPRIGHT)) for row, position in enumerate(part)]
            for search in options:
                # The array searches, so that all positions see the same patches of rough wall and the same edges.
                # With diffraction Sionna RT searches from transmitters, so the array is the transmitter.
                traced = trace_paths(scene, receiver.position_m, ends, search, search_from="transmitters")
                paths = traced.paths
                counted = (paths.interactions == SCATTERING).any(axis=1)
                if not search.scattering:
                    names = np.array([paths.object_names.index(name) for name in opaque if name in paths.object_names])
                    counted = ~((paths.interactions == DIFFRACTION) & ~np.isin(paths.objects, names)).any(axis=1)
                yield slice(start, start + len(part)), traced.select(counted)


def set_scattering(scene: Any, coefficient: float | None) -> None:
    """Set the share of the reflected amplitude that all surfaces of a ``sionna.rt.Scene`` scatter; None: as stated."""
    for material in scene.radio_materials.values() if coefficient is not None else ():
        material.scattering_coefficient = coefficient
