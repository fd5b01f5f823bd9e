"""Antennas of traced arrays: turned frames, warnings of cross-polarised links, the command's options."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from calling import call
from scipy.spatial.transform import Rotation
from traced_rooms import SHOEBOX, write_xml

from wrf_mi.core import Antenna, AntennaOptions, InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.runs.api import open_run, train
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, load_trace, open_scene, trace_paths
from wrf_mi.tracing.tracer import GAIN_DB, cross_polarized
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.trainer import Trainer

HZ = 920e6
OPTIONS = TraceOptions(depth=1, rays=1 << 12)
ARRAY_M = planar_array(4, 4, 0.16)
STANDING = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # boresight -x, the array's y axis up


WARNING = "try --rx-polarization H or --rx-frame world"


@pytest.fixture(scope="module")
def xml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xml(tmp_path_factory.mktemp("shoebox"), SHOEBOX)


@pytest.fixture(scope="module")
def scene(xml: Path) -> Any:
    return open_scene(xml, HZ)


def array(turn_deg: float, antenna: Antenna) -> Receiver:
    """An array on the east side, turned about its normal."""
    turned = STANDING * Rotation.from_euler("z", turn_deg, degrees=True)
    return Receiver("gateway1", np.array([5.2, 2.4, 1.1]), turned.as_quat(), antenna)


def record(receiver: Receiver, tx: np.ndarray, spectra: np.ndarray) -> Record:
    rows = np.arange(len(tx))
    split = rows[: len(tx) // 2], rows[len(tx) // 2 :]
    ends = {"official": split, "frequencies_hz": np.array([HZ])}
    return Record("turned", "spectrum", tx, (receiver,), spectra[None], **ends).with_array(ARRAY_M)


def places(count: int = 12) -> np.ndarray:
    return np.random.default_rng(1).uniform([0.4, 0.4, 0.5], [3.5, 4.6, 2.2], (count, 3))


def spectra_of(scene: Any, receiver: Receiver, tx: np.ndarray) -> np.ndarray:
    instrument = instrument_of(record(receiver, tx, np.zeros((len(tx), 30, 120), np.float32)))
    return np.asarray(instrument.observe(trace_paths(scene, tx, receiver, OPTIONS).paths)[0])


@pytest.fixture(scope="module")
def turned_folder(scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spectra of a vertically polarised array that is mounted turned by 90 degrees about its normal."""
    tx = places()
    spectra = np.roll(spectra_of(scene, array(0, Antenna()), tx), -30, axis=-1)
    path = tmp_path_factory.mktemp("data") / "turned"
    return write_spectrum_folder(path, record(array(90, Antenna()), tx, spectra))


def median(run: Path) -> float:
    return float(json.loads((run / "metrics.json").read_text())["ssim"]["median"])


def test_turning_the_frame_about_its_normal_rolls_the_spectrum(scene: Any) -> None:
    """A square array sees the same sky from another azimuth if its antennas stay vertical in the world."""
    tx, turned = places(4), 90 // 3
    spectra = [spectra_of(scene, array(degrees, Antenna()), tx) for degrees in (0, 90)]
    np.testing.assert_allclose(np.roll(spectra[0], -turned, axis=-1), spectra[1], atol=1e-4)
    framed = [spectra_of(scene, array(degrees, Antenna(frame="array")), tx) for degrees in (0, 90)]
    np.testing.assert_allclose(framed[0], spectra[0], atol=1e-4)  # the array's y axis is up
    assert np.abs(np.roll(framed[0], -turned, axis=-1) - framed[1]).max() > 0.1


def test_spectra_of_a_turned_array_are_traced(
    xml: Path, turned_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert median(train(turned_folder, tmp_path / "run", "ray-tracing", scene=xml, settings=OPTIONS).folder) > 0.99
    assert "polarisation" not in caplog.text


def test_cross_polarised_data_warn_and_name_the_option(
    xml: Path, turned_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: Any
) -> None:
    asked = ["trace", xml, turned_folder, "--depth", "1", "--rays", "4096"]
    status, _, err = call([*asked, "--rx-frame", "array", "--out", tmp_path / "wrong"], capsys)
    assert status == 0, err
    assert "try --rx-polarization H or --rx-frame world (now: V, frame array)" in caplog.text
    caplog.clear()
    both = ["--rx-frame", "array", "--rx-polarization", "H"]
    status, _, err = call([*asked, *both, "--out", tmp_path / "right"], capsys)
    assert status == 0, err
    assert "--rx-polarization" not in caplog.text
    assert median(tmp_path / "wrong") < median(tmp_path / "right") - 0.1
    # An isotropic antenna's H is along the azimuth's unit vector: vertical at the boresight alone.
    assert 0.85 < median(tmp_path / "right") < 0.99
    stated = yaml.safe_load((tmp_path / "right" / "config.yaml").read_text())["antennas"]
    assert (stated["rx_frame"], stated["rx_polarization"]) == ("array", "H")
    assert load_trace(tmp_path / "right" / "paths.npz").receivers[0].antenna == Antenna("iso", "H", "array")
    status, _, err = call(["evaluate", tmp_path / "right"], capsys)
    assert status == 0, err
    assert median(tmp_path / "right") > 0.85
    status, _, err = call([*asked, "--rx-frame", "world", "--out", tmp_path / "world"], capsys)
    assert status == 0, err
    assert median(tmp_path / "world") > 0.99


def test_only_cross_polarised_receivers_are_found(scene: Any) -> None:
    tx = places()
    good, bad = array(0, Antenna()), replace(array(0, Antenna(polarization="H")), name="gateway2")
    traced = trace_paths(scene, tx, [good, bad], TraceOptions(depth=0))
    found = cross_polarized(traced, scene)
    assert list(found) == ["gateway2"]
    assert found["gateway2"] > GAIN_DB


def test_each_receiver_is_traced_with_its_antenna(scene: Any) -> None:
    antennas = [Antenna(), Antenna("dipole", "H"), Antenna("tr38901", "V", "array"), Antenna("hw_dipole")]
    receivers = [replace(array(20, a), name=f"gateway{i}") for i, a in enumerate(antennas)]
    tx = places(3)
    together = trace_paths(scene, tx, receivers, OPTIONS).paths
    for index, receiver in enumerate(receivers):
        alone = trace_paths(scene, tx, receiver, OPTIONS).paths
        np.testing.assert_allclose(together.gain[together.rx == index], alone.gain, rtol=1e-5, atol=1e-9)


def test_transmitters_are_traced_with_their_antenna(scene: Any) -> None:
    """Along a horizontal line of sight a horizontal transmitter reaches a horizontal antenna only."""
    tx = np.array([[2.0, 2.4, 1.1]])
    direct = TraceOptions(depth=0)
    gains = {
        (sent, taken): abs(
            trace_paths(scene, tx, array(0, Antenna("iso", taken)), direct, tx_antenna=Antenna("iso", sent)).paths.gain[
                0
            ]
        )
        for sent in "VH"
        for taken in "VH"
    }
    assert gains["H", "H"] == pytest.approx(gains["V", "V"], rel=1e-5)
    assert max(gains["H", "V"], gains["V", "H"]) < 1e-5 * gains["V", "V"]


def test_run_predicts_with_its_antennas(scene: Any, xml: Path, turned_folder: Path, tmp_path: Path) -> None:

    antennas = AntennaOptions(rx_pattern="tr38901", rx_frame="array", rx_polarization="H", tx_pattern="dipole")
    out = train(turned_folder, tmp_path / "run", "ray-tracing", scene=xml, settings=OPTIONS, antennas=antennas).folder
    tx = places()
    with np.load(out / "predictions.npz") as stored:
        np.testing.assert_allclose(open_run(out).predict(tx[stored["row"]]).mean, stored["prediction"], atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "wrf-gs+", "--rx-polarization", "H"], "antenna options belong to a scene that is traced"),
        (["--model", "kriging", "--tx-pattern", "dipole"], "antenna options belong to a scene that is traced"),
        (["--model", "hybrid", "--rx-polarization", "H"], "antenna options belong to a scene that is traced"),
    ],
)
def test_antenna_options_are_refused_where_nothing_is_traced(
    turned_folder: Path, tmp_path: Path, capsys: Any, arguments: list[str], message: str
) -> None:
    status, _, err = call(["train", turned_folder, *arguments, "--out", tmp_path / "run"], capsys)
    assert status == 2
    assert message in err
    assert not (tmp_path / "run").exists()


def test_directional_pattern_needs_a_frame(xml: Path, turned_folder: Path, tmp_path: Path) -> None:
    antennas = AntennaOptions(rx_pattern="tr38901")
    with pytest.raises(InputError, match="state frame array"):
        train(turned_folder, tmp_path / "run", "ray-tracing", scene=xml, settings=OPTIONS, antennas=antennas)
    assert not (tmp_path / "run").exists()


def test_joint_training_warns_of_crossed_polarisation(
    scene: Any, turned_folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = np.arange(4)
    split = Split("all", 0, rows, rows[:0], rows[:0])
    config = with_settings(TrainConfig(), ["model=wrf-gs+", "traced.depth=1", "traced.rays=4096"])
    for options, warned in ((AntennaOptions(), False), (AntennaOptions(rx_frame="array"), True)):
        Trainer(load(turned_folder).with_antennas(options), split, config, scene=scene)
        assert (WARNING in caplog.text) is warned
