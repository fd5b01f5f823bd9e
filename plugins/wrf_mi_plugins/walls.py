"""Transmission through the meshes of a Mitsuba scene: radio materials of walls and their crossings by rays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from wrf_mi.backend.vectors import Pose
from wrf_mi.core import InputError
from wrf_mi.tracing.search.surfaces import shape_id
from wrf_mi.tracing.sionna.materials import itu_constants
from wrf_mi.tracing.slabs import slab

from .blend_rays import Walls
from .ray_response import to_world
from .shape import interleave

ITU_PREFIX = "mat-itu_"
"""Prefix of the id of a BSDF that denotes a material of ITU-R P.2040, as in Sionna RT's scene files."""

MOST_CROSSINGS = 64
"""Largest number of walls on a ray; more are taken for a mistake (terrain, say, or foliage)."""

SMALLEST_SINE = 1e-6
"""Sine of the angle of incidence below which both polarisations have equal transmission."""


@dataclass
class Crossings:
    """Crossings of walls by rays; ``k`` lists of arrays [rays], in order of distance, detached.

    Attributes:
        distance: distance from the receiver, metres; infinite where a ray crosses no further wall.
        cosine: cosine of the angle of incidence.
        across: share of the power polarised across the plane of incidence (TE).
        wall: number of the wall in the list of shapes.
    """

    distance: list[Any]
    cosine: list[Any]
    across: list[Any]
    wall: list[Any]


def wall_shapes(scene: Any) -> list[Any]:
    """All shapes of a ``mi.Scene`` except ellipsoids and those of a ``null`` BSDF, the borders of media."""
    lobes, nothing = mi.BSDFFlags.All.value, mi.BSDFFlags.Null.value
    return [s for s in scene.shapes() if not s.is_ellipsoids() and s.bsdf().flags() & lobes != nothing]


def wall_scene(shapes: list[Any]) -> Any:
    """A ``mi.Scene`` of these shapes alone, in which rays do not meet Gaussians."""
    return mi.load_dict({"type": "scene"} | {f"wall_{i}": shape for i, shape in enumerate(shapes)})


def find_crossings(
    scene: Any, shapes: list[Any], pose: Pose, direction: list[Any], polarization: list[float] | None
) -> Crossings:
    """Trace rays straight through walls.

    Args:
        scene: scene from `wall_scene`.
        shapes: shapes of that scene.
        pose: pose of the receiver.
        direction: unit vectors of the rays, receiver's frame, three arrays [rays].
        polarization: direction of the receiver's antenna, receiver's frame; None: the world's z axis.

    Raises:
        InputError: a ray crosses more than `MOST_CROSSINGS` walls.
    """
    d = dr.detach(mi.Vector3f(*to_world(pose, direction)))
    field = mi.Vector3f(0, 0, 1)
    if polarization is not None:
        field = dr.detach(mi.Vector3f(*to_world(pose, [mi.Float(c) for c in polarization])))
    field -= dr.dot(field, d) * d
    number = dr.zeros(mi.UInt32, max(shape_id(s) for s in shapes) + 1)
    for i, shape in enumerate(shapes):
        dr.scatter(number, mi.UInt32(i), mi.UInt32(shape_id(shape)))
    origin = mi.Point3f(*(dr.detach(x) for x in pose.position))
    ray, active, distance = mi.Ray3f(origin, d), mi.Bool(True), mi.Float(0)
    dr.eval(ray, field, number)
    crossings = Crossings([], [], [], [])
    while True:
        si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True, active=active)
        active = active & si.is_valid()
        # The next ray starts a little behind the wall.
        distance = dr.select(active, dr.norm(si.p - origin), dr.inf)
        cosine = dr.minimum(dr.abs(dr.dot(si.n, d)), 1)
        te = dr.cross(d, si.n)
        sine = dr.squared_norm(te) * dr.squared_norm(field)
        across = dr.select(sine > SMALLEST_SINE**2, dr.square(dr.dot(field, te)) / sine, 0.5)
        met: Any = dr.reinterpret_array(mi.UInt32, si.shape)
        wall = dr.gather(mi.UInt32, number, met, active)
        ray = dr.select(active, si.spawn_ray(d), ray)
        dr.eval(active, distance, cosine, across, wall, ray)
        if not dr.any(active):
            return crossings
        if len(crossings.distance) == MOST_CROSSINGS:
            raise InputError(f"scene: a ray crosses more than {MOST_CROSSINGS} walls; simplify its meshes")
        for values, value in zip(vars(crossings).values(), (distance, cosine, across, wall), strict=True):
            values.append(value)


def walls_of(
    crossings: Crossings, shapes: list[Any], frequency_hz: Any, thickness_m: Mapping[str, float]
) -> Walls | None:
    """The complex transmission along rays, differentiable in the parameters of Sionna RT's radio materials.

    Each wall is one slab (`wrf_mi.tracing.slabs.slab`), and passes the receiver's polarisation by
    T = T_TE s + T_TM (1 - s), where s is the share of it across the plane of incidence.

    Args:
        crossings: result of `find_crossings`.
        shapes: walls, in the order of `find_crossings`.
        frequency_hz: carrier, ``mi.Float`` of width 1.
        thickness_m: thickness of materials known by a BSDF's id alone, by name ``itu_*``; else Sionna RT's default.

    Raises:
        InputError: a shape without a radio material, or one unknown at this frequency.
    """
    if not crossings.distance:
        return None
    constants = [radio_constants(shape, frequency_hz, thickness_m) for shape in shapes]
    columns = [interleave(list(column)) for column in zip(*constants, strict=True)]
    re, im = mi.Float(1), mi.Float(0)
    passed = [(re, im)]
    for distance, cosine, across, wall in zip(*vars(crossings).values(), strict=True):
        permittivity, conductivity, thickness = (dr.gather(mi.Float, column, wall) for column in columns)
        c = slab(cosine, permittivity, conductivity, thickness, frequency_hz)
        t = c.transmitted_te * across + c.transmitted_tm * (1 - across)
        crossed = dr.isfinite(distance)
        t_re, t_im = dr.select(crossed, t.real, 1), dr.select(crossed, t.imag, 0)
        re, im = re * t_re - im * t_im, re * t_im + im * t_re
        passed.append((re, im))
    rays = dr.width(crossings.distance[0])
    spread = [[part + dr.zeros(mi.Float, rays) for part in parts] for parts in zip(*passed, strict=True)]
    result = Walls(
        interleave(crossings.distance), interleave(spread[0]), interleave(spread[1]), len(crossings.distance)
    )
    dr.eval(result.distance, result.factor_re, result.factor_im)
    return result


def radio_constants(shape: Any, frequency_hz: Any, thickness_m: Mapping[str, float]) -> tuple[Any, Any, Any]:
    """Relative permittivity, conductivity (S/m) and slab thickness (m) of a shape's material, of width 1.

    Those of a radio material of Sionna RT have derivatives. Any other BSDF with id ``mat-itu_*`` denotes the material
    of ITU-R P.2040 of that name.

    Raises:
        InputError: neither, a material unknown at this frequency, or a material at another frequency.
    """
    from sionna.rt import RadioMaterial
    from sionna.rt.constants import DEFAULT_THICKNESS

    bsdf = shape.bsdf()
    frequency = float(dr.detach(frequency_hz)[0])
    if isinstance(bsdf, RadioMaterial):
        if bsdf.scene is not None and abs(float(bsdf.scene.frequency[0]) / frequency - 1) > 1e-6:
            carrier = float(bsdf.scene.frequency[0])
            raise InputError(
                f"{bsdf.id()}: its scene is at {carrier:g} Hz, the integrator at {frequency:g} Hz; use one"
            )
        return bsdf.relative_permittivity, bsdf.conductivity, bsdf.thickness
    name = bsdf.id()
    if not name.startswith(ITU_PREFIX):
        what = f"shape {shape.id() or 'without id'}: its BSDF {name or 'without id'} is no radio material"
        raise InputError(f"{what}; name it {ITU_PREFIX}*, use one of Sionna RT, or set the integrator's walls to false")
    itu, kind = itu_constants(frequency), name.removeprefix(ITU_PREFIX)
    if kind not in itu:
        raise InputError(f"{name} at {frequency:g} Hz: no constants of ITU-R P.2040; choose another material")
    eta_r, sigma, _ = itu[kind]
    thickness = thickness_m.get(name.removeprefix("mat-"), DEFAULT_THICKNESS)
    return mi.Float(eta_r), mi.Float(sigma), mi.Float(thickness)
