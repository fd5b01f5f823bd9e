"""Complex blending of footprints on the perception plane, and its hand-written derivative.

The recurrence is that of `wrf_mi.gaussians.recurrence`; a lane of a vector register walks the list of its tile for a
few pixels of one column.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr

from ..backend.device import quads
from .footprint import Footprints
from .footprint_constants import CUTOFF, MIN_COSINE
from .recurrence import Pair, Rest, Sum, ahead, before, behind, plus
from .tiles import LANE_ROWS, Plane, TileLists

RECORD = 16
"""Floats per Gaussian in the packed table: n, a, b (3 each), then blending attributes; one cache line."""

MOST_COPIED = 1 << 16
"""Floats of a gradient table of which each lane of each thread may sum into a copy of its own: some MB in all.

That takes a fifth less time than sums in place, but the copies of larger tables leave the cache.
"""

LOG2_E = 1.4426950408889634


def pack(columns: list[Any]) -> Any:
    """Interleave per-Gaussian arrays into one table [n * RECORD]: one lookup then reads one cache line."""
    n = dr.width(columns[0])
    index = dr.arange(dr.uint32_array_t(type(columns[0])), n) * RECORD
    table = dr.zeros(type(columns[0]), n * RECORD)
    for k, column in enumerate(columns):
        dr.scatter(table, column, index + k)
    return table


def read(table: Any, i: Any, count: int) -> list[Any]:
    """The first ``count`` numbers of record i of the table that `pack` makes, four with each lookup."""
    kind = quads(type(table))
    parts = [dr.gather(kind, table, i * (RECORD // 4) + k) for k in range(-(-count // 4))]
    return [value for part in parts for value in part][:count]


def _along_azimuth(record: list[Any], azimuth: list[Any]) -> list[Any]:
    """What n . u, a . u and b . u are in terms of elevation: pairs (factor of its cosine, factor of its sine).

    All pixels of a lane share their azimuth.
    """
    cosine, sine = azimuth
    return [[dr.fma(x, cosine, y * sine), z] for x, y, z in (record[0:3], record[3:6], record[6:9])]


def _footprint(along: list[Any], elevation: list[Any]) -> tuple[Any, Any, Any, Any]:
    """Footprint G' at one elevation, the whitened coordinates p, q and 1 / (n . u)."""
    cosine, sine = elevation
    facing, p, q = (dr.fma(h, cosine, z * sine) for h, z in along)
    inverse = dr.rcp(facing)
    p, q = p * inverse, q * inverse
    square = dr.fma(p, p, q * q)
    inside = (facing > MIN_COSINE) & (square < CUTOFF * CUTOFF)
    return dr.select(inside, dr.exp2(-0.5 * LOG2_E * square), 0), p, q, inverse


@dataclass
class Lanes:
    """The pixels of all transmitters, in lanes."""

    azimuth: list[Any]
    elevation: list[list[Any]]
    pixel: list[Any]
    active: list[Any]
    start: Any
    end: Any


def lanes_of(plane: Plane, lists: TileLists, n: int, batch: int) -> Lanes:
    """Pixels and lists of ``batch`` transmitters with n Gaussians each."""
    index_type = type(lists.index)
    lane = dr.arange(index_type, batch * plane.lanes)
    inner, b = lane % plane.lanes, lane // plane.lanes

    def of(array: Any) -> Any:
        return dr.gather(type(array), array, inner)

    tile = b * plane.tiles + of(plane.tile)
    return Lanes(
        azimuth=[of(a) for a in plane.azimuth],
        elevation=[[of(c) for c in e] for e in plane.elevation],
        pixel=[b * plane.pixels + of(p) for p in plane.pixel],
        active=[of(a) for a in plane.active],
        start=lists.begin(tile, n),
        end=dr.gather(index_type, lists.length, tile),
    )


def add(record: list[Any], own: list[Any], signals: list[Pair], lanes: Lanes, so_far: Sum) -> Sum:
    """One more Gaussian, behind all before it.

    Args:
        record: begins with n, a and b.
        own: opacity or delta, see `wrf_mi.gaussians.recurrence`.
        signals: S of each transmitter.
        lanes: the pixels.
        so_far: of them.
    """
    along = _along_azimuth(record, lanes.azimuth)
    result = Sum([], [])
    for elevation, total, t in zip(lanes.elevation, so_far.total, so_far.t, strict=True):
        weight, after = ahead(own, _footprint(along, elevation)[0], t)
        result.total.append([plus(r, weight, s) for r, s in zip(total, signals, strict=True)])
        result.t.append(after)
    return result


def _brightest(t: list[Pair], product: bool) -> Any:
    """Largest |T|^2 of a lane's pixels."""
    return reduce(dr.maximum, [re * re + im * im if product else re * re for re, im in t])


@dr.syntax
def _forward(
    table: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int, early: bool = False
) -> tuple[Any, Any]:
    float_type, index_type = type(table), type(lists.index)
    lanes = lanes_of(plane, lists, n, batch)
    fields = 13 if product else 12
    state = Sum.start(float_type, LANE_ROWS)
    j, end = index_type(0), index_type(lanes.end)
    while j < end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        if dr.hint(early, mode="scalar"):
            # This Gaussian is the lane's last once it and all behind it can send no more than what is allowed.
            reach = dr.gather(float_type, table, i * RECORD + fields)
            end = dr.select(_brightest(state.t, product) * reach * reach <= 1, j, end)
        record = read(table, i, fields)
        state = add(record, record[11:], [(record[9], record[10])], lanes, state)
        j += 1
    # Each scatter below is a kernel of its own, which would run the loop again.
    dr.eval(state.total)
    out_re, out_im = dr.zeros(float_type, batch * plane.pixels), dr.zeros(float_type, batch * plane.pixels)
    for k in range(LANE_ROWS):
        dr.scatter(out_re, state.total[k][0][0], lanes.pixel[k], lanes.active[k])
        dr.scatter(out_im, state.total[k][0][1], lanes.pixel[k], lanes.active[k])
    return out_re, out_im


def take_away(
    record: list[Any], own: list[Any], signals: list[Pair], lanes: Lanes, rest: Rest, slopes: list[list[Pair]]
) -> tuple[list[Any], list[Any], list[Pair], Any, Rest]:
    """One Gaussian's derivatives, summed over a lane's pixels: of n, a and b, of ``own`` and of each signal.

    Arguments as of `add`, and the rest and gradients of `wrf_mi.gaussians.recurrence.before`. Also returned: whether
    any pixel sees the Gaussian, and the rest behind it.
    """
    along = _along_azimuth(record, lanes.azimuth)
    sums: list[list[Any]] = [[0, 0] for _ in range(3)]
    by_own: list[Any] = [0 for _ in own]
    by_signal: list[Pair] = [(0, 0) for _ in signals]
    after, seen = Rest([], []), False
    for k, elevation in enumerate(lanes.elevation):
        g, x, y, inverse = _footprint(along, elevation)
        by_g, d_own, d_signal, t, q = behind(own, g, rest.t[k], rest.q[k], signals, slopes[k])
        after.t.append(t)
        after.q.append(q)
        f = dr.select(g > 0, -by_g * g * inverse, 0)
        d_x, d_y = f * x, f * y
        for pair, d in zip(sums, (-(d_x * x + d_y * y), d_x, d_y), strict=True):
            pair[0], pair[1] = dr.fma(d, elevation[0], pair[0]), dr.fma(d, elevation[1], pair[1])
        by_own = [a + b for a, b in zip(by_own, d_own, strict=True)]
        by_signal = [(a + c, b + d) for (a, b), (c, d) in zip(by_signal, d_signal, strict=True)]
        seen |= g > 0
    cosine, sine = lanes.azimuth
    vectors = [c for level, up in sums for c in (level * cosine, level * sine, up)]
    return vectors, by_own, by_signal, seen, after


@dr.syntax
def _backward(
    table: Any,
    lists: TileLists,
    plane: Plane,
    n: int,
    product: bool,
    batch: int,
    total: tuple[Any, Any],
    gradient: tuple[Any, Any],
) -> Any:
    """Gradient table [batch * n * RECORD] in the layout of ``table``."""
    float_type, index_type = type(table), type(lists.index)
    lanes = lanes_of(plane, lists, n, batch)
    slopes, rest = before([[pixel] for pixel in lanes.pixel], lanes.active, total, gradient)
    fields = 13 if product else 12
    out = dr.zeros(float_type, dr.width(table))
    dr.eval(out)
    mode = dr.ReduceMode.Auto if dr.width(table) <= MOST_COPIED else dr.ReduceMode.Local
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        record = read(table, i, fields)
        signals = [(record[9], record[10])]
        vectors, by_own, by_signal, seen, rest = take_away(record, record[11:], signals, lanes, rest, slopes)
        values = [*vectors, *by_signal[0], *by_own]
        for k in range(fields):
            dr.scatter_reduce(dr.ReduceOp.Add, out, values[k], i * RECORD + k, seen, mode=mode)
        j += 1
    return out


class _Blend(dr.CustomOp):
    """Blending as one differentiable operation over per-Gaussian columns."""

    def eval(
        self,
        lists: TileLists,
        plane: Plane,
        n: int,
        product: bool,
        batch: int,
        columns: list[Any],
        reach: Any | None,
    ) -> Any:
        self.parts = (lists, plane, n, product, batch)
        self.count = len(columns)
        self.table = pack(columns if reach is None else [*columns, reach])
        dr.eval(self.table)
        self.total = _forward(self.table, *self.parts, reach is not None)
        dr.eval(self.total)
        return self.total

    def backward(self) -> None:
        gradient: Any = self.grad_out()
        dr.eval(gradient)
        out = _backward(self.table, *self.parts, self.total, gradient)
        dr.eval(out)
        index = dr.arange(dr.uint32_array_t(type(out)), dr.width(out) // RECORD) * RECORD
        self.set_grad_in("columns", [dr.gather(type(out), out, index + k) for k in range(self.count)])

    def name(self) -> str:
        return "wrf_mi blending"


def blend(
    footprints: Footprints,
    signal: list[Any],
    lists: TileLists,
    plane: Plane,
    batch: int,
    opacity: Any | None = None,
    attenuation: list[Any] | None = None,
    reach: Any | None = None,
) -> tuple[Any, Any]:
    """Received complex signal of each pixel.

    Args:
        footprints: of ``batch * n`` Gaussians.
        signal: complex signal (re, im), two arrays [batch * n].
        lists: Gaussians of each tile, near to far.
        plane: the perception plane.
        batch: number of transmitters.
        opacity: array [batch * n] in [0, 1); alpha blending.
        attenuation: complex factor delta (re, im), |delta| < 1; product blending.
        reach: bound of what a Gaussian and all behind it send (`wrf_mi.gaussians.skip.behind`) in units of the error
            that is allowed, [batch * n]; a pixel's walk then ends once T times it is below 1. None: walk to the end.

    Returns:
        Real and imaginary part of R, arrays [batch * height * width], row-major. Differentiable in
        footprints, signal, and opacity or attenuation.

    Raises:
        ValueError: gradients of walks that end early, which are not bounded.
    """
    product = attenuation is not None
    n = dr.width(signal[0]) // batch
    own = attenuation if attenuation is not None else [opacity]
    columns = [*footprints.direction, *footprints.whitened[0], *footprints.whitened[1], *signal, *own]
    if reach is not None and dr.grad_enabled(columns):
        raise ValueError(
            "blend: walks that end early give no gradients; leave skip.early_stop_tolerance at 0 in training"
        )
    return dr.custom(_Blend, lists, plane, n, product, batch, columns, reach)
