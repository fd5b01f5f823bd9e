"""Surfaces that the mesh lacks, found in the misfit of a traced spectrum.

The known paths are the reference wave of a hologram: a further wave beats with them, phase included, and a mirror's
wave is determined by its plane. A mirror at the right position makes spectra likelier for all transmitters whose point
of reflection lies on it, over many wavelengths; at a wrong one only for some. Candidates are planes along the mesh's
directions, a sixteenth of a wavelength apart, in patches; the best patches grow into rectangles ("sheets"), edge by
edge, and stay if the likelihood rises significantly. A sheet also attenuates every known path that crosses it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import mirrored
from ...tracing.slab import slab
from .spectrum_rays import ChainPaths, ChainTable
from .spectrum_waves import ComplexArray, Spectrometer, gains, spherical_waves

KINDS = np.array([[1.0, 1e7, 0.002], [2.6, 0.02, 0.02]]).T
"""Relative permittivity, conductivity (S/m) and thickness (m) of a sheet, [3, kinds]: metal, or a wooden board."""
FAMILIES = 6
"""Families of parallel planes at most."""
HALF_M = (0.35, 0.7)
"""Half the edges of the patches that are tried, metres."""
PATCH_M = 0.5
"""A patch hides paths that cross its plane so near to a row's point of reflection, metres."""
LEAST_SEED = 8.0
"""Least gain of a patch."""
SEEDS, GROWN = 40, 10
"""Patches that are tried in one round, and the best of them that are grown."""
SHEETS_PER_ROUND = 4
STEPS = 16
"""Planes to a wavelength that are tried."""
KEPT_NUMBERS = 1 << 25
"""Most numbers of the changes by planes that are kept from round to round, 256 MiB; others are made anew."""
SCANNED_ROWS = 600
"""Rows of the scan for patches: enough to rank them."""
LEAST_M = 0.15
"""Shortest edge of a sheet."""
LEAST_ROWS = 4
"""Least number of transmitters that a sheet affects."""


@dataclass(frozen=True)
class Frame:
    """A family of parallel planes: two axes in them and their normal [3, 3], bounds of the room along these [3]."""

    axes: FloatArray
    low: FloatArray
    high: FloatArray


def frames_of(normals: FloatArray, areas: FloatArray, points_m: FloatArray) -> list[Frame]:
    """Families of planes along normals [q, 3], those of most area [q] first, within the bounds of points [n, 3]."""
    left = np.array(areas, float)
    frames: list[Frame] = []
    while left.max(initial=0) > 0 and len(frames) < FAMILIES:
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
class Sheet:
    """A rectangle that reflects, in a plane of a family at an offset along the family's normal, of a kind of `KINDS`.

    Its edges [4] are low and high along the first axis, then along the second, metres.
    """

    frame: int
    offset_m: float
    edges_m: tuple[float, ...]
    kind: int

    def corners(self, frames: list[Frame]) -> FloatArray:
        """Shape [4, 3], in order, metres."""
        a, b, c, d = self.edges_m
        along = np.array([[x, y, self.offset_m] for x, y in ((a, c), (b, c), (b, d), (a, d))])
        return along @ frames[self.frame].axes

    def contains(self, point_m: FloatArray) -> NDArray[np.bool_]:
        """Whether points [n, 2] along the first two axes lie inside the edges."""
        (x, y), (a, b, c, d) = point_m.T, self.edges_m
        return np.asarray((x > a) & (x < b) & (y > c) & (y < d))


@dataclass(frozen=True)
class KnownPaths:
    """Paths [p] of the present model with waves at the elements [p, m], and their straight legs [g]."""

    wave: ComplexArray
    tx: IntArray
    path: IntArray
    start_m: FloatArray
    end_m: FloatArray

    @classmethod
    def of(cls, table: ChainTable, paths: ChainPaths, wave: ComplexArray, tx_pos_m: FloatArray) -> KnownPaths:
        """Legs of paths from transmitters [n, 3] by a table's chains, with their waves [p, m]."""
        vertices = table.vertices(table.images(tx_pos_m[paths.tx], paths.chain), paths.chain)[1]
        length, legs = table.length[paths.chain], []
        here = np.tile(table.receiver_m, (len(paths), 1))
        for leg in range(vertices.shape[1] + 1):
            row = np.flatnonzero(length >= leg)
            last = length[row] == leg
            level = min(leg, vertices.shape[1] - 1)
            there = np.where(last[:, None], tx_pos_m[paths.tx[row]], vertices[row, level])
            legs.append((row, here[row], there))
            here[row] = there
        return cls(wave, paths.tx, *(np.concatenate(column) for column in zip(*legs, strict=True)))

    def select(self, count: int) -> KnownPaths:
        """Paths of the first ``count`` transmitters."""
        kept = self.tx < count
        number = np.cumsum(kept) - 1
        leg = kept[self.path]
        return KnownPaths(self.wave[kept], self.tx[kept], number[self.path[leg]], self.start_m[leg], self.end_m[leg])

    def crossings(self, axes: FloatArray, offset_m: float) -> tuple[IntArray, FloatArray]:
        """Paths that cross a plane, and the points along its axes [k, 2]; legs that end at it do not cross it."""
        near, far = self.start_m @ axes[2] - offset_m, self.end_m @ axes[2] - offset_m
        leg = np.flatnonzero((near * far < 0) & (np.minimum(np.abs(near), np.abs(far)) > 1e-3))
        share = near[leg] / (near[leg] - far[leg])
        point = self.start_m[leg] + share[:, None] * (self.end_m[leg] - self.start_m[leg])
        return self.path[leg], point @ axes[:2].T


@dataclass(frozen=True)
class Plane:
    """Reflected waves [kinds, n, m] of an infinite plane, points of reflection [n, 2] where ``fine``, and crossings."""

    wave: ComplexArray
    point: FloatArray
    fine: NDArray[np.bool_]
    path: IntArray
    crossing: FloatArray


@dataclass(frozen=True)
class ConductingPlane:
    """A conducting plane: rows with a point of reflection on it [k], and these points [k, 2].

    ``change`` [k, m] is what it changes of the rows' signals, in single precision, as it ranks patches.
    """

    row: IntArray
    point: FloatArray
    change: NDArray[np.complex64]


@dataclass
class Search:
    """Search for sheets with transmitters [n, 3], their spectra's shapes [n, r * c] and present paths."""

    frames: list[Frame]
    instrument: Spectrometer
    tx_pos_m: FloatArray
    shapes: FloatArray
    known: KnownPaths

    def __post_init__(self) -> None:
        """Compute the transmission of each kind of sheet at normal incidence."""
        self.wavelength_m, self._rx = self.instrument.wavelength_m, self.instrument.receiver.position_m
        self._passed = slab(
            np.ones_like(KINDS[0]), KINDS[0], KINDS[1], KINDS[2], self.instrument.frequency_hz
        ).transmitted_te
        self._kept, self._free = dict[tuple[int, float], ConductingPlane | None](), KEPT_NUMBERS

    @cached_property
    def _scanned(self) -> Search:
        """The search with the rows of the scan for patches."""
        part = slice(0, SCANNED_ROWS)
        known = self.known.select(len(self.tx_pos_m[part]))
        return Search(self.frames, self.instrument, self.tx_pos_m[part], self.shapes[part], known)

    def loss(self, signals: ComplexArray, row: IntArray | slice = slice(None)) -> FloatArray:
        """Loss of element signals of some rows."""
        return self.instrument.grid.loss(signals, self.shapes[row])

    def plane(self, frame: int, offset_m: float, kinds: int = KINDS.shape[1]) -> Plane:
        """Effect of a plane of a family."""
        axes = self.frames[frame].axes
        normal = axes[2]
        near, height = float(self._rx @ normal - offset_m), self.tx_pos_m @ normal - offset_m
        fine = near * height > 0
        row = np.flatnonzero(fine)
        image = mirrored(self.tx_pos_m[row], normal, offset_m) - self._rx
        point = np.zeros((len(fine), 2))
        point[row] = (self._rx + (near / (near + height[row]))[:, None] * image) @ axes[:2].T
        wave = np.zeros((kinds, len(fine), len(self.instrument.elements_m)), complex)
        wave[:, row] = self._gains(image, normal, kinds)[:, :, None] * spherical_waves(image, self.instrument)
        return Plane(wave, point, fine, *self.known.crossings(axes, offset_m))

    def _gains(self, image_m: FloatArray, normal: FloatArray, kinds: int) -> ComplexArray:
        """Gains [kinds, n] of a reflection at a plane of each kind; images [n, 3] less the receiver's position."""
        n = len(image_m)
        kind, row = np.repeat(np.arange(kinds), n), np.tile(np.arange(n), kinds)
        normals = np.broadcast_to(normal, (len(row), 1, 3))
        paths = ChainPaths(row, row, image_m[row], kind[:, None], kind[:, None], normals)
        return gains(paths, KINDS, self.instrument.antennas, self.instrument.frequency_hz).reshape(kinds, n)

    def change(self, sheet: Sheet, plane: Plane | None = None) -> tuple[IntArray, ComplexArray]:
        """Rows that a sheet changes [k] and the change of their signals [k, m]."""
        plane = plane or self.plane(sheet.frame, sheet.offset_m)
        inside = plane.fine & sheet.contains(plane.point)
        hidden = np.unique(plane.path[sheet.contains(plane.crossing)])
        row = np.union1d(np.flatnonzero(inside), self.known.tx[hidden])
        added = np.where(inside[row, None], plane.wave[sheet.kind, row], 0)
        lost = (1 - self._passed[sheet.kind]) * self.known.wave[hidden]
        np.subtract.at(added, np.searchsorted(row, self.known.tx[hidden]), lost)
        return row, added

    def gain(self, sheet: Sheet, plane: Plane, signals: ComplexArray, before: FloatArray) -> float:
        """Reduction of the loss by a sheet; 0 where it affects too few transmitters."""
        row, added = self.change(sheet, plane)
        return float((before[row] - self.loss(signals[row] + added, row)).sum()) if len(row) >= LEAST_ROWS else 0.0

    def __call__(self, signals: ComplexArray, most: int, least_gain: float) -> list[Sheet]:
        """Sheets in the order in which they are found, from the present model's element signals [n, m].

        ``least_gain`` is the least gain of a sheet in the logarithm of the likelihood.
        """
        found: list[Sheet] = []
        signals = signals.copy()
        while len(found) < most:
            before = self.loss(signals)
            tried = [Growth(self, signals, before, *seed) for seed in self._seeds(signals)]
            tried.sort(key=lambda growth: -growth.best[0])
            taken = 0
            for gain, sheet in sorted((growth.grow() for growth in tried[:GROWN]), key=lambda pair: -pair[0]):
                if gain < least_gain or taken == SHEETS_PER_ROUND or len(found) == most:
                    break
                row, added = self.change(sheet)
                change = before[row] - self.loss(signals[row] + added, row)
                # A sheet that has lost gain to one taken before waits for the next round.
                if change.sum() < 0.8 * gain:
                    continue
                signals[row] += added
                before[row] -= change
                taken += 1
                found.append(sheet)
            if not taken:
                break
        return found

    def _conducting(self, frame: int, offset_m: float) -> ConductingPlane | None:
        """A conducting plane of a family, kept for further rounds; None where too few rows are reflected.

        A row loses the known paths that cross the plane near its point of reflection.
        """
        place = frame, offset_m
        if place in self._kept:
            return self._kept[place]
        plane, found = self.plane(frame, offset_m, kinds=1), None
        use = np.flatnonzero(plane.fine)
        if len(use) >= LEAST_ROWS:
            tx = self.known.tx[plane.path]
            near = np.abs(plane.crossing - plane.point[tx]).max(axis=1) < PATCH_M
            hidden = np.unique(plane.path[near & plane.fine[tx]])
            changed = plane.wave[0]
            np.subtract.at(changed, self.known.tx[hidden], self.known.wave[hidden])
            found = ConductingPlane(use, plane.point[use], changed[use].astype(np.complex64))
        size = 0 if found is None else found.change.size
        if size <= self._free:
            self._free -= size
            self._kept[place] = found
        return found

    def _seeds(self, signals: ComplexArray) -> list[tuple[int, float, FloatArray]]:
        """Most promising patches: family, offset, centre and half size.

        A conducting plane is tried as a whole, row by row; the gain of a patch is the sum over the rows whose point of
        reflection lies in it, as rows are independent.
        """
        scanned, step = self._scanned, self.wavelength_m / STEPS
        before = scanned.loss(signals[:SCANNED_ROWS])
        candidates: list[tuple[float, int, float, FloatArray]] = []
        for index, frame in enumerate(self.frames):
            for offset in np.arange(frame.low[2], frame.high[2] + step, step).tolist():
                if abs(float(self._rx @ frame.axes[2]) - offset) < self.wavelength_m / 4:
                    continue
                plane = scanned._conducting(index, offset)
                if plane is None:
                    continue
                gain = before[plane.row] - scanned.loss(signals[plane.row] + plane.change, plane.row)
                for half in HALF_M:
                    grid = [np.arange(frame.low[i] + half / 2, frame.high[i], half) for i in (0, 1)]
                    first, second = (
                        (np.abs(plane.point[:, i] - grid[i][:, None]) < half).astype(float) for i in (0, 1)
                    )
                    total = (first * gain) @ second.T
                    for i, j in np.argwhere(total > LEAST_SEED):
                        patch = np.array([grid[0][i], grid[1][j], half])
                        candidates.append((float(total[i, j]), index, offset, patch))
        candidates.sort(key=lambda candidate: -candidate[0])
        seeds: list[tuple[int, float, FloatArray]] = []
        for _, index, offset, patch in candidates:
            apart = all(
                index != i or abs(offset - o) > self.wavelength_m / 8 or np.abs(patch[:2] - p[:2]).sum() > 0.8
                for i, o, p in seeds
            )
            if apart:
                seeds.append((index, offset, patch))
            if len(seeds) == SEEDS:
                break
        return seeds


Judged = tuple[float, Sheet]
"""A sheet and its gain."""


class Growth:
    """A patch, given by family, offset, centre and half size, whose edges and plane move as long as the loss falls."""

    def __init__(
        self, search: Search, signals: ComplexArray, before: FloatArray, frame: int, offset_m: float, patch: FloatArray
    ) -> None:
        self._search, self._signals, self._before, self._frame = search, signals, before, frame
        self._family, self._planes = search.frames[frame], dict[float, Plane]()
        self._half = search.wavelength_m / 2
        x, y, half = (float(value) for value in patch)
        edges = (x - half, x + half, y - half, y + half)
        self.best = self._swept(self._judged(offset_m, edges), np.linspace(-self._half / 4, self._half / 4, 5))

    def grow(self) -> Judged:
        """Gain and sheet when no change helps any more."""
        if self.best[0] <= 0:
            return self.best
        best = self._edged(self.best, 0.4)
        # Planes half a wavelength apart look alike in phase: the likeliest gets edges of its own.
        judged = (self._judged(best[1].offset_m + shift * self._half, best[1].edges_m) for shift in (-2, -1, 1, 2))
        others = [self._swept(each, np.linspace(-0.04, 0.04, 9)) for each in judged]
        other = max(others, key=itemgetter(0))
        if other[0] > 0.6 * best[0]:
            best = max(best, self._edged(other, 0.2), key=itemgetter(0))
        self._planes.clear()
        return best

    def _judged(self, offset: float, edges: tuple[float, ...], kind: int | None = None) -> Judged:
        """The better kind, or the given one, of a sheet within the family's bounds; gain 0 where it is too small."""
        family = self._family
        low, high = np.repeat(family.low[:2], 2), np.repeat(family.high[:2], 2)
        a, b, c, d = clipped = tuple(np.clip(edges, low, high).tolist())
        best = 0.0, Sheet(self._frame, offset, clipped, 0)
        inside = family.low[2] - LEAST_M < offset < family.high[2] + LEAST_M
        if b - a < LEAST_M or d - c < LEAST_M or not inside:
            return best
        if offset not in self._planes:
            self._planes[offset] = self._search.plane(self._frame, offset)
        for each in range(KINDS.shape[1]) if kind is None else (kind,):
            sheet = Sheet(self._frame, offset, clipped, each)
            gain = self._search.gain(sheet, self._planes[offset], self._signals, self._before)
            best = max(best, (gain, sheet), key=itemgetter(0))
        return best

    def _swept(self, best: Judged, offsets: FloatArray) -> Judged:
        tries = [self._judged(best[1].offset_m + float(shift), best[1].edges_m) for shift in offsets]
        return max([best, *tries], key=itemgetter(0))

    def _edged(self, best: Judged, step: float) -> Judged:
        while step >= 0.05:
            old = best[0]
            for edge in range(4):
                for change in (-step, step):
                    edges = list(best[1].edges_m)
                    edges[edge] += change
                    best = max(best, self._judged(best[1].offset_m, tuple(edges), best[1].kind), key=itemgetter(0))
            best = self._swept(best, np.array([-0.01, -0.003, 0.003, 0.01]))
            if best[0] <= old + 1e-6:
                step /= 2
        return best
