"""Change of an image on removal of one Gaussian, for all of them in one walk.

The received field of a pixel is linear in each footprint G'_i under both blending rules, so removal of Gaussian i
changes it by exactly G'_i dR/dG'_i: its signal, less the signal behind that it hides.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .blend import Lanes, along_azimuth, blend, columns_of, footprint_at, lanes_of, pack, read
from .footprint import Pose, depth_order, project
from .parameters import Gaussians
from .recurrence import Pair, ReverseState, reverse_start, reverse_step
from .tiles import Plane, TileLists, build_lists


def _change(blending: list[Any], signal: list[Any], g: Any, t: Pair, q: Pair) -> tuple[Any, Pair, Pair]:
    """One pixel's |change|, and T and Q behind the Gaussian."""
    unit = (1, 0)
    by_re, _, _, after, q_re = reverse_step(blending, g, t, q, [(signal[0], signal[1])], [unit])
    # The imaginary part is the real one of all divided by j.
    by_im, _, _, _, q_im = reverse_step(blending, g, t, (q[1], -q[0]), [(signal[1], -signal[0])], [unit])
    return g * dr.sqrt(dr.square(by_re) + dr.square(by_im)), after, (q_re[0], q_im[0])


def _step(record: list[Any], lanes: Lanes, state: ReverseState) -> tuple[Any, ReverseState]:
    """Sum of one Gaussian's |change| over a lane's pixels, and the state behind it."""
    along = along_azimuth(record, lanes.azimuth)
    value, after = 0, ReverseState([], [])
    for k, elevation in enumerate(lanes.elevation):
        change, t, q = _change(record[9:-2], record[-2:], footprint_at(along, elevation)[0], state.t[k], state.q[k])
        after.t.append(t)
        after.q.append(q)
        value += dr.select(lanes.active[k], change, 0)
    return value, after


@dr.syntax
def _walk(table: Any, lists: TileLists, plane: Plane, n: int, fields: int, batch: int, total: Pair) -> Any:
    float_type, index_type = type(table), type(lists.index)
    lanes = lanes_of(plane, lists, n, batch)
    # With a gradient of one, Q before the first Gaussian is the whole sum.
    unit = (dr.full(float_type, 1, dr.width(total[0])), dr.zeros(float_type, dr.width(total[0])))
    _, state = reverse_start(lanes.pixel, lanes.active, total, unit)
    out = dr.zeros(float_type, batch * n)
    dr.eval(out)
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        value, state = _step(read(table, i, fields), lanes, state)
        dr.scatter_reduce(dr.ReduceOp.Add, out, value, i, value > 0, mode=dr.ReduceMode.Local)
        j += 1
    return out


def removal(gaussians: Gaussians, pose: Pose, plane: Plane) -> Any:
    """Sum over the plane's pixels of |change of R| on removal of one Gaussian, [batch * n].

    Args:
        gaussians: Gaussians of one field for ``batch`` transmitters.
        pose: pose of the receiver.
        plane: the receiver's perception plane.
    """
    gaussians = gaussians.spread()
    batch, blending = gaussians.batch, gaussians.blending
    with dr.suspend_grad():
        footprints = project(gaussians, pose)
        lists = build_lists(footprints, depth_order(footprints.depth, gaussians.position), plane, batch)
        columns = [*columns_of(footprints, blending), *gaussians.signal]
        table = pack(columns)
        total = blend(footprints, gaussians.signal, lists, plane, batch, blending)
        dr.eval(table, total)
        return _walk(table, lists, plane, gaussians.count, len(columns), batch, total)
