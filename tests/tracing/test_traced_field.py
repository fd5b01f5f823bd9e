"""Traced fields against Sionna RT: gains, lengths, derivatives, moved receivers, repeated searches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, PARTITION, THICKNESS_M, WALLS, receiver, room, transmitters
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.constants import speed_of_light
from scipy.special import sph_harm_y
from traced_rooms import write_xml

from wrf_mi.backend.device import to_uint
from wrf_mi.core import Antenna, InputError, Receiver
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions

# isort: split
import drjit as dr
import mitsuba as mi
from sionna.rt.utils import itu_coefficients_single_layer_slab

from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.paths import traced_field as traced_field_module
from wrf_mi.tracing.paths.field_calculator import slab
from wrf_mi.tracing.paths.instrument_parameters import pattern_factor, receiver_pose
from wrf_mi.tracing.paths.scene_parameters import QUANTITIES
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.sionna.path_solver import field_of, to_buffer

Float64 = dr.float64_array_t(mi.Float)
Tensor64 = dr.tensor_t(Float64)

SINGLE = 2e-6
"""Of the strongest path: Sionna RT's gains in single precision, four interactions deep."""
DOUBLE = 1e-12
SLOPE = 1e-4
"""Relative: Sionna RT's derivatives in single precision, sums of some hundred terms of both signs."""

OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return room(tmp_path_factory.mktemp("room"), {**WALLS, **CEILING, **PARTITION})


def tensors(traced: TracedField, **changes: Any) -> dict[str, Any]:
    values = {**traced.parameters(), **changes}
    return {name: Tensor64(np.asarray(value, float)) for name, value in values.items()}


def existing(traced: TracedField, parameters: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain, length and arrival (world) of the paths that are not place holders."""
    paths = traced(parameters)
    there = traced.exists
    gain = paths.gain[0].numpy() + 1j * paths.gain[1].numpy()
    pose = receiver_pose(traced.receiver, parameters, Float64)
    to_world = np.array([[float(c[0]) for c in row] for row in pose.to_world])
    arrival = np.stack([c.numpy() for c in paths.arrival], axis=-1) @ to_world.T
    return gain[there], paths.length_m.numpy()[there], arrival[there]


@pytest.mark.parametrize("turn", [(0, 2, 0), (30, 50, -70)])
@pytest.mark.parametrize(
    ("rx", "tx"),
    [
        (Antenna(), Antenna()),
        (Antenna(frame="array"), Antenna()),
        (Antenna("iso", "H", "array"), Antenna("iso", "H")),
        (Antenna("dipole", "V", "array"), Antenna("hw_dipole")),
        (Antenna("hw_dipole", "H"), Antenna("dipole", "H")),
        (Antenna("tr38901", "V", "array"), Antenna()),
    ],
)
def test_paths_are_those_of_sionna_rt(scene: Any, turn: tuple[float, float, float], rx: Antenna, tx: Antenna) -> None:
    """Line of sight, reflections, transmissions and both, for rotated arrays, all patterns and polarisations."""
    array = replace(receiver(turn), antenna=rx)
    reference = trace_paths(scene, transmitters(5), array, OPTIONS, tx_antenna=tx).paths
    traced = TracedField(scene, transmitters(5), array, TracedOptions(OPTIONS, tx_antenna=tx))
    gain, length, arrival = existing(traced, tensors(traced))
    assert set(map(tuple, np.sort(reference.interactions, axis=1))) >= {(0, 0), (0, 1), (0, 4), (1, 4)}
    np.testing.assert_allclose(length, reference.length_m, rtol=DOUBLE)
    np.testing.assert_allclose(arrival, reference.arrival, atol=DOUBLE)
    np.testing.assert_allclose(gain, reference.gain, atol=SINGLE * np.abs(reference.gain).max())


def test_gains_for_other_materials_are_those_of_sionna_rt(scene: Any) -> None:
    """With the same values in its scene, which the traced field does not change."""
    found = trace_paths(scene, transmitters(3), receiver(), OPTIONS)
    traced = TracedField(scene, transmitters(3), receiver(), TracedOptions(OPTIONS), traced=found)
    assert traced.searches == 0
    concrete = scene.radio_materials["itu_concrete"]
    before = float(concrete.relative_permittivity[0]), float(concrete.conductivity[0])
    parameters = tensors(traced) | {
        "material.itu_concrete.permittivity": Tensor64(np.log([2.2])),
        "material.itu_concrete.conductivity": Tensor64(np.log([0.3])),
        "receiver.array.gain": Tensor64([np.log(7.0), 0.4]),
    }
    gain, _, _ = existing(traced, parameters)
    try:
        concrete.relative_permittivity, concrete.conductivity = 3.2, 0.3
        expected = recompute(found, scene).paths.gain * 7 * np.exp(0.4j)
    finally:
        concrete.relative_permittivity, concrete.conductivity = before
    np.testing.assert_allclose(gain, expected, atol=SINGLE * np.abs(expected).max())


def test_gains_at_another_carrier_are_those_of_sionna_rt(tmp_path: Path) -> None:
    """Conductivities follow the laws of ITU-R P.2040, with materials of names and of surfaces."""
    parts, high_hz = {**WALLS, **CEILING, **PARTITION}, 3.5e9
    low, high = (open_scene(write_xml(tmp_path / str(hz), parts), hz, THICKNESS_M) for hz in (1.8e9, high_hz))
    found = trace_paths(low, transmitters(3), receiver(), OPTIONS)
    expected = recompute(found, high).paths.gain
    assert np.abs(expected - found.paths.gain).max() > 0.1 * np.abs(expected).max()
    for options in (TracedOptions(OPTIONS), TracedOptions(OPTIONS, materials="surface", constants=QUANTITIES)):
        traced = TracedField(low, transmitters(3), receiver(), options, traced=found, frequency_hz=high_hz)
        gain, _, _ = existing(traced, tensors(traced))
        np.testing.assert_allclose(gain, expected, atol=SINGLE * np.abs(expected).max())


@pytest.mark.parametrize("cosine", [0.02, 0.4, 1.0])
def test_slab_is_that_of_sionna_rt(cosine: float) -> None:
    given = [3.0, 6.0, 1.001], [1e-6, 0.3, 1e7], [0.02, 0.4, 0.1]
    c = slab(Float64(cosine), *(Float64(v) for v in given), FREQUENCY_HZ)
    eta = mi.Complex2f(mi.Float(given[0]), -mi.Float(given[1]) / (2 * np.pi * FREQUENCY_HZ * 8.8541878128e-12))
    wavelength = mi.Float(speed_of_light / FREQUENCY_HZ)
    expected = itu_coefficients_single_layer_slab(mi.Float(cosine), eta, mi.Float(given[2]), wavelength)
    ours = c.reflected_te, c.reflected_tm, c.transmitted_te, c.transmitted_tm
    for mine, theirs in zip(ours, expected, strict=True):
        # Single precision, and its phase over a slab of two wavelengths.
        np.testing.assert_allclose(mine.numpy(), theirs.numpy(), atol=1e-5)


def test_slab_of_single_precision_is_that_of_double_down_to_grazing_incidence() -> None:
    """Within 2e-4, half of it rounding of the phase over ten wavelengths; Sionna RT's own is off by 3e-2 there."""
    rng, found = np.random.default_rng(0), []
    given = [rng.uniform(0.01, 1, 9999), rng.uniform(1.001, 9, 9999), 10 ** rng.uniform(-6, 1, 9999)]
    single = [column.astype(np.float32) for column in (*given, rng.uniform(0.005, 0.3, 9999))]
    for kind in (mi.Float, Float64):
        c = slab(*(kind(column) for column in single), kind(2.4e9))
        found.append(
            np.stack([np.array(t) for t in (c.reflected_te, c.reflected_tm, c.transmitted_te, c.transmitted_tm)])
        )
    np.testing.assert_allclose(*found, atol=2e-4, rtol=0)


@pytest.mark.gradcheck
def test_derivatives_by_materials_are_those_of_sionna_rt(scene: Any) -> None:
    """Its field calculator in the differentiable mode, over the same paths."""
    found = trace_paths(scene, transmitters(3), receiver((0, 20, 0)), OPTIONS)
    rng = np.random.default_rng(1)
    weight = rng.standard_normal((2, len(found.paths)))
    concrete = scene.radio_materials["itu_concrete"]
    permittivity, conductivity = mi.Float(5.1), mi.Float(0.06)
    before = concrete.relative_permittivity, concrete.conductivity
    dr.enable_grad(permittivity, conductivity)
    try:
        concrete.relative_permittivity, concrete.conductivity = permittivity, conductivity
        surfaces = scene_surfaces(scene)
        buffer = to_buffer(found.legs(surfaces), surfaces)
        gain = field_of(scene, buffer, found.ends(), found.rays, loop_mode="evaluated")
        dr.backward(dr.sum(gain[0] * mi.Float(weight[0]) + gain[1] * mi.Float(weight[1])))
        theirs = [float(dr.grad(permittivity)[0]), float(dr.grad(conductivity)[0])]
    finally:
        concrete.relative_permittivity, concrete.conductivity = before

    traced = TracedField(scene, found.tx_pos_m, receiver((0, 20, 0)), TracedOptions(OPTIONS), traced=found)
    logs = [Tensor64(np.log([4.1])), Tensor64(np.log([0.06]))]
    dr.enable_grad(logs)
    names = [f"material.itu_concrete.{quantity}" for quantity in ("permittivity", "conductivity")]
    paths = traced(tensors(traced) | dict(zip(names, logs, strict=True)))
    place = to_uint(np.flatnonzero(traced.exists))
    re, im = (dr.gather(Float64, part, place) for part in paths.gain)
    dr.backward(dr.sum(re * Float64(weight[0]) + im * Float64(weight[1])))
    ours = [float(dr.grad(log).array[0]) / scale for log, scale in zip(logs, (4.1, 0.06), strict=True)]
    np.testing.assert_allclose(ours, theirs, rtol=SLOPE)


def test_paths_follow_a_moved_receiver_until_searched_again(scene: Any) -> None:
    """Moved paths are those of a new search, as long as it finds the same ones."""
    stated = receiver((10, 5, 0))
    traced = TracedField(scene, transmitters(3), stated, TracedOptions(OPTIONS))
    assert traced.searches == 1
    shift, turn = np.array([0.03, -0.02, 0.04]), np.array([0.02, -0.03, 0.3])
    moved = tensors(traced) | {"receiver.array.position": Tensor64(shift), "receiver.array.turn": Tensor64(turn)}
    assert not traced.refresh(moved)
    there = Receiver("array", stated.position_m + shift, stated.orientation_xyzw)
    reference = trace_paths(scene, transmitters(3), there, OPTIONS).paths
    _, length, arrival = existing(traced, moved)
    np.testing.assert_allclose(np.sort(length), np.sort(reference.length_m), rtol=DOUBLE)
    np.testing.assert_allclose(np.sort(arrival, axis=0), np.sort(reference.arrival, axis=0), atol=DOUBLE)

    # Behind the partition, a quarter of a wavelength and more away.
    far = tensors(traced) | {"receiver.array.position": Tensor64([-1.6, 0.0, 0.0])}
    assert traced.refresh(far)
    assert not traced.refresh(far)
    assert traced.searches == 2
    there = replace(stated, position_m=stated.position_m + np.array([-1.6, 0, 0]))
    reference = trace_paths(scene, transmitters(3), there, OPTIONS).paths
    gain, length, _ = existing(traced, far)
    np.testing.assert_allclose(length, reference.length_m, rtol=DOUBLE)
    np.testing.assert_allclose(gain, reference.gain, atol=SINGLE * np.abs(reference.gain).max())


def test_pattern_factors_are_exponentials_of_harmonics(scene: Any) -> None:
    """Degree one along an axis is a known function; a transmitter's pattern turns with its heading."""
    direction = np.random.default_rng(0).standard_normal((3, 50))
    direction /= np.linalg.norm(direction, axis=0)
    coefficients = np.zeros((2, 8))
    coefficients[:, 1] = 0.3, 0.7  # degree 1, order 0
    re, im = pattern_factor(Tensor64(coefficients), [Float64(c) for c in direction])
    expected = np.exp((0.3 + 0.7j) * np.sqrt(3 / (4 * np.pi)) * direction[2])
    np.testing.assert_allclose(re.numpy() + 1j * im.numpy(), expected, atol=1e-6)  # coefficients are float32

    options, heading = TracedOptions(OPTIONS, pattern_degree=1), np.array([0.0, 1.2])
    both = np.tile(transmitters(1), (2, 1))
    traced = TracedField(scene, both, receiver(), options, heading)
    parameters = tensors(traced)
    plain, _, _ = existing(traced, parameters)
    table = np.zeros((2, 3))
    table[0] = 0.2, 0.0, 0.5
    changed, _, _ = existing(traced, parameters | {"pattern.transmitter": Tensor64(table)})
    reference = trace_paths(scene, both, receiver(), OPTIONS).paths
    azimuth = heading[reference.tx]
    x, y, _ = reference.departure.T
    own = np.stack([np.cos(azimuth) * x + np.sin(azimuth) * y, np.cos(azimuth) * y - np.sin(azimuth) * x])
    # Real harmonics of degree 1, orders -1, 0, 1: -y, z, -x times sqrt(3 / 4 pi).
    expected = np.exp(-np.sqrt(3 / (4 * np.pi)) * (0.2 * own[1] + 0.5 * own[0]))
    strong = np.abs(plain) > 1e-9
    np.testing.assert_allclose((changed / np.where(strong, plain, 1))[strong], expected[strong], rtol=1e-6)


@pytest.mark.parametrize("degree", [1, 4, 8])
def test_pattern_factors_have_the_harmonics_of_scipy(degree: int) -> None:
    """Real harmonics with the Condon-Shortley phase, by degree and order; Dr.Jit's constants are float32."""
    rng = np.random.default_rng(3)
    n = rng.normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    polar, azimuth = np.arccos(n[:, 2]), np.arctan2(n[:, 1], n[:, 0])
    harmonics = []
    for level in range(1, degree + 1):
        for order in range(-level, level + 1):
            value = sph_harm_y(level, abs(order), polar, azimuth)
            harmonics.append(value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real))
    coefficients = rng.normal(size=(2, (degree + 1) ** 2 - 1)) / degree
    re, im = pattern_factor(Tensor64(coefficients), [Float64(c) for c in n.T.copy()])
    expected = np.exp(np.stack(harmonics, axis=1) @ (coefficients[0] + 1j * coefficients[1]))
    np.testing.assert_allclose(re.numpy() + 1j * im.numpy(), expected, rtol=1e-5)


def test_batch_has_the_paths_of_its_rows(scene: Any) -> None:
    traced = TracedField(scene, transmitters(4), receiver(), TracedOptions(OPTIONS))
    everything, some = traced(tensors(traced)), traced(tensors(traced), mi.UInt32([3, 1, 3]))
    assert (some.batch, some.each) == (3, everything.each)
    length = everything.length_m.numpy().reshape(4, -1)
    np.testing.assert_array_equal(some.length_m.numpy().reshape(3, -1), length[[3, 1, 3]])


@given(share=st.floats(1e-4, 0.5), seed=st.integers(0, 99))
@settings(max_examples=8, deadline=None)
def test_error_of_faint_paths_left_out_is_bounded(scene: Any, share: float, seed: int) -> None:
    tx = transmitters(3, seed)
    whole = TracedField(scene, tx, receiver(), TracedOptions(OPTIONS))
    kept = TracedField(scene, tx, receiver(), TracedOptions(OPTIONS, faint=share))
    response, amplitude, count = np.zeros((2, 3), complex), np.zeros(3), np.zeros((2, 3), int)
    for i, traced in enumerate((whole, kept)):
        paths = traced({})
        gain = (paths.gain[0].numpy() + 1j * paths.gain[1].numpy()).reshape(3, -1)
        phase = np.exp(-2j * np.pi * FREQUENCY_HZ / speed_of_light * paths.length_m.numpy().reshape(3, -1))
        response[i], count[i] = (gain * phase).sum(1), traced.exists.reshape(3, -1).sum(1)
        amplitude = np.maximum(amplitude, np.abs(gain).sum(1))
    # Faint paths are chosen by gains in single precision.
    assert (np.abs(response[0] - response[1]) <= (share + SINGLE) * amplitude).all()
    assert (count[1] <= count[0]).all()
    assert (count[1] > 0).all()


def test_kernels_are_smaller_without_faint_paths(scene: Any) -> None:
    sizes = []
    for share in (0.0, 0.1):
        traced = TracedField(scene, transmitters(4), receiver(), TracedOptions(OPTIONS, faint=share))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(traced({}).gain)
            sizes.append(max(entry["size"] for entry in dr.kernel_history([dr.KernelType.JIT])))
        assert sizes[-1] == traced.exists.size
    assert sizes[1] < 0.8 * sizes[0]


def test_free_space_gain_is_that_of_friis_in_double_precision() -> None:
    """An empty scene, vertical antennas of the same height."""
    from sionna import rt

    scene = rt.load_scene()
    scene.frequency = FREQUENCY_HZ
    array = receiver(position=(0.0, 0.0, 1.0))
    traced = TracedField(scene, [[3.0, 4.0, 1.0]], array, TracedOptions(TraceOptions()))
    gain, length, arrival = existing(traced, tensors(traced))
    np.testing.assert_allclose(gain, [speed_of_light / traced.frequency_hz / (4 * np.pi * 5)], rtol=DOUBLE)
    np.testing.assert_allclose(length, [5.0], rtol=DOUBLE)
    np.testing.assert_allclose(arrival, [[0.6, 0.8, 0.0]], atol=DOUBLE)


def test_transmitter_without_a_path_has_no_gain_and_finite_derivatives(tmp_path: Path) -> None:
    """A transmitter behind metal."""
    scene = room(tmp_path, {"ceiling": CEILING["ceiling"]})
    above = np.array([[2.0, 2.0, 5.0]])
    traced = TracedField(scene, above, receiver(), TracedOptions(TraceOptions(depth=1, rays=1024)))
    parameters = tensors(traced)
    for p in parameters.values():
        dr.enable_grad(p)
    paths = traced(parameters)
    assert not paths.gain[0].numpy().any()
    dr.backward(dr.sum(paths.gain[0]) + dr.sum(paths.gain[1]))
    assert all(np.isfinite(dr.grad(p).numpy()).all() for p in parameters.values())


def test_known_paths_of_antennas_behind_outer_walls_are_taken(scene: Any) -> None:
    """The tracer moves such antennas before the wall; lengths are those of the stated positions."""
    behind, array = np.array([[-0.003, 2.0, 1.0], [2.0, 2.0, 1.0]]), receiver(position=(4.2, 5.004, 0.4))
    found = trace_paths(scene, behind, array, OPTIONS)
    assert (found.tx_pos_m != behind).any()
    assert (found.receivers[0].position_m != array.position_m).any()
    known = TracedField(scene, behind, array, TracedOptions(OPTIONS), traced=found)
    searched = TracedField(scene, behind, array, TracedOptions(OPTIONS))
    for ours, theirs in zip(existing(known, {}), existing(searched, {}), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_wrong_arguments_are_refused(scene: Any) -> None:
    with pytest.raises(InputError, match="no derivative"):
        TracedOptions(TraceOptions(diffraction=True))
    with pytest.raises(ValueError, match="tx_pos_m has shape"):
        TracedField(scene, [[1.0, 2.0]], receiver())
    with pytest.raises(ValueError, match="tx_heading_rad has shape"):
        TracedField(scene, transmitters(2), receiver(), TracedOptions(OPTIONS), [0.0])


def test_gains_that_are_not_numbers_are_refused(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """They would all count as faint, and no path would be left."""
    evaluate = traced_field_module.evaluate_paths

    def broken(*given: Any) -> Any:
        (real, imaginary), *others = evaluate(*given)
        return (real * dr.nan, imaginary), *others

    monkeypatch.setattr(traced_field_module, "evaluate_paths", broken)
    with pytest.raises(InputError, match="gains that are not numbers"):
        TracedField(scene, transmitters(2), receiver(), TracedOptions(OPTIONS, faint=1e-3))
