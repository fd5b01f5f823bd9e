"""Paths that nothing obstructs, against all triangles; files of traces and gains that are recomputed from them."""

from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from traced_rooms import FREQUENCY_HZ, LENGTH, PARTITION, SHOEBOX, inside, receiver, room
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Antenna, InputError, load_paths, save_paths
from wrf_mi.core.settings import settings_from, with_settings
from wrf_mi.correction.options import CorrectionOptions
from wrf_mi.estimators.ray_tracing import TracingSettings
from wrf_mi.estimators.uplink.r2f2 import PathSettings
from wrf_mi.graph.settings import TracedConfig
from wrf_mi.tracing import TraceOptions, load_trace, open_scene, recompute, save_trace, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.chains import SPECULAR, TRANSMISSION

SINGLE = 1e-5  # Relative to the largest; other widths of vector instructions
OPTIONS = TraceOptions(transmission=True, rays=1 << 13)


@pytest.fixture
def scene(divided_xml):
    return open_scene(divided_xml, FREQUENCY_HZ)


@pytest.fixture(scope="module")
def traced(divided_xml):
    everyone = [receiver(p, f"rx{k}") for k, p in enumerate(inside(2, 2))]
    return trace_paths(open_scene(divided_xml, FREQUENCY_HZ), inside(5), everyone, OPTIONS)


def close(a, b):
    np.testing.assert_allclose(a, b, atol=SINGLE * np.abs(b).max())


def test_stored_traces_are_read_back(traced, tmp_path):
    read = load_trace(save_trace(tmp_path / "paths.npz", traced))
    np.testing.assert_equal(vars(read.paths), vars(traced.paths))
    for name in ("options", "rays", "from_receivers", "frequency_hz"):
        assert getattr(read, name) == getattr(traced, name), name
    for name in ("tx_pos_m", "primitives", "probability"):
        np.testing.assert_array_equal(getattr(read, name), getattr(traced, name))
    assert [r.name for r in read.receivers] == ["rx0", "rx1"]
    np.testing.assert_array_equal(load_paths(tmp_path / "paths.npz").length_m, traced.paths.length_m)
    assert {path.name for path in tmp_path.iterdir()} == {"paths.npz"}


def test_array_of_an_earlier_version_is_not_read(traced, tmp_path):
    file = save_trace(tmp_path / "paths.npz", traced)
    with np.load(file) as stored:
        np.savez(file, length_rate_mps=traced.paths.length_m, **stored)
    np.testing.assert_equal(vars(load_trace(file).paths), vars(traced.paths))


def test_settings_of_every_model_with_a_scene_state_the_same_search():
    """One name and one meaning of depth, reflections, transmission and rays."""
    for kind, transmission in product((TracedConfig, CorrectionOptions, PathSettings, TracingSettings), (True, False)):
        search_options: dict[str, Any] = {"depth": 2, "reflections": 1, "transmission": transmission, "rays": 64}
        assert kind(**search_options).options == TraceOptions(**search_options), kind


def test_former_names_of_depth_and_reflections_are_read():
    """Traces and runs of earlier versions state them, and so do scripts."""
    former = {"max_depth": 6, "max_reflections": 2, "transmission": True}
    as_text = with_settings(TraceOptions(), [f"{name}={value}" for name, value in former.items()])
    expected = TraceOptions(depth=6, reflections=2, transmission=True)
    assert settings_from(TraceOptions, former, "paths.npz") == as_text == expected


def test_selected_transmitters_have_the_paths_of_their_own_trace(traced, scene):
    """In the order asked for, repeatedly, at all receivers, of one carrier or several."""
    which = np.array([3, 1, 3])
    selected = replace(traced, carriers_hz=np.arange(5.0)).of_transmitters(which)
    expected = trace_paths(scene, inside(5)[which], traced.receivers, OPTIONS)
    for name in ("tx", "rx", "interactions", "objects", "n_tx", "n_rx"):
        np.testing.assert_array_equal(getattr(selected.paths, name), getattr(expected.paths, name))
    np.testing.assert_array_equal(selected.primitives, expected.primitives)
    np.testing.assert_array_equal(selected.tx_pos_m, inside(5)[which])
    np.testing.assert_array_equal(selected.carriers_hz, which)
    assert not len(traced.of_transmitters(which[:0]).paths)
    close(selected.paths.gain, expected.paths.gain)
    close(selected.paths.length_m, expected.paths.length_m)


def test_wrong_files_are_refused(traced, tmp_path):
    with pytest.raises(InputError, match="missing; trace"):
        load_trace(tmp_path / "none.npz")
    plain, bad = save_paths(tmp_path / "plain.npz", traced.paths), tmp_path / "bad.npz"
    assert len(load_paths(plain)) == len(traced.paths)
    with pytest.raises(InputError, match="holds paths alone"):
        load_trace(plain)
    bad.write_bytes(b"PK no")
    with pytest.raises(InputError, match="not readable"):
        load_paths(bad)
    arrays = dict(np.load(plain))
    without = {key: value for key, value in arrays.items() if key != "gain"}
    pickled = arrays | {"tx": np.array([{}], object)}
    wrong = {"format 99": arrays | {"format": np.array(99)}, "gain": without, "not readable": pickled}
    for message, changed in wrong.items():
        np.savez(bad, **changed)
        with pytest.raises(InputError, match=message):
            load_paths(bad)
    with pytest.raises(ValueError, match="length_m has shape"):
        replace(traced.paths, length_m=traced.paths.length_m[:-1])


def test_traces_of_other_scenes_are_refused(traced, scene, shoebox):
    with pytest.raises(InputError, match="no object 'partition'"):
        recompute(traced, shoebox)
    again = replace(traced, primitives=np.where(traced.primitives >= 0, 77, -1).astype(np.int32))
    with pytest.raises(InputError, match="is not the one"):
        recompute(again, scene)


def test_recomputed_gains_are_the_traced_ones(traced, scene, tmp_path):
    for trace in (traced, load_trace(save_trace(tmp_path / "paths.npz", traced))):
        np.testing.assert_array_equal(recompute(trace, scene).paths.gain, traced.paths.gain)


def test_recomputed_gains_for_other_materials_are_those_of_a_new_trace(traced, scene):
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


def test_recomputed_gains_at_another_frequency_are_those_of_a_new_trace(traced, divided_xml):
    scene = open_scene(divided_xml, 5.2e9)
    again = recompute(traced, scene)
    assert again.frequency_hz == pytest.approx(5.2e9, rel=1e-6)
    close(again.paths.gain, trace_paths(scene, traced.tx_pos_m, traced.receivers, OPTIONS).paths.gain)


def test_recomputed_gains_of_dipoles_have_their_pattern(traced, scene):
    """A half-wave dipole's directivity is 1.64 at the horizon, and cos(pi/2 cos) / sin elsewhere, at both ends."""
    direct, antenna = traced.select(traced.paths.bounces == 0), Antenna("hw_dipole")
    assert len(direct.paths)
    receivers = tuple(replace(rx, antenna=antenna) for rx in direct.receivers)
    dipole = recompute(replace(direct, receivers=receivers, tx_antenna=antenna), scene).paths.gain
    cosine = direct.paths.departure[:, 2]
    pattern = 1.643 * (np.cos(np.pi / 2 * cosine) / np.sqrt(1 - cosine**2)) ** 2
    np.testing.assert_allclose(np.abs(dipole / direct.paths.gain), pattern, rtol=1e-3)  # of the rounded 1.643


SHORT_M = 0.01  # Sionna RT's least distance of interactions
AT_M = 1e-9  # Rounding of float64 at a few metres, with a margin of a million
TWO_SHEETS = {
    **SHOEBOX,
    **PARTITION,
    "behind": ("itu_plasterboard", sheet(0, 3.19, (0.5, 4.5), (0.0, 2.8))),
    "board": ("itu_brick", sheet(1, 2.6, (0.4, LENGTH - 0.7), (0.6, 2.0))),
}
"""The shoebox with a wall of two sheets, of which the first hides the second, and a board across it."""


@pytest.fixture(scope="module")
def sheets(tmp_path_factory):
    return room(tmp_path_factory.mktemp("sheets"), TWO_SHEETS)


def met(surfaces, start, end):
    """Distances from the start at which a segment meets planes with faces, by plane (Moeller and Trumbore, 1997)."""
    a, way = surfaces.triangles[:, 0], end - start
    first, second = (surfaces.triangles[:, k] - a for k in (1, 2))
    p = np.cross(way, second)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (first * p).sum(axis=1)
        u = ((start - a) * p).sum(axis=1) * scale
        q = np.cross(start - a, first)
        v, t = (q @ way) * scale, (second * q).sum(axis=1) * scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t <= 1 + AT_M)
    return {int(surfaces.plane[face]): float(t[face] * np.linalg.norm(way)) for face in np.flatnonzero(hit)}


def paths_of(surfaces, source, target, depth, reflections, passes):
    """Kinds and planes of the interactions of all paths, by trying all sequences of planes."""
    for planes in (p for count in range(reflections + 1) for p in product(range(len(surfaces.normal)), repeat=count)):
        images = [source]
        for plane in planes:
            height = images[-1] @ surfaces.normal[plane] - surfaces.offset[plane]
            images.append(images[-1] - 2 * height * surfaces.normal[plane])
        vertices = [target]
        for plane, image in zip(reversed(planes), reversed(images), strict=False):
            near, far = (x @ surfaces.normal[plane] - surfaces.offset[plane] for x in (vertices[0], image))
            if near * far >= 0:
                break
            vertices.insert(0, vertices[0] + near / (near - far) * (image - vertices[0]))
        if len(vertices) != len(planes) + 1:
            continue
        vertices.insert(0, source)
        interactions, points = list[tuple[int, int]](), [source]
        for leg, (start, end) in enumerate(pairwise(vertices)):
            hits = met(surfaces, start, end)
            length = float(np.linalg.norm(end - start))
            if leg:
                hits.pop(planes[leg - 1], None)
            reflecting = leg < len(planes)
            if reflecting and hits.pop(planes[leg], None) is None:
                break
            between = sorted((at, plane) for plane, at in hits.items() if at < length - AT_M)
            interactions += [(TRANSMISSION, plane) for _, plane in between]
            points += [start + (end - start) * at / length for at, _ in between] + [end]
            if reflecting:
                interactions.append((SPECULAR, planes[leg]))
        else:
            apart = np.linalg.norm(np.diff(points, axis=0), axis=1).min() > SHORT_M
            kinds, where = tuple(kind for kind, _ in interactions), tuple(plane for _, plane in interactions)
            if apart and len(interactions) <= depth and (passes or TRANSMISSION not in kinds):
                yield kinds, where


@pytest.mark.parametrize("passes", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_paths_are_those_of_all_sequences_of_planes(sheets, seed, passes):
    """Among them reflections at the second sheet of a wall, with a transmission through the first before and after."""
    tx, rx = inside(4, seed), [receiver(p, f"rx{k}") for k, p in enumerate(inside(2, seed + 10))]
    options = TraceOptions(transmission=passes, depth=5, reflections=2, rays=1 << 16)
    prepared = Prepared(sheets)
    traced = trace_paths(sheets, tx, rx, options, prepared=prepared, gains=False)
    surfaces, paths, sequences = prepared.surfaces, traced.paths, set[tuple[Any, ...]]()
    plane = surfaces.plane[surfaces.first_face[:-1]]  # of each sheet
    for number, kinds in enumerate(paths.interactions):
        count = np.count_nonzero(kinds)
        ends = int(paths.tx[number]), int(paths.rx[number])
        sequences.add((*ends, tuple(kinds[:count].tolist()), tuple(plane[paths.objects[number, :count]].tolist())))
    expected = {
        (i, k, *path)
        for i, k in product(range(len(tx)), range(len(rx)))
        for path in paths_of(surfaces, tx[i], rx[k].position_m, 5, 2, passes)
    }
    assert sequences == expected
    assert len(sequences) == len(paths) > 25
    behind = paths.objects[:, 1] == paths.object_names.index("behind")
    assert (behind & (paths.interactions[:, :3] == [4, 1, 4]).all(axis=1)).any() == passes
