"""Surfaces that the mesh lacks, found in what a traced spectrum leaves unexplained.

The known paths are the reference wave of a hologram: a further wave shows by how it beats with them, phase included,
and a mirror's wave is known once its plane is. A mirror at the right place makes spectra likelier for all transmitters
whose point of reflection lies on it, over many wavelengths; at a wrong one it helps some and harms others. Candidates
are planes along the mesh's own directions, a sixteenth of a wavelength apart, in patches; the best patches grow into
rectangles, edge by edge, and stay if the likelihood rises by more than chance allows. A rectangle also hides what lies
behind it: every known path that crosses it is weakened by what it lets pass.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import mirrored
from ...tracing.slab import slab
from .spectrum_gains import Antennas, Slabs, gains
from .spectrum_loss import Grid
from .spectrum_rays import Met
from .spectrum_sheets import KINDS, Frame, Known, Sheet

ComplexArray = NDArray[np.complex128]

HALF_M = (0.35, 0.7)
"""Half the edges of the patches that are tried, metres."""
PATCH_M = 0.5
"""A patch hides paths that cross its plane so near to a row's point of reflection, metres."""
LEAST_SEED = 8.0
"""Gain of a patch that is looked at further."""
SEEDS, GROWN = 40, 10
"""Patches that are tried in one round, and the best of them that are grown."""
CHUNK_SIZE = 4
"""Sheets that are taken in one round."""
SCANNED_ROWS = 600
"""Rows of the scan for patches: enough to rank them."""
LEAST_M = 0.15
"""Shortest edge of a sheet."""
LEAST_ROWS = 4
"""Transmitters that must see it."""


@dataclass(frozen=True)
class Plane:
    """What a plane does to all rows: waves of each kind [kinds, n, m], where [n, 2], whether [n]; crossings."""

    wave: ComplexArray
    place: FloatArray
    fine: NDArray[np.bool_]
    path: IntArray
    crossing: FloatArray


class Search:
    """Looks for sheets with some transmitters.

    Args:
        frames: families of planes to look in.
        tx_pos_m: transmitters [n, 3], metres.
        receiver_m: the array's origin [3].
        elements_m: its elements less that [m, 3], world frame.
        antennas: of the transmitters and of the elements.
        frequency_hz: of the carrier.
        shapes: the rows' spectra, see `Grid.shapes`.
        grid: of these.
        known: paths of these transmitters.
    """

    def __init__(
        self,
        frames: list[Frame],
        tx_pos_m: FloatArray,
        receiver_m: FloatArray,
        elements_m: FloatArray,
        antennas: Antennas,
        frequency_hz: float,
        shapes: FloatArray,
        grid: Grid,
        known: Known,
    ) -> None:
        self.frames, self._tx, self._rx, self._elements = frames, tx_pos_m, receiver_m, elements_m
        self._antennas = antennas
        self._hz, self._shapes, self._grid, self._known = frequency_hz, shapes, grid, known
        self.wavelength_m = speed_of_light / frequency_hz
        self._passed = []
        for kind in KINDS:
            permittivity, conductivity, thickness = (np.array([value]) for value in kind)
            passed = slab(np.ones(1), permittivity, conductivity, thickness, frequency_hz)
            self._passed.append(complex(passed.transmitted_te[0]))

    def plane(self, frame: int, offset_m: float, kinds: int = len(KINDS)) -> Plane:
        """What a plane of a family would do."""
        axes = self.frames[frame].axes
        normal = axes[2]
        height = self._tx @ normal - offset_m
        image = mirrored(self._tx, normal, offset_m) - self._rx
        n = len(image)
        zeros = np.zeros((n, 1), np.int64)
        met = Met(zeros[:, 0], zeros[:, 0], image, zeros, zeros, np.broadcast_to(normal, (n, 1, 3)))
        length = np.linalg.norm(image, axis=1)
        distance = np.linalg.norm(image[:, None] - self._elements, axis=-1)
        wave = length[:, None] / distance * np.exp(-2j * np.pi / self.wavelength_m * distance)
        gain = [gains(met, Slabs(*(np.array([v]) for v in kind)), self._antennas, self._hz) for kind in KINDS[:kinds]]
        near = float(self._rx @ normal - offset_m)
        fine = near * height > 0  # both on one side
        share = near / np.where(fine, near + height, 1.0)
        place = (self._rx + share[:, None] * image) @ axes[:2].T
        return Plane(np.stack(gain)[:, :, None] * wave, place, fine, *self._known.crossings(axes, offset_m))

    def change(self, sheet: Sheet, plane: Plane | None = None) -> tuple[IntArray, ComplexArray]:
        """Rows that a sheet changes [k] and what it adds to their signals [k, m]."""
        plane = plane or self.plane(sheet.frame, sheet.offset_m)
        inside = plane.fine & _inside(plane.place, sheet.edges_m)
        hidden = np.unique(plane.path[_inside(plane.crossing, sheet.edges_m)])
        hit = np.zeros(len(self._tx), bool)
        hit[self._known.tx[hidden]] = True
        row = np.flatnonzero(hit | inside)
        added = np.where(inside[row, None], plane.wave[sheet.kind, row], 0)
        number = np.full(len(self._tx), -1)
        number[row] = np.arange(len(row))
        lost = (1 - self._passed[sheet.kind]) * self._known.wave[hidden]
        np.subtract.at(added, number[self._known.tx[hidden]], lost)
        return row, added

    def __call__(self, signals: ComplexArray, most: int, least_gain: float) -> list[Sheet]:
        """Sheets in the order in which they were found.

        Args:
            signals: what is explained already, [n, m].
            most: sheets.
            least_gain: by how much the logarithm of the likelihood has to grow.
        """
        found: list[Sheet] = []
        signals = signals.copy()
        while len(found) < most:
            before = self._grid.loss(signals, self._shapes)[0]
            tried = [Growth(self, signals, before, *seed) for seed in self._seeds(signals)]
            tried.sort(key=lambda one: -one.best[0])
            grown = [one.grow() for one in tried[:GROWN]]
            grown.sort(key=lambda one: -one[0])
            taken = 0
            for gain, sheet in grown:
                if gain < least_gain or taken == CHUNK_SIZE or len(found) == most:
                    break
                row, added = self.change(sheet)
                own = before[row] - self._grid.loss(signals[row] + added, self._shapes[row])[0]
                # What another one has explained meanwhile waits for the next round.
                if own.sum() < 0.8 * gain:
                    continue
                signals[row] += added
                before[row] -= own
                taken += 1
                found.append(sheet)
            if not taken:
                break
        return found

    def _seeds(self, signals: ComplexArray) -> list[tuple[int, float, FloatArray]]:
        """Patches that promise most: family, offset, centre and half size.

        A conducting plane is tried as a whole, row by row; what a patch of it gains is the sum over the rows whose
        point of reflection lies in it, as rows know nothing of each other. Of the known paths a row loses those that
        cross the plane near that point.
        """
        rows = min(len(signals), SCANNED_ROWS)
        signals, shapes, known = signals[:rows], self._shapes[:rows], self._known.select(rows)
        some = Search(
            self.frames, self._tx[:rows], self._rx, self._elements, self._antennas, self._hz, shapes, self._grid, known
        )  # fmt: skip
        before = self._grid.loss(signals, shapes)[0]
        candidates: list[tuple[float, int, float, FloatArray]] = []
        for index, frame in enumerate(self.frames):
            for offset in np.arange(frame.low[2], frame.high[2] + self.wavelength_m / 16, self.wavelength_m / 16):
                if abs(float(self._rx @ frame.axes[2]) - offset) < self.wavelength_m / 4:
                    continue
                plane = some.plane(index, float(offset), kinds=1)
                if plane.fine.sum() < LEAST_ROWS:
                    continue
                tx = known.tx[plane.path]
                near = np.abs(plane.crossing - plane.place[tx]).max(axis=1) < PATCH_M
                hidden = np.unique(plane.path[near & plane.fine[tx]])
                changed = plane.wave[0].copy()
                np.subtract.at(changed, known.tx[hidden], known.wave[hidden])
                use = np.flatnonzero(plane.fine)
                gain = before[use] - self._grid.loss(signals[use] + changed[use], shapes[use])[0]
                for half in HALF_M:
                    first, second = (np.arange(frame.low[i] + half / 2, frame.high[i], half) for i in (0, 1))
                    inside = [
                        (np.abs(plane.place[use, i] - centres[:, None]) < half).astype(float)
                        for i, centres in ((0, first), (1, second))
                    ]
                    total = (inside[0] * gain) @ inside[1].T
                    for i, j in np.argwhere(total > LEAST_SEED):
                        candidates.append(
                            (float(total[i, j]), index, float(offset), np.array([first[i], second[j], half]))
                        )
        candidates.sort(key=lambda one: -one[0])
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

    def gain(self, sheet: Sheet, plane: Plane, signals: ComplexArray, before: FloatArray) -> float:
        """By how much the loss falls with a sheet; 0 where too few transmitters see it."""
        row, added = self.change(sheet, plane)
        if len(row) < LEAST_ROWS:
            return 0.0
        after, _ = self._grid.loss(signals[row] + added, self._shapes[row])
        return float((before[row] - after).sum())


class Growth:
    """A patch whose edges and plane move as long as the loss falls.

    Args:
        search: with its rows.
        signals: what is explained already [n, m].
        before: its loss [n].
        frame: family of planes.
        offset_m: of the plane.
        patch: its centre and half its edge.

    Attributes:
        best: gain and sheet so far.
    """

    def __init__(
        self,
        search: Search,
        signals: ComplexArray,
        before: FloatArray,
        frame: int,
        offset_m: float,
        patch: FloatArray,
    ) -> None:
        self._search, self._signals, self._before, self._frame = search, signals, before, frame
        self._family, self._planes = search.frames[frame], dict[float, Plane]()
        self._half = search.wavelength_m / 2
        x, y, half = (float(value) for value in patch)
        edges = (x - half, x + half, y - half, y + half)
        self.best = self._swept(self._judged(offset_m, edges), np.linspace(-self._half / 4, self._half / 4, 5))

    def grow(self) -> tuple[float, Sheet]:
        """Gain and sheet when nothing helps any more."""
        if self.best[0] <= 0:
            return self.best
        best = self._edged(self.best, 0.4)
        # Planes half a wavelength apart look alike in phase: the likeliest gets its chance with edges of its own.
        others = [
            self._swept(
                self._judged(best[1].offset_m + shift * self._half, best[1].edges_m), np.linspace(-0.04, 0.04, 9)
            )
            for shift in (-2, -1, 1, 2)
        ]
        other = max(others, key=lambda one: one[0])
        if other[0] > 0.6 * best[0]:
            best = max(best, self._edged(other, 0.2), key=lambda one: one[0])
        self._planes.clear()
        return best

    def _judged(self, offset: float, edges: tuple[float, ...], only: int | None = None) -> tuple[float, Sheet]:
        family = self._family
        limits = [(family.low[i // 2], family.high[i // 2]) for i in range(4)]
        a, b, c, d = (float(np.clip(e, *limit)) for e, limit in zip(edges, limits, strict=True))
        best = 0.0, Sheet(self._frame, offset, (a, b, c, d), 0)
        inside = family.low[2] - LEAST_M < offset < family.high[2] + LEAST_M
        if b - a < LEAST_M or d - c < LEAST_M or not inside:
            return best
        if offset not in self._planes:
            self._planes[offset] = self._search.plane(self._frame, offset)
        for kind in range(len(KINDS)) if only is None else (only,):
            sheet = Sheet(self._frame, offset, (a, b, c, d), kind)
            gain = self._search.gain(sheet, self._planes[offset], self._signals, self._before)
            if gain > best[0]:
                best = gain, sheet
        return best

    def _swept(self, best: tuple[float, Sheet], offsets: FloatArray) -> tuple[float, Sheet]:
        tries = [self._judged(best[1].offset_m + float(shift), best[1].edges_m) for shift in offsets]
        return max([best, *tries], key=lambda one: one[0])

    def _edged(self, best: tuple[float, Sheet], step: float) -> tuple[float, Sheet]:
        while step >= 0.05:
            old = best[0]
            for edge in range(4):
                for change in (-step, step):
                    edges = list(best[1].edges_m)
                    edges[edge] += change
                    tried = self._judged(best[1].offset_m, tuple(edges), best[1].kind)
                    best = max(best, tried, key=lambda one: one[0])
            best = self._swept(best, np.array([-0.01, -0.003, 0.003, 0.01]))
            if best[0] <= old + 1e-6:
                step /= 2
        return best


def _inside(place: FloatArray, edges: tuple[float, ...]) -> NDArray[np.bool_]:
    a, b, c, d = edges
    inside: NDArray[np.bool_] = (place[:, 0] > a) & (place[:, 0] < b) & (place[:, 1] > c) & (place[:, 1] < d)
    return inside
