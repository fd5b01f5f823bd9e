"""The traced evaluation of a graph's Gaussians: ``mi.render`` with `wrf_traced`, walls of its scene included.

A scene is built once for each transmitter of a batch, and each call assigns parameters by ``mi.traverse``. The reverse
pass of ``mi.render`` reads the scene again, so two transmitters can take turns in one scene only without derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.backend.vectors import Complex, Pose
from wrf_mi.core import InputError
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.tiles import TiledPlane
from wrf_mi.graph.evaluations import Evaluation, facing_down
from wrf_mi.graph.settings import DEFAULT, TracedConfig
from wrf_mi.tracing.paths.scene_parameters import MaterialGrouping, slabs_of_faces
from wrf_mi.tracing.search.surfaces import scene_surfaces, triangle_mesh

from . import register_all
from .shape import deinterleave, gaussian_shape, shape_parameters

SHAPE = "gaussians"


class SceneWalls:
    """The surfaces of a Sionna RT scene as walls of another Mitsuba scene, one mesh for each material.

    The Sionna RT scene is not changed: materials are copies.

    Args:
        scene: scene from `wrf_mi.tracing.open_scene`.
        materials: whether each named material or each surface has a permittivity and a conductivity, see
            `wrf_mi.tracing.paths.scene_parameters`.

    Attributes:
        names: names of the materials, or ``object/plane`` of the surfaces, in the order of the walls.
        shapes: entries for ``mi.load_dict``, ``wall_0`` and so on. ``mi.traverse`` lists each ``wall_<k>.bsdf.eta_r``
            (relative permittivity), ``.sigma`` (conductivity, S/m) and ``.d`` (thickness, m).
        frequency_hz: carrier of the scene.

    Raises:
        InputError: a surface whose material is no slab.
    """

    def __init__(self, scene: Any, materials: MaterialGrouping = "named") -> None:
        surfaces = scene_surfaces(scene)
        self._slabs, slab = slabs_of_faces(scene, surfaces, materials)
        if (slab < 0).any():
            thing = surfaces.called(int(surfaces.object_of(np.flatnonzero(slab < 0))[0]))
            raise InputError(
                f"object {thing}: its material is no slab, which no wave is traced through; choose another"
            )
        self._stated = self._slabs.constants(mi.Float)
        self._used = np.unique(slab).tolist()
        self.names = tuple(self._slabs.names[k] for k in self._used)
        self.frequency_hz = float(scene.frequency[0])
        self.shapes = {
            f"wall_{i}": triangle_mesh(f"wall_{i}", surfaces.triangles[slab == k], mesh_bsdf=self._material(k))
            for i, k in enumerate(self._used)
        }

    def _material(self, k: int) -> Any:
        from sionna.rt import RadioMaterial

        slabs = self._slabs
        constants = slabs.permittivity[k], slabs.conductivity[k], slabs.thickness[k]
        names = "relative_permittivity", "conductivity", "thickness"
        return RadioMaterial(f"slab-{k}", **dict(zip(names, map(float, constants), strict=True)))

    def values(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Values for ``mi.traverse`` of trained materials, differentiable; others stay as stated.

        Args:
            params: Dr.Jit tensors by the names of `wrf_mi.tracing.paths.scene_parameters.SlabMaterials.parameters`.
        """
        tables = self._slabs.tables(params, self._stated)[:2]  # thicknesses are constants of the meshes
        return {
            f"wall_{i}.bsdf.{name}": dr.gather(mi.Float, table, mi.UInt32(k))
            for i, k in enumerate(self._used)
            for name, table in zip(("eta_r", "sigma"), tables, strict=True)
        }


class _FieldScene:
    """A scene of Gaussians and walls, with a perception plane for each view of the receiver."""

    def __init__(self, gaussians: Gaussians, plane: TiledPlane, views: int, walls: SceneWalls | None) -> None:
        film = {"type": "hdrfilm", "width": plane.width, "height": plane.height, "rfilter": {"type": "box"}}
        sensor = {"type": "wrf_perception_plane", "film": film | {"pixel_format": "luminance"}}
        carrier = {} if walls is None else {"frequency_hz": walls.frequency_hz}
        entries: dict[str, Any] = {"integrator": {"type": "wrf_traced"} | carrier, SHAPE: gaussian_shape(gaussians)}
        entries |= {f"view_{i}": sensor for i in range(views)} | ({} if walls is None else walls.shapes)
        # Not optimised: materials with equal starting values must not be merged.
        self.scene = mi.load_dict({"type": "scene"} | entries, optimize=False)
        self.params = mi.traverse(self.scene)
        self._assigned: list[str] = []

    def render(self, values: Mapping[str, Any], views: int) -> list[Any]:
        """Images [height, width, 2] of all views with these values of parameters."""
        for name, value in values.items():
            self.params[name] = value
        self.params.update()
        self._assigned = list(values)
        return [mi.render(self.scene, self.params, sensor=i) for i in range(views)]

    def release(self) -> None:
        """Detach assigned values."""
        for name in self._assigned:
            self.params[name] = dr.detach(self.params[name])


class Traced(Evaluation):
    """Gaussians evaluated along rays by ``mi.render`` with the integrator `wrf_traced`.

    Derivatives reach Gaussians, the receiver's pose and the walls' materials. With a scene each Gaussian behind walls
    is multiplied by their transmission of a wave polarised along the world's z axis. Scenes are built by the first
    calls and whenever the number of Gaussians changes; Dr.Jit then finds each kernel compiled, but cannot record a call
    (`dr.freeze`), which builds bounding volumes anew.

    Args:
        scene: scene from `wrf_mi.tracing.open_scene`; None: no walls.
        traced: parameters of the scene that are trained.

    Raises:
        InputError: planes that training moves, or a material that is no slab.
    """

    recordable = False

    def __init__(self, scene: Any | None = None, traced: TracedConfig = DEFAULT) -> None:
        if scene is not None and traced.moves_planes:
            remedy = "set traced.shift=0 and traced.tilt=0, or evaluation=splatted"
            raise InputError(f"setting evaluation: traced walls stand where the scene has them; {remedy}")
        register_all()
        self._walls = None if scene is None else SceneWalls(scene, traced.materials)
        self._scenes: list[_FieldScene] = []
        self._form: tuple[Any, ...] = ()

    def __call__(
        self,
        gaussians: Gaussians,
        pose: Pose,
        plane: TiledPlane,
        sphere: bool,
        params: Mapping[str, Any],
    ) -> Complex:
        """Complex signal on directions, in the order of `wrf_mi.graph.evaluations.learned_field`."""
        poses = [pose, facing_down(pose)] if sphere else [pose]
        if not gaussians.count:
            pixels = gaussians.batch * len(poses) * plane.pixels
            return dr.zeros(mi.Float, pixels), dr.zeros(mi.Float, pixels)
        gaussians = gaussians.spread()
        common = {f"view_{i}.to_world": _to_world(view) for i, view in enumerate(poses)}
        if self._walls is not None:
            common |= self._walls.values(params)
        each = [
            common | {f"{SHAPE}.{name}": value for name, value in shape_parameters(gaussians, k).items()}
            for k in range(gaussians.batch)
        ]
        images = []
        for k, values in enumerate(each):
            scene = self._scene(k if dr.grad_enabled(each) else 0, gaussians, plane, len(poses))
            images += scene.render(values, len(poses))
        flat = dr.concat([image.array for image in images])
        re, im = deinterleave(flat, dr.width(flat) // 2)
        return re, im

    def release(self) -> None:
        """Detach the scenes' parameters.

        Mitsuba's calls of materials read those of all scenes, which would attach the results of another scene.
        """
        for scene in self._scenes:
            scene.release()

    def _scene(self, number: int, gaussians: Gaussians, plane: TiledPlane, views: int) -> _FieldScene:
        form = gaussians.count, gaussians.opacity is None, plane.height, plane.width, views
        if form != self._form:
            self._form, self._scenes = form, []
        while len(self._scenes) <= number:
            self._scenes.append(_FieldScene(gaussians, plane, views, self._walls))
        return self._scenes[number]


def _to_world(pose: Pose) -> Any:
    rows = [[*row, x] for row, x in zip(pose.to_world, pose.position, strict=True)]
    return mi.AffineTransform4f(mi.Matrix4f([*rows, [0, 0, 0, 1]]))
