"""Boards before walls and recesses, nearer than the noise of single points resolves."""

from __future__ import annotations

import numpy as np
import pytest
from made_rooms import Mesh, by_kind, closed_box, sampled
from wrf_mi_scenes.build_laboratory import sheet, wall

from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.scene.scan.cloud import surfaces_from_points

NOISE_M = 0.015
COUNT = 150_000
LAYER_M = 0.003
"""Offset of a layer: some thousand points have an error of a third of a millimetre; its rim has others' points."""
RIM_M = 0.2
"""Edges of a layer are those of cells: 1,000 points per square metre have cells of 15 cm."""
BOARD, SHEET, NICHE = (((0.6, 1.8), (0.9, 2.1)), ((2.4, 4.2), (0.2, 2.0)), ((4.8, 5.8), (0.9, 2.1)))
"""Stretches along and up the wall."""


def room() -> list[Mesh]:
    """A room of 3 x 7 x 2.8 m; before its wall at x = 0 a board and a sheet, which hide it, and a niche in it."""
    y, up = (0.0, 7.0), (0.0, 2.8)
    flat = [sheet(2, z, (0.0, 3.0), y) for z in up] + [sheet(1, at, (0.0, 3.0), up) for at in y]
    layers = [sheet(0, x, *place) for x, place in ((0.02, BOARD), (0.05, SHEET), (-0.06, NICHE))]
    return [*flat, sheet(0, 3.0, y, up), wall(0, 0.0, y, up, [BOARD, SHEET, NICHE]), *layers]


def across(surfaces: list[Surface]) -> dict[float, Surface]:
    """Surfaces near the wall and parallel to it, by their mean x."""
    flat = [one for one in surfaces if np.ptp(one.vertices_m[:, 0]) < 1e-3 and abs(one.vertices_m[:, 0].mean()) < 0.2]
    return {float(one.vertices_m[:, 0].mean()): one for one in flat}


def test_layers_of_a_wall_are_surfaces_of_their_own() -> None:
    """The wall goes on behind what hides it, and ends at the niche."""
    found = across(surfaces_from_points(sampled(room(), COUNT, NOISE_M)))
    assert len(found) == 4
    for expected, (along, above) in ((0.02, BOARD), (0.05, SHEET), (-0.06, NICHE)):
        at = min(found, key=lambda x: abs(x - expected))
        assert at == pytest.approx(expected, abs=LAYER_M)
        bounds = np.array([found[at].vertices_m.min(axis=0)[1:], found[at].vertices_m.max(axis=0)[1:]])
        np.testing.assert_allclose(bounds, np.array([along, above]).T, atol=RIM_M)
    at = min(found, key=abs)
    assert at == pytest.approx(0, abs=LAYER_M)
    niche = np.prod(np.diff(NICHE, axis=1))
    assert found[at].mesh.area == pytest.approx(7 * 2.8 - niche, rel=0.03)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_plain_walls_have_no_layers(seed: int) -> None:
    surfaces = by_kind(surfaces_from_points(sampled(closed_box(), 40_000, 0.02, seed=seed)))
    assert [len(group) for group in surfaces.values()] == [1, 1, 4, 0]
