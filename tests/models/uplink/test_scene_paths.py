"""R2F2 with the paths of a scene: uplink and downlink of transmitters in the laboratory, traced and noisy."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import wrf_mi
from wrf_mi.core import InputError, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.estimators.uplink.r2f2 import distinct
from wrf_mi.estimators.uplink.uplink_paths import Start, find_paths
from wrf_mi.estimators.uplink.uplink_waves import Bands, waves_of
from wrf_mi.synthetic.laboratory import RECEIVER, transmitter_path
from wrf_mi.synthetic.searches import trace_channels
from wrf_mi.tasks.scores import cea_db
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.options import TraceOptions

HZ = 2.437e9 + 312.5e3 * np.arange(-16.0, 16)
HALF = 16
SNR_DB = 25.0
GAIN_DB = 8.0  # least gain by lengths that are known to centimetres: half of the one in these draws
SCENE_GAIN_DB = 4.0  # least gain by the exact scene: 6.8 dB with this noise
SETTINGS = ["depth=2", "reflections=2", "max_paths=20", "wavefront=spherical"]


def noisy(h: NDArray[np.complex128], rng: np.random.Generator) -> NDArray[np.complex128]:
    deviation = np.sqrt(np.square(np.abs(h)).mean(axis=(1, 2), keepdims=True) * 10 ** (-SNR_DB / 10) / 2)
    return h + deviation * (rng.standard_normal((*h.shape, 2)) @ np.array([1, 1j]))


@pytest.fixture(scope="module")
def room() -> Record:
    """Sixteen transmitters in the laboratory, 25 dB above noise; what is scored has none."""
    receiver = replace(RECEIVER, array_m=planar_array(4, 6, 0.06))
    positions = transmitter_path(16)
    options = TraceOptions(transmission=True, depth=2)
    h = trace_channels(open_scene("laboratory", 2.437e9), receiver, positions, HZ, [options])
    measured = noisy(h, np.random.default_rng(0)).astype(np.complex64)
    hz: dict[str, Any] = {"frequencies_hz": HZ[HALF:], "uplink_hz": HZ[:HALF]}
    truth, official = h[None, :, :, HALF:].astype(np.complex64), (np.arange(8), np.arange(8, 16))
    uplink, downlink = measured[:, :, :HALF], measured[None, :, :, HALF:]
    return Record("room", "csi", positions, (receiver,), downlink, official, uplink=uplink, truth=truth, **hz)


def test_known_lengths_carry_close_paths_into_the_next_band():
    """Paths in nearly equal directions: the uplink tells their sum, and lengths known to 3 cm how it turns."""
    rng = np.random.default_rng(3)
    elements = planar_array(4, 6, 0.06)[:, :2]
    waves = waves_of("spherical", Bands(HZ[:HALF], HZ[HALF:], len(elements), True, elements), 100.0)
    theta = np.concatenate([rng.uniform(4, 30, (8, 6, 1)), rng.uniform(-0.3, 0.3, (8, 6, 2))], axis=2)
    gains = rng.standard_normal((8, 6, 2)) @ np.array([1, 1j])
    up, down = (waves.evaluate(theta, gains[..., None], part) for part in (HZ[:HALF], HZ[HALF:]))
    deviation = np.array([0.03, 0.003, 0.003])
    off = theta + deviation * rng.standard_normal(theta.shape)
    known_start = Start(off, np.ones((8, 6), bool), np.broadcast_to(deviation**-2.0, theta.shape))
    median = {}
    for name, start in (("searched", None), ("known", known_start)):
        fitted = find_paths(waves, noisy(up, rng), 12, 1, 15, start)
        median[name] = np.median(cea_db(waves.evaluate(fitted.theta, fitted.gains, HZ[HALF:]), down))
    assert median["known"] > median["searched"] + GAIN_DB


def test_distinct_paths_are_the_strongest_of_those_that_are_alike():
    theta = np.array([[5.0, 0.1, 0.2], [5.01, 0.105, 0.2], [5.0, 0.3, 0.2], [9.0, 0.1, 0.2], [7.0, 0, 0]])
    distinct_theta = distinct(theta, np.array([0.5, 1.0, 0.2, 1e-4, 0.0]))
    assert distinct_theta == pytest.approx(theta[[1, 2]])


def test_scene_raises_the_accuracy_of_the_downlink(room: Record, tmp_path: Path):
    run = {
        scene: wrf_mi.train(
            room, "r2f2", out=tmp_path / str(scene), scene=scene, settings=SETTINGS[0 if scene else 2 :]
        )
        for scene in ("laboratory", None)
    }
    with_scene, without = (run[scene].metrics["cea_db"]["median"] for scene in ("laboratory", None))
    assert with_scene > without + SCENE_GAIN_DB
    assert with_scene > SNR_DB
    opened = wrf_mi.open_run(tmp_path / "laboratory", room)
    asked: dict[str, Any] = {"tx_pos_m": room.tx_pos_m[8:10], "uplink": room.uplink[8:10]}
    assert np.array_equal(opened.predict(**asked).mean, run["laboratory"].predict(**asked).mean)
    with pytest.raises(InputError, match="position"):
        opened.predict(tx_pos_m=np.full((1, 3), np.nan), uplink=room.uplink[:1])
    with pytest.raises(InputError, match="another wavefront than free"):
        wrf_mi.train(room, "r2f2", out=tmp_path / "free", scene="laboratory", settings=["wavefront=free"])
