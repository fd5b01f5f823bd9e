"""Specular paths by Sionna RT, as plain arrays with lengths in float64."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from .. import backend
from ..core import InputError, Receiver
from ..core.angles import FloatArray, rotation_matrix
from ..core.types import IntArray
from .materials import set_frequency

RAYS_PER_SOURCE = 10_000
"""Rays that search for reflections from each transmitter: 98 % of the paths that 1e6 find in a furnished room."""
RAYS_AT_ONCE = 500_000
"""Rays of one call of the solver; more transmitters are traced in turn, which bounds the memory."""

# The array's axes (x, y, z) in those of a Sionna RT device, whose arrays lie in y-z with boresight +x:
# array x = device y, array y = device z, array z = device x. A cyclic change, so a proper rotation.
_DEVICE_TO_ARRAY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class SpecularPaths:
    """Line-of-sight and specularly reflected (or straight transmitted) paths to one receiver; p paths in all.

    Attributes:
        transmitter: which transmitter each path begins at, shape [p], ascending.
        gain: complex, shape [p]: amplitude with free-space loss, reflections and antenna patterns, without the phase
            exp(-j k length) of travelling.
        length_m: unfolded length, shape [p], metres.
        direction: unit vector from the receiver to where the wave comes from, world frame, shape [p, 3].
        bounces: number of interactions, shape [p].
        n_transmitters: number of transmitters traced, with or without a path.
    """

    transmitter: IntArray
    gain: NDArray[np.complex128]
    length_m: FloatArray
    direction: FloatArray
    bounces: IntArray
    n_transmitters: int


def open_scene(xml: str | Path, frequency_hz: float, thickness_m: Mapping[str, float] | None = None) -> Any:
    """Open a scene file in Sionna RT at a carrier frequency.

    Args:
        xml: Mitsuba scene file whose BSDFs are radio materials (``mat-itu_*``).
        frequency_hz: of the carrier; below a material's range see `set_frequency`.
        thickness_m: slab thickness of materials by name, metres.

    Returns:
        A ``sionna.rt.Scene``.

    Raises:
        InputError: the file is missing or cannot be opened.
    """
    backend.init()
    from sionna import rt

    if not Path(xml).is_file():
        raise InputError(f"{xml}: no such scene file; give a Mitsuba XML")
    try:
        # Merged shapes come in another order each time, and with them the paths.
        scene = rt.load_scene(str(xml), merge_shapes=False)
    except (RuntimeError, ValueError, SyntaxError) as error:
        raise InputError(f"{xml}: cannot be opened ({' '.join(str(error).split())}); correct the scene") from None
    set_frequency(scene, frequency_hz, thickness_m)
    return scene


def trace_paths(
    scene: Any,
    tx_pos_m: ArrayLike,
    receiver: Receiver,
    *,
    max_depth: int = 3,
    refraction: bool = False,
    rays_per_source: int = RAYS_PER_SOURCE,
    seed: int = 1,
    progress: bool = False,
) -> SpecularPaths:
    """Trace specular paths from every transmitter position to a receiver with Sionna RT's ``PathSolver``.

    Antennas are isotropic and linearly polarised: the transmitter's along the world's z axis, the receiver's along
    its array's y axis. The candidate search is the deterministic one, and the path buffer has room for every
    candidate, so that none is dropped.

    Args:
        scene: from `open_scene`, without devices of its own; its antenna arrays are set to those above.
        tx_pos_m: transmitter positions [n, 3], world frame, metres.
        receiver: pose of the receiver.
        max_depth: interactions per path at most.
        refraction: let paths pass through walls, straight on. Rays then divide between both ways, so give more.
        rays_per_source: rays that search for reflections.
        seed: of the rays.
        progress: show a progress bar on standard error.

    Returns:
        The paths, sorted by transmitter and length. Lengths and directions are recomputed in float64 from Sionna RT's
        vertices, because a float32 length is too coarse for phases (2e-3 rad at 28 GHz and 100 m).

    Raises:
        ValueError: positions of another shape or not finite, or a scene that has transmitters or receivers.
    """
    positions = np.atleast_2d(np.asarray(tx_pos_m, float))
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
        raise ValueError(f"trace_paths: tx_pos_m has shape {np.shape(tx_pos_m)}; give finite [n, 3]")
    if scene.transmitters or scene.receivers:
        raise ValueError("trace_paths: the scene has transmitters or receivers; give one without")
    from sionna import rt

    solver = rt.PathSolver(deterministic=True)
    step = max(1, RAYS_AT_ONCE // rays_per_source)
    parts = []
    bar = Progress(console=Console(stderr=True), transient=True, disable=not progress)
    with _single_antennas(scene, receiver), bar:
        task = bar.add_task("tracing paths", total=len(positions))
        for start in range(0, len(positions), step):
            batch = positions[start : start + step]
            with _transmitters(scene, batch):
                paths = solver(
                    scene,
                    max_depth=max_depth,
                    samples_per_src=rays_per_source,
                    max_num_paths_per_src=rays_per_source * max(max_depth, 1) + 1,
                    refraction=refraction,
                    seed=seed,
                )
                parts.append(_plain(paths, batch, receiver.position_m, start))
            bar.advance(task, len(batch))
    transmitter, gain, length, direction, bounces = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((length, transmitter))
    return SpecularPaths(
        transmitter[order], gain[order], length[order], direction[order], bounces[order], len(positions)
    )


def sionna_orientation(orientation_xyzw: ArrayLike) -> tuple[float, float, float]:
    """Sionna RT's angles (alpha, beta, gamma; rad) of a device whose array has the given orientation.

    The one place that turns our arrays (x-y plane, boresight +z) into Sionna RT's (y-z plane, boresight +x).

    Args:
        orientation_xyzw: unit quaternion, array's frame to world.
    """
    device_to_world = rotation_matrix(orientation_xyzw) @ _DEVICE_TO_ARRAY
    alpha, beta, gamma = Rotation.from_matrix(device_to_world).as_euler("ZYX")
    return float(alpha), float(beta), float(gamma)


def _plain(paths: Any, tx_pos_m: FloatArray, rx_pos_m: FloatArray, first: int) -> tuple[Any, ...]:
    valid = paths.valid.numpy()[0]  # [tx, path]
    transmitter, index = np.nonzero(valid)
    real, imaginary = (part.numpy()[0, 0, :, 0, :] for part in paths.a)
    gain = (real + 1j * imaginary).astype(np.complex128)[transmitter, index]
    hit = paths.interactions.numpy()[:, 0, transmitter, index] != 0  # [depth, p]; 0 is "none"
    vertices = paths.vertices.numpy().astype(float)[:, 0, transmitter, index]  # [depth, p, 3]
    last = tx_pos_m[transmitter]
    length = np.zeros(len(transmitter))
    for used, vertex in zip(hit, vertices, strict=True):
        here = np.where(used[:, None], vertex, last)
        length += np.linalg.norm(here - last, axis=-1)
        last = here
    towards = last - rx_pos_m
    final = np.linalg.norm(towards, axis=-1)
    return transmitter + first, gain, length + final, towards / final[:, None], hit.sum(axis=0)


@contextmanager
def _single_antennas(scene: Any, receiver: Receiver) -> Iterator[None]:
    import mitsuba as mi
    from sionna import rt

    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    name = "wrf_mi-receiver"
    angles = mi.Point3f(sionna_orientation(receiver.orientation_xyzw))
    scene.add(rt.Receiver(name, mi.Point3f(receiver.position_m.tolist()), angles))
    try:
        yield
    finally:
        scene.remove(name)


@contextmanager
def _transmitters(scene: Any, positions: FloatArray) -> Iterator[None]:
    import mitsuba as mi
    from sionna import rt

    names = [f"wrf_mi-transmitter-{row}" for row in range(len(positions))]
    for name, position in zip(names, positions, strict=True):
        scene.add(rt.Transmitter(name, mi.Point3f(position.tolist())))
    try:
        yield
    finally:
        scene.remove(names)
