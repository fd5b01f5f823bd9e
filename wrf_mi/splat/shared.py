"""Blending for transmitters that share one geometry: footprints and weights once, signals for each.

Under either blending a weight w_i T_i depends on geometry alone. Where that stands still, a lane keeps the sums of up
to `GROUP` transmitters beside one transmittance, and the reverse pass one rest Q, that of the sum over them:

    dL/dw_i = sum_k Re(conj(g_k) S_ik) T_i,   dL/db_i = sum_k Re(conj(g_k) Q_ik) / b_i.

What a further transmitter costs is two products a pixel instead of a footprint's exponential.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.device import quads
from ..project.footprint import Footprints
from .blend import (
    MOST_COPIED,
    RECORD,
    SMALLEST_FACTOR,
    _along_azimuth,
    _footprint,
    _Lanes,
    _lanes,
    pack,
    read,
)
from .tiles import LANE_ROWS, Plane, TileLists

GROUP = 4
"""Transmitters whose sums a lane keeps: more would not fit into its registers."""


def group_of(batch: int) -> int:
    """The largest divisor of a batch that is no larger than `GROUP`."""
    return next(k for k in range(min(GROUP, batch), 0, -1) if batch % k == 0)


def _pack_signals(signal: list[Any], n: int, batch: int) -> Any:
    """Signals (re, im) [batch * n] as [groups, n, 2 * group]: one lookup reads those of a whole group."""
    group, kind = group_of(batch), type(signal[0])
    index = dr.arange(dr.uint32_array_t(kind), batch * n)
    b, i = index // n, index % n
    place = ((b // group) * n + i) * (2 * group) + (b % group) * 2
    table = dr.zeros(kind, 2 * batch * n)
    for part in (0, 1):
        dr.scatter(table, signal[part], place + part)
    return table


def _unpack_signals(table: Any, n: int, batch: int) -> list[Any]:
    group, kind = group_of(batch), type(table)
    index = dr.arange(dr.uint32_array_t(kind), batch * n)
    b, i = index // n, index % n
    place = ((b // group) * n + i) * (2 * group) + (b % group) * 2
    return [dr.gather(kind, table, place + part) for part in (0, 1)]


def _read_signals(table: Any, place: Any, group: int) -> list[tuple[Any, Any]]:
    """Signals of a group for one Gaussian."""
    if group % 2:
        values = [dr.gather(type(table), table, place * (2 * group) + k) for k in range(2 * group)]
    else:
        packets = [dr.gather(quads(type(table)), table, place * (group // 2) + k) for k in range(group // 2)]
        values = [v for packet in packets for v in packet]
    return list(zip(values[::2], values[1::2], strict=True))


def _group_lanes(plane: Plane, lists: TileLists, n: int, groups: int) -> tuple[_Lanes, Any]:
    """Lanes of all groups, which walk the same lists, and the group of each."""
    index_type = type(lists.index)
    lanes = _lanes(plane, lists, n, groups)
    group = dr.arange(index_type, groups * plane.lanes) // plane.lanes
    tile = dr.gather(index_type, plane.tile, dr.arange(index_type, groups * plane.lanes) % plane.lanes)
    lanes.start, lanes.end = lists.begin(tile, n), dr.gather(index_type, lists.length, tile)
    return lanes, group


def _pixels(lanes: _Lanes, group: Any, plane: Plane, size: int) -> list[list[Any]]:
    """For each of a lane's pixels its number in the images of the group's transmitters."""
    first = group * ((size - 1) * plane.pixels)  # what `_lanes` counted is one image a group
    return [[pixel + first + k * plane.pixels for k in range(size)] for pixel in lanes.pixel]


def _factor(record: list[Any], g: Any, product: bool) -> tuple[Any, Any, Any]:
    """Weight w and factor b (re, im) of a footprint."""
    if product:
        d_re, d_im = record[9:]
        return g, 1 - g * (1 - d_re), g * d_im
    alpha = record[9] * g
    return alpha, 1 - alpha, 0


def _through(t: tuple[Any, Any], b: tuple[Any, Any], product: bool) -> tuple[Any, Any]:
    if product:
        return t[0] * b[0] - t[1] * b[1], t[0] * b[1] + t[1] * b[0]
    return t[0] * b[0], t[1]


@dr.syntax
def _forward(table: Any, signals: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int) -> Any:
    float_type, index_type = type(table), type(lists.index)
    size = group_of(batch)
    lanes, group = _group_lanes(plane, lists, n, batch // size)
    fields = 11 if product else 10
    t = [(float_type(1), float_type(0)) for _ in range(LANE_ROWS)]
    total = [[(float_type(0), float_type(0)) for _ in range(size)] for _ in range(LANE_ROWS)]
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        t, total = _add(read(table, i, fields), _read_signals(signals, group * n + i, size), lanes, t, total, product)
        j += 1
    # Each scatter below is a kernel of its own, which would run the loop again.
    dr.eval(total)
    out_re, out_im = dr.zeros(float_type, batch * plane.pixels), dr.zeros(float_type, batch * plane.pixels)
    pixels = _pixels(lanes, group, plane, size)
    for row in range(LANE_ROWS):
        for k in range(size):
            dr.scatter(out_re, total[row][k][0], pixels[row][k], lanes.active[row])
            dr.scatter(out_im, total[row][k][1], pixels[row][k], lanes.active[row])
    return out_re, out_im


def _add(
    record: list[Any], signal: list[tuple[Any, Any]], lanes: _Lanes, t: list[Any], total: list[Any], product: bool
) -> tuple[list[Any], list[Any]]:
    """One more Gaussian, behind all before it."""
    along = _along_azimuth(record, lanes.azimuth)
    after, sums = [], []
    for row, elevation in enumerate(lanes.elevation):
        weight, *factor = _factor(record, _footprint(along, elevation)[0], product)
        w_re, w_im = weight * t[row][0], weight * t[row][1]
        own = []
        for (re, im), (s_re, s_im) in zip(total[row], signal, strict=True):
            re, im = dr.fma(w_re, s_re, re), dr.fma(w_re, s_im, im)
            own.append((dr.fma(-w_im, s_im, re), dr.fma(w_im, s_re, im)) if product else (re, im))
        sums.append(own)
        after.append(_through(t[row], (factor[0], factor[1]), product))
    return after, sums


def _start(
    lanes: _Lanes, pixels: list[list[Any]], total: tuple[Any, Any], gradient: tuple[Any, Any]
) -> tuple[list[Any], list[Any], list[Any]]:
    """Gradients of each of a lane's pixels; T and Q before the first Gaussian."""
    float_type: Any = type(total[0])
    slope, t, q = [], [], []
    for own, active in zip(pixels, lanes.active, strict=True):
        # Pixels that pad the plane have no gradient and so add nothing.
        g = [tuple(dr.gather(float_type, part, pixel, active) for part in gradient) for pixel in own]
        r = [tuple(dr.gather(float_type, part, pixel, active) for part in total) for pixel in own]
        slope.append(g)
        q.append(
            (
                sum(a * c + b * d for (a, b), (c, d) in zip(g, r, strict=True)),
                sum(a * d - b * c for (a, b), (c, d) in zip(g, r, strict=True)),
            )
        )
        t.append((float_type(1), float_type(0)))
    return slope, t, q


@dr.syntax
def _backward(
    table: Any,
    signals: Any,
    lists: TileLists,
    plane: Plane,
    n: int,
    product: bool,
    batch: int,
    total: tuple[Any, Any],
    gradient: tuple[Any, Any],
) -> Any:
    """Gradients of both tables, in their layouts."""
    float_type, index_type = type(table), type(lists.index)
    size = group_of(batch)
    lanes, group = _group_lanes(plane, lists, n, batch // size)
    pixels = _pixels(lanes, group, plane, size)
    slope, t, q = _start(lanes, pixels, total, gradient)
    fields = 11 if product else 10
    out, out_signals = dr.zeros(float_type, dr.width(table)), dr.zeros(float_type, dr.width(signals))
    dr.eval(out, out_signals, slope, t, q)
    copied = dr.width(table) + dr.width(signals) <= MOST_COPIED
    mode = dr.ReduceMode.Auto if copied else dr.ReduceMode.Local
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        place = group * n + i
        values, by_signal, seen, t, q = _take_away(
            read(table, i, fields), _read_signals(signals, place, size), lanes, slope, t, q, product
        )
        for k in range(fields):
            dr.scatter_reduce(dr.ReduceOp.Add, out, values[k], i * RECORD + k, seen, mode=mode)
        for k in range(2 * size):
            dr.scatter_reduce(dr.ReduceOp.Add, out_signals, by_signal[k], place * (2 * size) + k, seen, mode=mode)
        j += 1
    return out, out_signals


def _take_away(
    record: list[Any],
    signal: list[tuple[Any, Any]],
    lanes: _Lanes,
    slope: list[list[tuple[Any, Any]]],
    t: list[Any],
    q: list[Any],
    product: bool,
) -> tuple[list[Any], list[Any], Any, list[Any], list[Any]]:
    """One Gaussian's derivatives by its record and its signals, summed over the lane's pixels; who sees it; the rest.

    All with the conjugate of the gradient multiplied in, so that real parts are derivatives by real weights.
    """
    along = _along_azimuth(record, lanes.azimuth)
    sums: list[list[Any]] = [[0, 0] for _ in range(3)]
    by_own: list[Any] = [0 for _ in record[9:]]
    by_signal: list[Any] = [0 for _ in range(2 * len(signal))]
    next_t, next_q, seen = [], [], False
    for row, elevation in enumerate(lanes.elevation):
        g, x, y, inverse = _footprint(along, elevation)
        (t_re, t_im), (q_re, q_im) = t[row], q[row]
        weight, b_re, b_im = _factor(record, g, product)
        w_re, w_im = weight * t_re, weight * t_im
        h_re: Any = 0
        h_im: Any = 0
        for k, ((s_re, s_im), (g_re, g_im)) in enumerate(zip(signal, slope[row], strict=True)):
            # conj(gradient) S, summed over the group
            h_re = h_re + g_re * s_re + g_im * s_im
            by_signal[2 * k] += w_re * g_re + w_im * g_im if product else w_re * g_re
            by_signal[2 * k + 1] += w_re * g_im - w_im * g_re if product else w_re * g_im
            if product:
                h_im = h_im + g_re * s_im - g_im * s_re
        if product:
            d_re, d_im = record[9:]
            c_re, c_im = h_re * t_re - h_im * t_im, h_re * t_im + h_im * t_re
            q_re, q_im = q_re - g * c_re, q_im - g * c_im
            scale = dr.rcp(dr.maximum(b_re * b_re + b_im * b_im, SMALLEST_FACTOR**2))
            f_re, f_im = (q_re * b_re + q_im * b_im) * scale, (q_im * b_re - q_re * b_im) * scale
            d_g = c_re - f_re * (1 - d_re) - f_im * d_im
            own = [g * f_re, -g * f_im]
        else:
            c = h_re * t_re
            q_re = q_re - weight * c
            d_alpha = c - q_re * dr.rcp(dr.maximum(b_re, SMALLEST_FACTOR))
            d_g, own = d_alpha * record[9], [d_alpha * g]
        next_t.append(_through((t_re, t_im), (b_re, b_im), product))
        next_q.append((q_re, q_im))
        f = dr.select(g > 0, -d_g * g * inverse, 0)
        d_x, d_y = f * x, f * y
        for pair, d in zip(sums, (-(d_x * x + d_y * y), d_x, d_y), strict=True):
            pair[0], pair[1] = dr.fma(d, elevation[0], pair[0]), dr.fma(d, elevation[1], pair[1])
        by_own = [e + o for e, o in zip(by_own, own, strict=True)]
        seen |= g > 0
    cosine, sine = lanes.azimuth
    vectors = [c for level, up in sums for c in (level * cosine, level * sine, up)]
    return [*vectors, *by_own], by_signal, seen, next_t, next_q


class _SharedBlend(dr.CustomOp):
    """Blending as one differentiable operation over the columns of n Gaussians and batch * n signals."""

    def eval(
        self, lists: TileLists, plane: Plane, n: int, product: bool, batch: int, columns: list[Any], signal: list[Any]
    ) -> Any:
        self.parts = (lists, plane, n, product, batch)
        self.count = len(columns)
        self.table, self.signals = pack(columns), _pack_signals(signal, n, batch)
        dr.eval(self.table, self.signals)
        self.total = _forward(self.table, self.signals, *self.parts)
        dr.eval(self.total)
        return self.total

    def backward(self) -> None:
        gradient: Any = self.grad_out()
        dr.eval(gradient)
        out, out_signals = _backward(self.table, self.signals, *self.parts, self.total, gradient)
        dr.eval(out, out_signals)
        _, _, n, _, batch = self.parts
        index = dr.arange(dr.uint32_array_t(type(out)), n) * RECORD
        self.set_grad_in("columns", [dr.gather(type(out), out, index + k) for k in range(self.count)])
        self.set_grad_in("signal", _unpack_signals(out_signals, n, batch))

    def name(self) -> str:
        return "wrf_mi shared blending"


def blend_shared(
    footprints: Footprints,
    signal: list[Any],
    lists: TileLists,
    plane: Plane,
    batch: int,
    opacity: Any | None = None,
    attenuation: list[Any] | None = None,
) -> tuple[Any, Any]:
    """Received complex signal of each pixel for transmitters that share one geometry.

    Args:
        footprints: of n Gaussians.
        signal: complex signal (re, im), two arrays [batch * n], batch-major.
        lists: Gaussians of each tile, near to far, of one transmitter.
        plane: the perception plane.
        batch: number of transmitters.
        opacity: array [n] in [0, 1); alpha blending.
        attenuation: complex factor delta (re, im) [n], |delta| < 1; product blending.

    Returns:
        Real and imaginary part of R, arrays [batch * height * width], row-major; what `blend` gives for the same
        Gaussians repeated for each transmitter. Differentiable in footprints, signal, and opacity or attenuation.
    """
    product = attenuation is not None
    own = attenuation if attenuation is not None else [opacity]
    columns = [*footprints.direction, *footprints.whitened[0], *footprints.whitened[1], *own]
    n = dr.width(signal[0]) // batch
    result: tuple[Any, Any] = dr.custom(_SharedBlend, lists, plane, n, product, batch, columns, signal)
    return result
