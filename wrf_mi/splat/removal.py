"""How much an image changes when one Gaussian is taken away, for all of them in one walk.

The received field of a pixel is linear in each footprint G'_i, for both ways of blending, so taking Gaussian i away
changes it by exactly G'_i dR/dG'_i: what it sends, less what it hides of those behind.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..field.gaussians import Gaussians
from ..project.footprint import Pose, depth_order, project
from .blend import (
    SMALLEST_FACTOR,
    _along_azimuth,
    _before,
    _footprint,
    _forward,
    _Lanes,
    _lanes,
    _Rest,
    pack,
    read,
)
from .tiles import Plane, TileLists, build_lists

Pair = tuple[Any, Any]


def _times(a: Pair, b: Pair) -> Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _change(record: list[Any], g: Any, t: Pair, q: Pair, product: bool) -> tuple[Any, Pair, Pair]:
    """One pixel's |change|, and the next T and Q (what lies behind)."""
    if product:
        hidden = (1 - record[11], -record[12])
        weight = g
    else:
        # Footprint times opacity is the weight; what passes is the rest.
        hidden, weight = (1, 0), g * record[11]
    own = _times((record[9], record[10]), t)
    q = (q[0] - weight * own[0], q[1] - weight * own[1])
    b = (1 - weight * hidden[0], -weight * hidden[1])
    scale = dr.rcp(dr.maximum(b[0] * b[0] + b[1] * b[1], SMALLEST_FACTOR**2))
    through = _times(_times(q, (b[0] * scale, -b[1] * scale)), hidden)
    change = weight * dr.sqrt(dr.square(own[0] - through[0]) + dr.square(own[1] - through[1]))
    return change, _times(t, b), q


def _step(record: list[Any], lanes: _Lanes, rest: _Rest, product: bool) -> tuple[Any, _Rest]:
    """Sum of one Gaussian's |change| over a lane's pixels, and the rest behind it."""
    along = _along_azimuth(record, lanes.azimuth)
    value, t, q = 0, [], []
    for k, elevation in enumerate(lanes.elevation):
        g = _footprint(along, elevation)[0]
        change, next_t, next_q = _change(record, g, rest.t[k], rest.q[k], product)
        t.append(next_t)
        q.append(next_q)
        value += dr.select(lanes.active[k], change, 0)
    return value, _Rest(t, q)


@dr.syntax
def _walk(table: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int, total: Pair) -> Any:
    float_type, index_type = type(table), type(lists.index)
    lanes = _lanes(plane, lists, n, batch)
    fields = 13 if product else 12
    # With a gradient of one, what `_before` starts from is the whole sum.
    whole = (dr.full(float_type, 1, dr.width(total[0])), dr.zeros(float_type, dr.width(total[0])))
    _, rest = _before(lanes, total, whole, float_type)
    out = dr.zeros(float_type, batch * n)
    dr.eval(out)
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        value, rest = _step(read(table, i, fields), lanes, rest, product)
        dr.scatter_reduce(dr.ReduceOp.Add, out, value, i, value > 0, mode=dr.ReduceMode.Local)
        j += 1
    return out


def removal(gaussians: Gaussians, pose: Pose, plane: Plane) -> Any:
    """Sum over the plane's pixels of |change of R| when a Gaussian alone is taken away, [batch * n].

    Args:
        gaussians: of one field for ``batch`` transmitters.
        pose: of the receiver.
        plane: its perception plane.
    """
    gaussians = gaussians.spread()
    footprints = project(gaussians, pose)
    order = depth_order(footprints.depth, gaussians.position)
    batch, n = gaussians.batch, gaussians.count
    lists = build_lists(footprints, order, plane, batch)
    product = gaussians.attenuation is not None
    own = gaussians.attenuation if gaussians.attenuation is not None else [gaussians.opacity]
    columns = [*footprints.direction, *footprints.whitened[0], *footprints.whitened[1], *gaussians.signal, *own]
    table = pack([dr.detach(c) for c in columns])
    dr.eval(table)
    total = _forward(table, lists, plane, n, product, batch)
    dr.eval(total)
    return _walk(table, lists, plane, n, product, batch, total)
