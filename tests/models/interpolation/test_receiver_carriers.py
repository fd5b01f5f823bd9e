"""Free-space mean of signal strengths of receivers with different carriers."""

from __future__ import annotations

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.models.interpolation.strengths import Strengths, fit_strengths


def test_the_mean_of_a_receiver_has_its_carrier_and_is_stored():
    """At one place free space differs by 20 log10 of the carriers' ratio, as of Friis' law."""
    place, carriers_hz = np.array([0.0, 0, 2]), np.array([0.9e9, 3.6e9])
    receivers = tuple(Receiver(f"cell:{hz:g}", place, np.array(UPRIGHT)) for hz in carriers_hz)
    positions_m = np.random.default_rng(0).uniform(1, 9, (12, 3))
    level = -20 * np.log10(np.linalg.norm(positions_m - place, axis=1))
    observed = np.stack([level - 40, level - 52]).astype(np.float32)
    plain = Record("cells", "rssi", positions_m, receivers, observed, frequencies_hz=np.array([0.9e9]))
    expected = {}
    for name, record in (("own", plain.at_receiver_carriers(carriers_hz)), ("one", plain)):
        fitted = fit_strengths(record, np.arange(12))
        again = Strengths.from_arrays(fitted.arrays())
        np.testing.assert_array_equal(again.field.prior.frequency_hz, fitted.field.prior.frequency_hz)
        poses = again.field.stops.poses
        expected[name] = np.subtract(*(again.field.prior.columns(poses, receiver)[0] for receiver in (0, 1)))
    np.testing.assert_allclose(expected["own"], 20 * np.log10(4), rtol=1e-12)
    np.testing.assert_array_equal(expected["one"], 0)
