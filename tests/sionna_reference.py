"""Paths of Sionna RT's own solver, as a reference."""

import numpy as np
from scipy.constants import speed_of_light


def sionna_paths(scene, tx_m, rx_m, pattern="iso", turn_rad=(0, 0, 0), depth=3, **kinds):
    """Lengths [m] and gains from a vertical isotropic antenna to one with a pattern, turned by yaw and pitch."""
    import mitsuba as mi
    from sionna import rt

    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern=pattern, polarization="V")
    place, other, turn = (mi.Point3f(*np.asarray(values, float).tolist()) for values in (tx_m, rx_m, turn_rad))
    scene.add(rt.Transmitter("tx", place))
    scene.add(rt.Receiver("rx", other, orientation=turn))
    solve, bounds = rt.PathSolver(deterministic=True), {"samples_per_src": 30_000, "max_num_paths_per_src": 100_000}
    try:
        paths = solve(scene, max_depth=depth, seed=1, **bounds, **kinds)
    finally:
        scene.remove(["tx", "rx"])
    valid, (real, imaginary) = paths.valid.numpy()[0, 0], (part.numpy()[0, 0, 0, 0] for part in paths.a)
    return paths.tau.numpy()[0, 0][valid].astype(float) * speed_of_light, (real + 1j * imaginary)[valid]
