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

from typing import Any

import drjit as dr

from ..project.footprint import Footprints
from ..project.footprint_constants import CUTOFF, MIN_COSINE
from .tiles import Plane, TileLists

RECORD = 16
"""Floats per Gaussian in the packed table: n, a, b (3 each), then blending attributes; one cache line."""

SMALLEST_FACTOR = 1e-4
"""|b| below this is replaced in the derivative's quotient Q / b, of which both then vanish.

In float32, Q carries an error of 1e-7 of the pixel's sum, so the quotient is good to 1e-3 at this bound.
"""

LOG2_E = 1.4426950408889634


def _pack(columns: list[Any]) -> Any:
    """Interleave per-Gaussian arrays into one table [n * RECORD]: one lookup then reads one cache line."""
    n = dr.width(columns[0])
    index = dr.arange(dr.uint32_array_t(type(columns[0])), n) * RECORD
    table = dr.zeros(type(columns[0]), n * RECORD)
    for k, column in enumerate(columns):
        dr.scatter(table, column, index + k)
    return table


def _footprint(record: list[Any], u: list[Any]) -> tuple[Any, Any, Any, Any]:
    """Footprint G' at unit vectors ``u``, the whitened coordinates p, q and 1 / (n . u)."""
    nx, ny, nz, ax, ay, az, bx, by, bz = record[:9]
    cosine = dr.fma(nx, u[0], dr.fma(ny, u[1], nz * u[2]))
    inverse = dr.rcp(cosine)
    p = dr.fma(ax, u[0], dr.fma(ay, u[1], az * u[2])) * inverse
    q = dr.fma(bx, u[0], dr.fma(by, u[1], bz * u[2])) * inverse
    square = dr.fma(p, p, q * q)
    inside = (cosine > MIN_COSINE) & (square < CUTOFF * CUTOFF)
    return dr.select(inside, dr.exp2(-0.5 * LOG2_E * square), 0), p, q, inverse


def _read(table: Any, i: Any, count: int) -> list[Any]:
    return [dr.gather(type(table), table, i * RECORD + k) for k in range(count)]


@dr.syntax
def _forward(table: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int) -> tuple[Any, Any]:
    float_type, index_type = type(table), type(lists.index)
    slots = dr.width(plane.tile)
    slot = dr.arange(index_type, batch * slots)
    inner, b = slot % slots, slot // slots
    u = [dr.gather(float_type, d, inner) for d in plane.direction]
    tile = b * plane.tiles + dr.gather(index_type, plane.tile, inner)
    end, start, j = dr.gather(index_type, lists.length, tile), tile * n, index_type(0)
    re, im = float_type(0), float_type(0)
    t_re, t_im = float_type(1), float_type(0)
    while j < end:
        i = dr.gather(index_type, lists.index, start + j)
        record = _read(table, i, 13 if product else 12)
        g, _, _, _ = _footprint(record, u)
        if dr.hint(product, mode="scalar"):
            s_re, s_im, d_re, d_im = record[9:]
            re += g * (s_re * t_re - s_im * t_im)
            im += g * (s_re * t_im + s_im * t_re)
            b_re, b_im = 1 - g * (1 - d_re), g * d_im
            next_re = t_re * b_re - t_im * b_im
            t_im = t_re * b_im + t_im * b_re
            t_re = next_re
        else:
            s_re, s_im, opacity = record[9:]
            alpha = opacity * g
            weight = t_re * alpha
            re += weight * s_re
            im += weight * s_im
            t_re *= 1 - alpha
        j += 1
    target = b * plane.pixels + dr.gather(index_type, plane.pixel, inner)
    active = dr.gather(dr.mask_t(float_type), plane.active, inner)
    out_re, out_im = (dr.zeros(float_type, batch * plane.pixels) for _ in range(2))
    dr.scatter(out_re, re, target, active)
    dr.scatter(out_im, im, target, active)
    return out_re, out_im


@dr.syntax
def _backward(
    table: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int,
    total: tuple[Any, Any], gradient: tuple[Any, Any],
) -> Any:
    """Gradient table [batch * n * RECORD] in the layout of ``table``."""
    float_type, index_type = type(table), type(lists.index)
    slots = dr.width(plane.tile)
    slot = dr.arange(index_type, batch * slots)
    inner, b = slot % slots, slot // slots
    u = [dr.gather(float_type, d, inner) for d in plane.direction]
    tile = b * plane.tiles + dr.gather(index_type, plane.tile, inner)
    end, start, j = dr.gather(index_type, lists.length, tile), tile * n, index_type(0)
    pixel = b * plane.pixels + dr.gather(index_type, plane.pixel, inner)
    active = dr.gather(dr.mask_t(float_type), plane.active, inner)
    # Slots that pad the plane have no gradient and so add nothing.
    g_re = dr.gather(float_type, gradient[0], pixel, active)
    g_im = dr.gather(float_type, gradient[1], pixel, active)
    # What lies behind, times the conjugate of the gradient: real for alpha blending, complex for product.
    r_re, r_im = dr.gather(float_type, total[0], pixel, active), dr.gather(float_type, total[1], pixel, active)
    q_re, q_im = g_re * r_re + g_im * r_im, g_re * r_im - g_im * r_re
    t_re, t_im = float_type(1), float_type(0)
    out = dr.zeros(float_type, dr.width(table))
    dr.eval(out)
    while j < end:
        i = dr.gather(index_type, lists.index, start + j)
        record = _read(table, i, 13 if product else 12)
        g, p, q, inverse = _footprint(record, u)
        if dr.hint(product, mode="scalar"):
            s_re, s_im, d_re, d_im = record[9:]
            # c = conj(gradient) S T, so that Re(c) is the derivative by a real weight.
            a_re, a_im = g_re * t_re + g_im * t_im, g_re * t_im - g_im * t_re
            c_re, c_im = s_re * a_re - s_im * a_im, s_re * a_im + s_im * a_re
            q_re -= g * c_re
            q_im -= g * c_im
            b_re, b_im = 1 - g * (1 - d_re), g * d_im
            scale = dr.rcp(dr.maximum(b_re * b_re + b_im * b_im, SMALLEST_FACTOR**2))
            # conj(gradient) Q / b
            f_re, f_im = (q_re * b_re + q_im * b_im) * scale, (q_im * b_re - q_re * b_im) * scale
            d_g = c_re - f_re * (1 - d_re) - f_im * d_im
            extra = [g * a_re, -g * a_im, g * f_re, -g * f_im]
            next_re = t_re * b_re - t_im * b_im
            t_im = t_re * b_im + t_im * b_re
            t_re = next_re
        else:
            s_re, s_im, opacity = record[9:]
            alpha = opacity * g
            weight = t_re * alpha
            c_re = g_re * s_re + g_im * s_im
            q_re -= weight * c_re
            d_alpha = t_re * c_re - q_re * dr.rcp(dr.maximum(1 - alpha, SMALLEST_FACTOR))
            d_g = d_alpha * opacity
            extra = [weight * g_re, weight * g_im, d_alpha * g]
            t_re *= 1 - alpha
        f = -d_g * g * inverse
        d_p, d_q = f * p, f * q
        d_n = -(d_p * p + d_q * q)
        hit = active & (g > 0)
        for k, value in enumerate([d * c for d in (d_n, d_p, d_q) for c in u] + extra):
            dr.scatter_reduce(dr.ReduceOp.Add, out, value, i * RECORD + k, hit, mode=dr.ReduceMode.Local)
        j += 1
    return out


class _Blend(dr.CustomOp):
    """Blending as one differentiable operation over per-Gaussian columns."""

    def eval(self, lists: TileLists, plane: Plane, n: int, product: bool, batch: int, columns: list[Any]) -> Any:
        self.parts = (lists, plane, n, product, batch)
        self.count = len(columns)
        self.table = _pack(columns)
        dr.eval(self.table)
        self.total = _forward(self.table, *self.parts)
        dr.eval(self.total)
        return self.total

    def backward(self) -> None:
        gradient = tuple(self.grad_out())
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

    Returns:
        Real and imaginary part of R, arrays [batch * height * width], row-major. Differentiable in
        footprints, signal, and opacity or attenuation.
    """
    product = attenuation is not None
    n = dr.width(signal[0]) // batch
    own = attenuation if attenuation is not None else [opacity]
    columns = [*footprints.direction, *footprints.whitened[0], *footprints.whitened[1], *signal, *own]
    return dr.custom(_Blend, lists, plane, n, product, batch, columns)
