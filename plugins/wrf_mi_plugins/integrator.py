"""The plugin `wrf_traced`: a Gaussian field evaluated along the rays of a sensor."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba.python.ad.integrators.common import ADIntegrator

from wrf_mi.backend.vectors import Pose
from wrf_mi.core import InputError

from .acceleration import traced_lists
from .blend_rays import Walls, blend_rays
from .bundles import RayLists, ray_bundles
from .ray_response import ray_footprints
from .sensor import RIGID_TOLERANCE, PerceptionPlane, pose_of
from .shape import gaussian_shape_of, interleave, read_gaussians
from .walls import find_crossings, wall_scene, wall_shapes, walls_of

KEPT = 8
"""Number of views (sensor and pose, with geometry) whose rays, hits and walls are kept."""

POINT_TOLERANCE_M = 1e-3
"""Largest distance of a ray from its sensor's position: the rounding of float32 some kilometres from the origin."""

THICKNESS = "thickness_"
"""Prefix of properties with the thickness of a material."""


class _Cache(OrderedDict[tuple[Any, ...], Any]):
    """The last `KEPT` values by key, with the arrays whose indices are in the key, so that Dr.Jit reuses none."""

    def find(self, key: tuple[Any, ...], make: Callable[[], Any], *arrays: Any) -> Any:
        if key not in self:
            self[key] = make(), arrays
            while len(self) > KEPT:
                self.popitem(last=False)
        self.move_to_end(key)
        return self[key][0]


@dataclass
class _View:
    """A sensor's pose, its rays' directions in its frame, samples per pixel, and a key of all of them."""

    pose: Pose
    direction: Any
    height: int
    width: int
    samples: int
    key: tuple[Any, ...]


class TracedField(ADIntegrator):
    """Traced evaluation of a Gaussian field (:monosp:`wrf_traced`).

    Evaluates the complex field at a receiver along each ray of its sensor: from near to far, each Gaussian adds its
    signal times its largest response on the ray, times the transmission of nearer Gaussians and walls. Gaussians with
    an ``opacity`` are blended as in WRF-GS+ (alpha), those with an ``attenuation`` as in WRF-GS (product). Order,
    cut-off and low-pass are those of the splatted evaluation (`wrf_mi.gaussians.blend.splat`); the footprint is
    exact where splatting projects (`wrf_mi_plugins.ray_response`).

    The field is the scene's ``ellipsoids`` shape with the attribute ``signal``, see
    `wrf_mi_plugins.shape.gaussian_shape`; its parameters in ``mi.traverse(scene)`` have derivatives, forward and
    backward, and so has the pose of a `wrf_perception_plane`. All other shapes, but those with a ``null`` BSDF, are
    walls: each that a ray crosses before the Gaussian's strongest point on the ray multiplies it by the slab's
    transmission (ITU-R P.2040). Their materials' parameters, in scenes of Sionna RT, have derivatives too. The
    edge of a footprint and the border of a wall are jumps that derivatives ignore.

    ``mi.render`` returns a tensor [height, width, 2], the real and the imaginary part. The film then holds the
    magnitude as its picture and both parts as channels ``real`` and ``imaginary``, so that ``mitsuba scene.xml`` and
    ``sensor.film().bitmap()`` give them. Samples within a pixel are averaged as complex numbers, whatever the film's
    filter; `wrf_perception_plane` takes one sample.

    ==================== ======= ==== ======= =======================================================================
    parameter            type    unit default meaning
    ==================== ======= ==== ======= =======================================================================
    ``walls``            boolean      true    shapes other than ellipsoids attenuate
    ``frequency_hz``     float   Hz   0       carrier (in ``mi.traverse``); 0: that of the walls' Sionna RT scene
    ``polarization``     vector       z axis  direction of the antenna, receiver's frame; default: the world's z axis
    ``thickness_<name>`` float   m    0.1     slab thickness of a material ``mat-<name>`` known by its BSDF's id alone
    ==================== ======= ==== ======= =======================================================================

    The rays' hits are found by Mitsuba's ray tracing (`wrf_mi_plugins.acceleration`) and kept: a render after which
    only signals, opacities or attenuations changed traces nothing. Sensors must be points: `wrf_perception_plane`,
    ``perspective`` and the like.

    Raises:
        InputError: in `render`, a scene without Gaussians or with several shapes of them, a wall without a radio
            material, a sensor that is no point.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.with_walls = bool(props.get("walls", True))
        self.frequency_hz = mi.Float(float(props.get("frequency_hz", 0.0)))
        polarization = props.get("polarization")
        self.polarization = None if polarization is None else [float(c) for c in polarization]
        self.thickness_m = {n.removeprefix(THICKNESS): float(props[n]) for n in props if n.startswith(THICKNESS)}
        if self.polarization is not None and not (np.isfinite(self.polarization).all() and np.any(self.polarization)):
            raise InputError(f"{props.plugin_name()}: polarization {self.polarization} is no direction")
        self._bundles, self._crossings, self._lists, self._wall_scenes = (_Cache() for _ in range(4))

    def sample(self, scene: mi.Scene, sensor: int | mi.Sensor, seed: Any, spp: int) -> Any:
        """The field of each pixel, a tensor [height, width, 2], attached to the scene's parameters.

        Rays, hits and walls of a view are kept; blending alone is repeated when signals change.
        """
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        shape = gaussian_shape_of(scene)
        gaussians, data = read_gaussians(shape), dr.detach(mi.traverse(shape)["data"])
        view = self._view(sensor, scene, seed, spp)
        footprints = ray_footprints(gaussians, view.pose)
        bundles = self._bundles.find(
            view.key, lambda: ray_bundles(view.direction, view.height, view.width * view.samples), view.direction
        )

        def lists_of_view() -> RayLists:
            with dr.suspend_grad():
                return traced_lists(gaussians, footprints, view.pose, bundles)

        lists = self._lists.find((data.index, *view.key), lists_of_view, data, view.direction)
        walls = self._walls(scene, view) if self.with_walls else None
        parts = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending, walls)
        if view.samples > 1:
            parts = tuple(dr.block_sum(p, view.samples) / view.samples for p in parts)
        return mi.TensorXf(interleave(list(parts)), (view.height, view.width, 2))

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """The field of each pixel, a tensor [height, width, 2]. See `mi.Integrator.render`."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        with dr.suspend_grad():
            image = self.sample(scene, sensor, seed, spp)
            _write_film(sensor.film(), image)
            if evaluate:
                dr.eval(image)
        return image

    def render_forward(
        self, scene: mi.Scene, params: Any, sensor: int | mi.Sensor = 0, seed: Any = 0, spp: int = 0
    ) -> mi.TensorXf:
        """Derivative of the image along the gradients of the scene's parameters, [height, width, 2]."""
        image = self.sample(scene, sensor, seed, spp)
        dr.forward_to(image)
        return dr.grad(image)

    def render_backward(
        self,
        scene: mi.Scene,
        params: Any,
        grad_in: mi.TensorXf,
        sensor: int | mi.Sensor = 0,
        seed: Any = 0,
        spp: int = 0,
    ) -> None:
        """Add the gradient of the image, [height, width, 2], to the gradients of the scene's parameters."""
        dr.backward_from(self.sample(scene, sensor, seed, spp) * grad_in)

    def aov_names(self) -> list[str]:
        """Channels of the film beside the magnitude."""
        return ["real", "imaginary"]

    def traverse(self, callback: Any) -> None:
        """Expose the carrier frequency."""
        callback.put("frequency_hz", self.frequency_hz, mi.ParamFlags.NonDifferentiable)

    def to_string(self) -> str:
        """Class and parameters."""
        return f"TracedField[walls = {self.with_walls}, frequency_hz = {self.frequency_hz[0]:g}]"

    def _view(self, sensor: Any, scene: Any, seed: Any, spp: int) -> _View:
        film = sensor.film()
        frame = tuple(int(s) for pair in (film.size(), film.crop_size(), film.crop_offset()) for s in pair)
        width, height = frame[2:4]
        if isinstance(sensor, PerceptionPlane):
            matrix = np.array(dr.detach(sensor.to_world).matrix).tobytes()
            return _View(sensor.pose(), sensor.crop_directions(), height, width, 1, (sensor.coverage, *frame, matrix))
        with dr.suspend_grad():
            sampler, samples = self.prepare(sensor, seed, spp, self.aov_names())
            ray, _, _ = self.sample_rays(scene, sensor, sampler)
            pose = pose_of(sensor.world_transform())
            start, d = ray.o - mi.Point3f(*pose.position), mi.Vector3f(ray.d)
            local = mi.Vector3f(*pose.to_local(list(d)))
            off = dr.max(dr.squared_norm(dr.cross(start, d)))
            dr.eval(local, off)
        rigid = dr.all(dr.abs(dr.squared_norm(local) - 1) < RIGID_TOLERANCE)
        if not (float(off[0]) < POINT_TOLERANCE_M**2 and rigid):
            raise InputError(f"sensor {sensor.id()}: its rays do not start at one point, or its pose is not rigid")
        matrix = np.array(dr.detach(sensor.world_transform()).matrix).tobytes()
        return _View(pose, local, height, width, samples, (*frame, matrix, *(c.index for c in local)))

    def _walls(self, scene: Any, view: _View) -> Walls | None:
        shapes = wall_shapes(scene)
        if not shapes:
            return None
        key, arrays = _fingerprint(shapes)
        frequency_hz = self._frequency(shapes)
        only_walls = self._wall_scenes.find(key, lambda: wall_scene(shapes), arrays)
        crossings = self._crossings.find(
            (*key, *view.key),
            lambda: find_crossings(only_walls, shapes, view.pose, view.direction, self.polarization),
            arrays,
            view.direction,
        )
        return walls_of(crossings, shapes, frequency_hz, self.thickness_m)

    def _frequency(self, shapes: list[Any]) -> Any:
        if self.frequency_hz[0] > 0:
            return self.frequency_hz
        scenes = [getattr(shape.bsdf(), "scene", None) for shape in shapes]
        carrier = next((s.frequency for s in scenes if s is not None), None)
        if carrier is None:
            raise InputError("wrf_traced: the scene has walls; give frequency_hz, or set walls to false")
        return mi.Float(carrier)


def _fingerprint(shapes: list[Any]) -> tuple[tuple[Any, ...], list[Any]]:
    """A key that changes with any of these shapes, and the arrays whose numbers are in it."""
    key: list[Any] = []
    arrays = []
    for shape in shapes:
        for name, value in mi.traverse(shape).items():
            if name.startswith("bsdf."):
                continue
            is_array = isinstance(value, mi.Float | mi.UInt32)
            key.append(value.index if is_array else repr(value))
            if is_array:
                arrays.append(dr.detach(value))
    return tuple(key), arrays


def _write_film(film: Any, image: Any) -> None:
    """Write the magnitude of an image as the film's picture and its parts as channels."""
    film.prepare(["real", "imaginary"])
    re, im = image[:, :, 0].array, image[:, :, 1].array
    size = dr.sqrt(re * re + im * im)
    unit = dr.full(mi.Float, 1, dr.width(size))
    channels = [size, size, size] + [unit] * (2 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 1) + [re, im]
    tensor = mi.TensorXf(interleave(channels), (*image.shape[:2], len(channels)))
    film.put_block(mi.ImageBlock(tensor, mi.ScalarPoint2i(film.crop_offset())))  # type: ignore[call-overload]


def register() -> None:
    """Make the integrator known to Mitsuba."""
    mi.register_integrator("wrf_traced", TracedField)
