"""Paths that nothing obstructs, against intersections with all triangles in float64."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from traced_rooms import LENGTH, PARTITION, SHOEBOX, Parts, inside, receiver, room
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.chains import SPECULAR, TRANSMISSION
from wrf_mi.tracing.search.surfaces import Surfaces
from wrf_mi.tracing.search.visibility import unobstructed

SHORT_M = 0.01
"""Sionna RT's least distance of interactions."""
AT_M = 1e-9
"""Rounding of float64 at a few metres, with a margin of a million."""
TWO_SHEETS: Parts = {
    **SHOEBOX,
    **PARTITION,
    "behind": ("itu_plasterboard", sheet(0, 3.19, (0.5, 4.5), (0.0, 2.8))),
    "board": ("itu_brick", sheet(1, 2.6, (0.4, LENGTH - 0.7), (0.6, 2.0))),
}
"""The shoebox with a wall of two sheets, of which the first hides the second, and a board across it."""


@pytest.fixture(scope="module")
def sheets(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return room(tmp_path_factory.mktemp("sheets"), TWO_SHEETS)


def met(surfaces: Surfaces, start: np.ndarray, end: np.ndarray) -> dict[int, float]:
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


def paths_of(
    surfaces: Surfaces, source: np.ndarray, target: np.ndarray, depth: int, reflections: int, passes: bool
) -> Iterator[tuple[tuple[int, ...], tuple[int, ...]]]:
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
        found, points = list[tuple[int, int]](), [source]
        for leg, (start, end) in enumerate(pairwise(vertices)):
            hits = met(surfaces, start, end)
            length = float(np.linalg.norm(end - start))
            if leg:
                hits.pop(planes[leg - 1], None)
            reflecting = leg < len(planes)
            if reflecting and hits.pop(planes[leg], None) is None:
                break
            between = sorted((at, plane) for plane, at in hits.items() if at < length - AT_M)
            found += [(TRANSMISSION, plane) for _, plane in between]
            points += [start + (end - start) * at / length for at, _ in between] + [end]
            if reflecting:
                found.append((SPECULAR, planes[leg]))
        else:
            apart = np.linalg.norm(np.diff(points, axis=0), axis=1).min() > SHORT_M
            kinds, where = tuple(kind for kind, _ in found), tuple(plane for _, plane in found)
            if apart and len(found) <= depth and (passes or TRANSMISSION not in kinds):
                yield kinds, where


@pytest.mark.parametrize("passes", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_paths_are_those_of_all_sequences_of_planes(sheets: Any, seed: int, passes: bool):
    """Among them reflections at the second sheet of a wall, with a transmission through the first before and after."""
    tx, rx = inside(4, seed), [receiver(p, f"rx{k}") for k, p in enumerate(inside(2, seed + 10))]
    options = TraceOptions(transmission=passes, depth=5, reflections=2, rays=1 << 16)
    prepared = Prepared(sheets)
    traced = trace_paths(sheets, tx, rx, options, prepared=prepared, gains=False)
    surfaces, paths, found = prepared.surfaces, traced.paths, set[tuple[Any, ...]]()
    plane = surfaces.plane[surfaces.first_face[:-1]]  # of each sheet
    for number, kinds in enumerate(paths.interactions):
        count = np.count_nonzero(kinds)
        ends = int(paths.tx[number]), int(paths.rx[number])
        found.add((*ends, tuple(kinds[:count].tolist()), tuple(plane[paths.objects[number, :count]].tolist())))
    expected = {
        (i, k, *path)
        for i, k in product(range(len(tx)), range(len(rx)))
        for path in paths_of(surfaces, tx[i], rx[k].position_m, 5, 2, passes)
    }
    assert found == expected
    assert len(found) == len(paths) > 25
    behind = paths.objects[:, 1] == paths.object_names.index("behind")
    assert (behind & (paths.interactions[:, :3] == [4, 1, 4]).all(axis=1)).any() == passes


def test_every_target_is_reached_where_there_are_no_surfaces(sheets: Any):
    """In a scene without surfaces, and without candidates."""
    surfaces = Prepared(sheets).surfaces
    none = replace(surfaces, triangles=surfaces.triangles[:0], plane=surfaces.plane[:0])
    ends = np.array([[[0.0, 0, 0], [1, 2, 2]], [[0, 0, 0], [0.005, 0, 0]]])
    met = unobstructed(none, ends, np.zeros((2, 0), np.int64), 3, True)
    assert met.candidate.tolist() == [0, 1]
    assert not met.interactions.any()
    assert not len(unobstructed(surfaces, ends[:0], np.zeros((0, 0), np.int64), 3, True).candidate)
