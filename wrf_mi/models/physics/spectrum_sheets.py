"""Sheets: rectangles that the mesh lacks, the planes that they may lie in, and the paths that they would cross.

`wrf_mi.models.physics.spectrum_search` finds them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from .spectrum_fit import Constants, Waves
from .spectrum_rays import ChainTable

ComplexArray = NDArray[np.complex128]

KINDS = ((1.0, 1e7, 0.002), (2.6, 0.02, 0.02))
"""Relative permittivity, conductivity (S/m) and thickness (m) of what a sheet may be: metal, or a wooden board."""


@dataclass(frozen=True)
class Frame:
    """A family of parallel planes.

    Attributes:
        axes: two unit vectors in the planes and their normal, rows of [3, 3].
        low, high: bounds of the room along these, shape [3].
    """

    axes: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class Sheet:
    """A rectangle that reflects.

    Attributes:
        frame: index of its family of planes.
        offset_m: along the family's normal.
        edges_m: low and high along the first axis, then along the second, shape [4].
        kind: index into `KINDS`.
    """

    frame: int
    offset_m: float
    edges_m: tuple[float, float, float, float]
    kind: int

    def corners(self, frames: list[Frame]) -> FloatArray:
        """Shape [4, 3], in order, metres."""
        a, b, c, d = self.edges_m
        along = np.array([[a, c, self.offset_m], [b, c, self.offset_m], [b, d, self.offset_m], [a, d, self.offset_m]])
        return along @ frames[self.frame].axes


def frames_of(normals: FloatArray, areas: FloatArray, points_m: FloatArray, most: int = 6) -> list[Frame]:
    """Families of planes along the directions of a mesh's surfaces, those of most area first.

    Args:
        normals: unit vectors [q, 3]; none: the axes of the coordinates.
        areas: of each, square metres, shape [q].
        points_m: what the room holds, [n, 3].
        most: families.
    """
    if not len(normals):
        normals, areas = np.eye(3), np.ones(3)
    left = np.array(areas, float)
    frames: list[Frame] = []
    while left.max(initial=0) > 0 and len(frames) < most:
        normal = normals[int(left.argmax())]
        up = np.eye(3)[int(np.abs(normal).argmin()) if abs(normal[2]) > 0.9 else 2]
        first = np.cross(up, normal)
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(normal, first), normal])
        along = points_m @ axes.T
        frames.append(Frame(axes, along.min(axis=0), along.max(axis=0)))
        left[np.abs(normals @ normal) > np.cos(np.radians(5))] = 0
    return frames


@dataclass(frozen=True)
class Known:
    """The paths that are known already, as straight legs; g legs of p paths.

    Attributes:
        wave: what each path brings to the elements [p, m].
        tx: transmitter of each, [p].
        path: of each leg, [g].
        start_m, end_m: of each leg [g, 3].
    """

    wave: ComplexArray
    tx: IntArray
    path: IntArray
    start_m: FloatArray
    end_m: FloatArray

    @classmethod
    def of(
        cls, table: ChainTable, waves: Waves, constants: Constants, factor: ComplexArray, tx_pos_m: FloatArray
    ) -> Known:
        """Paths of a table's chains with their present gains times ``factor`` [p]."""
        met = waves.met
        wave = (waves.gain(constants) * factor)[:, None] * waves.steering(constants.offset_m)
        vertices = table.vertices(table.images(tx_pos_m[met.tx], met.chain), met.chain)[1]
        length, own = table.length[met.chain], np.arange(len(met))
        paths, starts, ends = [], [], []
        here = np.broadcast_to(table.receiver_m, (len(met), 3))
        for leg in range(vertices.shape[1] + 1):
            row = own[length >= leg]
            last = length[row] == leg
            level = min(leg, vertices.shape[1] - 1)
            there = np.where(last[:, None], tx_pos_m[met.tx[row]], vertices[row, level])
            paths.append(row)
            starts.append(here[row])
            ends.append(there)
            here = np.array(here)
            here[row] = there
        return cls(wave, met.tx, np.concatenate(paths), np.concatenate(starts), np.concatenate(ends))

    def select(self, count: int) -> Known:
        """Paths of the first ``count`` transmitters."""
        kept = self.tx < count
        number = np.cumsum(kept) - 1
        leg = kept[self.path]
        return Known(self.wave[kept], self.tx[kept], number[self.path[leg]], self.start_m[leg], self.end_m[leg])

    def crossings(self, axes: FloatArray, offset_m: float) -> tuple[IntArray, FloatArray]:
        """Paths that cross a plane, and where along its axes [k, 2]; legs that end at it do not."""
        near, far = self.start_m @ axes[2] - offset_m, self.end_m @ axes[2] - offset_m
        leg = np.flatnonzero((near * far < 0) & (np.minimum(np.abs(near), np.abs(far)) > 1e-3))
        share = near[leg] / (near[leg] - far[leg])
        place = (self.start_m[leg] + share[:, None] * (self.end_m[leg] - self.start_m[leg])) @ axes[:2].T
        return self.path[leg], place
