"""Gaussians of all kinds for the traced evaluation, scenes of them, and what a ray meets of them in float64 NumPy."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from made_fields import device_gaussians
from wrf_mi_bench import field_oracle as oracle
from wrf_mi_plugins.blend_rays import Walls, blend_rays
from wrf_mi_plugins.bundles import all_lists, ray_bundles
from wrf_mi_plugins.ray_response import ray_footprints
from wrf_mi_plugins.sensor import receiver_to_world
from wrf_mi_plugins.shape import gaussian_shape

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Float64, Pose
from wrf_mi.core import Receiver, rotation_matrix, unit_vectors
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M, depth_order

QUATERNION = np.array([0.51291602, -0.48674136, -0.48674136, 0.51291602])
RECEIVER = Receiver("receiver", np.array([0.3, -1.2, 2.0]), QUATERNION)


def any_field(count: int, seed: int = 0, size: float = 0.25) -> dict[str, np.ndarray]:
    """Needles, discs and balls all around the receiver, near and far, some that contain it, some nearer than 5 cm."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((count, 3))
    distance = np.exp(rng.uniform(np.log(0.03), np.log(8), count))
    direction *= (distance / np.linalg.norm(direction, axis=1))[:, None]
    # One on the zenith and one across the azimuth seam.
    direction[0], direction[1] = RECEIVER.to_world @ [0, 0, 3.0], RECEIVER.to_world @ (2 * unit_vectors(0.0, 0.2))
    distance[:2] = 3.0, 2.0
    scale = size * np.maximum(distance, 0.3)[:, None] * np.exp(rng.normal(-0.5, 0.8, (count, 3)))
    delta = rng.uniform(0, 0.95, count) * np.exp(1j * rng.uniform(0, 2 * np.pi, count))
    return {
        "position": RECEIVER.position_m + direction,
        "scale": scale,
        "rotation": rng.standard_normal((count, 4)),
        "signal": rng.standard_normal((count, 2)),
        "opacity": rng.uniform(0, 0.9, (count, 1)),
        "attenuation": np.stack([delta.real, delta.imag], axis=1),
    }


def seen(field: dict[str, np.ndarray], directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By the definition, no tangent plane: Gaussians near to far, and for each and each direction [..., 3] of the
    receiver's frame its largest response on the ray (zero beyond the cut-off) and where on the ray that is."""
    offset = field["position"] - RECEIVER.position_m
    depth = np.linalg.norm(offset, axis=1)
    x, y, z = field["position"].T
    order = np.lexsort((z, y, x, depth))
    order = order[depth[order] >= NEAR_M]
    world = directions @ RECEIVER.to_world.T
    responses, peaks = [], []
    for i in order:
        scale = np.sqrt(field["scale"][i] ** 2 + (LOW_PASS_RAD * depth[i]) ** 2)
        whiten = rotation_matrix(field["rotation"][i]).T / scale[:, None]
        start, along = -whiten @ offset[i], world @ whiten.T
        t = np.maximum(-(along @ start) / (along**2).sum(-1), 0)
        square = ((start + t[..., None] * along) ** 2).sum(-1)
        inside = (square < CUTOFF**2) & (world @ offset[i] / depth[i] > MIN_COSINE)
        responses.append(np.where(inside, np.exp(-square / 2), 0))
        peaks.append(t)
    return order, np.array(responses), np.array(peaks)


def blended(field: dict[str, np.ndarray], blending: str, directions: np.ndarray) -> Any:
    """The field along each ray, without walls."""
    order, responses, _ = seen(field, directions)
    signal, delta = (field[name][order] @ [1, 1j] for name in ("signal", "attenuation"))
    if blending == "alpha":
        return oracle.blend_alpha(responses, signal, field["opacity"][order, 0])
    return oracle.blend_product(responses, signal, delta)


def gaussians_of(field: dict[str, np.ndarray], blending: str, float_type: Any = Float64) -> Gaussians:
    geometry: dict[str, Any] = {name: field[name].T for name in ("position", "scale", "rotation")}
    blend: dict[str, Any] = {"opacity": field["opacity"][:, 0]}
    if blending == "product":
        blend = {"attenuation": field["attenuation"] @ [1, 1j]}
    return device_gaussians(float_type, **geometry, signal=field["signal"] @ [1, 1j], **blend)


def pose_of(float_type: Any = Float64) -> Pose:
    position, *axes = (
        [dr.opaque(float_type, float(x)) for x in row] for row in (RECEIVER.position_m, *RECEIVER.to_world)
    )
    return Pose(position, axes)


def bundles_of(directions: np.ndarray, float_type: Any = Float64) -> Any:
    return ray_bundles([on_device(c, float_type) for c in directions.reshape(-1, 3).T], *directions.shape[:2])


def brute(gaussians: Gaussians, pose: Pose, bundles: Any, walls: Walls | None = None, footprints: Any = None) -> Any:
    """Real and imaginary part along the rays, with lists that hold every Gaussian."""
    footprints = footprints or ray_footprints(gaussians, pose)
    lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
    return blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending, walls)


def film(height: int, width: int, **more: Any) -> dict[str, Any]:
    box = {"type": "box"}
    return {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance", "rfilter": box, **more}


def plane(height: int = 12, width: int = 40, crop: dict[str, int] | None = None, **more: Any) -> dict[str, Any]:
    """The sensor of `RECEIVER`."""
    to_world = receiver_to_world(RECEIVER.position_m, RECEIVER.orientation_xyzw)
    return {"type": "wrf_perception_plane", "to_world": to_world, "film": film(height, width, **crop or {}), **more}


def scene_of(field: Gaussians, **more: Any) -> Any:
    shape = {"gaussians": gaussian_shape(field)}
    return mi.load_dict({"type": "scene", "integrator": {"type": "wrf_traced"}, "sensor": plane()} | shape | more)


def complex_image(tensor: Any) -> np.ndarray:
    return np.asarray(tensor.numpy(), float) @ np.array([1, 1j])
