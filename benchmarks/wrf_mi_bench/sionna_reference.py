"""Paths of Sionna RT's own solver, as a reference."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from wrf_mi.core import Paths
from wrf_mi.core.types import FloatArray, IntArray
from wrf_mi.tracing import TraceOptions

MOST_PATHS = 100_000  # least room for the paths of a transmitter; Sionna RT drops paths beyond it silently


def sionna_paths(
    scene: Any,
    tx_m: ArrayLike,
    rx_m: ArrayLike,
    options: TraceOptions,
    polarization: str = "V",
    pattern: str = "iso",
    turn_rad: Sequence[float] = (0, 0, 0),
) -> tuple[IntArray, NDArray[np.complex128], FloatArray, FloatArray]:
    """Paths from isotropic transmitters [n, 3] or [3] to a receiver [3] with a pattern, turned by yaw, pitch and roll.

    Returns:
        Of p paths: row of the transmitter, gain without the phase exp(-j k length), length in metres from Sionna RT's
        delay in single precision, and point of the first interaction [p, 3], NaN for none.
    """
    import mitsuba as mi
    from sionna import rt

    assert isinstance(options.rays, int), "a number of rays, not auto"
    rays = options.rays
    array_options: dict[str, Any] = {"num_rows": 1, "num_cols": 1, "polarization": polarization}
    scene.tx_array, scene.rx_array = (
        rt.PlanarArray(pattern="iso", **array_options),
        rt.PlanarArray(pattern=pattern, **array_options),
    )
    places = np.atleast_2d(np.asarray(tx_m, float))
    names = [f"tx{row}" for row in range(len(places))]
    rx, turn = (mi.Point3f(*np.asarray(values, float).tolist()) for values in (rx_m, turn_rad))
    for name, place in zip(names, places.tolist(), strict=True):
        scene.add(rt.Transmitter(name, mi.Point3f(*place)))
    scene.add(rt.Receiver("rx", rx, orientation=turn))
    try:
        paths = rt.PathSolver(deterministic=True)(
            scene,
            max_depth=options.depth,
            los=options.line_of_sight,
            specular_reflection=options.reflection,
            diffuse_reflection=options.scattering,
            refraction=options.transmission,
            diffraction=options.diffraction,
            edge_diffraction=options.diffraction,
            samples_per_src=rays,
            max_num_paths_per_src=max(MOST_PATHS, rays * options.depth),
            seed=options.seed,
        )
    finally:
        scene.remove([*names, "rx"])
    traced = as_paths(paths)
    point = traced.vertices_m[:, 0] if options.depth else np.full((len(traced), 3), np.nan)
    return traced.tx, traced.gain, traced.length_m, point


def as_paths(solved: Any) -> Paths:
    """Paths of single antennas from a ``sionna.rt.Paths``, without their directions and surfaces.

    Gains have no phase exp(-j k length), and lengths are from delays in single precision.
    """
    rx, tx, path = which = np.nonzero(solved.valid.numpy())
    real, imaginary = (part.numpy()[:, 0, :, 0] for part in solved.a)
    kinds = np.moveaxis(solved.interactions.numpy(), 0, -1)[which].astype(np.uint8)
    points = np.moveaxis(solved.vertices.numpy(), 0, -2)[which].astype(float)
    points[kinds == 0] = np.nan
    gain, length = (real + 1j * imaginary)[which], solved.tau.numpy()[which].astype(float) * speed_of_light
    aside, counts = np.full((len(path), 3), np.nan), reversed(solved.valid.shape[:2])
    return Paths(tx, rx, gain, length, aside, aside, kinds, points, np.full(kinds.shape, -1, np.int32), (), *counts)
