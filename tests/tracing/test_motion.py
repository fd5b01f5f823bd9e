"""Doppler shifts: Sionna RT's, closed forms, and the phase of the channel a moment later."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.constants import speed_of_light
from traced_rooms import FREQUENCY_HZ, SHOEBOX, WAVELENGTH_M, receiver, room
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import InputError
from wrf_mi.receivers import csi
from wrf_mi.scene.folder import read_scene_folder
from wrf_mi.tracing import TraceOptions, load_trace, save_trace, trace_paths
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.sionna.scattering import scattering_materials

OF_SIONNA = 1e-4
"""Share of the largest shift: Sionna RT computes directions from points in single precision."""
OF_EDGES = 3e-4
"""Likewise of diffracted paths, whose direction of arrival Sionna RT takes from a point shortly before the edge."""
SINGLE_M = 2e-5
"""Lengths are of points in single precision."""
SECOND_ORDER = 0.02
"""Share of the change in a millisecond: the shift itself changes by v t / d, and gains with the angles at surfaces."""
TX_M, RX_M = np.array([1.0, 1.5, 1.2]), np.array([5.0, 4.2, 1.7])
TX_MPS, RX_MPS, BOX_MPS = np.array([1.0, -2.0, 0.5]), np.array([-0.7, 0.4, 1.1]), np.array([0.3, 1.5, -0.8])


def furnished(folder: Path) -> Any:
    """The shoebox with a moving box between transmitter and receiver, so that paths pass, bend around and meet it."""
    box = trimesh.creation.box((0.6, 0.8, 1.4))
    box.apply_translation([3.0, 2.6, 0.9])
    scene = room(folder, {**SHOEBOX, "box": ("itu_plasterboard", box)})
    scene.objects["box"].velocity = BOX_MPS.tolist()
    return scene


def sionna_shifts(scene: Any, options: TraceOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths [m], Doppler shifts [Hz] and whether they are diffracted, of Sionna RT's paths of all kinds."""
    import mitsuba as mi
    from sionna import rt

    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", mi.Point3f(*TX_M.tolist()), velocity=mi.Vector3f(*TX_MPS.tolist())))
    scene.add(rt.Receiver("rx", mi.Point3f(*RX_M.tolist()), velocity=mi.Vector3f(*RX_MPS.tolist())))
    kinds = {"diffuse_reflection": True, "diffraction": True, "edge_diffraction": True}
    with scattering_materials(scene, options):
        solve = rt.PathSolver(deterministic=True)
        paths = solve(scene, max_depth=options.depth, samples_per_src=options.rays, seed=options.seed, **kinds)
    valid = paths.valid.numpy()[0, 0]
    bent = (paths.interactions.numpy()[:, 0, 0, valid] == 8).any(axis=0)
    lengths = paths.tau.numpy()[0, 0][valid].astype(float) * speed_of_light
    return lengths, paths.doppler.numpy()[0, 0][valid].astype(float), bent


def test_shifts_of_all_kinds_of_paths_are_sionna_rts(tmp_path: Path) -> None:
    kinds: dict[str, Any] = {"diffraction": True, "scattering": True, "scattering_coefficient": 0.3}
    scene, options = furnished(tmp_path), TraceOptions(depth=2, rays=4096, **kinds)
    moving = {"tx_velocity_mps": TX_MPS[None], "rx_velocity_mps": RX_MPS[None]}
    traced = trace_paths(scene, TX_M[None], receiver(RX_M), options, **moving)
    assert set(np.unique(traced.paths.interactions)) == {0, 1, 2, 4, 8}
    assert "box" in {traced.paths.object_names[k] for k in np.unique(traced.paths.objects[traced.paths.objects >= 0])}
    shift, (lengths, expected, bent) = traced.paths.doppler_hz(FREQUENCY_HZ), sionna_shifts(scene, options)
    assert len(lengths) > 100
    # Of equal lengths, as of a room's mirror images, the nearest shift counts.
    other = np.abs(traced.paths.length_m - lengths[:, None]) > SINGLE_M
    error = np.where(other, np.inf, np.abs(shift - expected[:, None])).min(axis=1) / np.abs(expected).max()
    assert error[~bent].max() < OF_SIONNA
    assert error[bent].max() < OF_EDGES
    still = trace_paths(scene, TX_M[None], receiver(RX_M), options).paths
    moved = (still.objects == still.object_names.index("box")) & np.isin(still.interactions, (1, 2, 8))
    np.testing.assert_array_equal(still.length_rate_mps != 0, moved.any(axis=1))


def test_shift_of_a_mirrored_path_is_that_of_the_image(tmp_path: Path) -> None:
    scene = room(tmp_path, {"mirror": ("itu_metal", sheet(1, 0.0, (-50.0, 50.0), (-50.0, 50.0)))})
    tx, rx = np.array([[0.0, 2.0, 1.0]]), receiver((10.0, 3.0, 1.0))
    paths = trace_paths(scene, tx, rx, TraceOptions(depth=1), tx_velocity_mps=[[3.0, 0.0, 0.0]]).paths
    # Towards the receiver along x: v / lambda times the cosine of the path's direction.
    cosines = 10 / np.hypot(10, [1.0, 5.0])
    np.testing.assert_allclose(paths.doppler_hz(FREQUENCY_HZ), 3 / WAVELENGTH_M * cosines, rtol=SINGLE_M)
    # A mirror that recedes at v lengthens the path by 2 v times the cosine to its normal, and no other path.
    scene.objects["mirror"].velocity = [7.0, -1.5, 2.0]
    paths = trace_paths(scene, tx, rx, TraceOptions(depth=1)).paths
    np.testing.assert_allclose(paths.length_rate_mps, [0, 2 * 1.5 * 5 / np.hypot(10, 5)], rtol=SINGLE_M)


def test_phase_of_the_channel_turns_with_the_doppler_shifts(tmp_path: Path) -> None:
    """The channel that is traced a moment later is that of the paths with their lengths then."""
    scene, seconds, options = room(tmp_path), 1e-3, TraceOptions(depth=3)
    velocity, place = np.array([[1.0, -2.0, 0.5]]), receiver(RX_M)
    before = trace_paths(scene, TX_M[None], place, options, tx_velocity_mps=velocity)
    later = trace_paths(scene, TX_M + seconds * velocity, place, options)
    frequencies = FREQUENCY_HZ + np.array([-40e6, 0.0, 40e6])
    expected, channel = csi(later.paths, frequencies), csi(before.paths.after(seconds), frequencies)
    change = np.abs(expected - csi(before.paths, frequencies)).max()
    assert np.abs(channel - expected).max() < SECOND_ORDER * change
    # Each wave turns by 2 pi f_D t, and a trace that is stored and selected keeps its rates.
    turn = np.exp(2j * np.pi * before.paths.doppler_hz(FREQUENCY_HZ) * seconds)
    paths = replace(before.paths, gain=before.paths.gain * turn)
    np.testing.assert_allclose(csi(paths, FREQUENCY_HZ), channel[..., 1:2], rtol=1e-9)
    save_trace(tmp_path / "paths.npz", before)
    read = load_trace(tmp_path / "paths.npz").of_transmitters(np.array([0, 0]))
    np.testing.assert_array_equal(read.paths.length_rate_mps, np.tile(before.paths.length_rate_mps, 2))


def test_corrected_scene_moves_as_its_scene(tmp_path: Path) -> None:
    folder = write_corrected_scene(tmp_path / "corrected", furnished(tmp_path), {})
    moving = read_scene_folder(folder).materials.velocities_mps
    assert all(name.startswith("box") for name in moving)
    np.testing.assert_allclose(list(moving.values()), np.tile(BOX_MPS, (len(moving), 1)), rtol=1e-6)
    assert len(moving) >= 1


def test_velocities_that_are_none_are_refused(tmp_path: Path) -> None:
    scene = room(tmp_path)
    with pytest.raises(InputError, match=r"transmitter 1: its velocity is .*; give finite"):
        trace_paths(scene, TX_M[None], receiver(RX_M), tx_velocity_mps=[[np.nan, 0, 0]])
    with pytest.raises(InputError, match=r"receiver 1: .* below 3e"):
        trace_paths(scene, TX_M[None], receiver(RX_M), rx_velocity_mps=[[3e8, 0, 0]])
