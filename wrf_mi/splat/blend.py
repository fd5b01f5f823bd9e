"""Complex blending of footprints, front to back, and its hand-written derivative.

Alpha blending (WRF-GS+, paper eq. 14) and product blending (WRF-GS, eq. 12 and 13 with footprints) are one sum

    R = sum_i w_i S_i T_i,   T_{i+1} = T_i b_i

with weight w = o G', factor b = 1 - o G' (real) for the first and w = G', b = 1 - G' (1 - delta)
(complex) for the second. With Q_i = sum_{k > i} w_k S_k T_k, what lies behind i, the derivatives are

    dR/dw_i = S_i T_i,   dR/db_i = Q_i / b_i,   dR/dS_i = w_i T_i.

The reverse pass walks front to back again and keeps Q as the rest of the stored sum, so that its memory
does not grow with the number of layers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr

from ..backend.device import quads
from ..project.footprint import Footprints
from ..project.footprint_constants import CUTOFF, MIN_COSINE
from .tiles import LANE_ROWS, Plane, TileLists

RECORD = 16
"""Floats per Gaussian in the packed table: n, a, b (3 each), then blending attributes; one cache line."""

SMALLEST_FACTOR = 1e-4
"""|b| below this is replaced in the derivative's quotient Q / b, of which both then vanish.

In float32, Q carries an error of 1e-7 of the pixel's sum, so the quotient is good to 1e-3 at this bound.
"""

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
class _Lanes:
    """The pixels of all transmitters, in lanes."""

    azimuth: list[Any]
    elevation: list[list[Any]]
    pixel: list[Any]
    active: list[Any]
    start: Any
    end: Any


def _lanes(plane: Plane, lists: TileLists, n: int, batch: int) -> _Lanes:
    index_type = type(lists.index)
    lane = dr.arange(index_type, batch * plane.lanes)
    inner, b = lane % plane.lanes, lane // plane.lanes

    def of(array: Any) -> Any:
        return dr.gather(type(array), array, inner)

    tile = b * plane.tiles + of(plane.tile)
    return _Lanes(
        azimuth=[of(a) for a in plane.azimuth],
        elevation=[[of(c) for c in e] for e in plane.elevation],
        pixel=[b * plane.pixels + of(p) for p in plane.pixel],
        active=[of(a) for a in plane.active],
        start=lists.begin(tile, n),
        end=dr.gather(index_type, lists.length, tile),
    )


@dataclass
class _Sum:
    """Blending so far, for each pixel of a lane: sum (re, im) and transmittance (t_re, t_im)."""

    re: list[Any]
    im: list[Any]
    t_re: list[Any]
    t_im: list[Any]


def _add(record: list[Any], weights: list[Any], so_far: _Sum, product: bool) -> _Sum:
    """One more Gaussian, behind all before it."""
    pixels = list(zip(weights, so_far.re, so_far.im, so_far.t_re, so_far.t_im, strict=True))
    if product:
        s_re, s_im, d_re, d_im = record[9:]
        factors = [(1 - g * (1 - d_re), g * d_im) for g in weights]
        return _Sum(
            re=[re + g * (s_re * x - s_im * y) for g, re, _, x, y in pixels],
            im=[im + g * (s_re * y + s_im * x) for g, _, im, x, y in pixels],
            t_re=[x * u - y * v for (u, v), (_, _, _, x, y) in zip(factors, pixels, strict=True)],
            t_im=[x * v + y * u for (u, v), (_, _, _, x, y) in zip(factors, pixels, strict=True)],
        )
    s_re, s_im, opacity = record[9:]
    return _Sum(
        re=[dr.fma(t * opacity * g, s_re, re) for g, re, _, t, _ in pixels],
        im=[dr.fma(t * opacity * g, s_im, im) for g, _, im, t, _ in pixels],
        t_re=[dr.fma(-t, opacity * g, t) for g, _, _, t, _ in pixels],
        t_im=so_far.t_im,
    )


def _brightest(so_far: _Sum, product: bool) -> Any:
    """Largest |T|^2 of a lane's pixels."""
    squares = [x * x + y * y if product else x * x for x, y in zip(so_far.t_re, so_far.t_im, strict=True)]
    return reduce(dr.maximum, squares)


@dr.syntax
def _forward(
    table: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int, early: bool = False
) -> tuple[Any, Any]:
    float_type, index_type = type(table), type(lists.index)
    lanes = _lanes(plane, lists, n, batch)
    fields = 13 if product else 12
    state = _start(float_type)
    j, end = index_type(0), index_type(lanes.end)
    while j < end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        if dr.hint(early, mode="scalar"):
            # This Gaussian is the lane's last once it and all behind it can send no more than what is allowed.
            reach = dr.gather(float_type, table, i * RECORD + fields)
            end = dr.select(_brightest(state, product) * reach * reach <= 1, j, end)
        record = read(table, i, fields)
        along = _along_azimuth(record, lanes.azimuth)
        state = _add(record, [_footprint(along, e)[0] for e in lanes.elevation], state, product)
        j += 1
    # Each scatter below is a kernel of its own, which would run the loop again.
    dr.eval(state.re, state.im)
    out_re, out_im = dr.zeros(float_type, batch * plane.pixels), dr.zeros(float_type, batch * plane.pixels)
    for k in range(LANE_ROWS):
        dr.scatter(out_re, state.re[k], lanes.pixel[k], lanes.active[k])
        dr.scatter(out_im, state.im[k], lanes.pixel[k], lanes.active[k])
    return out_re, out_im


def _start(float_type: Any) -> _Sum:
    def each(value: float) -> list[Any]:
        return [float_type(value) for _ in range(LANE_ROWS)]

    return _Sum(each(0), each(0), each(1), each(0))


def behind_product(
    record: list[Any], g: Any, t: tuple[Any, Any], q: tuple[Any, Any], gradient: tuple[Any, Any]
) -> tuple[Any, list[Any], tuple[Any, Any], tuple[Any, Any]]:
    """One pixel's derivatives under product blending: by G', by (S, delta), and the next T and Q."""
    (t_re, t_im), (q_re, q_im), (g_re, g_im) = t, q, gradient
    s_re, s_im, d_re, d_im = record[9:]
    # c = conj(gradient) S T, so that Re(c) is the derivative by a real weight.
    a_re, a_im = g_re * t_re + g_im * t_im, g_re * t_im - g_im * t_re
    c_re, c_im = s_re * a_re - s_im * a_im, s_re * a_im + s_im * a_re
    q_re, q_im = q_re - g * c_re, q_im - g * c_im
    b_re, b_im = 1 - g * (1 - d_re), g * d_im
    scale = dr.rcp(dr.maximum(b_re * b_re + b_im * b_im, SMALLEST_FACTOR**2))
    # conj(gradient) Q / b
    f_re, f_im = (q_re * b_re + q_im * b_im) * scale, (q_im * b_re - q_re * b_im) * scale
    d_g = c_re - f_re * (1 - d_re) - f_im * d_im
    following = (t_re * b_re - t_im * b_im, t_re * b_im + t_im * b_re)
    return d_g, [g * a_re, -g * a_im, g * f_re, -g * f_im], following, (q_re, q_im)


def behind_alpha(
    record: list[Any], g: Any, t: tuple[Any, Any], q: tuple[Any, Any], gradient: tuple[Any, Any]
) -> tuple[Any, list[Any], tuple[Any, Any], tuple[Any, Any]]:
    """One pixel's derivatives under alpha blending: by G', by (S, o), and the next T and Q (real parts)."""
    t_re, q_re = t[0], q[0]
    s_re, s_im, opacity = record[9:]
    alpha = opacity * g
    weight = t_re * alpha
    c = gradient[0] * s_re + gradient[1] * s_im
    q_re = q_re - weight * c
    d_alpha = t_re * c - q_re * dr.rcp(dr.maximum(1 - alpha, SMALLEST_FACTOR))
    extra = [weight * gradient[0], weight * gradient[1], d_alpha * g]
    return d_alpha * opacity, extra, (dr.fma(-t_re, alpha, t_re), t[1]), (q_re, q[1])


@dataclass
class _Rest:
    """The reverse pass so far, for each pixel of a lane: transmittance and what lies behind, as pairs (re, im)."""

    t: list[tuple[Any, Any]]
    q: list[tuple[Any, Any]]


def _before(
    lanes: _Lanes, total: tuple[Any, Any], gradient: tuple[Any, Any], float_type: Any
) -> tuple[list[tuple[Any, Any]], _Rest]:
    """Gradient of each pixel, and the rest before the first Gaussian."""
    slope, t, q = [], [], []
    for pixel, active in zip(lanes.pixel, lanes.active, strict=True):
        # Pixels that pad the plane have no gradient and so add nothing.
        g_re, g_im, r_re, r_im = (dr.gather(float_type, a, pixel, active) for a in (*gradient, *total))
        slope.append((g_re, g_im))
        # What lies behind, times the conjugate of the gradient; alpha blending needs its real part alone.
        q.append((g_re * r_re + g_im * r_im, g_re * r_im - g_im * r_re))
        t.append((float_type(1), float_type(0)))
    return slope, _Rest(t, q)


def _take_away(
    record: list[Any], lanes: _Lanes, rest: _Rest, slope: list[tuple[Any, Any]], product: bool
) -> tuple[list[Any], Any, _Rest]:
    """One Gaussian's derivatives by its record, summed over the lane's pixels; whether any pixel sees it; the rest."""
    behind = behind_product if product else behind_alpha
    along = _along_azimuth(record, lanes.azimuth)
    sums: list[list[Any]] = [[0, 0] for _ in range(3)]
    extra: list[Any] = [0 for _ in record[9:]]
    t, q, seen = [], [], False
    for k, elevation in enumerate(lanes.elevation):
        g, x, y, inverse = _footprint(along, elevation)
        d_g, own, next_t, next_q = behind(record, g, rest.t[k], rest.q[k], slope[k])
        t.append(next_t)
        q.append(next_q)
        f = dr.select(g > 0, -d_g * g * inverse, 0)
        d_x, d_y = f * x, f * y
        for pair, d in zip(sums, (-(d_x * x + d_y * y), d_x, d_y), strict=True):
            pair[0], pair[1] = dr.fma(d, elevation[0], pair[0]), dr.fma(d, elevation[1], pair[1])
        extra = [e + o for e, o in zip(extra, own, strict=True)]
        seen |= g > 0
    cosine, sine = lanes.azimuth
    vectors = [c for level, up in sums for c in (level * cosine, level * sine, up)]
    return [*vectors, *extra], seen, _Rest(t, q)


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
    lanes = _lanes(plane, lists, n, batch)
    slope, rest = _before(lanes, total, gradient, float_type)
    fields = 13 if product else 12
    out = dr.zeros(float_type, dr.width(table))
    dr.eval(out)
    mode = dr.ReduceMode.Auto if dr.width(table) <= MOST_COPIED else dr.ReduceMode.Local
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        values, seen, rest = _take_away(read(table, i, fields), lanes, rest, slope, product)
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
        reach: bound of what a Gaussian and all behind it send (`wrf_mi.splat.skip.behind`) in units of the error
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
        raise ValueError("blend: walks that end early give no gradients; leave skip.rest at 0 in training")
    return dr.custom(_Blend, lists, plane, n, product, batch, columns, reach)
