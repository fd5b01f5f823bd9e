"""Surfaces that a fit knows stay known to fits whose paths do not meet them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from correction_rooms import CARRIER_HZ, channels, stated_scene

from wrf_mi.correction import CorrectionOptions
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.state import ABSENT, ABSENT_VALUES, ScenePosterior, State, material_places
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.paths.solve import Prepared


def test_an_absent_surface_that_no_path_meets_stays_absent(tmp_path: Path) -> None:
    """Of direct paths alone, as in a scene from which the surface is gone."""
    scene = stated_scene(tmp_path / "scene")
    opened, options = open_scene(scene, CARRIER_HZ), CorrectionOptions(("materials",), depth=1, rays=4096)
    record = channels(scene, 24)

    def fit(reflections: int, surfaces: tuple[np.ndarray, np.ndarray]) -> ScenePosterior:
        how = replace(options, reflections=reflections)
        misfit = Misfit(record, np.arange(12), Prepared(opened), how, surfaces=surfaces)
        return ScenePosterior(misfit, options, lambda what, share: None)

    none = np.zeros(0, np.int64)
    first = fit(1, (none, none))
    slab = next(k for k, name in enumerate(first.misfit.sides[0].slabs.names) if name.startswith("wall_01"))
    vector = first.stated.copy()
    vector[material_places(first.misfit, slab)] = ABSENT_VALUES
    state = State(first, "materials", vector, vector, {first.misfit.sides[0].slabs.names[slab]: ABSENT})
    second = fit(0, (first.misfit.planes, first.misfit.slabs))
    assert not second.misfit.counts()[1][slab]
    over = state.at(second)
    assert over.absent() == state.absent() != frozenset()
    np.testing.assert_array_equal(over.vector, vector)
