"""Blending for transmitters that share one geometry: footprints and weights once, signals for each.

Under either blending a weight w_i T_i depends on geometry alone. Where that stands still, a lane keeps the sums of up
to `GROUP` transmitters beside one transmittance, and the reverse pass one rest Q, that of the sum over them
(`wrf_mi.gaussians.recurrence`). What a further transmitter costs is two products a pixel instead of a footprint's
exponential.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..backend.device import quads
from .blend import MOST_COPIED, RECORD, Lanes, add, lanes_of, pack, read, take_away
from .footprint import Footprints
from .recurrence import Sum, before
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


def _group_lanes(plane: Plane, lists: TileLists, n: int, groups: int) -> tuple[Lanes, Any]:
    """Lanes of all groups, which walk the same lists, and the group of each."""
    index_type = type(lists.index)
    lanes = lanes_of(plane, lists, n, groups)
    group = dr.arange(index_type, groups * plane.lanes) // plane.lanes
    tile = dr.gather(index_type, plane.tile, dr.arange(index_type, groups * plane.lanes) % plane.lanes)
    lanes.start, lanes.end = lists.begin(tile, n), dr.gather(index_type, lists.length, tile)
    return lanes, group


def _pixels(lanes: Lanes, group: Any, plane: Plane, size: int) -> list[list[Any]]:
    """For each of a lane's pixels its number in the images of the group's transmitters."""
    first = group * ((size - 1) * plane.pixels)  # what `lanes_of` counted is one image a group
    return [[pixel + first + k * plane.pixels for k in range(size)] for pixel in lanes.pixel]


@dr.syntax
def _forward(table: Any, signals: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int) -> Any:
    float_type, index_type = type(table), type(lists.index)
    size = group_of(batch)
    lanes, group = _group_lanes(plane, lists, n, batch // size)
    fields = 11 if product else 10
    state = Sum.start(float_type, LANE_ROWS, size)
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        record = read(table, i, fields)
        state = add(record, record[9:], _read_signals(signals, group * n + i, size), lanes, state)
        j += 1
    # Each scatter below is a kernel of its own, which would run the loop again.
    dr.eval(state.total)
    out_re, out_im = dr.zeros(float_type, batch * plane.pixels), dr.zeros(float_type, batch * plane.pixels)
    pixels = _pixels(lanes, group, plane, size)
    for row in range(LANE_ROWS):
        for k in range(size):
            dr.scatter(out_re, state.total[row][k][0], pixels[row][k], lanes.active[row])
            dr.scatter(out_im, state.total[row][k][1], pixels[row][k], lanes.active[row])
    return out_re, out_im


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
    slopes, rest = before(pixels, lanes.active, total, gradient)
    fields = 11 if product else 10
    out, out_signals = dr.zeros(float_type, dr.width(table)), dr.zeros(float_type, dr.width(signals))
    dr.eval(out, out_signals, slopes, rest)
    copied = dr.width(table) + dr.width(signals) <= MOST_COPIED
    mode = dr.ReduceMode.Auto if copied else dr.ReduceMode.Local
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        place = group * n + i
        record = read(table, i, fields)
        signal = _read_signals(signals, place, size)
        vectors, by_own, by_signal, seen, rest = take_away(record, record[9:], signal, lanes, rest, slopes)
        values, parts = [*vectors, *by_own], [part for pair in by_signal for part in pair]
        for k in range(fields):
            dr.scatter_reduce(dr.ReduceOp.Add, out, values[k], i * RECORD + k, seen, mode=mode)
        for k in range(2 * size):
            dr.scatter_reduce(dr.ReduceOp.Add, out_signals, parts[k], place * (2 * size) + k, seen, mode=mode)
        j += 1
    return out, out_signals


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
