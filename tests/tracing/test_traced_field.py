"""Traced fields against Sionna RT: gains, lengths, derivatives, moved receivers, repeated searches."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, THICKNESS_M, receiver, room, transmitters
from double_precision import Tensor64
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.constants import epsilon_0, speed_of_light
from scipy.special import sph_harm_y
from sionna.rt.utils import itu_coefficients_single_layer_slab

from wrf_mi.backend.device import to_uint
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Antenna, InputError
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.paths.instrument_parameters import pattern_factor, receiver_pose
from wrf_mi.tracing.paths.scene_parameters import QUANTITIES
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.sionna.path_solver import field_of, to_buffer
from wrf_mi.tracing.slabs import slab

SINGLE = 2e-6  # Of the strongest path: Sionna RT's gains in single precision, four interactions deep
DOUBLE = 1e-12
SLOPE = 1e-4  # Relative: Sionna RT's derivatives in single precision, sums of some hundred terms of both signs

OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)


def field(scene, count, array=None, traced=None, **options):
    """Of so many transmitters, at the usual receiver or another one."""
    how = TracedOptions(OPTIONS, **options)
    return TracedField(scene, transmitters(count), array or receiver(), how, traced=traced)


def tensors(traced, **changes):
    values = {**traced.parameters(), **changes}
    return {name: Tensor64(np.asarray(value, float)) for name, value in values.items()}


def complex_gain(paths):
    return paths.gain[0].numpy() + 1j * paths.gain[1].numpy()


def existing(traced, parameters):
    """Gain, length and arrival (world) of the paths that are not place holders."""
    paths, exists = traced(parameters), traced.exists
    pose = receiver_pose(traced.receiver, parameters, Float64)
    to_world = np.array([[float(c[0]) for c in row] for row in pose.to_world])
    arrival = np.stack([c.numpy() for c in paths.arrival], axis=-1) @ to_world.T
    return complex_gain(paths)[exists], paths.length_m.numpy()[exists], arrival[exists]


@pytest.mark.parametrize("turn", [(0, 2, 0), (30, 50, -70)])
@pytest.mark.parametrize(
    ("rx", "tx"),
    [
        *((Antenna(), Antenna()), (Antenna(frame="array"), Antenna()), (Antenna("tr38901", "V", "array"), Antenna())),
        *((Antenna("iso", "H", "array"), Antenna("iso", "H")), (Antenna("dipole", "V", "array"), Antenna("hw_dipole"))),
        (Antenna("hw_dipole", "H"), Antenna("dipole", "H")),
    ],
)
def test_paths_are_those_of_sionna_rt(box, turn, rx, tx):
    """Line of sight, reflections, transmissions and both, for rotated arrays, all patterns and polarisations."""
    array = replace(receiver(turn), antenna=rx)
    reference = trace_paths(box, transmitters(5), array, OPTIONS, tx_antenna=tx).paths
    traced = field(box, 5, array, tx_antenna=tx)
    gain, length, arrival = existing(traced, tensors(traced))
    assert set(map(tuple, np.sort(reference.interactions, axis=1))) >= {(0, 0), (0, 1), (0, 4), (1, 4)}
    np.testing.assert_allclose(length, reference.length_m, rtol=DOUBLE)
    np.testing.assert_allclose(arrival, reference.arrival, atol=DOUBLE)
    np.testing.assert_allclose(gain, reference.gain, atol=SINGLE * np.abs(reference.gain).max())


def test_gains_for_other_materials_are_those_of_sionna_rt(box):
    """With the same values in its scene, which the traced field does not change."""
    trace_result = trace_paths(box, transmitters(3), receiver(), OPTIONS)
    traced, concrete = field(box, 3, traced=trace_result), box.radio_materials["itu_concrete"]
    assert traced.searches == 0
    before = float(concrete.relative_permittivity[0]), float(concrete.conductivity[0])
    constants = {"permittivity": np.log([2.2]), "conductivity": np.log([0.3])}
    changes = {f"material.itu_concrete.{name}": value for name, value in constants.items()}
    gain, _, _ = existing(traced, tensors(traced, **changes, **{"receiver.array.gain": [np.log(7.0), 0.4]}))
    try:
        concrete.relative_permittivity, concrete.conductivity = 3.2, 0.3
        expected = recompute(trace_result, box).paths.gain * 7 * np.exp(0.4j)
    finally:
        concrete.relative_permittivity, concrete.conductivity = before
    np.testing.assert_allclose(gain, expected, atol=SINGLE * np.abs(expected).max())


def test_gains_at_another_carrier_are_those_of_sionna_rt(box_xml):
    """Conductivities follow the laws of ITU-R P.2040, with materials of names and of surfaces."""
    low, high = (open_scene(box_xml, hz, THICKNESS_M) for hz in (1.8e9, 3.5e9))
    trace_result = trace_paths(low, transmitters(3), receiver(), OPTIONS)
    expected = recompute(trace_result, high).paths.gain
    assert np.abs(expected - trace_result.paths.gain).max() > 0.1 * np.abs(expected).max()
    for options in (TracedOptions(OPTIONS), TracedOptions(OPTIONS, materials="surface", constants=QUANTITIES)):
        traced = TracedField(low, transmitters(3), receiver(), options, traced=trace_result, frequency_hz=3.5e9)
        gain, _, _ = existing(traced, tensors(traced))
        np.testing.assert_allclose(gain, expected, atol=SINGLE * np.abs(expected).max())


def coefficients(slab):
    return slab.reflected_te, slab.reflected_tm, slab.transmitted_te, slab.transmitted_tm


@pytest.mark.parametrize("cosine", [0.02, 0.4, 1.0])
def test_slab_is_that_of_sionna_rt(cosine):
    """Of single precision, and its phase over a slab of two wavelengths."""
    permittivity, conductivity, thickness_m = [3.0, 6.0, 1.001], [1e-6, 0.3, 1e7], [0.02, 0.4, 0.1]
    ours = slab(*(*map(Float64, (cosine, permittivity, conductivity, thickness_m)), FREQUENCY_HZ))
    complex_type: Any = mi.Complex2f
    eta = complex_type(mi.Float(permittivity), -mi.Float(conductivity) / (2 * np.pi * FREQUENCY_HZ * epsilon_0))
    wavelength = mi.Float(speed_of_light / FREQUENCY_HZ)
    theirs = itu_coefficients_single_layer_slab(mi.Float(cosine), eta, mi.Float(thickness_m), wavelength)
    for coefficient, expected in zip(coefficients(ours), theirs, strict=True):
        np.testing.assert_allclose(coefficient.numpy(), expected.numpy(), atol=1e-5)


def test_slab_of_single_precision_is_that_of_double_down_to_grazing_incidence():
    """Within 2e-4, half of it rounding of the phase over ten wavelengths; Sionna RT's own is off by 3e-2 there."""
    rng = np.random.default_rng(0)
    low, high = [0.01, 1.001, -6, 0.005], [1, 9, 1, 0.3]
    cosine, permittivity, log_conductivity, thickness_m = rng.uniform(low, high, (9999, 4)).T.astype(np.float32)
    values = cosine, permittivity, 10**log_conductivity, thickness_m
    types: tuple[Any, ...] = mi.Float, Float64
    slabs = (slab(*map(kind, (*values, 2.4e9))) for kind in types)
    single, double = ([np.array(c) for c in coefficients(each)] for each in slabs)
    np.testing.assert_allclose(single, double, atol=2e-4, rtol=0)


@pytest.mark.gradcheck
def test_derivatives_by_materials_are_those_of_sionna_rt(box):
    """Its field calculator in the differentiable mode, over the same paths."""
    trace_result = trace_paths(box, transmitters(3), receiver((0, 20, 0)), OPTIONS)
    weight = np.random.default_rng(1).standard_normal((2, len(trace_result.paths)))
    concrete, surfaces = box.radio_materials["itu_concrete"], scene_surfaces(box)
    constants = [mi.Float(5.1), mi.Float(0.06)]
    before = concrete.relative_permittivity, concrete.conductivity
    dr.enable_grad(constants)
    try:
        concrete.relative_permittivity, concrete.conductivity = constants
        buffer = to_buffer(trace_result.legs(surfaces), surfaces)
        gain = field_of(box, buffer, trace_result.ends(), trace_result.rays, loop_mode="evaluated")
        dr.backward(dr.sum(gain[0] * mi.Float(weight[0]) + gain[1] * mi.Float(weight[1])))
        theirs = [float(dr.grad(constant)[0]) for constant in constants]
    finally:
        concrete.relative_permittivity, concrete.conductivity = before

    traced = field(box, 3, receiver((0, 20, 0)), trace_result)
    names = [f"material.itu_concrete.{quantity}" for quantity in ("permittivity", "conductivity")]
    logs = dict(zip(names, (Tensor64(np.log([4.1])), Tensor64(np.log([0.06]))), strict=True))
    dr.enable_grad(logs)
    paths, place = traced(tensors(traced) | logs), to_uint(np.flatnonzero(traced.exists))
    re, im = (dr.gather(Float64, part, place) for part in paths.gain)
    dr.backward(dr.sum(re * Float64(weight[0]) + im * Float64(weight[1])))
    ours = [float(dr.grad(log).array[0]) / scale for log, scale in zip(logs.values(), (4.1, 0.06), strict=True)]
    np.testing.assert_allclose(ours, theirs, rtol=SLOPE)


def test_paths_follow_a_moved_receiver_until_searched_again(box):
    """Moved paths are those of a new search, as long as it finds the same ones."""
    start = receiver((10, 5, 0))
    traced = field(box, 3, start)
    assert traced.searches == 1

    def searched(shift_m):
        return trace_paths(box, transmitters(3), replace(start, position_m=start.position_m + shift_m), OPTIONS).paths

    shift, turn = np.array([0.03, -0.02, 0.04]), np.array([0.02, -0.03, 0.3])
    moved = tensors(traced, **{"receiver.array.position": shift, "receiver.array.turn": turn})
    assert not traced.refresh(moved)
    (_, length, arrival), reference = existing(traced, moved), searched(shift)
    np.testing.assert_allclose(np.sort(length), np.sort(reference.length_m), rtol=DOUBLE)
    np.testing.assert_allclose(np.sort(arrival, axis=0), np.sort(reference.arrival, axis=0), atol=DOUBLE)

    shift = np.array([-1.6, 0.0, 0.0])  # behind the partition, a quarter of a wavelength and more away
    far = tensors(traced, **{"receiver.array.position": shift})
    assert [traced.refresh(far), traced.refresh(far), traced.searches] == [True, False, 2]
    (gain, length, _), reference = existing(traced, far), searched(shift)
    np.testing.assert_allclose(length, reference.length_m, rtol=DOUBLE)
    np.testing.assert_allclose(gain, reference.gain, atol=SINGLE * np.abs(reference.gain).max())


def test_pattern_of_a_transmitter_turns_with_its_heading(box):
    heading, both = np.array([0.0, 1.2]), np.tile(transmitters(1), (2, 1))
    traced = TracedField(box, both, receiver(), TracedOptions(OPTIONS, pattern_degree=1), heading)
    plain, _, _ = existing(traced, tensors(traced))
    table = np.array([[0.2, 0.0, 0.5], [0.0, 0.0, 0.0]])
    changed, _, _ = existing(traced, tensors(traced, **{"pattern.transmitter": table}))
    reference = trace_paths(box, both, receiver(), OPTIONS).paths
    azimuth, (x, y, _) = heading[reference.tx], reference.departure.T
    local = np.stack([np.cos(azimuth) * x + np.sin(azimuth) * y, np.cos(azimuth) * y - np.sin(azimuth) * x])
    # Real harmonics of degree 1, orders -1, 0, 1: -y, z, -x times sqrt(3 / 4 pi).
    expected = np.exp(-np.sqrt(3 / (4 * np.pi)) * (0.2 * local[1] + 0.5 * local[0]))
    strong = np.abs(plain) > 1e-9
    np.testing.assert_allclose((changed / np.where(strong, plain, 1))[strong], expected[strong], rtol=1e-6)


@pytest.mark.parametrize("degree", [1, 4, 8])
def test_pattern_factors_have_the_harmonics_of_scipy(degree):
    """Exponentials of real harmonics with the Condon-Shortley phase, by degree and order; constants are float32."""
    rng = np.random.default_rng(3)
    n = rng.normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    polar, azimuth = np.arccos(n[:, 2]), np.arctan2(n[:, 1], n[:, 0])
    harmonics = []
    for level, order in [(n, m) for n in range(1, degree + 1) for m in range(-n, n + 1)]:
        value = sph_harm_y(level, abs(order), polar, azimuth)
        harmonics.append(value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real))
    coefficients = rng.normal(size=(2, (degree + 1) ** 2 - 1)) / degree
    re, im = pattern_factor(Tensor64(coefficients), [Float64(c) for c in n.T.copy()])
    expected = np.exp(np.stack(harmonics, axis=1) @ (coefficients[0] + 1j * coefficients[1]))
    rtol, atol = (1e-7, 1e-6) if degree == 1 else (1e-5, 0)
    np.testing.assert_allclose(re.numpy() + 1j * im.numpy(), expected, rtol=rtol, atol=atol)


def test_batch_has_the_paths_of_its_rows(box):
    traced = field(box, 4)
    everything, batch = traced(tensors(traced)), traced(tensors(traced), mi.UInt32([3, 1, 3]))
    assert (batch.batch, batch.each) == (3, everything.each)
    length = everything.length_m.numpy().reshape(4, -1)
    np.testing.assert_array_equal(batch.length_m.numpy().reshape(3, -1), length[[3, 1, 3]])


@given(share=st.floats(1e-4, 0.5), seed=st.integers(0, 99))
@settings(max_examples=8, deadline=None)
def test_error_of_faint_paths_left_out_is_bounded(box, share, seed):
    response, amplitude, count = np.zeros((2, 3), complex), np.zeros(3), np.zeros((2, 3), int)
    for i, faint in enumerate((0.0, share)):
        traced = TracedField(box, transmitters(3, seed), receiver(), TracedOptions(OPTIONS, faint=faint))
        paths = traced({})
        gain = complex_gain(paths).reshape(3, -1)
        phase = np.exp(-2j * np.pi * FREQUENCY_HZ / speed_of_light * paths.length_m.numpy().reshape(3, -1))
        response[i], count[i] = (gain * phase).sum(1), traced.exists.reshape(3, -1).sum(1)
        amplitude = np.maximum(amplitude, np.abs(gain).sum(1))
    # Faint paths are chosen by gains in single precision.
    assert (np.abs(response[0] - response[1]) <= (share + SINGLE) * amplitude).all()
    assert ((count[1] > 0) & (count[1] <= count[0])).all()


def test_kernels_are_smaller_without_faint_paths(box):
    sizes = []
    for share in (0.0, 0.1):
        traced = field(box, 4, faint=share)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(traced({}).gain)
            sizes.append(max(entry["size"] for entry in dr.kernel_history([dr.KernelType.JIT])))
        assert sizes[-1] == traced.exists.size
    assert sizes[1] < 0.8 * sizes[0]


def test_transmitter_without_a_path_has_no_gain_and_finite_derivatives(tmp_path):
    """A transmitter behind metal."""
    options = TracedOptions(TraceOptions(depth=1, rays=1024, transmission=False))
    traced = TracedField(room(tmp_path, CEILING), [[2.0, 2.0, 5.0]], receiver(), options)
    parameters = tensors(traced)
    dr.enable_grad(parameters)
    paths = traced(parameters)
    assert not paths.gain[0].numpy().any()
    dr.backward(dr.sum(paths.gain[0]) + dr.sum(paths.gain[1]))
    assert all(np.isfinite(dr.grad(p).numpy()).all() for p in parameters.values())


def test_known_paths_of_antennas_behind_outer_walls_are_taken(box):
    """The tracer moves such antennas before the wall; lengths are those of the stated positions."""
    behind, array = np.array([[-0.003, 2.0, 1.0], [2.0, 2.0, 1.0]]), receiver(position=(4.2, 5.004, 0.4))
    trace_result = trace_paths(box, behind, array, OPTIONS)
    assert (trace_result.tx_pos_m != behind).any()
    assert (trace_result.receivers[0].position_m != array.position_m).any()
    reused = TracedField(box, behind, array, TracedOptions(OPTIONS), traced=trace_result)
    searched = TracedField(box, behind, array, TracedOptions(OPTIONS))
    for ours, theirs in zip(existing(reused, {}), existing(searched, {}), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_wrong_arguments_are_refused(box):
    with pytest.raises(InputError, match="no derivative"):
        TracedOptions(TraceOptions(diffraction=True))
    for places, headings, name in (([[1.0, 2.0]], None, "tx_pos_m"), (transmitters(2), [0.0], "tx_heading_rad")):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            TracedField(box, places, receiver(), TracedOptions(OPTIONS), headings)
