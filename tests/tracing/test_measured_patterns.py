"""Measured antenna patterns in traces: traced fields, gains of a trace and Sionna RT's own solver agree."""

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from box_room import receiver, transmitters
from wrf_mi_bench.sionna_reference import sionna_paths

from wrf_mi.backend.device import Recorded
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Antenna
from wrf_mi.core.antenna import boresight_orientation
from wrf_mi.tracing import TraceOptions, load_trace, recompute, save_trace, trace_paths
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.sionna.path_solver import sionna_pattern

AGREE = 1e-4  # of the strongest path: Sionna RT in single precision, angles of a table among them
SLOPE = 1e-5  # Relative: central differences in float64
OPTIONS = TraceOptions(depth=2, rays=4096)
TURN_DEG = (30, 50, -70)
Tensor64: Any = dr.tensor_t(Float64)


@pytest.fixture(scope="module")
def patterns(tmp_path_factory: pytest.TempPathFactory) -> list[Antenna]:
    """Two lobes of random spherical harmonics with phase and one without, in a smaller table."""
    folder, rng, antennas = tmp_path_factory.mktemp("patterns"), np.random.default_rng(4), []
    for number, step in enumerate((5, 5, 10)):
        theta, phi = (np.ravel(a) for a in np.meshgrid(np.arange(0, 180.1, step), np.arange(0, 360, step)))
        t, p = np.radians(theta), np.radians(phi)
        unit = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])
        gain, phase = (scale * rng.normal(size=3) @ unit for scale in (4, 60))
        columns = [theta, phi, gain - 6, phase][: 3 + (number < 2)]
        header = ",".join(("theta", "phi", "gain_db", "phase")[: len(columns)])
        file = folder / f"{number}.csv"
        np.savetxt(file, np.stack(columns, axis=-1), delimiter=",", header=header, comments="")
        antennas.append(Antenna(str(file), "VH"[number % 2], "array"))
    return antennas


def gains(field: TracedField, paths: Any) -> np.ndarray[Any, Any]:
    real, imaginary = (part.numpy() for part in paths.gain)
    return (real + 1j * imaginary)[field.exists]


def test_traced_fields_are_those_of_sionna_rt(box, patterns, tmp_path):
    """With phases at both ends, and whichever end the search started from."""
    tx_antenna = replace(patterns[1], frame="world")
    for rx_antenna in (patterns[0], patterns[2]):
        array, tx = replace(receiver(TURN_DEG), antenna=rx_antenna), transmitters(5)
        traced = trace_paths(box, tx, array, OPTIONS, tx_antenna=tx_antenna)
        field = TracedField(box, tx, array, TracedOptions(OPTIONS, tx_antenna=tx_antenna), traced=traced)
        largest = np.abs(traced.paths.gain).max()
        np.testing.assert_allclose(gains(field, field({})), traced.paths.gain, atol=AGREE * largest)
        other = replace(traced, from_receivers=not traced.from_receivers)
        np.testing.assert_allclose(recompute(other, box).paths.gain, traced.paths.gain, atol=AGREE * largest)
        stored = load_trace(save_trace(tmp_path / "paths.npz", traced))
        assert (stored.receivers[0].antenna, stored.tx_antenna) == (rx_antenna, tx_antenna)


def test_gains_are_those_of_sionna_rts_solver(box, patterns):
    """Of a registered pattern, whose conjugate Sionna RT takes at the receiver; phases included."""
    from sionna.rt import register_antenna_pattern
    from sionna.rt.antenna_pattern import AntennaPattern

    class Measured(AntennaPattern):
        def __init__(self, *, polarization: str) -> None:
            self.patterns = [sionna_pattern(replace(patterns[0], polarization=polarization), receives=True)]

    register_antenna_pattern("measured", Measured)
    pose = replace(receiver(), orientation_xyzw=boresight_orientation(0.7, 0.2), antenna=patterns[0])
    options, [tx_m] = replace(OPTIONS, rays=30_000, transmission=False), transmitters(1)
    paths = trace_paths(box, tx_m, pose, options).paths
    turned = {"pattern": "measured", "turn_rad": (0.7, 0.2, 0)}
    _, expected, length_m, _ = sionna_paths(box, tx_m, pose.position_m, options, **turned)
    of_length, of_expected = np.argsort(paths.length_m), np.argsort(length_m)
    np.testing.assert_allclose(paths.gain[of_length], expected[of_expected], atol=AGREE * np.abs(expected).max())


def test_recordings_read_tables_at_each_call(box, patterns):
    """A function that was recorded with one table gives the paths of another one, and its derivatives."""
    poses = [replace(receiver(TURN_DEG), antenna=replace(each, polarization="V")) for each in patterns[:2]]
    first, second = (TracedField(box, transmitters(5), pose, TracedOptions(OPTIONS)) for pose in poses)
    assert first.form == second.form
    present = [first]
    recorded = Recorded(lambda: present[0]({}).gain, lambda: present[0].arrays)
    for present[0] in (first, second, first, second):
        expected = np.stack([part.numpy() for part in present[0]({}).gain])
        np.testing.assert_allclose(np.stack([part.numpy() for part in recorded()]), expected, rtol=0, atol=1e-15)
    assert recorded.frozen.n_recordings < 4  # the others are replayed
    difference = np.abs(gains(first, first({})) - gains(second, second({})))
    assert difference.max() > 0.1 * np.abs(gains(first, first({}))).max()


def test_gains_follow_turns_of_the_receiver(box, patterns):
    """Derivatives of coherent sums by the rotation of the receiver are finite differences."""
    pose = replace(receiver(TURN_DEG), antenna=patterns[0])
    field = TracedField(box, transmitters(5), pose, TracedOptions(OPTIONS))
    weights = Float64(np.random.default_rng(5).normal(size=dr.width(field.chains.exists)))

    def total(turn: Any) -> Any:
        re, im = field({"receiver.array.turn": turn}).gain
        return dr.sum(weights * (re + 2 * im))

    turn = Tensor64([0.01, -0.02, 0.03])
    dr.enable_grad(turn)
    dr.backward(total(turn))
    for axis in range(3):
        up, down = (float(total(Tensor64(turn.numpy() + sign * 1e-5 * np.eye(3)[axis]))[0]) for sign in (1, -1))
        assert turn.grad.numpy()[axis] == pytest.approx((up - down) / 2e-5, rel=SLOPE)
