"""Patterns and polarisations of antennas against Sionna RT, in files and as options."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import refusal
from scipy.spatial.transform import Rotation

from wrf_mi import backend
from wrf_mi.core import Antenna, AntennaOptions, Receiver, Record, receiver_arrays, stored_receivers
from wrf_mi.core.antenna import FRAMES, PATTERNS, POLARIZATIONS
from wrf_mi.core.array_files import write_arrays

SINGLE = 1e-6
"""Sionna RT's patterns in single precision."""


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("polarization", POLARIZATIONS)
def test_field_is_that_of_sionna_rt(pattern: str, polarization: str) -> None:
    backend.init()
    import mitsuba as mi
    from sionna.rt.antenna_pattern import antenna_pattern_registry

    rng = np.random.default_rng(0)
    theta, phi = np.arccos(rng.uniform(-0.999, 0.999, 200)), rng.uniform(-np.pi, np.pi, 200)
    sine, cosine = np.sin(theta), np.cos(theta)
    field = Antenna(pattern, polarization, "array").field(
        np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
    )
    theta_hat = np.stack([cosine * np.cos(phi), cosine * np.sin(phi), -sine], axis=-1)
    phi_hat = np.stack([-np.sin(phi), np.cos(phi), np.zeros(200)], axis=-1)
    function = antenna_pattern_registry.get(pattern)(polarization=polarization).patterns[0]
    expected = [part.real.numpy() for part in function(mi.Float(theta), mi.Float(phi))]
    np.testing.assert_allclose((field * theta_hat).sum(axis=1), expected[0], atol=20 * SINGLE)
    np.testing.assert_allclose((field * phi_hat).sum(axis=1), expected[1], atol=20 * SINGLE)
    assert (field * np.cross(theta_hat, phi_hat)).sum(axis=1) == pytest.approx(0, abs=1e-12)
    # Along the axis, too, it is finite.
    assert np.isfinite(Antenna(pattern, polarization, "array").field([[0.0, 0, 1], [0.0, 0, -1], [1e-9, 0, 1]])).all()


def test_frames_and_turned_antennas() -> None:
    """The default is vertical in the world for any orientation of the array."""
    for turn in Rotation.random(5, rng=3).as_quat():
        assert np.array_equal(Antenna().to_world(turn), np.eye(3))
        # Boresight +x is the array's normal, and V lies along the array's y axis.
        array = Rotation.from_quat(turn).as_matrix()
        np.testing.assert_allclose(Antenna(frame="array").to_world(turn), array[:, [2, 0, 1]], atol=1e-12)
    antenna = Antenna("dipole", "H", "array")
    assert antenna.turned.turned == antenna
    assert antenna.turned == replace(antenna, polarization="V")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"pattern": "horn"}, "pattern is 'horn'; choose from iso, dipole, hw_dipole, tr38901"),
        ({"polarization": "VH"}, "polarization is 'VH'; choose from V, H"),
        ({"frame": "body"}, "frame is 'body'; choose from world, array"),
        ({"pattern": "tr38901"}, "has a boresight, which the frame world does not tell; state frame array"),
        ({"pattern": ["iso"]}, "pattern is"),
    ],
)
def test_unknown_antennas_are_refused(words: dict[str, Any], message: str) -> None:
    refusal(Antenna, message, **words)


def test_options_replace_only_the_given_properties() -> None:
    pair = tuple(Receiver(name, np.zeros(3), np.array([0, 0, 0, 1.0]), Antenna("dipole", "H")) for name in "ab")
    record = Record("made", "rssi", np.ones((2, 3)), pair, np.zeros((2, 2), np.float32))
    assert record.with_antennas(AntennaOptions()) is record
    changed = record.with_antennas(AntennaOptions(rx_polarization="V", tx_pattern="hw_dipole"))
    assert [receiver.antenna for receiver in changed.receivers] == [Antenna("dipole")] * 2
    assert changed.tx_antenna == Antenna("hw_dipole")
    refusal(record.with_antennas, AntennaOptions(rx_pattern="tr38901"), "state frame array")
    directional = record.with_antennas(AntennaOptions(rx_pattern="tr38901", rx_frame="array"))
    assert directional.receivers[1].antenna.frame == "array"


def test_stored_receivers_are_read_back(tmp_path: Path) -> None:
    words = [(p, q, f) for p in PATTERNS for q in POLARIZATIONS for f in FRAMES]
    antennas = [Antenna(p, q, f) for p, q, f in words if (p, f) != ("tr38901", "world")]
    rng = np.random.default_rng(2)
    receivers = [
        Receiver(f"r{i}", rng.normal(size=3), rng.normal(size=4), antenna) for i, antenna in enumerate(antennas)
    ]
    write_arrays(tmp_path / "receivers.npz", receiver_arrays(receivers))
    with np.load(tmp_path / "receivers.npz", allow_pickle=False) as arrays:
        read = stored_receivers(arrays)
    np.testing.assert_equal([*map(vars, read)], [*map(vars, receivers)])
