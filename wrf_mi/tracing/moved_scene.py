"""A scene whose planes have moved, in which paths are searched for those of the scene as stated.

Planes that move take paths with them (`wrf_mi.tracing.plane_parameters`), but edges that move uncover some paths and
hide others. Faces, planes and materials of the moved scene have the numbers of the stated one, so that paths found
there are paths of the stated scene with these parameters.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from ..backend.device import on_device, to_tensor
from ..core.angles import FloatArray
from .corrected_scene import moved_triangles, planes_at
from .material_parameters import slabs_of_faces
from .solve import Prepared
from .surfaces import Surfaces, largest_face, plane_bounds, shape_id


@dataclass(frozen=True)
class MovedSearch:
    """Where paths are searched for the scene as stated.

    Attributes:
        prepared: shared state of traces in the moved scene.
        parameters: parameters of the traced fields, Dr.Jit tensors by name, by which faint paths are told.
    """

    prepared: Prepared
    parameters: Mapping[str, Any]


def moved_search(
    copy: Any, stated: Surfaces, parameters: Mapping[str, NDArray[Any]], absent: Collection[int] = ()
) -> MovedSearch:
    """Move the planes of a scene in place, for the search of paths there.

    Args:
        copy: ``sionna.rt.Scene`` with the objects of the stated one, which may have been moved before; nothing else
            may use it.
        stated: surfaces of the scene as stated.
        parameters: parameters of `wrf_mi.tracing.traced_field.TracedField` by name, those of planes among them.
        absent: slabs of surfaces, in the order of their parameters, that no ray shall meet.

    Raises:
        ValueError: parameters of a scene with another number of planes.
    """
    triangles = moved_triangles(stated, parameters)
    left_out = np.isin(slabs_of_faces(copy, stated, "surface")[1], list(absent))
    triangles[left_out] = triangles[left_out][:, :1]  # no ray meets a point
    _move(copy, stated, triangles)
    normal, offset = planes_at(stated, parameters)
    flat = np.einsum("fcx,fax->fca", triangles, stated.axes[stated.plane])
    low, high = plane_bounds(stated.plane, flat, len(normal))
    face = np.where(left_out[stated.face], largest_face(stated.plane, trimesh.triangles.area(triangles)), stated.face)
    surfaces = replace(
        stated,
        shape_ids=np.array([shape_id(copy.objects[name].mi_mesh) for name in stated.names], np.uint32),
        triangles=triangles,
        normal=normal,
        offset=offset,
        face=face,
        low=low,
        high=high,
    )
    return MovedSearch(Prepared(copy, surfaces), {name: to_tensor(values) for name, values in parameters.items()})


def _move(scene: Any, stated: Surfaces, triangles: FloatArray) -> None:
    """Give the faces of a scene other corners [f, 3, 3], which they no longer share."""
    parameters = scene.mi_scene_params
    for number, name in enumerate(stated.names):
        mesh = scene.objects[name].mi_mesh.id()
        corners = triangles[stated.first_face[number] : stated.first_face[number + 1]].reshape(-1)
        parameters[f"{mesh}.vertex_positions"] = on_device(corners, mi.Float)
        parameters[f"{mesh}.faces"] = on_device(np.arange(len(corners) // 3), mi.UInt32)
    parameters.update()
