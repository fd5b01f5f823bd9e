"""Complex blending along rays: the traced evaluation, with its derivatives.

The sum is that of `wrf_mi.gaussians.recurrence`, with the response of the 3D Gaussian along the ray in place of the
projected footprint (`wrf_mi.gaussians.ray_response`) and, where walls stand between, their complex transmission W:

    R = sum_i w_i S_i W(t_i) T_i,   T_{i+1} = T_i b_i

t_i is where on the ray Gaussian i is strongest. The order is that of the splatted way: by distance of the centre from
the receiver, ties by the centre's coordinates. It is the same for all rays, so it needs one sort, not one a ray.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from .blend import RECORD, pack, read
from .bundles import Bundles, RayLists
from .ray_response import RAY_FIELDS, RayFootprints, peak_distance, response, response_slope
from .recurrence import Rest, Sum, ahead, before, behind, conjugate_times, plus, times


@dataclass
class Walls:
    """Walls that rays cross, at most k each.

    Attributes:
        distance: of each crossing from the receiver, ascending, infinite beyond the last, metres, [rays * k]; detached.
        factor_re: real part of what has passed before the first crossing (1), after it, and so on, [rays * (k + 1)].
        factor_im: its imaginary part.
        k: crossings per ray.
    """

    distance: Any
    factor_re: Any
    factor_im: Any
    k: int


class _Setting:
    """What a pass over the lists reads. No dataclass: Dr.Jit would carry each array through its loops."""

    def __init__(
        self,
        table: Any,
        factor: list[Any],
        lists: RayLists,
        bundles: Bundles,
        product: bool,
        depth: Any,
        walls: Walls | None,
    ) -> None:
        self.table, self.factor = table, factor
        self.lists, self.bundles, self.product, self.depth, self.walls = lists, bundles, product, depth, walls


def _passed(setting: _Setting, ray: Any, distance: Any) -> tuple[Any, Any, Any]:
    """What the walls up to a distance let pass, and where that factor stands in the table."""
    assert setting.walls is not None
    k = setting.walls.k
    index_type: Any = type(ray)
    crossed = index_type(0)
    for i in range(k):
        crossed += dr.select(dr.gather(type(distance), setting.walls.distance, ray * k + i) < distance, 1, 0)
    slot = ray * (k + 1) + crossed
    return *(dr.gather(type(distance), f, slot) for f in setting.factor), slot


def _signal(setting: _Setting, record: list[Any], parts: Any, ray: Any, depth: Any) -> tuple[Any, Any]:
    """The Gaussian's signal as it comes through the walls, and what let it pass."""
    re, im = record[RAY_FIELDS : RAY_FIELDS + 2]
    if setting.walls is None:
        return (re, im), None
    passed = _passed(setting, ray, peak_distance(depth, parts))
    return times(passed[:2], (re, im)), passed


def _add(record: list[Any], depth: Any, so_far: Sum, setting: _Setting) -> Sum:
    """One more Gaussian, behind all before it."""
    result = Sum([], [])
    for k, ray in enumerate(setting.bundles.ray):
        parts = response(record, setting.bundles.direction[k])
        signal, _ = _signal(setting, record, parts, ray, depth)
        weight, after = ahead(record[RAY_FIELDS + 2 :], parts[0], so_far.t[k])
        result.total.append([plus(so_far.total[k][0], weight, signal)])
        result.t.append(after)
    return result


def _record(setting: _Setting, i: Any) -> tuple[list[Any], Any]:
    """What is read of Gaussian i; its depth matters to walls alone."""
    depth = None if setting.walls is None else dr.gather(type(setting.table), setting.depth, i)
    return read(setting.table, i, RAY_FIELDS + (4 if setting.product else 3)), depth


@dr.syntax
def _forward(setting: _Setting) -> tuple[Any, Any]:
    float_type, index_type = type(setting.table), type(setting.lists.index)
    bundles = setting.bundles
    state = Sum.start(float_type, len(bundles.ray))
    j = dr.gather(index_type, setting.lists.start, bundles.bundle)
    end = dr.gather(index_type, setting.lists.start, bundles.bundle + 1)
    while j < end:
        record, depth = _record(setting, dr.gather(index_type, setting.lists.index, j))
        state = _add(record, depth, state, setting)
        j += 1
    # All at once: a scatter for each would run the loop anew for each.
    dr.eval(state)
    parts = ([own[0][k] for own in state.total] for k in (0, 1))
    re, im = (dr.gather(float_type, dr.concat(part), bundles.place) for part in parts)
    return re, im


def _take_away(
    record: list[Any], depth: Any, rest: Rest, slopes: list[Any], setting: _Setting
) -> tuple[list[Any], Any, Rest, list[tuple[Any, Any, Any]]]:
    """One Gaussian's derivatives, summed over the lane's rays; whether any sees it; the rest; those of the walls."""
    sent, own = record[RAY_FIELDS : RAY_FIELDS + 2], record[RAY_FIELDS + 2 :]
    total: list[Any] = [0 for _ in record]
    after, factors, seen = Rest([], []), [], False
    for k, ray in enumerate(setting.bundles.ray):
        u = setting.bundles.direction[k]
        parts = response(record, u)
        signal, passed = _signal(setting, record, parts, ray, depth)
        by_g, by_own, (by_signal,), t, q = behind(own, parts[0], rest.t[k], rest.q[k], [signal], slopes[k])
        if passed is not None:
            factors.append((passed[2], *conjugate_times(sent, by_signal)))
            by_signal = conjugate_times(passed[:2], by_signal)
        mine = [*response_slope(record, u, parts, by_g), *by_signal, *by_own]
        total = [a + b for a, b in zip(total, mine, strict=True)]
        after.t.append(t)
        after.q.append(q)
        seen |= parts[0] > 0
    return total, seen, after, factors


@dr.syntax
def _backward(setting: _Setting, total: tuple[Any, Any], gradient: tuple[Any, Any]) -> tuple[Any, list[Any]]:
    """Gradients of the table, in its layout, and of the walls' factors."""
    float_type, index_type = type(setting.table), type(setting.lists.index)
    bundles = setting.bundles
    slopes, rest = before([[ray] for ray in bundles.ray], bundles.active, total, gradient)
    out = dr.zeros(float_type, dr.width(setting.table))
    out_factor = [dr.zeros(float_type, dr.width(f)) for f in setting.factor]
    dr.eval(out, out_factor)
    j = dr.gather(index_type, setting.lists.start, bundles.bundle)
    end = dr.gather(index_type, setting.lists.start, bundles.bundle + 1)
    while j < end:
        i = dr.gather(index_type, setting.lists.index, j)
        record, depth = _record(setting, i)
        values, seen, rest, factors = _take_away(record, depth, rest, slopes, setting)
        for k in range(len(values)):
            dr.scatter_reduce(dr.ReduceOp.Add, out, values[k], i * RECORD + k, seen, mode=dr.ReduceMode.Local)
        for slot, d_re, d_im in factors:
            dr.scatter_add(out_factor[0], d_re, slot, seen)
            dr.scatter_add(out_factor[1], d_im, slot, seen)
        j += 1
    return out, out_factor


class _BlendRays(dr.CustomOp):
    """Blending as one differentiable operation over per-Gaussian columns and the walls' factors."""

    def eval(self, make: Callable[[Any, list[Any]], _Setting], columns: list[Any], factor: list[Any]) -> Any:
        self.make, self.columns, self.factor = make, columns, factor
        self.setting = make(pack(columns), factor)
        dr.eval(self.setting.table)
        self.total = _forward(self.setting)
        dr.eval(self.total)
        return self.total

    def forward(self) -> None:
        # Dr.Jit differentiates the loop itself in this direction.
        with dr.resume_grad():
            columns, factor = ([dr.detach(c) for c in own] for own in (self.columns, self.factor))
            for name, own in (("columns", columns), ("factor", factor)):
                gradients: Any = self.grad_in(name)
                for array, gradient in zip(own, gradients, strict=True):
                    dr.enable_grad(array)
                    dr.set_grad(array, gradient)
            out = _forward(self.make(pack(columns), factor))
            dr.forward_to(out)
        self.set_grad_out(dr.grad(out))

    def backward(self) -> None:
        gradient: Any = self.grad_out()
        dr.eval(gradient)
        out, out_factor = _backward(self.setting, self.total, gradient)
        dr.eval(out, out_factor)
        index = dr.arange(dr.uint32_array_t(type(out)), dr.width(out) // RECORD) * RECORD
        self.set_grad_in("columns", [dr.gather(type(out), out, index + k) for k in range(len(self.columns))])
        self.set_grad_in("factor", out_factor)

    def name(self) -> str:
        return "wrf_mi blending along rays"


def blend_rays(
    footprints: RayFootprints,
    signal: list[Any],
    lists: RayLists,
    bundles: Bundles,
    opacity: Any | None = None,
    attenuation: list[Any] | None = None,
    walls: Walls | None = None,
) -> tuple[Any, Any]:
    """Received complex signal along each ray.

    Args:
        footprints: of n Gaussians, see `wrf_mi.gaussians.ray_response.ray_footprints`.
        signal: complex signal (re, im), two arrays [n].
        lists: Gaussians of each bundle, near to far: at least those that its rays meet.
        bundles: the rays.
        opacity: array [n] in [0, 1); alpha blending.
        attenuation: complex factor delta (re, im), |delta| < 1; product blending.
        walls: between the receiver and the Gaussians, or None.

    Returns:
        Real and imaginary part of R, arrays [rays]. Differentiable, forward and backward, in footprints, signal,
        opacity or attenuation and the walls' factors.
    """
    product = attenuation is not None
    own = attenuation if attenuation is not None else [opacity]
    columns = [*footprints.columns(), *signal, *own]
    factor = [] if walls is None else [walls.factor_re, walls.factor_im]

    def setting(table: Any, own_factor: list[Any]) -> _Setting:
        return _Setting(table, own_factor, lists, bundles, product, type(table)(footprints.depth), walls)

    return dr.custom(_BlendRays, setting, columns, factor)
