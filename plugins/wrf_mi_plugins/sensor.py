"""The plugin `wrf_perception_plane`: directions around a receiver as a Mitsuba sensor."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from wrf_mi.backend.device import to_vectors
from wrf_mi.backend.vectors import Pose
from wrf_mi.core import InputError, pixel_directions, rotation_matrix
from wrf_mi.core.angles import UNIT_QUATERNION_TOLERANCE, FloatArray, azimuth_rad, unit_vectors


def equirectangular_sphere(height: int, width: int) -> FloatArray:
    """Unit vector of every pixel of an equirectangular grid over the full sphere, shape [height, width, 3].

    Row r lies at ``-90 + r * 180 / height`` degrees, so no row at the zenith; azimuths rise from 0 (column 0).
    """
    elevation = np.arange(height, dtype=float) * (np.pi / height) - np.pi / 2
    return unit_vectors(azimuth_rad(width)[None, :], elevation[:, None])


DIRECTIONS = {"hemisphere": pixel_directions, "sphere": equirectangular_sphere}
"""Functions of (height, width) for the unit vectors of all pixels."""

RIGID_TOLERANCE = 1e-4
"""Largest departure of R^T R from the identity: rotations in float32 and in files of five digits are nearer."""


class PerceptionPlane(mi.Sensor):
    """A receiver's perception plane (:monosp:`wrf_perception_plane`).

    Equirectangular. Pixel (row r, column c) of an H x W film is the *point* at azimuth ``c * 360 / W`` degrees and
    elevation ``r * 90 / H`` degrees (``hemisphere``) or ``-90 + r * 180 / H`` degrees (``sphere``) in the receiver's
    frame, azimuth from +x towards +y, elevation from the x-y plane towards the boresight +z. A pixel has one ray
    through that point for all its samples, so more than one sample per pixel has no effect where nothing scatters. Row
    0 is the film's first.

    ============ ========= ====== =========== ======================================== ========================
    parameter    type      unit   default     meaning                                  ``mi.traverse``
    ============ ========= ====== =========== ======================================== ========================
    ``to_world`` transform m      identity    receiver's frame to world, rigid         exposed, differentiable,
                                                                                       discontinuous
    ``coverage`` string           hemisphere  ``hemisphere`` or ``sphere``
    ``film``     film      pixels 768 x 576   its size is W and H; crops work          ``film.size`` and so on
    ``sampler``  sampler          independent Mitsuba's
    ============ ========= ====== =========== ======================================== ========================

    A box filter keeps pixels apart; Mitsuba's default would blend neighbours.

    The pose of a receiver from its position and quaternion is `receiver_to_world`.

    Raises:
        InputError: an unknown ``coverage``, or a ``to_world`` that is not a rotation and a translation.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.coverage = str(props.get("coverage", "hemisphere"))
        if self.coverage not in DIRECTIONS:
            raise InputError(f"{props.plugin_name()}: coverage {self.coverage!r} is none of {', '.join(DIRECTIONS)}")
        self.to_world = mi.AffineTransform4f(self.m_to_world)
        _check_rigid(props.plugin_name(), self.to_world)
        self._size: tuple[int, int] | None = None
        self.m_needs_sample_2, self.m_needs_sample_3 = True, False

    def directions(self) -> Any:
        """Unit vectors of all the film's pixels, row-major, receiver's frame: ``mi.Vector3f`` [H * W]."""
        width, height = (int(s) for s in self.film().size())
        if self._size != (height, width):
            table = DIRECTIONS[self.coverage](height, width).reshape(-1, 3)
            self._table = to_vectors(table, mi.Vector3f)
            dr.eval(self._table)
            self._size = height, width
        return self._table

    def crop_directions(self) -> Any:
        """Unit vectors of the pixels of the film's crop, which are rendered."""
        film = self.film()
        crop = film.crop_size()
        if list(crop) == list(film.size()):
            return self.directions()
        number = dr.arange(mi.UInt32, int(crop[0]) * int(crop[1]))
        return self._direction(number // int(crop[0]), number % int(crop[0]))

    def _direction(self, row: Any, column: Any, active: Any = True) -> Any:
        """Unit vectors of pixels of the crop."""
        film = self.film()
        x, y = (int(o) for o in film.crop_offset())
        return dr.gather(mi.Vector3f, self.directions(), (row + y) * int(film.size()[0]) + column + x, active)

    def pose(self) -> Pose:
        """The receiver's pose, attached to ``to_world`` for derivatives."""
        return pose_of(self.to_world)

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """The ray of the pixel that contains ``sample2``, in 0..1 across the film's crop."""
        crop = self.film().crop_size()
        column, row = (dr.minimum(mi.UInt32(sample2[k] * int(crop[k])), int(crop[k]) - 1) for k in range(2))
        local = self._direction(row, column, active)
        wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        ray: Any = mi.Ray3f(self.to_world.translation(), self.to_world @ local, time, wavelengths)  # type: ignore[call-overload]
        return ray, weight

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The ray of `sample_ray`; a point has no differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Empty box: the sensor is a point and does not extend the scene."""
        return mi.ScalarBoundingBox3f()

    def traverse(self, callback: Any) -> None:
        """Expose ``to_world`` in addition to the base class's parameters."""
        super().traverse(callback)
        callback.put("to_world", self.to_world, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Check and adopt a new pose.

        Raises:
            InputError: it is not rigid.
        """
        super().parameters_changed(keys)
        _check_rigid(self.class_name(), self.to_world)
        self.m_to_world = self.to_world

    def to_string(self) -> str:
        """Class, size and pose."""
        width, height = self.film().size()
        return f"PerceptionPlane[size = {width} x {height}, coverage = {self.coverage}, to_world = {self.to_world}]"


def receiver_to_world(position_m: ArrayLike, orientation_xyzw: ArrayLike) -> mi.ScalarTransform4f:
    """Transform ``to_world`` of a receiver.

    Args:
        position_m: position [3], world frame, metres.
        orientation_xyzw: unit quaternion [4], receiver's frame to world.

    Raises:
        InputError: another shape, a number that is not finite, or a quaternion that is not of unit length.
    """
    position, quaternion = np.asarray(position_m, float), np.asarray(orientation_xyzw, float)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise InputError(f"position_m: expected three finite coordinates in metres, got {position_m!r}")
    if quaternion.shape != (4,) or not abs(np.linalg.norm(quaternion) - 1) < UNIT_QUATERNION_TOLERANCE:
        raise InputError(f"orientation_xyzw: expected a unit quaternion x, y, z, w, got {orientation_xyzw!r}")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(quaternion), position
    return mi.ScalarTransform4f(matrix.tolist())


def pose_of(to_world: Any) -> Pose:
    """Pose of a rigid ``mi.AffineTransform4f``, attached to its matrix."""
    m = to_world.matrix
    # As constants each pose would compile a new kernel.
    dr.make_opaque(m)
    return Pose([mi.Float(m[i, 3]) for i in range(3)], [[mi.Float(m[i, j]) for j in range(3)] for i in range(3)])


def _check_rigid(name: str, to_world: Any) -> None:
    turn: FloatArray = np.array(dr.detach(to_world).matrix, float).reshape(4, 4)[:3, :3]
    if not (np.abs(turn.T @ turn - np.eye(3)).max() < RIGID_TOLERANCE and np.linalg.det(turn) > 0):
        raise InputError(f"{name}: to_world is not a rotation and a translation; a receiver has no scale and no mirror")


def register() -> None:
    """Make the sensor known to Mitsuba."""
    mi.register_sensor("wrf_perception_plane", PerceptionPlane)
