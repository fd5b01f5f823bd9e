"""Short fits to strengths and channels of any level: predictions follow the transmitter, and are no constant."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_building import building
from scipy.constants import speed_of_light

import wrf_mi
from wrf_mi.core import Receiver, Record
from wrf_mi.gaussians import FIELDS
from wrf_mi.runs.baselines import LEAST_VARIATION, VARIATION

OF_FIELD = (
    *("steps=300", "batch=8", "initial.gaussians=60", "density.every=0", "network.width=64", "validate_every=1000"),
    *("optimiser.network=3e-3", "optimiser.warm_up=20", "optimiser.ema_decay=0.95"),
)
OF_NERF2 = (
    *("steps=300", "sphere_batch=64", "networks.width=64", "networks.layers=4", "networks.skip=0"),
    *("validate_every=100", "optimiser.network=3e-3"),
)
STRENGTHS = {  # offset in dB, and factor of the differences from the mean
    "as received": (0.0, 1.0),
    "weak": (-120.0, 1.0),  # near the power that counts as none
    "strong": (100.0, 1.0),
    "wide": (-20.0, 4.0),  # over 100 dB
}
CHANNELS = {"unit": 1.0, "weak": 1e-9, "strong": 1e6}  # factors


def strengths(kind: str) -> Record:
    """Powers of a law in a building, of any level and range."""
    record = building()
    (offset_db, factor), mean = STRENGTHS[kind], record.observation.mean()
    observed = mean + offset_db + factor * (record.observation - mean)
    return replace(record, observation=observed.astype(np.float32))


def channels(kind: str) -> Record:
    """Channels of a direct wave over a region of half a wavelength; the last fifth of 60 rows is the test set."""
    hz, rng = 300e6 + 1e6 * np.arange(2.0), np.random.default_rng(0)
    tx_m = rng.uniform([-0.25, -0.25, 1.5], [0.25, 0.25, 2.0], (60, 3))
    length = np.linalg.norm(tx_m, axis=1)[:, None]
    observed = CHANNELS[kind] * np.exp(-2j * np.pi * hz / speed_of_light * length) / length
    receiver = Receiver("station", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    official = np.arange(48), np.arange(48, 60)
    observed = observed.astype(np.complex64)[None]
    return Record("channels", "csi", tx_m, (receiver,), observed, official=official, frequencies_hz=hz)


def check(record: Record, model: str, out: Path) -> None:
    settings = OF_FIELD if model in FIELDS else OF_NERF2
    metrics = wrf_mi.train(record, model, out=out, settings=settings).metrics
    assert metrics[VARIATION]["ratio"] > LEAST_VARIATION


def cases(kinds: Mapping[str, Any]) -> list[Any]:
    """Pairs of a model and a kind, all but one slow."""
    fast = ("factorised", "weak")
    pairs = product((*FIELDS, "nerf2"), kinds)
    return [pytest.param(*pair, marks=[] if pair == fast else pytest.mark.slow) for pair in pairs]


@pytest.mark.parametrize(("model", "kind"), cases(STRENGTHS))
def test_strengths_of_any_level_are_learned(model: str, kind: str, tmp_path: Path) -> None:
    check(strengths(kind), model, tmp_path / "run")


@pytest.mark.parametrize(("model", "kind"), cases(CHANNELS))
def test_channels_of_any_level_are_learned(model: str, kind: str, tmp_path: Path) -> None:
    check(channels(kind), model, tmp_path / "run")
