"""Outlines of planes of one face, which furniture of CAD programs has by the hundred thousand."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.tracing.surfaces import find_planes
from wrf_mi.tracing.walls import ON_LINE_M, outline_edges, walls_of


@pytest.mark.parametrize("size_m", [1.0, 0.01, 10 * ON_LINE_M])
def test_outlines_of_single_faces_are_those_of_any_plane(size_m: float) -> None:
    """Slivers among them, whose sides lie on one line within the tolerance."""
    triangles = np.random.default_rng(0).normal(0, size_m, (100, 3, 3)) + np.arange(100)[:, None, None]
    surfaces = find_planes(("soup",), np.zeros(1, np.uint32), np.array([0, 100]), triangles)
    walls = walls_of(surfaces)
    assert len(walls) == 100
    flat = np.einsum("fad,fcd->fca", surfaces.axes[surfaces.plane], triangles - walls.centre_m[surfaces.plane, None])
    expected = [outline_edges(flat[surfaces.plane == plane]) for plane in range(len(walls))]
    np.testing.assert_array_equal(walls.edge_m, np.concatenate(expected))
    np.testing.assert_array_equal(np.diff(walls.first_edge), [len(edges) for edges in expected])
