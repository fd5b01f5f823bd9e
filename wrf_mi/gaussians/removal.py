"""How much an image changes when one Gaussian is taken away, for all of them in one walk.

The received field of a pixel is linear in each footprint G'_i, for both ways of blending, so taking Gaussian i away
changes it by exactly G'_i dR/dG'_i: what it sends, less what it hides of those behind.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from .blend import Lanes, _along_azimuth, _footprint, _forward, lanes_of, pack, read
from .footprint import Pose, depth_order, project
from .parameters import Gaussians
from .recurrence import Pair, Rest, before, behind
from .tiles import Plane, TileLists, build_lists


def _change(record: list[Any], g: Any, t: Pair, q: Pair) -> tuple[Any, Pair, Pair]:
    """One pixel's |change|, and T and Q behind the Gaussian."""
    one, signal, own = (1, 0), (record[9], record[10]), record[11:]
    by_re, _, _, after, rest_re = behind(own, g, t, q, [signal], [one])
    # The imaginary part is the real one of all divided by j.
    by_im, _, _, _, rest_im = behind(own, g, t, (q[1], -q[0]), [(signal[1], -signal[0])], [one])
    return g * dr.sqrt(dr.square(by_re) + dr.square(by_im)), after, (rest_re[0], rest_im[0])


def _step(record: list[Any], lanes: Lanes, rest: Rest) -> tuple[Any, Rest]:
    """Sum of one Gaussian's |change| over a lane's pixels, and the rest behind it."""
    along = _along_azimuth(record, lanes.azimuth)
    value, after = 0, Rest([], [])
    for k, elevation in enumerate(lanes.elevation):
        change, t, q = _change(record, _footprint(along, elevation)[0], rest.t[k], rest.q[k])
        after.t.append(t)
        after.q.append(q)
        value += dr.select(lanes.active[k], change, 0)
    return value, after


@dr.syntax
def _walk(table: Any, lists: TileLists, plane: Plane, n: int, product: bool, batch: int, total: Pair) -> Any:
    float_type, index_type = type(table), type(lists.index)
    lanes = lanes_of(plane, lists, n, batch)
    fields = 13 if product else 12
    # With a gradient of one, the rest before the first Gaussian is the whole sum.
    one = (dr.full(float_type, 1, dr.width(total[0])), dr.zeros(float_type, dr.width(total[0])))
    _, rest = before([[pixel] for pixel in lanes.pixel], lanes.active, total, one)
    out = dr.zeros(float_type, batch * n)
    dr.eval(out)
    j = index_type(0)
    while j < lanes.end:
        i = dr.gather(index_type, lists.index, lanes.start + j)
        value, rest = _step(read(table, i, fields), lanes, rest)
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
