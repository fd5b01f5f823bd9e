"""Gains of known paths by Sionna RT's field calculator, with the materials that the scene has at this moment."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..core import InputError
from ..core.angles import FloatArray, rotation_matrix
from .buffer import Legs, to_buffer
from .options import TraceOptions
from .surfaces import Surfaces

PATHS_AT_ONCE = 1 << 19
"""Paths of one call of the field calculator, which takes some 300 bytes per path and interaction."""

# The array's axes (x, y, z) in those of a Sionna RT device, whose arrays lie in y-z with boresight +x:
# array x = device y, array y = device z, array z = device x. A cyclic change, so a proper rotation.
_DEVICE_TO_ARRAY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])

UPRIGHT = (0.0, 0.0, 0.0)
"""Sionna RT's angles of a device whose antenna is polarised along the world's z axis."""


def sionna_orientation(orientation_xyzw: ArrayLike) -> tuple[float, float, float]:
    """Sionna RT's angles (alpha, beta, gamma; rad) of a device whose array has the given orientation.

    The one place that turns our arrays (x-y plane, boresight +z) into Sionna RT's (y-z plane, boresight +x).

    Args:
        orientation_xyzw: unit quaternion, array's frame to world.
    """
    device_to_world = rotation_matrix(orientation_xyzw) @ _DEVICE_TO_ARRAY
    with warnings.catch_warnings():
        # Of an array that looks straight up or down many angles are right, and any of them will do.
        warnings.filterwarnings("ignore", "Gimbal lock")
        alpha, beta, gamma = Rotation.from_matrix(device_to_world).as_euler("ZYX")
    return float(alpha), float(beta), float(gamma)


def point_array(points: FloatArray) -> Any:
    """Mitsuba's points of rows [n, 3]."""
    import mitsuba as mi

    from ..backend.device import to_vectors

    return to_vectors(points, mi.Point3f)


def field_of(
    scene: Any,
    buffer: Any,
    ends_m: tuple[FloatArray, FloatArray],
    angles: tuple[FloatArray, FloatArray],
    rays: int,
    pattern: str = "iso",
    loop_mode: Literal["symbolic", "evaluated"] = "symbolic",
) -> tuple[Any, Any]:
    """Complex gains of paths as Dr.Jit arrays, differentiable in the materials with ``loop_mode="evaluated"``.

    Args:
        scene: ``sionna.rt.Scene``.
        buffer: p paths from source to target, as `wrf_mi.trace.buffer.to_buffer` makes it; may be used again.
        ends_m: positions of sources [n, 3] and of targets [m, 3].
        angles: their orientations, as `sionna_orientation` gives them.
        rays: that were shot per source, for diffuse reflections.
        pattern: Sionna RT's name of an antenna pattern, linearly polarised along the device's z axis.
        loop_mode: Dr.Jit's; the symbolic one is faster and has no derivatives.

    Returns:
        Real and imaginary part, ``mi.Float`` of p each, without the phase of travelling.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna import rt
    from sionna.rt.path_solvers.field_calculator import FieldCalculator

    if buffer.buffer_size == 0:
        return mi.Float(), mi.Float()
    patterns = rt.PlanarArray(num_rows=1, num_cols=1, pattern=pattern, polarization="V").antenna_pattern.patterns
    calculator = FieldCalculator()
    calculator.loop_mode = loop_mode
    buffer.valid = dr.full(mi.Bool, True, buffer.buffer_size)
    done = calculator(
        wavelength=scene.wavelength,
        paths=buffer,
        samples_per_src=rays,
        diffraction=buffer.diffracting_wedges is not None,
        src_positions=point_array(ends_m[0]),
        tgt_positions=point_array(ends_m[1]),
        src_orientations=point_array(angles[0]),
        tgt_orientations=point_array(angles[1]),
        src_antenna_patterns=patterns,
        tgt_antenna_patterns=patterns,
    )
    gain = done.a[0][0]
    return gain.real, gain.imag


def path_gains(
    scene: Any,
    surfaces: Surfaces,
    legs: Legs,
    ends_m: tuple[FloatArray, FloatArray],
    angles: tuple[FloatArray, FloatArray],
    rays: int,
    pattern: str = "iso",
) -> NDArray[np.complex128]:
    """The same as a NumPy array [p], in parts of bounded memory.

    Raises:
        InputError: a gain that is not a number.
    """
    gain = np.zeros(len(legs), np.complex128)
    for start in range(0, len(legs), PATHS_AT_ONCE):
        part = slice(start, start + PATHS_AT_ONCE)
        buffer = to_buffer(legs.select(part), surfaces, valid=True)
        real, imaginary = field_of(scene, buffer, ends_m, angles, rays, pattern)
        gain[part] = real.numpy() + 1j * imaginary.numpy()
    if not np.isfinite(gain).all():
        raise InputError("gains that are not numbers: give materials constants that single precision can hold")
    return gain


@contextmanager
def scattering_materials(scene: Any, options: TraceOptions) -> Iterator[None]:
    """Let every material scatter as asked for while the block lasts."""
    able = [m for m in scene.radio_materials.values() if options.scattering and hasattr(m, "scattering_coefficient")]
    before = [material.scattering_coefficient for material in able]
    for material in able:
        material.scattering_coefficient = options.scattering_coefficient
    try:
        yield
    finally:
        for material, coefficient in zip(able, before, strict=True):
            material.scattering_coefficient = coefficient
