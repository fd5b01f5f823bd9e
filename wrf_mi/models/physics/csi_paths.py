"""Image sources of an antenna in plane mirrors, the paths from them that may exist, and corrections of the planes.

Image method (`wrf_mi.tracing.image_method`). Each path has *margins*: its distance in metres from being cut off by an
outline, from which the probability that it exists follows. Planes are shifted and tilted until the phases of the paths
that they mirror fit the measured channels (Gauss-Newton).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tracing.image_method import image_sources, meeting_point
from ...tracing.walls import Walls

CHUNK_SIZE = 1 << 19
"""Pairs of chain and position that are computed together."""
REACH_M = 0.1
"""Paths with a margin below minus this length are dropped."""
MOUNTED_M = 0.01
"""An antenna so close to a plane is mounted on it: the plane neither hides nor mirrors the antenna."""
NUMBERS = 5
"""Parameters of a plane: shift (m), two tilts (rad), logarithm and phase of its reflection coefficient."""
STEPS = 3

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Images:
    """Chains of planes [c, b] from one antenna, -1 beyond the last plane.

    ``image_m`` [c, b + 1, 3] are images after 0, 1, ... reflections, the last repeated; ``slope`` [c, b, 3, 3] is the
    derivative of the last image by the change (`Walls.moved`) of each plane: level, component, coordinate.
    """

    plane: IntArray
    image_m: FloatArray
    slope: FloatArray

    def __len__(self) -> int:
        """Number of chains."""
        return len(self.plane)


def images_of(walls: Walls, source_m: FloatArray, plane: IntArray) -> Images:
    """Mirror a source [3], or one of each chain [c, 3], at the planes of each chain [c, b] in turn."""
    count, depth = plane.shape
    image = image_sources(walls.normal, walls.offset_m, plane, source_m)
    slope = np.zeros((count, depth, 3, 3))
    for level in range(depth):
        row = np.flatnonzero(plane[:, level] >= 0)
        q, here = plane[row, level], image[row, level]
        n, axes = walls.normal[q], walls.axes[q]
        before = slope[row, :level]
        slope[row, :level] = before - 2 * np.einsum("clkd,cd->clk", before, n)[..., None] * n[:, None, None]
        height = (here * n).sum(axis=1) - walls.offset_m[q]
        tilt = np.einsum("cad,cd->ca", axes, here - walls.centre_m[q])[..., None] * n[:, None]
        slope[row, level] = np.concatenate([2 * n[:, None], -2 * (tilt + height[:, None, None] * axes)], axis=1)
    return Images(plane, image, slope)


@dataclass(frozen=True)
class CandidatePaths:
    """Paths that may exist, sorted by position; p paths of at most b reflections.

    Attributes:
        row: position of each path [p].
        chain: chain of each path [p].
        length_m: unfolded [p].
        point_m: points from the antenna to the position: antenna, reflections, position [p, b + 2, 3]; the position
            repeated after the last.
        inside_m: least distance of its reflections from the mirrors' outlines, positive inside [p]; inf without any.
        clear_m: least distance of its legs from a screen that would hide it [p]; negative where one hides it: the
            shift of the leg, in the screen's plane or through it, that would clear it.
        inside_edge: edge of an outline that decides ``inside_m`` [p], -1 without any.
        clear_edge: edge that decides ``clear_m`` [p], -1 where none is near or the screen's depth decides.
    """

    row: IntArray
    chain: IntArray
    length_m: FloatArray
    point_m: FloatArray
    inside_m: FloatArray
    clear_m: FloatArray
    inside_edge: IntArray
    clear_edge: IntArray

    def __len__(self) -> int:
        """Number of paths."""
        return len(self.row)

    def select(self, which: NDArray[Any]) -> CandidatePaths:
        """The paths of a mask or of ascending indices."""
        return CandidatePaths(*(getattr(self, field.name)[which] for field in fields(self)))


def candidate_paths(walls: Walls, images: Images, positions_m: FloatArray) -> CandidatePaths:
    """Paths from each position [n, 3] in metres to the antenna with margins above -`REACH_M`."""
    step = max(1, CHUNK_SIZE // max(len(images), 1))
    starts = range(0, max(len(positions_m), 1), step)
    parts = [_reflected(walls, images, positions_m, slice(start, start + step)) for start in starts]
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((joined[1], joined[0]))
    row, chain, point, inside, edge = (column[order] for column in joined)
    length = np.linalg.norm(positions_m[row] - images.image_m[chain, -1], axis=1)
    clear, clear_edge = _clear(walls, images.plane[chain], point)
    paths = CandidatePaths(row, chain, length, point, inside, clear, edge, clear_edge)
    return paths.select(clear > -REACH_M)


def _near(walls: Walls, plane: IntArray, flat_m: FloatArray) -> NDArray[np.bool_]:
    """Points [n, 2] of planes [n] whose distance from the bounds is below `REACH_M`."""
    inside = (flat_m > walls.low_m[plane] - REACH_M) & (flat_m < walls.high_m[plane] + REACH_M)
    return np.asarray(inside.all(axis=1))


def _reflected(
    walls: Walls, images: Images, positions_m: FloatArray, chunk: slice
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, IntArray]:
    """Pairs of position and chain that meet their mirrors: row, chain, points, distance inside, nearest edge."""
    depth = images.plane.shape[1]
    bounces = np.count_nonzero(images.plane >= 0, axis=1)
    rows, kept = np.arange(len(positions_m))[chunk], []
    for count in range(depth + 1):
        members = np.flatnonzero(bounces == count)
        row, chain = np.repeat(rows, len(members)), np.tile(members, len(rows))
        points = [positions_m[row]]
        inside, edge = np.full(len(row), np.inf), np.full(len(row), -1)
        for level in reversed(range(count)):
            q = images.plane[chain, level]
            image = images.image_m[chain, level + 1]
            point, here, there = meeting_point(points[-1], image, walls.normal[q], walls.offset_m[q])
            flat = walls.flat(q, point)
            through = np.flatnonzero((here * there < 0) & _near(walls, q, flat))
            within, nearest = walls.inside_m(q[through], flat[through])
            chosen = within > -REACH_M
            through, within, nearest = through[chosen], within[chosen], nearest[chosen]
            edge = np.where(within < inside[through], nearest, edge[through])
            inside = np.minimum(inside[through], within)
            row, chain, points = row[through], chain[through], [part[through] for part in (*points, point)]
        way = [images.image_m[chain, 0], *reversed(points), *([positions_m[row]] * (depth - count))]
        kept.append((row, chain, np.stack(way, axis=1), inside, edge))
    row, chain, point, inside, edge = (np.concatenate(column) for column in zip(*kept, strict=True))
    return row, chain, point, inside, edge


def _clear(walls: Walls, plane: IntArray, point_m: FloatArray) -> tuple[FloatArray, IntArray]:
    """``clear_m`` and ``clear_edge`` of `CandidatePaths`."""
    clear, edge = np.full(len(plane), REACH_M), np.full(len(plane), -1)
    depth = plane.shape[1]
    side = np.einsum("pkd,qd->pkq", point_m, walls.normal) - walls.offset_m
    mounted = np.abs(side[:, 0]) < MOUNTED_M
    for leg in range(depth + 1):
        before, after = side[:, leg], side[:, leg + 1]
        cross = before * after < 0
        if leg == 0:
            cross &= ~mounted
        # A mirror does not hide its own reflection.
        for level in {leg - 1, leg} & set(range(depth)):
            mirrored = np.flatnonzero(plane[:, level] >= 0)
            cross[mirrored, plane[mirrored, level]] = False
        path, q = np.nonzero(cross)
        legs = point_m[path, leg], point_m[path, leg + 1]
        point, here, there = meeting_point(*legs, walls.normal[q], walls.offset_m[q])
        flat = walls.flat(q, point)
        near = _near(walls, q, flat)
        path, q, flat = path[near], q[near], flat[near]
        within, nearest = walls.inside_m(q, flat)
        through = np.minimum(np.abs(here), np.abs(there))[near]
        nearest = np.where(within < through, nearest, -1)
        hidden = np.minimum(within, through)
        order = np.argsort(hidden, kind="stable")  # the last written is the most hidden
        best, which = np.full(len(plane), -np.inf), np.full(len(plane), -1)
        best[path[order]], which[path[order]] = hidden[order], nearest[order]
        nearer = -best < clear
        clear, edge = np.where(nearer, -best, clear), np.where(nearer, which, edge)
    return clear, edge


@dataclass(frozen=True)
class Model:
    """Image sources with all parameters that are fitted to channels.

    Attributes:
        scan, walls: planes as given, and with their changes.
        change: parameters of each plane [q, NUMBERS].
        images: images of all antennas, antenna by antenna.
        source, source_m: antenna of each chain [c], and antennas [r, 3].
        k: wave numbers [subcarriers], rad/m.
        reflection: coefficient of an unchanged plane.
        gain: complex factor of each antenna [r].
    """

    scan: Walls
    change: FloatArray
    walls: Walls
    images: Images
    source: IntArray
    source_m: FloatArray
    k: FloatArray
    reflection: complex
    gain: Complex

    def changed(self, change: FloatArray) -> Model:
        """The model with other parameters of the planes."""
        walls = self.scan.moved(change[:, :3])
        images = images_of(walls, self.source_m[self.source], self.images.plane)
        return replace(self, change=change, walls=walls, images=images)

    def path_gain(self, chain: IntArray, position_m: FloatArray) -> Complex:
        """Gain of paths [p, subcarriers]: factor * exp(-j k L) / (2 k L), free-space loss of isotropic antennas."""
        plane = self.images.plane
        # An entry beyond the last plane stands for "no reflection" (index -1).
        each = np.append(self.reflection * np.exp(self.change[:, 3] + 1j * self.change[:, 4]), 1)
        factor = each[plane].prod(axis=1) * self.gain[self.source]
        length = np.linalg.norm(position_m - self.images.image_m[chain, -1], axis=1)[:, None]
        return np.asarray(factor[chain, None] * np.exp(-1j * self.k * length) / (2 * self.k * length))

    def length_slope(self, chain: IntArray, position_m: FloatArray) -> FloatArray:
        """Derivative of lengths [p, b, 3] by shift and tilts of each level's plane."""
        away = self.images.image_m[chain, -1] - position_m
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        return np.asarray(np.einsum("plkd,pd->plk", self.images.slope[chain], away))

    def phase_sd(self, chain: IntArray, position_m: FloatArray, covariance: FloatArray) -> FloatArray:
        """Standard deviation of phases [p] by the covariance of all planes' parameters, at the middle subcarrier."""
        if not len(covariance):
            return np.zeros(len(chain))
        slope = self.length_slope(chain, position_m) * np.median(self.k)
        plane = self.images.plane[chain]
        used = (plane >= 0)[..., None]
        turn = np.concatenate([slope, np.zeros_like(slope[..., :1]), np.ones_like(slope[..., :1])], axis=2) * used
        index = NUMBERS * np.where(plane >= 0, plane, 0)[..., None] + np.arange(NUMBERS)
        flat, index = turn.reshape(len(chain), -1), index.reshape(len(chain), -1)
        variance = np.zeros(len(chain))
        for a in range(flat.shape[1]):
            for b in range(flat.shape[1]):
                variance += flat[:, a] * flat[:, b] * covariance[index[:, a], index[:, b]]
        return np.sqrt(np.maximum(variance, 0))


@dataclass(frozen=True)
class Explained:
    """Channels [n, subcarriers], the paths [p] that explain them, and precisions of the residuals [n]."""

    channel: Complex
    row: IntArray
    chain: IntArray
    position_m: FloatArray
    probability: FloatArray
    precision: FloatArray

    def expected_gain(self, model: Model) -> Complex:
        """Gain of each path times its probability [p, subcarriers]."""
        return np.asarray(self.probability[:, None] * model.path_gain(self.chain, self.position_m))

    def residual(self, model: Model) -> Complex:
        """Measured channels less their expectation [n, subcarriers]."""
        residual = self.channel.astype(complex)
        np.subtract.at(residual, self.row, self.expected_gain(model))
        return residual


def refit(model: Model, explained: Explained, prior_sd: FloatArray) -> tuple[Model, FloatArray]:
    """A few steps of Levenberg and Marquardt for the planes' parameters, with fixed paths.

    ``prior_sd`` [q, NUMBERS] are standard deviations of each plane's parameters about zero; 0 fixes one. Returns the
    model, and the covariance of all parameters [NUMBERS q, NUMBERS q].
    """
    sd = np.maximum(prior_sd.reshape(-1), 1e-12)
    damping = 1e-6

    def cost(candidate: Model) -> float:
        square = np.square(np.abs(explained.residual(candidate))).sum(axis=1)
        return float(explained.precision @ square + np.square(candidate.change.reshape(-1) / sd).sum())

    best = cost(model)
    normal = np.zeros((len(sd), len(sd)))
    for _ in range(STEPS):
        normal, right = _normal_equations(model, explained)
        right = right - model.change.reshape(-1) / sd**2
        while damping < 1e6:
            # In units of the prior: the parameters are metres, radians and pure numbers.
            scaled = sd[:, None] * normal * sd + np.eye(len(sd))
            scaled[np.diag_indices(len(sd))] *= 1 + damping
            step = sd * np.linalg.solve(scaled, sd * right)
            candidate = model.changed(model.change + step.reshape(model.change.shape))
            value = cost(candidate)
            if value <= best:
                model, best, damping = candidate, value, damping / 10
                break
            damping = max(damping, 1e-6) * 10
        else:
            break
    scaled = sd[:, None] * normal * sd + np.eye(len(sd))
    return model, sd[:, None] * np.linalg.inv(scaled) * sd


def _normal_equations(model: Model, explained: Explained) -> tuple[FloatArray, FloatArray]:
    """J^H W J and J^H W r, real parts, for all planes' parameters."""
    slope = model.length_slope(explained.chain, explained.position_m)
    gain, residual = explained.expected_gain(model), explained.residual(model)
    size = NUMBERS * len(model.scan)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for carrier, k in enumerate(model.k):
        jacobian = np.zeros((len(residual), size), complex)
        for level in range(slope.shape[1]):
            plane = model.images.plane[explained.chain, level]
            use = plane >= 0
            wave = gain[use, carrier]
            columns = [*(-1j * k * wave * slope[use, level, part] for part in range(3)), wave, 1j * wave]
            for part, values in enumerate(columns):
                np.add.at(jacobian, (explained.row[use], NUMBERS * plane[use] + part), values)
        weighted = jacobian.conj().T * explained.precision
        normal += (weighted @ jacobian).real
        right += (weighted @ residual[:, carrier]).real
    return normal, right
