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

from wrf_mi.core import InputError
from wrf_mi.gaussians.blend_rays import Walls, blend_rays
from wrf_mi.gaussians.bundles import RayLists, ray_bundles
from wrf_mi.gaussians.footprint import Pose
from wrf_mi.gaussians.ray_response import ray_footprints

from .acceleration import traced_lists
from .hidden import without_hidden
from .sensor import RIGID_TOLERANCE, PerceptionPlane, pose_of
from .shape import gaussian_shape_of, interleave, read_gaussians
from .walls import find_crossings, wall_scene, wall_shapes, walls_of

KEPT = 8
"""Views (sensor and pose, with geometry) whose rays, hits and walls are kept."""

POINT_TOLERANCE_M = 1e-3
"""How far from its sensor's position a ray may pass: float32 is good to that some kilometres from the origin."""

THICKNESS = "thickness_"
"""Start of the names of properties that give the thickness of a material."""


class _Kept(OrderedDict[tuple[Any, ...], Any]):
    """The last `KEPT` values by key. A value holds the arrays whose numbers are in its key, so that none is reused."""

    def find(self, key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        if key not in self:
            self[key] = make()
            while len(self) > KEPT:
                self.popitem(last=False)
        self.move_to_end(key)
        return self[key]


@dataclass
class _Look:
    """A sensor's pose, its rays' directions in its own frame, samples a pixel, and what identifies all this."""

    pose: Pose
    direction: Any
    height: int
    width: int
    samples: int
    key: tuple[Any, ...]


class TracedField(ADIntegrator):
    """Traced evaluation of a Gaussian field (:monosp:`wrf_traced`).

    Evaluates the complex field at a receiver along each ray of its sensor: from near to far, each Gaussian adds its
    signal times its largest response on the ray, times what nearer Gaussians and walls let pass. Gaussians with an
    ``opacity`` are blended as in WRF-GS+ (alpha), those with an ``attenuation`` as in WRF-GS (product). Order, cut-off
    and low-pass are those of the splatted evaluation (`wrf_mi.gaussians.render.splat`); the footprint is exact where
    splatting projects (`wrf_mi.gaussians.ray_response`).

    The field is the scene's ``ellipsoids`` shape with the attribute ``signal``, see
    `wrf_mi_plugins.shape.gaussian_shape`; its parameters in ``mi.traverse(scene)`` have derivatives, forward and
    backward, and so has the pose of a `wrf_perception_plane`. All other shapes, but those with a ``null`` BSDF, are
    walls: each that a ray crosses before the Gaussian's strongest point on the ray multiplies it by the slab's
    transmission (ITU-R P.2040). Their materials' parameters, in scenes of Sionna RT, have derivatives too. As
    everywhere in this project the edge of a footprint and the border of a wall are jumps that derivatives do not see.

    ``mi.render`` returns a tensor [height, width, 2], the real and the imaginary part. The film then holds the
    magnitude as its picture and both parts as channels ``real`` and ``imaginary``, so that ``mitsuba scene.xml`` and
    ``sensor.film().bitmap()`` give them. Samples within a pixel are averaged as complex numbers, whatever the film's
    filter; `wrf_perception_plane` needs one and takes one.

    ======================= ======= ===== ========= ================================================== ==============
    parameter               type    unit  default   meaning                                            ``mi.traverse``
    ======================= ======= ===== ========= ================================================== ==============
    ``walls``               boolean       true      shapes other than ellipsoids attenuate
    ``frequency_hz``        float   Hz    0         carrier; 0 takes that of the walls' Sionna scene,  exposed
                                                    and is an error where walls have none
    ``polarization``        vector        vertical  of the antenna, receiver's frame; by default
                                                    the world's z axis, however the sensor is turned
    ``thickness_<name>``    float   m     0.1       slab thickness of a material ``mat-<name>`` that
                                                    is known by its BSDF's id alone, e.g.
                                                    ``thickness_itu_glass``
    ``opaque_power``        float         0         Gaussians behind walls that pass at most this
                                                    share of the power are left out; 0: none
    ======================= ======= ===== ========= ================================================== ==============

    .. code-block:: python

        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "wrf_traced", "frequency_hz": 920e6},
            "sensor": {"type": "wrf_perception_plane", "film": {"type": "hdrfilm", "width": 360, "height": 90}},
            "gaussians": gaussian_shape(gaussians),
        })
        image = mi.render(scene)

    With ``opaque_power`` p no pixel's field changes by more than sqrt(p) M, M the largest abs(signal) (alpha blending)
    or the sum of all (product blending), nor a derivative by a signal by more than sqrt(p) (`wrf_mi_plugins.hidden`).

    The rays' hits are found by Mitsuba's ray tracing (`wrf_mi_plugins.acceleration`) and kept: a render after which
    only signals, opacities or attenuations changed traces nothing. Sensors must be points: `wrf_perception_plane`,
    ``perspective`` and the like.

    Raises:
        InputError: in `render`, a scene without Gaussians or with several shapes of them, a wall without a radio
            material, a sensor that is no point.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.with_walls = bool(props.get("walls", True))
        self.frequency_hz = mi.Float(float(props.get("frequency_hz", 0.0)))
        self.opaque_power = float(props.get("opaque_power", 0.0))
        if not 0 <= self.opaque_power < 1:
            raise InputError(f"{props.plugin_name()}: opaque_power {self.opaque_power}; give a share from 0 to below 1")
        stated = props.get("polarization")
        self.polarization = None if stated is None else [float(c) for c in stated]
        self.thickness_m = {n.removeprefix(THICKNESS): float(props[n]) for n in props if n.startswith(THICKNESS)}
        if self.polarization is not None and not (np.isfinite(self.polarization).all() and np.any(self.polarization)):
            raise InputError(f"{props.plugin_name()}: polarization {self.polarization} is no direction")
        self._bundles, self._crossings, self._lists, self._wall_scenes = (_Kept() for _ in range(4))

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
            image = self._image(scene, sensor, seed, spp)
            _put(sensor.film(), image)
            if evaluate:
                dr.eval(image)
        return image

    def render_forward(
        self, scene: mi.Scene, params: Any, sensor: int | mi.Sensor = 0, seed: Any = 0, spp: int = 0
    ) -> mi.TensorXf:
        """Derivative of the image along the gradients of the scene's parameters, [height, width, 2]."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        image = self._image(scene, sensor, seed, spp)
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
        """Add to the gradients of the scene's parameters that of the image, [height, width, 2]."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        image = self._image(scene, sensor, seed, spp)
        dr.backward_from(image * grad_in)

    def aov_names(self) -> list[str]:
        """Channels of the film beside the magnitude."""
        return ["real", "imaginary"]

    def traverse(self, callback: Any) -> None:
        """Expose the carrier frequency."""
        callback.put("frequency_hz", self.frequency_hz, mi.ParamFlags.NonDifferentiable)

    def to_string(self) -> str:
        """Class and parameters."""
        return f"TracedField[walls = {self.with_walls}, frequency_hz = {self.frequency_hz[0]:g}]"

    def _image(self, scene: Any, sensor: Any, seed: Any, spp: int) -> Any:
        shape = gaussian_shape_of(scene)
        gaussians, data = read_gaussians(shape), dr.detach(mi.traverse(shape)["data"])
        look = self._look(sensor, scene, seed, spp)
        footprints = ray_footprints(gaussians, look.pose)
        bundles = self._bundles.find(
            look.key, lambda: (ray_bundles(look.direction, look.height, look.width * look.samples), look.direction)
        )[0]
        lists = self._lists.find(
            (data.index, *look.key), lambda: (_lists(gaussians, footprints, look.pose, bundles), data, look.direction)
        )[0]
        walls = self._walls(scene, look) if self.with_walls else None
        if walls is not None and self.opaque_power:
            lists = without_hidden(lists, bundles, gaussians, footprints, walls, self.opaque_power)
        parts = blend_rays(
            footprints, gaussians.signal, lists, bundles, gaussians.opacity, gaussians.attenuation, walls
        )
        if look.samples > 1:
            parts = tuple(dr.block_sum(p, look.samples) / look.samples for p in parts)
        return mi.TensorXf(interleave(list(parts)), (look.height, look.width, 2))

    def _look(self, sensor: Any, scene: Any, seed: Any, spp: int) -> _Look:
        film = sensor.film()
        frame = tuple(int(s) for pair in (film.size(), film.crop_size(), film.crop_offset()) for s in pair)
        width, height = frame[2:4]
        if isinstance(sensor, PerceptionPlane):
            place = np.array(dr.detach(sensor.to_world).matrix).tobytes()
            key = (sensor.coverage, *frame, place)
            return _Look(sensor.pose(), sensor.crop_directions(), height, width, 1, key)
        with dr.suspend_grad():
            sampler, samples = self.prepare(sensor, seed, spp, self.aov_names())
            ray, _, _ = self.sample_rays(scene, sensor, sampler)
            pose = pose_of(sensor.world_transform())
            start, d = ray.o - mi.Point3f(*pose.position), mi.Vector3f(ray.d)
            local = mi.Vector3f(*pose.to_local(list(d)))
            off = dr.max(dr.squared_norm(dr.cross(start, d)))
            dr.eval(local, off)
        if not (float(off[0]) < POINT_TOLERANCE_M**2 and _unit(local)):
            raise InputError(f"sensor {sensor.id()}: its rays do not start at one point, or its pose is not rigid")
        place = np.array(dr.detach(sensor.world_transform()).matrix).tobytes()
        return _Look(pose, local, height, width, samples, (*frame, place, *(c.index for c in local)))

    def _walls(self, scene: Any, look: _Look) -> Walls | None:
        shapes = wall_shapes(scene)
        if not shapes:
            return None
        key, arrays = _fingerprint(shapes)
        frequency_hz = self._frequency(shapes)
        walls_alone = self._wall_scenes.find(key, lambda: (wall_scene(shapes), arrays))[0]
        crossings = self._crossings.find(
            (*key, *look.key),
            lambda: (
                find_crossings(walls_alone, shapes, look.pose, look.direction, self.polarization),
                arrays,
                look.direction,
            ),
        )[0]
        return walls_of(crossings, shapes, frequency_hz, self.thickness_m)

    def _frequency(self, shapes: list[Any]) -> Any:
        if self.frequency_hz[0] > 0:
            return self.frequency_hz
        scenes = [getattr(shape.bsdf(), "scene", None) for shape in shapes]
        own = next((s.frequency for s in scenes if s is not None), None)
        if own is None:
            raise InputError("wrf_traced: the scene has walls; give frequency_hz, or set walls to false")
        return mi.Float(own)


def _lists(*arguments: Any) -> RayLists:
    with dr.suspend_grad():
        return traced_lists(*arguments)


def _unit(v: Any) -> bool:
    return bool(dr.all(dr.abs(dr.squared_norm(v) - 1) < RIGID_TOLERANCE))


def _fingerprint(shapes: list[Any]) -> tuple[tuple[Any, ...], list[Any]]:
    """What changes when one of these shapes changes, and the arrays to hold so that it does."""
    key: list[Any] = []
    arrays = []
    for shape in shapes:
        for name, value in mi.traverse(shape).items():
            if name.startswith("bsdf."):
                continue
            key.append(value.index if isinstance(value, mi.Float | mi.UInt32) else repr(value))
            arrays.append(dr.detach(value) if isinstance(value, mi.Float | mi.UInt32) else None)
    return tuple(key), arrays


def _put(film: Any, image: Any) -> None:
    """The image in the film: its magnitude as the picture, its parts as channels."""
    film.prepare(["real", "imaginary"])
    re, im = image[:, :, 0].array, image[:, :, 1].array
    size = dr.sqrt(re * re + im * im)
    one = dr.full(mi.Float, 1, dr.width(size))
    channels = [size, size, size] + [one] * (2 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 1) + [re, im]
    tensor = mi.TensorXf(interleave(channels), (*image.shape[:2], len(channels)))
    film.put_block(mi.ImageBlock(tensor, mi.ScalarPoint2i(film.crop_offset())))


def register() -> None:
    """Make the integrator known to Mitsuba."""
    mi.register_integrator("wrf_traced", TracedField)
