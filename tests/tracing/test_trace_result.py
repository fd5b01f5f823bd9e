"""Files of traces, and recomputed gains for other materials, frequencies and antennas."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traced_rooms import FREQUENCY_HZ, PARTITION, SHOEBOX, inside, receiver, room, write_xml

from wrf_mi.core import Antenna, InputError, Paths, load_paths, save_paths
from wrf_mi.core.settings import settings_from, with_settings
from wrf_mi.correction.options import CorrectionOptions
from wrf_mi.graph.settings import TracedConfig
from wrf_mi.models.ray_tracing import TracingSettings
from wrf_mi.models.uplink.r2f2 import PathSettings
from wrf_mi.tracing import TraceOptions, TraceResult, load_trace, open_scene, recompute, save_trace, trace_paths
from wrf_mi.tracing.options import SpecularOptions
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.sionna.path_solver import field_of, to_buffer

SINGLE = 1e-5
"""Relative to the largest; other widths of vector instructions."""
OPTIONS = TraceOptions(transmission=True, rays=1 << 13)


@pytest.fixture(scope="module")
def xml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xml(tmp_path_factory.mktemp("room"), {**SHOEBOX, **PARTITION})


@pytest.fixture
def scene(xml: Path) -> Any:
    return open_scene(xml, FREQUENCY_HZ)


@pytest.fixture(scope="module")
def traced(xml: Path) -> TraceResult:
    everyone = [receiver(p, f"rx{k}") for k, p in enumerate(inside(2, 2))]
    return trace_paths(open_scene(xml, FREQUENCY_HZ), inside(5), everyone, OPTIONS)


def close(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(a, b, atol=SINGLE * np.abs(b).max())


def test_stored_traces_are_read_back(traced: TraceResult, tmp_path: Path):
    read = load_trace(save_trace(tmp_path / "paths.npz", traced))
    for field in fields(Paths):
        np.testing.assert_array_equal(getattr(read.paths, field.name), getattr(traced.paths, field.name))
    assert (read.options, read.rays, read.from_receivers, read.frequency_hz) == (
        traced.options,
        traced.rays,
        traced.from_receivers,
        traced.frequency_hz,
    )
    for name in ("tx_pos_m", "primitives", "probability"):
        np.testing.assert_array_equal(getattr(read, name), getattr(traced, name))
    assert [r.name for r in read.receivers] == ["rx0", "rx1"]
    np.testing.assert_array_equal(load_paths(tmp_path / "paths.npz").length_m, traced.paths.length_m)
    assert {path.name for path in tmp_path.iterdir()} == {"paths.npz"}


@pytest.mark.parametrize("kind", [TracedConfig, CorrectionOptions, PathSettings, TracingSettings])
def test_settings_of_every_model_with_a_scene_state_the_same_search(kind: type[SpecularOptions]) -> None:
    """One name and one meaning of depth, reflections, transmission and rays."""
    for transmission in (True, False):
        stated = {"depth": 2, "reflections": 1, "transmission": transmission, "rays": 64}
        assert kind(**stated).options == TraceOptions(**stated)


def test_former_names_of_depth_and_reflections_are_read() -> None:
    """Traces and runs of earlier versions state them, and so do scripts."""
    stated = {"max_depth": 6, "max_reflections": 2, "transmission": True}
    expected = TraceOptions(depth=6, reflections=2, transmission=True)
    assert settings_from(TraceOptions, stated, "paths.npz") == expected
    assert with_settings(TraceOptions(), [f"{name}={value}" for name, value in stated.items()]) == expected


def test_selected_transmitters_have_the_paths_of_their_own_trace(traced: TraceResult, scene: Any):
    """In the order asked for, repeatedly, at all receivers, of one carrier or several."""
    which = np.array([3, 1, 3])
    found = replace(traced, carriers_hz=np.arange(5.0)).of_transmitters(which)
    expected = trace_paths(scene, inside(5)[which], traced.receivers, OPTIONS)
    for name in ("tx", "rx", "interactions", "objects", "n_tx", "n_rx"):
        np.testing.assert_array_equal(getattr(found.paths, name), getattr(expected.paths, name))
    np.testing.assert_array_equal(found.primitives, expected.primitives)
    np.testing.assert_array_equal(found.tx_pos_m, inside(5)[which])
    np.testing.assert_array_equal(found.carriers_hz, [3, 1, 3])
    close(found.paths.gain, expected.paths.gain)
    close(found.paths.length_m, expected.paths.length_m)
    assert len(traced.of_transmitters(which[:0]).paths) == 0


def test_wrong_files_are_refused(traced: TraceResult, tmp_path: Path, scene: Any):
    with pytest.raises(InputError, match="missing; trace"):
        load_trace(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_bytes(b"PK no")
    with pytest.raises(InputError, match="not readable"):
        load_paths(tmp_path / "bad.npz")
    plain = save_paths(tmp_path / "plain.npz", traced.paths)
    assert len(load_paths(plain)) == len(traced.paths)
    with pytest.raises(InputError, match="holds paths alone"):
        load_trace(plain)
    arrays = dict(np.load(plain))
    np.savez(tmp_path / "new.npz", **(arrays | {"format": 99}))
    with pytest.raises(InputError, match="format 99"):
        load_paths(tmp_path / "new.npz")
    np.savez(tmp_path / "short.npz", **{key: value for key, value in arrays.items() if key != "gain"})
    with pytest.raises(InputError, match="gain"):
        load_paths(tmp_path / "short.npz")
    np.savez(tmp_path / "pickle.npz", **(arrays | {"tx": np.array([{}], object)}))
    with pytest.raises(InputError, match="not readable"):
        load_paths(tmp_path / "pickle.npz")
    with pytest.raises(ValueError, match="length_m has shape"):
        replace(traced.paths, length_m=traced.paths.length_m[:-1])
    other = room(tmp_path / "other", SHOEBOX)
    with pytest.raises(InputError, match="no object 'partition'"):
        recompute(traced, other)
    again = replace(traced, primitives=np.where(traced.primitives >= 0, 77, -1).astype(np.int32))
    with pytest.raises(InputError, match="is not the one"):
        recompute(again, scene)


def test_recomputed_gains_are_the_traced_ones(traced: TraceResult, scene: Any, tmp_path: Path):
    np.testing.assert_array_equal(recompute(traced, scene).paths.gain, traced.paths.gain)
    read = load_trace(save_trace(tmp_path / "paths.npz", traced))
    np.testing.assert_array_equal(recompute(read, scene).paths.gain, traced.paths.gain)


def test_recomputed_gains_for_other_materials_are_those_of_a_new_trace(traced: TraceResult, scene: Any):
    for name, thickness in (("itu_concrete", 0.37), ("itu_plasterboard", 0.013)):
        scene.radio_materials[name].thickness = thickness
    brick = scene.radio_materials["itu_brick"]
    brick.frequency_update_callback = None
    brick.relative_permittivity, brick.conductivity = 6.0, 0.1
    anew = trace_paths(scene, traced.tx_pos_m, traced.receivers, OPTIONS).paths
    again = recompute(traced, scene).paths
    np.testing.assert_array_equal(again.length_m, anew.length_m)
    close(again.gain, anew.gain)
    assert np.abs(again.gain - traced.paths.gain).max() > 1e-2 * np.abs(traced.paths.gain).max()


def test_recomputed_gains_at_another_frequency_are_those_of_a_new_trace(traced: TraceResult, xml: Path):
    scene = open_scene(xml, 5.2e9)
    again = recompute(traced, scene)
    assert again.frequency_hz == pytest.approx(5.2e9, rel=1e-6)
    close(again.paths.gain, trace_paths(scene, traced.tx_pos_m, traced.receivers, OPTIONS).paths.gain)


def test_recomputed_gains_of_dipoles_have_their_pattern(traced: TraceResult, scene: Any):
    """A half-wave dipole's directivity is 1.64 at the horizon, and cos(pi/2 cos) / sin elsewhere, at both ends."""
    direct = traced.select(traced.paths.bounces == 0)
    assert len(direct.paths)
    antenna = Antenna("hw_dipole")
    receivers = tuple(replace(rx, antenna=antenna) for rx in direct.receivers)
    dipole = recompute(replace(direct, receivers=receivers, tx_antenna=antenna), scene).paths.gain
    cosine = direct.paths.departure[:, 2]
    pattern = 1.643 * (np.cos(np.pi / 2 * cosine) / np.sqrt(1 - cosine**2)) ** 2
    np.testing.assert_allclose(np.abs(dipole / direct.paths.gain), pattern, rtol=1e-3)  # of the rounded 1.643


def test_reversed_legs_have_reversed_interactions(traced: TraceResult, scene: Any):
    legs = traced.legs(scene_surfaces(scene))
    back = legs.reverse()
    for index in np.flatnonzero(traced.paths.bounces == 3)[:5]:
        np.testing.assert_array_equal(back.vertices_m[index], legs.vertices_m[index, ::-1])
    for name in ("interactions", "face", "vertices_m", "source", "target"):
        np.testing.assert_array_equal(getattr(back.reverse(), name), getattr(legs, name))


@pytest.mark.gradcheck
def test_derivatives_by_materials_are_central_differences(traced: TraceResult, scene: Any):
    """Single precision leaves three digits."""
    import drjit as dr
    import mitsuba as mi

    surfaces = scene_surfaces(scene)
    buffer = to_buffer(traced.legs(surfaces), surfaces)
    material = scene.radio_materials["itu_brick"]
    material.frequency_update_callback = None
    names = "relative_permittivity", "conductivity", "thickness"
    stated = {name: float(np.ravel(getattr(material, name))[0]) for name in names}

    def power(**changes: Any) -> Any:
        for name, value in stated.items():
            setattr(material, name, changes.get(name, mi.Float(value)))
        real, imaginary = field_of(scene, buffer, traced.ends(), traced.rays, loop_mode="evaluated")
        return dr.sum(dr.square(real) + dr.square(imaginary)) * 1e6

    variables = {name: mi.Float(value) for name, value in stated.items()}
    dr.enable_grad(variables)
    dr.backward(power(**variables))
    for name, value in stated.items():
        step = 2e-3 * value  # a slab of half a wavelength resonates
        high, low = (float(power(**{name: mi.Float(value + sign * step)})[0]) for sign in (1, -1))
        assert float(dr.grad(variables[name])[0]) == pytest.approx((high - low) / (2 * step), rel=2e-2), name
