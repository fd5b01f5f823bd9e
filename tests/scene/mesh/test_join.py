"""Areas are joined as if every pair of planes were tried."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from wrf_mi.scene.mesh import outline
from wrf_mi.scene.mesh.planes import Plane, with_axes


def test_pairs_out_of_reach_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    planes, areas = [], []
    for number in range(24):
        normal = np.eye(3)[number % 3]
        offset = float(rng.choice([0.0, 3.0]) + rng.normal(0, 0.02))
        plane = Plane(normal, offset, np.zeros((0, 4, 3)), normal * offset, 1e-3)
        planes.append(with_axes(plane))
        low = rng.uniform(-3.2, 2, 2)
        areas.append(shapely.box(*low, *(low + rng.uniform(0.3, 3, 2))))
    reach = [0.15] * len(planes)
    skipped = outline.join(planes, areas, reach)
    monkeypatch.setattr(outline, "_beside", lambda *given: False)
    assert [one.wkb for one in skipped] == [one.wkb for one in outline.join(planes, areas, reach)]
    assert any(one.wkb != area.wkb for one, area in zip(skipped, areas, strict=True))
