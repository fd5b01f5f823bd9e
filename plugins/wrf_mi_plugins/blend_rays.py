"""Complex blending along rays: the traced evaluation, with its derivatives.

The sum is that of `wrf_mi.gaussians.recurrence`, with the response of the 3D Gaussian along the ray in place of the
projected footprint (`wrf_mi_plugins.ray_response`) and the complex transmission W of walls:

    R = sum_i w_i S_i W(t_i) T_i,   T_{i+1} = T_i b_i

t_i is the point of the ray at which Gaussian i is strongest. The order is that of splatting: by distance of the centre
from the receiver, ties by the centre's coordinates. It is common to all rays, so it needs one sort, not one per ray.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from wrf_mi.backend.vectors import conjugate_times, times
from wrf_mi.gaussians.blend import RECORD, pack, read, unpack
from wrf_mi.gaussians.recurrence import (
    ForwardState,
    ReverseState,
    accumulate,
    forward_step,
    reverse_start,
    reverse_step,
)

from .bundles import Bundles, RayLists
from .ray_response import RAY_FIELDS, RayFootprints, peak_distance, response, response_slope


@dataclass
class Walls:
    """Walls that rays cross, at most k each.

    Attributes:
        distance: distance of each crossing from the receiver, ascending, infinite beyond the last, metres, [rays * k];
            detached.
        factor_re: real part of the transmission before the first crossing (1), after it, and so on, [rays * (k + 1)].
        factor_im: imaginary part of that transmission.
        k: crossings per ray.
    """

    distance: Any
    factor_re: Any
    factor_im: Any
    k: int


class _Rays:
    """Input of a pass over the lists. No dataclass: Dr.Jit would carry each array through its loops."""

    def __init__(
        self,
        table: Any,  # [n * RECORD]
        factor: list[Any],  # re, im, [rays * (k + 1)] each; empty without walls
        lists: RayLists,
        bundles: Bundles,
        fields: int,  # numbers in a record
        depth: Any,  # [n]
        walls: Walls | None,
    ) -> None:
        self.table, self.factor, self.lists, self.bundles = table, factor, lists, bundles
        self.fields, self.depth, self.walls = fields, depth, walls

    def range(self) -> tuple[Any, Any]:
        """Begin and end of each lane's list."""
        return tuple(
            dr.gather(type(self.lists.index), ends, self.bundles.bundle) for ends in (self.lists.begin, self.lists.end)
        )

    def record(self, i: Any) -> tuple[list[Any], Any]:
        """Record of Gaussian i and its depth, which only walls need."""
        depth = None if self.walls is None else dr.gather(type(self.table), self.depth, i)
        return read(self.table, i, self.fields), depth

    def signal(self, record: list[Any], parts: Any, ray: Any, depth: Any) -> tuple[Any, Any]:
        """The Gaussian's signal behind the walls, and their transmission (re, im) with its slot in the table."""
        re, im = record[RAY_FIELDS : RAY_FIELDS + 2]
        if self.walls is None:
            return (re, im), None
        distance, k, crossed = peak_distance(depth, parts), self.walls.k, type(ray)(0)
        for i in range(k):
            crossed += dr.select(dr.gather(type(distance), self.walls.distance, ray * k + i) < distance, 1, 0)
        slot = ray * (k + 1) + crossed
        passed = [dr.gather(type(distance), f, slot) for f in self.factor]
        return times(passed, (re, im)), (*passed, slot)


def _blend_one(record: list[Any], depth: Any, state: ForwardState, rays: _Rays) -> ForwardState:
    """State behind one more Gaussian."""
    result = ForwardState([], [])
    for k, ray in enumerate(rays.bundles.ray):
        parts = response(record, rays.bundles.direction[k])
        signal, _ = rays.signal(record, parts, ray, depth)
        weight, after = forward_step(record[RAY_FIELDS + 2 :], parts[0], state.t[k])
        result.total.append([accumulate(state.total[k][0], weight, signal)])
        result.t.append(after)
    return result


@dr.syntax
def _forward(rays: _Rays) -> tuple[Any, Any]:
    float_type, index_type = type(rays.table), type(rays.lists.index)
    state = ForwardState.start(float_type, len(rays.bundles.ray))
    j, end = rays.range()
    while j < end:
        record, depth = rays.record(dr.gather(index_type, rays.lists.index, j))
        state = _blend_one(record, depth, state, rays)
        j += 1
    # All at once: each scatter would run the loop anew.
    dr.eval(state)
    parts = ([total[0][k] for total in state.total] for k in (0, 1))
    re, im = (dr.gather(float_type, dr.concat(part), rays.bundles.place) for part in parts)
    return re, im


def _derivatives(
    record: list[Any], depth: Any, state: ReverseState, slopes: list[Any], rays: _Rays
) -> tuple[list[Any], Any, ReverseState, list[tuple[Any, Any, Any]]]:
    """One Gaussian's derivatives, summed over the lane's rays; whether any sees it; the state; those of the walls."""
    sent, blending = record[RAY_FIELDS : RAY_FIELDS + 2], record[RAY_FIELDS + 2 :]
    total: list[Any] = [0 for _ in record]
    after, factors, visible = ReverseState([], []), [], False
    for k, ray in enumerate(rays.bundles.ray):
        u = rays.bundles.direction[k]
        parts = response(record, u)
        signal, passed = rays.signal(record, parts, ray, depth)
        by_g, by_blending, (by_signal,), t, q = reverse_step(
            blending, parts[0], state.t[k], state.q[k], [signal], slopes[k]
        )
        if passed is not None:
            factors.append((passed[2], *conjugate_times(sent, by_signal)))
            by_signal = conjugate_times(passed[:2], by_signal)
        by_record = [*response_slope(record, u, parts, by_g), *by_signal, *by_blending]
        total = [a + b for a, b in zip(total, by_record, strict=True)]
        after.t.append(t)
        after.q.append(q)
        visible |= parts[0] > 0
    return total, visible, after, factors


@dr.syntax
def _backward(rays: _Rays, total: tuple[Any, Any], gradient: tuple[Any, Any]) -> tuple[Any, list[Any]]:
    """Gradients of the table, in its layout, and of the walls' factors."""
    float_type, index_type = type(rays.table), type(rays.lists.index)
    slopes, state = reverse_start([[ray] for ray in rays.bundles.ray], rays.bundles.active, total, gradient)
    out = dr.zeros(float_type, dr.width(rays.table))
    out_factor = [dr.zeros(float_type, dr.width(f)) for f in rays.factor]
    dr.eval(out, out_factor)
    j, end = rays.range()
    while j < end:
        i = dr.gather(index_type, rays.lists.index, j)
        record, depth = rays.record(i)
        values, visible, state, factors = _derivatives(record, depth, state, slopes, rays)
        for k in range(len(values)):
            dr.scatter_reduce(dr.ReduceOp.Add, out, values[k], i * RECORD + k, visible, mode=dr.ReduceMode.Local)
        for slot, d_re, d_im in factors:
            dr.scatter_add(out_factor[0], d_re, slot, visible)
            dr.scatter_add(out_factor[1], d_im, slot, visible)
        j += 1
    return out, out_factor


class _BlendRays(dr.CustomOp):
    """Blending as one differentiable operation over per-Gaussian columns and the walls' factors."""

    def eval(self, make: Callable[[Any, list[Any]], _Rays], columns: list[Any], factor: list[Any]) -> Any:
        self.make, self.columns, self.factor = make, columns, factor
        self.rays = make(pack(columns), factor)
        dr.eval(self.rays.table)
        self.total = _forward(self.rays)
        dr.eval(self.total)
        return self.total

    def forward(self) -> None:
        # Dr.Jit differentiates the loop itself in this direction.
        with dr.resume_grad():
            inputs = {name: [dr.detach(c) for c in getattr(self, name)] for name in ("columns", "factor")}
            for name, arrays in inputs.items():
                gradients: Any = self.grad_in(name)
                for array, gradient in zip(arrays, gradients, strict=True):
                    dr.enable_grad(array)
                    dr.set_grad(array, gradient)
            out = _forward(self.make(pack(inputs["columns"]), inputs["factor"]))
            dr.forward_to(out)
        self.set_grad_out(dr.grad(out))

    def backward(self) -> None:
        gradient: Any = self.grad_out()
        dr.eval(gradient)
        out, out_factor = _backward(self.rays, self.total, gradient)
        dr.eval(out, out_factor)
        self.set_grad_in("columns", unpack(out, len(self.columns)))
        self.set_grad_in("factor", out_factor)

    def name(self) -> str:
        return "wrf_mi blending along rays"


def blend_rays(
    footprints: RayFootprints,
    signal: list[Any],
    lists: RayLists,
    bundles: Bundles,
    blending: list[Any],
    walls: Walls | None = None,
) -> tuple[Any, Any]:
    """Received complex signal along each ray.

    Args:
        footprints: responses of n Gaussians, see `wrf_mi_plugins.ray_response.ray_footprints`.
        signal: complex signal (re, im), two arrays [n].
        lists: Gaussians of each bundle, near to far: at least those that its rays meet.
        bundles: the rays.
        blending: one array [n] of opacities in [0, 1) (alpha blending), or real and imaginary part of delta,
            |delta| < 1 (product blending).
        walls: walls between the receiver and the Gaussians, or None.

    Returns:
        Real and imaginary part of R, arrays [rays]. Differentiable, forward and backward, in footprints, signal,
        ``blending`` and the walls' factors.
    """
    columns = [*footprints.columns(), *signal, *blending]
    factor = [] if walls is None else [walls.factor_re, walls.factor_im]

    def rays(table: Any, factor: list[Any]) -> _Rays:
        return _Rays(table, factor, lists, bundles, len(columns), type(table)(footprints.depth), walls)

    return dr.custom(_BlendRays, rays, columns, factor)
