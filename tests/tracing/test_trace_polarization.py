"""Antennas of traced arrays: turned frames, warnings of cross-polarised links, the command's options."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from wrf_mi.core import Antenna, AntennaOptions, InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.runs.api import open_run, train
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, load_trace, open_scene, trace_paths
from wrf_mi.tracing.tracer import GAIN_DB, TRIED, check_polarization, cross_polarized
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.trainer import Trainer

HZ = 920e6
OPTIONS = TraceOptions(depth=1, rays=1 << 12)
ARRAY_M = planar_array(4, 4, 0.16)
STANDING = Rotation.from_matrix([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # boresight -x, the array's y axis up


WARNING = "try --rx-polarization H or --rx-frame world"


@pytest.fixture(scope="module")
def polar(shoebox_xml):
    return open_scene(shoebox_xml, HZ)


def array(turn_deg, antenna):
    """An array on the east side, turned about its normal."""
    turned = STANDING * Rotation.from_euler("z", turn_deg, degrees=True)
    return Receiver("gateway1", np.array([5.2, 2.4, 1.1]), turned.as_quat(), antenna)


def record(receiver, tx, spectra):
    ends: dict[str, Any] = {"official": np.split(np.arange(len(tx)), 2), "frequencies_hz": np.array([HZ])}
    return Record("turned", "spectrum", tx, (receiver,), spectra[None], **ends).with_array(ARRAY_M)


def places(count=12):
    return np.random.default_rng(1).uniform([0.4, 0.4, 0.5], [3.5, 4.6, 2.2], (count, 3))


def spectra_of(polar, receiver, tx):
    instrument = instrument_of(record(receiver, tx, np.zeros((len(tx), 30, 120), np.float32)))
    return np.asarray(instrument.observe(trace_paths(polar, tx, receiver, OPTIONS).paths)[0])


@pytest.fixture(scope="module")
def turned_folder(polar, tmp_path_factory):
    """Spectra of a vertically polarised array that is mounted turned by 90 degrees about its normal."""
    tx = places()
    spectra = np.roll(spectra_of(polar, array(0, Antenna()), tx), -30, axis=-1)
    path = tmp_path_factory.mktemp("data") / "turned"
    return write_spectrum_folder(path, record(array(90, Antenna()), tx, spectra))


def median(run):
    return float(json.loads((run / "metrics.json").read_text())["ssim"]["median"])


def test_turning_the_frame_about_its_normal_rolls_the_spectrum(polar):
    """A square array sees the same sky from another azimuth if its antennas stay vertical in the world."""
    tx, turned = places(4), 90 // 3
    spectra = [spectra_of(polar, array(degrees, Antenna()), tx) for degrees in (0, 90)]
    np.testing.assert_allclose(np.roll(spectra[0], -turned, axis=-1), spectra[1], atol=1e-4)
    framed = [spectra_of(polar, array(degrees, Antenna(frame="array")), tx) for degrees in (0, 90)]
    np.testing.assert_allclose(framed[0], spectra[0], atol=1e-4)  # the array's y axis is up
    assert np.abs(np.roll(framed[0], -turned, axis=-1) - framed[1]).max() > 0.1


def test_cross_polarised_data_warn_and_name_the_option(shoebox_xml, turned_folder, tmp_path, caplog, command):
    def traced(name, *words):
        caplog.clear()
        asked = [
            "trace",
            turned_folder,
            "--scene",
            shoebox_xml,
            "--depth",
            "1",
            "--rays",
            "4096",
            "--out",
            tmp_path / name,
            *words,
        ]
        command.done(asked)
        return median(tmp_path / name)

    wrong = traced("wrong", "--rx-frame", "array")
    assert f"{WARNING} (now: V, frame array)" in caplog.text
    right = traced("right", "--rx-frame", "array", "--rx-polarization", "H")
    assert "--rx-polarization" not in caplog.text
    # An isotropic antenna's H is along the azimuth's unit vector: vertical at the boresight alone.
    assert max(wrong + 0.1, 0.85) < right < 0.99
    antennas = yaml.safe_load((tmp_path / "right" / "config.yaml").read_text())["antennas"]
    assert (antennas["rx_frame"], antennas["rx_polarization"]) == ("array", "H")
    assert load_trace(tmp_path / "right" / "paths.npz").receivers[0].antenna == Antenna("iso", "H", "array")
    command.done(["evaluate", tmp_path / "right"])
    assert median(tmp_path / "right") > 0.85
    for name, words in (("world", ["--rx-frame", "world"]), ("default", [])):
        assert traced(name, *words) > 0.99
        assert "polarisation" not in caplog.text


def test_only_cross_polarised_receivers_are_found(polar):
    tx = places()
    good, bad = array(0, Antenna()), replace(array(0, Antenna(polarization="H")), name="gateway2")
    traced = trace_paths(polar, tx, [good, bad], TraceOptions(depth=0))
    crossed = cross_polarized(traced, polar)
    assert list(crossed) == ["gateway2"]
    assert crossed["gateway2"] > GAIN_DB


def test_a_few_stated_receivers_tell_the_polarisation_of_a_building(polar, caplog):
    """Each receiver takes a search; whoever has not stated where one is has not stated its antenna either."""
    crossed = [replace(array(0, Antenna(polarization="H")), name=f"point{k}") for k in range(TRIED + 4)]
    check_polarization(polar, places(), crossed, Antenna())
    assert f"{TRIED} of {TRIED} receivers" in caplog.text
    caplog.clear()
    estimated = [replace(receiver, position_std_m=np.ones(3)) for receiver in crossed]
    check_polarization(polar, places(), estimated, Antenna())
    assert not caplog.text


def test_each_receiver_is_traced_with_its_antenna(polar):
    antennas = [Antenna(), Antenna("dipole", "H"), Antenna("tr38901", "V", "array"), Antenna("hw_dipole")]
    receivers = [replace(array(20, a), name=f"gateway{i}") for i, a in enumerate(antennas)]
    tx = places(3)
    together = trace_paths(polar, tx, receivers, OPTIONS).paths
    for index, receiver in enumerate(receivers):
        alone = trace_paths(polar, tx, receiver, OPTIONS).paths
        np.testing.assert_allclose(together.gain[together.rx == index], alone.gain, rtol=1e-5, atol=1e-9)


def test_transmitters_are_traced_with_their_antenna(polar):
    """Along a horizontal line of sight a horizontal transmitter reaches a horizontal antenna only."""

    def gain(sent, received):
        taking, sending = array(0, Antenna("iso", received)), Antenna("iso", sent)
        paths = trace_paths(polar, [[2.0, 2.4, 1.1]], taking, TraceOptions(depth=0), tx_antenna=sending).paths
        return float(abs(paths.gain[0]))

    assert gain("H", "H") == pytest.approx(gain("V", "V"), rel=1e-5)
    assert max(gain("H", "V"), gain("V", "H")) < 1e-5 * gain("V", "V")


def test_run_predicts_with_its_antennas(shoebox_xml, turned_folder, tmp_path):
    """A directional pattern needs a frame."""

    def trained(**antennas):
        options = AntennaOptions(rx_pattern="tr38901", **antennas)
        run = tmp_path / "run"
        return train(
            turned_folder, "ray-tracing", out=run, scene=shoebox_xml, settings=OPTIONS, antennas=options
        ).folder

    with pytest.raises(InputError, match="state frame array"):
        trained()
    assert not (tmp_path / "run").exists()
    out = trained(rx_frame="array", rx_polarization="H", tx_pattern="dipole")
    with np.load(out / "predictions.npz") as stored:
        predicted = open_run(out).predict(places()[stored["row"]]).mean
        np.testing.assert_allclose(predicted, stored["prediction"], atol=1e-4)


@pytest.mark.parametrize(
    ("model", "option"),
    [("wrf-gs+", "--rx-polarization=H"), ("kriging", "--tx-pattern=dipole"), ("hybrid", "--rx-polarization=H")],
)
def test_antenna_options_are_refused_where_nothing_is_traced(turned_folder, tmp_path, command, model, option):
    asked = ["train", turned_folder, "--model", model, option, "--out", tmp_path / "run"]
    command.refused(asked, "antenna options belong to a scene that is traced")
    assert not (tmp_path / "run").exists()


def test_joint_training_warns_of_crossed_polarisation(polar, turned_folder, caplog):
    rows = np.arange(4)
    config = with_settings(TrainConfig(), ["model=wrf-gs+", "traced.depth=1", "traced.rays=4096"])
    for options, warned in ((AntennaOptions(), False), (AntennaOptions(rx_frame="array"), True)):
        polarized = load(turned_folder).with_antennas(options)
        Trainer(polarized, Split("all", 0, rows, rows[:0], rows[:0]), config, scene=polar)
        assert (WARNING in caplog.text) is warned
