"""Rows of several carriers in one graph: ports of a receiver, each at its carrier."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from box_room import CEILING, PARTITION, WALLS, receiver, transmitters
from made_spectra import true_field
from traced_rooms import write_xml

import wrf_mi
from wrf_mi.core import Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.graph.graph import Graph
from wrf_mi.graph.settings import TracedConfig
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.receivers.registry import ObservationSpec
from wrf_mi.tasks.conditions import scene_carrier
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.config import calibration_config
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.trainer import Trainer

CARRIERS_HZ = (1.2e9, 2.4e9, 5.8e9)
BETWEEN_HZ = 3.5e9
OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)
CONFIG = TracedConfig(depth=2, reflections=2, rays=4096, faint=0.0)
SIZE = (9, 24)
SINGLE, SINGLE_DB = 1e-6, 2e-5  # Of greys in 0..1, and of dB: rounding of single precision
STRENGTH_DB, TRACED = 1e-3, 1e-3  # In dB and of greys: gains of the tracer are in single precision
QUICK = ("initial.gaussians=8", "optimiser.warm_up=5", "density.every=0", "validate_every=10", "batch=4")


@pytest.fixture(scope="module")
def xml(tmp_path_factory):
    return write_xml(tmp_path_factory.mktemp("room"), {**WALLS, **CEILING, **PARTITION})


def array():
    return replace(receiver(), array_m=planar_array(4, 4, 0.026))


def second():
    return replace(array(), name="second", position_m=np.array([4.0, 2.2, 0.7]))


def spectra(xml, count=12):
    """Spectra of each transmitter at each carrier, traced."""
    tracer = RayTracer(xml, Instrument("array", (array(),), np.array([CARRIERS_HZ[0]]), size=SIZE), OPTIONS)
    carriers = np.repeat(CARRIERS_HZ, count)
    traced = tracer.trace(np.tile(transmitters(count), (len(CARRIERS_HZ), 1)), carriers_hz=carriers)
    observed = tracer.observe(traced).astype(np.float32)
    return Record("bands", "spectrum", traced.tx_pos_m, (array(),), observed, carriers_hz=carriers)


def graph_of(xml, form, field=None, receivers=None, **config):
    """A graph at the carrier of a form, with a field beside the paths or without."""
    scene = open_scene(xml, form.carrier_hz or form.frequencies_hz[0])
    return Graph(field, receivers or (array(),), form, scene, replace(CONFIG, **config))


MIDDLE = ObservationSpec("array", SIZE, np.array([CARRIERS_HZ[1]]))
PORTS = ObservationSpec("array", SIZE, carriers_hz=np.array(CARRIERS_HZ))


@pytest.mark.parametrize(("model", "tolerance"), [("array", SINGLE), ("power", SINGLE_DB)])
def test_ports_observe_what_a_graph_of_each_carrier_observes(model, tolerance, xml):
    """At trained carriers and at others, in the order of the rows; materials follow the laws of ITU-R P.2040."""
    receivers, form = (array(), second()), replace(PORTS, receiver=model)
    rows = np.array([*CARRIERS_HZ, BETWEEN_HZ])[np.random.default_rng(0).permutation(np.arange(12) % 4)]
    predict = Predictor(graph_of(xml, form, receivers=receivers), {})
    predicted = [predict(transmitters(12), number, carriers_hz=rows) for number in range(2)]
    for hz in np.unique(rows):
        single = replace(form, frequencies_hz=np.array([hz]), carriers_hz=None)
        alone = Predictor(graph_of(xml, single, receivers=receivers), {})
        for number in range(2):
            expected = alone(transmitters(12)[rows == hz], number)
            np.testing.assert_allclose(predicted[number][rows == hz], expected, atol=tolerance)


@pytest.mark.parametrize("count", [1, 5])
def test_spectra_of_uncertain_phases_are_the_expectation_of_the_tracer(count, xml):
    """Of several transmitters, and of one, whose observation is recorded; both differ from those of certain phases."""
    instrument = Instrument("array", (array(),), np.array([CARRIERS_HZ[1]]), size=SIZE, phase_error=1.0)
    tracer, graph = RayTracer(xml, instrument, OPTIONS), graph_of(xml, MIDDLE)
    expected = tracer.observe(tracer.trace(transmitters(count)))[0]
    certain, predicted = (Predictor(graph, {}, phase_error=sd)(transmitters(count), 0) for sd in (0.0, 1.0))
    np.testing.assert_allclose(predicted, expected, rtol=0, atol=TRACED)
    assert np.abs(certain - expected).max() > 0.05


def test_gaussians_count_in_each_draw_of_the_paths_phases(xml):
    """With phases that are as good as certain the expectation is the observation itself, beside Gaussians, too."""
    field, params = true_field("wrf-gs+")
    graph = graph_of(xml, MIDDLE, field)
    for count in (1, 5):
        certain, drawn = (Predictor(graph, params, phase_error=sd)(transmitters(count), 0) for sd in (0.0, 1e-9))
        np.testing.assert_allclose(certain, drawn, rtol=0, atol=10 * SINGLE)


def test_observations_from_one_search_are_those_of_a_search_for_each_carrier(xml):
    """Of rows whose positions are partly the same, some of them repeated, at two trained carriers and another one."""
    predict = Predictor(graph_of(xml, PORTS, faint=0.05), {})
    tx = transmitters(6)[[0, 1, 2, 2, 3, 2, 1, 0, 5, 3, 4, 4]]
    carriers = np.array([CARRIERS_HZ[0], CARRIERS_HZ[2], BETWEEN_HZ]).repeat(4)
    predicted = predict(tx, 0, carriers_hz=carriers)
    for hz in np.unique(carriers):
        alone = predict(tx[carriers == hz], 0, carriers_hz=carriers[carriers == hz])
        np.testing.assert_allclose(predicted[carriers == hz], alone, rtol=0, atol=SINGLE)
    assert np.abs(predicted[0] - predicted[7]).max() > 0.01  # the same position at two carriers
    assert predict(tx[:0], 0, carriers_hz=carriers[:0]).shape == (0, *SIZE)


def test_paths_are_searched_once_for_all_carriers(xml, searches):
    """For the training rows of each receiver, at no validation, and in a prediction that asks for several."""
    record = spectra(xml, 10)
    observed = np.concatenate([record.observation, record.observation[:, ::-1]])
    record = replace(record, receivers=(array(), second()), observation=observed)
    split = Split("own", 0, np.r_[0:8, 12:18, 23:28], np.array([8, 18, 28]), np.array([9, 19, 29]))
    trained = np.unique(record.tx_pos_m[split.all_train], axis=0)
    settings = "traced.rays=4096", "traced.depth=2", "traced.reflections=2", "steps=20"
    config = with_settings(calibration_config(["gain"], record.task.settings_of_paths), settings)
    scene = open_scene(xml, scene_carrier(record, split.all_train))
    searches.clear()
    trainer = Trainer(record, split, config, scene=scene)
    checked = len(split.all_train)  # by the warning of orthogonal polarisations
    assert searches == [len(trained), len(trained), checked]
    searches.clear()
    assert np.isfinite(trainer.validate())
    assert searches == []
    trainer.predictor()(np.tile(transmitters(5), (4, 1)), 1, carriers_hz=np.repeat([*CARRIERS_HZ, BETWEEN_HZ], 5))
    assert searches == [5]


def test_strengths_at_ports_are_those_of_the_tracer(xml):
    rows = np.array([*CARRIERS_HZ, BETWEEN_HZ]).repeat(3)
    tracer = RayTracer(xml, Instrument("power", (array(),), np.array([CARRIERS_HZ[0]])), OPTIONS)
    expected = tracer.observe(tracer.trace(transmitters(12), carriers_hz=rows))[0]
    predicted = Predictor(graph_of(xml, replace(PORTS, receiver="power")), {})(transmitters(12), 0, carriers_hz=rows)
    np.testing.assert_allclose(predicted, expected, atol=STRENGTH_DB)


def assert_restored(run, record):
    """Predictions of a stored field depend on the carrier, which need not have training rows."""
    again, positions = wrf_mi.open_run(run.folder, record), np.tile(record.tx_pos_m[:2], (2, 1))
    at = np.repeat([CARRIERS_HZ[0], CARRIERS_HZ[1]], 2)
    predicted = again.predict(positions, 0, carriers_hz=at).mean
    np.testing.assert_array_equal(predicted, run.predict(positions, 0, carriers_hz=at).mean)
    assert np.abs(predicted[:2] - predicted[2:]).max() > 1e-3
    with pytest.raises(wrf_mi.InputError, match=r"give frequency_hz for each position|carrier"):
        again.predict(positions, 0)


def test_a_field_of_several_carriers_is_trained_beside_paths_and_restored(xml, tmp_path):
    record, small = spectra(xml), ("network.width=16", "network.layers=2", "traced.rays=4096", "traced.depth=2")
    settings = (*QUICK, *small, "steps=16")
    how: dict[str, Any] = {"scene": str(xml), "split": "frequency-known:1", "settings": settings}
    assert_restored(wrf_mi.train(record, "wrf-gs+", out=tmp_path / "run", **how), record)


def test_networks_learn_from_the_carrier_and_are_restored(tmp_path):
    """Strengths at one place that fall with the frequency: one field of all carriers follows them."""
    positions, carriers = np.tile(transmitters(10), (3, 1)), np.repeat(CARRIERS_HZ, 10)
    observed = (-40 - 20 * np.log10(carriers / CARRIERS_HZ[0]))[None].astype(np.float32)
    record = Record("falling", "rssi", positions, (receiver(),), observed, carriers_hz=carriers)
    # No strength depends on the place: of few octaves. At higher rates some seeds end at one strength for all carriers.
    octaves = "encoding.tx_octaves=1", "encoding.position_octaves=2"
    settings = (*QUICK, *octaves, "steps=200", "optimiser.network=0.002")
    run = wrf_mi.train(record, "wrf-gs+", out=tmp_path / "run", split="random", settings=settings)
    assert run.metrics["abs_error_db"]["median"] < 2  # 6 dB for the middle carrier's strength, the median
    assert_restored(run, record)


def test_paths_are_calibrated_at_several_carriers(xml, tmp_path):
    """All surfaces are stated as wood: one permittivity and conductivity of each serve all carriers."""
    record, parts = spectra(xml, 16), {**WALLS, **CEILING, **PARTITION}
    uncorrected_scene = write_xml(tmp_path / "stated", {name: ("itu_wood", mesh) for name, (_, mesh) in parts.items()})

    def trained(name, *settings):
        how: dict[str, Any] = {"scene": str(uncorrected_scene), "split": "frequency:1"}
        common = ("depth=2", "rays=4096", "transmission=true", *settings)
        return wrf_mi.train(record, "ray-tracing", out=tmp_path / name, settings=common, **how)

    plain, run = trained("plain"), trained("run", "calibration=gain,materials", "steps=60")
    assert run.metrics["ssim"]["mean"] > plain.metrics["ssim"]["mean"] + 0.01
    assert open_scene(run.folder / "corrected", BETWEEN_HZ).radio_materials


@pytest.mark.parametrize(("model", "tolerance"), [("array", SINGLE), ("power", SINGLE_DB)])
def test_single_predictions_are_those_of_a_batch(model, tolerance, xml):
    """Recordings of one transmitter serve others, whose numbers of paths differ, with Gaussians beside the paths."""
    (field, params), form, tx = true_field("wrf-gs+"), replace(MIDDLE, receiver=model), transmitters(12)
    predict, paths_alone = Predictor(graph_of(xml, form, field), params), Predictor(graph_of(xml, form), {})
    alone = np.concatenate([predict(tx[k : k + 1], 0) for k in range(12)])
    assert np.abs(alone - paths_alone(tx, 0)).max() > 0.01  # the Gaussians tell
    np.testing.assert_allclose(alone, predict(tx, 0), rtol=0, atol=tolerance)
    evaluate: Any = predict.evaluate
    recordings = evaluate.recordings.items()
    assert any(name[0] == "both" and each.frozen.n_recordings for (name, _), each in recordings)


@pytest.mark.parametrize(("off_m", "certain"), [(0.0, True), (0.03, False)])
def test_phases_are_uncertain_where_walls_are_off(off_m, certain, xml, tmp_path):
    """By held-out rows; the choice is stored with the state, and the trainer's predictions follow it."""
    record, parts = spectra(xml, 60), {**WALLS, **CEILING, **PARTITION}
    rows = np.flatnonzero(record.carriers_hz == CARRIERS_HZ[2])
    at_high = {"tx_pos_m": record.tx_pos_m[rows], "observation": record.observation[:, rows], "carriers_hz": None}
    record = replace(record, frequencies_hz=np.array([CARRIERS_HZ[2]]), **at_high)
    moved = {n: (kind, mesh.copy().apply_translation([off_m, -off_m, off_m])) for n, (kind, mesh) in parts.items()}
    train, validation, test = np.split(np.arange(60), [50, 55])
    split = Split("own", 0, train, validation, test)
    settings = "traced.rays=4096", "traced.depth=2", "traced.reflections=2", "steps=40", "validate_every=10"
    config = with_settings(calibration_config(["gain", "surface"], record.task.settings_of_paths), settings)
    trainer = Trainer(record, split, config, scene=open_scene(write_xml(tmp_path, moved), CARRIERS_HZ[2]))
    trainer.run(lambda progress: None, lambda: None, lambda: False)
    assert (trainer.state.phase_error == 0) == certain
    assert trainer.predictor().phase_error == trainer.state.phase_error
