"""Splatting: complex blending of footprints on the perception plane, and its hand-written derivative.

The recurrence is that of `wrf_mi.gaussians.recurrence`; a lane of a vector register walks the list of its tile for a
few pixels of one column. Under either rule a weight w_i T_i depends on geometry alone. Where transmitters share one
geometry, a lane therefore keeps the sums of up to `GROUP` transmitters with one transmittance, and the reverse pass
one Q: a further transmitter costs two products per pixel instead of a footprint's exponential.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import drjit as dr

from ..backend.device import quads
from ..backend.vectors import Complex, Pose
from .footprint import CUTOFF, LOG2_E, MIN_COSINE, Footprints, depth_order, project
from .parameters import Gaussians
from .recurrence import ForwardState, ReverseState, accumulate, forward_step, reverse_start, reverse_step
from .tiles import LANE_ROWS, TiledPlane, TileLists, build_lists

RECORD = 16  # floats per Gaussian in the packed table, one cache line: n, a, b (3 each), opacity or delta, and signal

GROUP = 4  # transmitters whose sums a lane keeps: more would not fit into its registers

MOST_COPIED = 1 << 16
"""Floats of a gradient table of which each lane of each thread may sum into its private copy: some MB in all.

That takes a fifth less time than sums in place, but the copies of larger tables leave the cache.
"""


def group_size(batch: int) -> int:
    """The largest divisor of a batch that is no larger than `GROUP`."""
    return next(k for k in range(min(GROUP, batch), 0, -1) if batch % k == 0)


def columns_of(footprints: Footprints, blending: list[Any]) -> list[Any]:
    """Per-Gaussian arrays of a table in the order of its records: footprint, then opacity or delta."""
    return [*footprints.direction, *footprints.whitened[0], *footprints.whitened[1], *blending]


def pack(columns: list[Any]) -> Any:
    """Interleave per-Gaussian arrays into one table [n * RECORD]: one lookup then reads one cache line."""
    n = dr.width(columns[0])
    index = dr.arange(dr.uint32_array_t(type(columns[0])), n) * RECORD
    table = dr.zeros(type(columns[0]), n * RECORD)
    for k, column in enumerate(columns):
        dr.scatter(table, column, index + k)
    return table


def unpack(table: Any, count: int) -> list[Any]:
    """The first ``count`` columns of a table that `pack` makes."""
    index = dr.arange(dr.uint32_array_t(type(table)), dr.width(table) // RECORD) * RECORD
    return [dr.gather(type(table), table, index + k) for k in range(count)]


def read(table: Any, i: Any, count: int) -> list[Any]:
    """The first ``count`` numbers of record i of the table that `pack` makes, four with each lookup."""
    kind = quads(type(table))
    parts = [dr.gather(kind, table, i * (RECORD // 4) + k) for k in range(-(-count // 4))]
    return [value for part in parts for value in part][:count]


def along_azimuth(record: list[Any], azimuth: list[Any]) -> list[Any]:
    """Factors of the elevation's cosine and sine in n . u, a . u and b . u, at a lane's azimuth (cosine, sine)."""
    # u = (cos e cos a, cos e sin a, sin e): x cos a + y sin a is common to the pixels of a column, which saves half of
    # each pixel's products.
    cosine, sine = azimuth
    return [[dr.fma(x, cosine, y * sine), z] for x, y, z in (record[0:3], record[3:6], record[6:9])]


def footprint_at(along: list[Any], elevation: list[Any]) -> tuple[Any, Any, Any, Any]:
    """Footprint G' at one elevation (cosine, sine), the whitened coordinates p, q and 1 / (n . u)."""
    cosine, sine = elevation
    facing, p, q = (dr.fma(h, cosine, z * sine) for h, z in along)
    inverse = dr.rcp(facing)
    p, q = p * inverse, q * inverse
    square = dr.fma(p, p, q * q)
    # 1 / (n . u) is infinite or negative for a pixel beside or behind the Gaussian; the mask discards those.
    inside = (facing > MIN_COSINE) & (square < CUTOFF * CUTOFF)
    return dr.select(inside, dr.exp2(-0.5 * LOG2_E * square), 0), p, q, inverse


def _signal_slots(n: int, batch: int, index_type: Any) -> Any:
    """Position of each signal's real part, [batch * n], in a table [groups, n, 2 * group]."""
    group, index = group_size(batch), dr.arange(index_type, batch * n)
    b, i = index // n, index % n
    return ((b // group) * n + i) * (2 * group) + (b % group) * 2


def _read_signals(table: Any, slot: Any, group: int) -> list[Complex]:
    # Packets of four floats hold two signals; an odd group leaves half a packet and reads its floats one by one.
    if group % 2:
        values = [dr.gather(type(table), table, slot * (2 * group) + k) for k in range(2 * group)]
    else:
        packets = [dr.gather(quads(type(table)), table, slot * (group // 2) + k) for k in range(group // 2)]
        values = [v for packet in packets for v in packet]
    return list(zip(values[::2], values[1::2], strict=True))


@dataclass
class Lanes:
    """Pixels in lanes, for all groups of transmitters."""

    azimuth: list[Any]  # cosine and sine, [lanes] each
    elevation: list[list[Any]]  # for each of a lane's pixels cosine and sine, [lanes] each
    pixel: list[list[Any]]  # for each of a lane's pixels its numbers in the images of the group, [lanes] each
    active: list[Any]  # for each of a lane's pixels a mask [lanes]
    start: Any  # begin of the lane's list, [lanes]
    end: Any  # length of the lane's list, [lanes]
    group: Any  # number of the lane's group of transmitters, [lanes]


@dataclass
class BlendLayout:
    """Pixels and lists of ``batch`` transmitters with n Gaussians each, or with one geometry if ``shared``."""

    lists: TileLists
    plane: TiledPlane
    n: int
    batch: int
    shared: bool
    fields: int  # number of a record's floats without the signal
    size: int  # transmitters whose sums a lane keeps


def lanes_of(layout: BlendLayout) -> Lanes:
    """The lanes of all groups of transmitters."""
    plane, lists, size = layout.plane, layout.lists, layout.size
    index_type = type(lists.index)
    # Lanes of one group of transmitters follow each other, so that those of a register walk the same list.
    lane = dr.arange(index_type, layout.batch // size * plane.lanes)
    inner, group = lane % plane.lanes, lane // plane.lanes

    def spread(array: Any) -> Any:
        return dr.gather(type(array), array, inner)

    tile = spread(plane.tile) if layout.shared else group * plane.tiles + spread(plane.tile)
    return Lanes(
        azimuth=[spread(a) for a in plane.azimuth],
        elevation=[[spread(c) for c in e] for e in plane.elevation],
        pixel=[[(group * size + k) * plane.pixels + spread(p) for k in range(size)] for p in plane.pixel],
        active=[spread(a) for a in plane.active],
        start=lists.begin(tile, layout.n),
        end=dr.gather(index_type, lists.length, tile),
        group=group,
    )


def _blend_one(
    record: list[Any], fields: int, signals: list[Complex], lanes: Lanes, state: ForwardState
) -> ForwardState:
    """State behind one more Gaussian, of ``fields`` numbers without its signal."""
    along = along_azimuth(record, lanes.azimuth)
    result = ForwardState([], [])
    for elevation, total, t in zip(lanes.elevation, state.total, state.t, strict=True):
        weight, after = forward_step(record[9:fields], footprint_at(along, elevation)[0], t)
        result.total.append([accumulate(r, weight, s) for r, s in zip(total, signals, strict=True)])
        result.t.append(after)
    return result


def _read_both(table: Any, signals: Any, layout: BlendLayout, i: Any, slot: Any) -> tuple[list[Any], list[Complex]]:
    """Record of Gaussian i and its signals, from their ``slot`` if the geometry is shared, else those of the record."""
    if layout.shared:
        return read(table, i, layout.fields), _read_signals(signals, slot, layout.size)
    record = read(table, i, layout.fields + 2)
    return record, [tuple(record[layout.fields :])]


@dr.syntax
def _forward(table: Any, signals: Any, layout: BlendLayout) -> tuple[Any, Any]:
    """Real and imaginary part of all images. Each record holds its signal where ``signals`` is None."""
    lists, n, fields, size = layout.lists, layout.n, layout.fields, layout.size
    float_type, index_type = type(table), type(lists.index)
    lanes = lanes_of(layout)
    state = ForwardState.start(float_type, LANE_ROWS, size)
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        record, sent = _read_both(table, signals, layout, i, lanes.group * n + i)
        state = _blend_one(record, fields, sent, lanes, state)
        j += 1
    # Each scatter below is a kernel that would run the loop again.
    dr.eval(state.total)
    out_re, out_im = (dr.zeros(float_type, layout.batch * layout.plane.pixels) for _ in range(2))
    for row in range(LANE_ROWS):
        for k in range(size):
            dr.scatter(out_re, state.total[row][k][0], lanes.pixel[row][k], lanes.active[row])
            dr.scatter(out_im, state.total[row][k][1], lanes.pixel[row][k], lanes.active[row])
    return out_re, out_im


def _derivatives(
    record: list[Any],
    fields: int,
    signals: list[Complex],
    lanes: Lanes,
    state: ReverseState,
    slopes: list[list[Complex]],
) -> tuple[list[Any], list[Any], Any, ReverseState]:
    """Derivatives by one Gaussian's record and signals, summed over a lane's pixels; whether any sees it; the state."""
    along = along_azimuth(record, lanes.azimuth)
    sums: list[list[Any]] = [[0, 0] for _ in range(3)]
    by_blending: list[Any] = [0] * (fields - 9)
    by_signal: list[Complex] = [(0, 0) for _ in signals]
    after, is_seen = ReverseState([], []), False
    for k, elevation in enumerate(lanes.elevation):
        g, x, y, inverse = footprint_at(along, elevation)
        by_g, d_blending, d_signal, t, q = reverse_step(record[9:fields], g, state.t[k], state.q[k], signals, slopes[k])
        after.t.append(t)
        after.q.append(q)
        # With p = (a . u) / (n . u) and q likewise, dG'/da = -G' p u / (n . u), dG'/dn = G' (p^2 + q^2) u / (n . u):
        # all are multiples of u, whose elevation is summed here and whose azimuth, common to the lane, below.
        f = dr.select(g > 0, -by_g * g * inverse, 0)
        d_x, d_y = f * x, f * y
        for pair, d in zip(sums, (-(d_x * x + d_y * y), d_x, d_y), strict=True):
            pair[0], pair[1] = dr.fma(d, elevation[0], pair[0]), dr.fma(d, elevation[1], pair[1])
        by_blending = [a + b for a, b in zip(by_blending, d_blending, strict=True)]
        by_signal = [(a + c, b + d) for (a, b), (c, d) in zip(by_signal, d_signal, strict=True)]
        is_seen |= g > 0
    cosine, sine = lanes.azimuth
    vectors = [c for level, up in sums for c in (level * cosine, level * sine, up)]
    return [*vectors, *by_blending], list(chain.from_iterable(by_signal)), is_seen, after


@dr.syntax
def _backward(
    table: Any,  # [batch * n * RECORD], or [n * RECORD] of a shared geometry
    signals: Any,  # [2 * batch * n] of a shared geometry, else None
    layout: BlendLayout,
    total: tuple[Any, Any],  # re, im, [batch * pixels] each
    gradient: tuple[Any, Any],  # re, im, [batch * pixels] each
) -> tuple[Any, Any]:
    """Gradients of both tables, in their layouts."""
    lists, n, shared, fields, size = layout.lists, layout.n, layout.shared, layout.fields, layout.size
    float_type, index_type = type(table), type(lists.index)
    lanes = lanes_of(layout)
    slopes, state = reverse_start(lanes.pixel, lanes.active, total, gradient)
    # The targets of the loop's scatters exist before it: inside of a recorded loop nothing can be evaluated.
    out = dr.zeros(float_type, dr.width(table))
    out_signals = dr.zeros(float_type, dr.width(signals)) if shared else None
    dr.eval(out, out_signals, (slopes, state) if shared else None)
    copied = dr.width(table) + (dr.width(signals) if shared else 0) <= MOST_COPIED
    # `Auto` sums into private copies of each thread, `Local` adds up within a register first and then in place.
    mode = dr.ReduceMode.Auto if copied else dr.ReduceMode.Local
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        slot = lanes.group * n + i
        record, sent = _read_both(table, signals, layout, i, slot)
        values, by_signal, is_seen, state = _derivatives(record, fields, sent, lanes, state, slopes)
        # Without a shared geometry a record ends with its signal, and one table takes all gradients.
        values, by_signal = (values, by_signal) if shared else (values + by_signal, [])
        for k in range(len(values)):
            dr.scatter_reduce(dr.ReduceOp.Add, out, values[k], i * RECORD + k, is_seen, mode=mode)
        for k in range(len(by_signal)):
            dr.scatter_reduce(dr.ReduceOp.Add, out_signals, by_signal[k], slot * (2 * size) + k, is_seen, mode=mode)
        j += 1
    return out, out_signals


class _Blend(dr.CustomOp):
    def eval(self, layout: BlendLayout, columns: list[Any], signal: list[Any]) -> Any:
        self.layout = layout
        self.table = pack([*columns, *([] if layout.shared else signal)])
        self.signals = None
        if layout.shared:  # a table that gives the signals of a group with one lookup
            slots = _signal_slots(layout.n, layout.batch, dr.uint32_array_t(type(signal[0])))
            self.signals = dr.zeros(type(signal[0]), 2 * layout.batch * layout.n)
            for part in (0, 1):
                dr.scatter(self.signals, signal[part], slots + part)
        dr.eval(self.table, self.signals)
        self.total = _forward(self.table, self.signals, layout)
        dr.eval(self.total)
        return self.total

    def backward(self) -> None:
        gradient: Any = self.grad_out()
        dr.eval(gradient)
        out, out_signals = _backward(self.table, self.signals, self.layout, self.total, gradient)
        dr.eval(out, out_signals)
        count = self.layout.fields
        columns = unpack(out, count + 2)
        if out_signals is None:
            by_signal = columns[count:]
        else:
            slots = _signal_slots(self.layout.n, self.layout.batch, dr.uint32_array_t(type(out)))
            by_signal = [dr.gather(type(out), out_signals, slots + part) for part in (0, 1)]
        self.set_grad_in("columns", columns[:count])
        self.set_grad_in("signal", by_signal)

    def name(self) -> str:
        return "wrf_mi blending"


def blend(
    footprints: Footprints, signal: list[Any], lists: TileLists, plane: TiledPlane, batch: int, blending: list[Any]
) -> tuple[Any, Any]:
    """Received complex signal of each pixel: real and imaginary part, [batch * height * width], row-major.

    Differentiable in footprints of ``batch * n`` Gaussians, or of n that all transmitters share, in the signal (re,
    im), two arrays [batch * n], batch-major, and in ``blending``: an array of opacities in [0, 1) (alpha blending), or
    real and imaginary part of delta, |delta| < 1 (product blending), as many numbers as footprints. ``lists`` are the
    Gaussians of each tile, near to far, of one transmitter where footprints are shared.
    """
    n = dr.width(signal[0]) // batch
    columns = columns_of(footprints, blending)
    shared = batch > 1 and dr.width(footprints.radius) == n
    layout = BlendLayout(lists, plane, n, batch, shared, len(columns), group_size(batch) if shared else 1)
    result: tuple[Any, Any] = dr.custom(_Blend, layout, columns, signal)
    return result


def splat(gaussians: Gaussians, pose: Pose, plane: TiledPlane) -> tuple[Any, Any]:
    """Complex signal (re, im) that a receiver gets from each pixel of a plane, [batch * height * width], row-major."""
    batch, signal = gaussians.batch, gaussians.signal
    if not gaussians.count:
        dark = type(gaussians.position[0])
        return dr.zeros(dark, batch * plane.pixels), dr.zeros(dark, batch * plane.pixels)
    # One geometry for all transmitters is projected once.
    gaussians = replace(gaussians, batch=1) if gaussians.shared else gaussians.spread()
    footprints = project(gaussians, pose)
    order = depth_order(footprints.depth, gaussians.position)
    lists = build_lists(footprints, order, plane, gaussians.batch)
    return blend(footprints, signal, lists, plane, batch, gaussians.blending)
