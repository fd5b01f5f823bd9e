"""Gaussians behind opaque walls are left out, and the field changes by no more than is stated."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import wrf_mi_plugins
from test_plugin_integrator_walls import BRICK, CARRIER
from traced_fields import RECEIVER, any_field, complex_image, gaussians_of, scene_of
from wrf_mi_plugins import integrator

from wrf_mi.core import InputError

pytestmark = pytest.mark.all_threads

wrf_mi_plugins.register_all()

ROUNDING = 1e-5
"""Float32 sums of some tens of signals of size one, in the same order."""
COUNT = 120


def sheet(where: list[float], size: float, name: str) -> dict[str, Any]:
    """A square across the x axis before or behind the receiver."""
    turn = mi.ScalarTransform4f().translate([*(RECEIVER.position_m + where)]).rotate([0, 1, 0], 90).scale(size)
    return {"type": "rectangle", "to_world": turn, "bsdf": {"type": "ref", "id": name}}


# Mitsuba makes one of two materials that look alike, whatever their ids.
GREY = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.3}}
METAL = {"type": "twosided", "id": "mat-itu_metal", "bsdf": GREY}
SHEETS = {
    "brick": BRICK,
    "metal": METAL,
    "large": sheet([-0.7, 0, 0], 1.0, METAL["id"]),
    "small": sheet([0.5, 0.3, 0.3], 0.3, METAL["id"]),
    "masonry": sheet([-0.8, 0, 0], 9.0, BRICK["id"]),
}


def rendered(field: Any, power: float, walls: dict[str, Any]) -> tuple[np.ndarray, int]:
    """The image, and how many entries lists had when it was blended."""
    entries, blend_rays = [], integrator.blend_rays

    def counting(footprints: Any, signal: Any, lists: Any, *more: Any) -> Any:
        entries.append(int(dr.sum(lists.end - lists.begin)[0]))
        return blend_rays(footprints, signal, lists, *more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(integrator, "blend_rays", counting)
        traced = CARRIER | {"thickness_itu_brick": 0.3, "opaque_power": power}
        return complex_image(mi.render(scene_of(field, integrator=traced, **walls))), entries[0]


@pytest.mark.parametrize("blending", ["alpha", "product"])
@pytest.mark.parametrize("seed", [0, 1])
def test_error_is_within_the_bound(blending, seed):
    """Metal hides at any bound and changes nothing; masonry that passes a sixth of the power does so at 0.2."""
    arrays = any_field(COUNT, seed, 0.05)
    field, strength = gaussians_of(arrays, blending), np.linalg.norm(arrays["signal"], axis=1)
    largest = strength.max() if blending == "alpha" else strength.sum()
    (exact, entries), (few, fewer), (least, fewest) = (rendered(field, power, SHEETS) for power in (0.0, 1e-8, 0.2))
    assert fewest < fewer < entries
    assert np.abs(few - exact).max() <= 1e-4 * largest + ROUNDING
    assert 1e-3 < np.abs(least - exact).max() <= np.sqrt(0.2) * largest


def test_gaussians_before_walls_are_kept():
    """A sheet behind all Gaussians hides none, and of a scene without walls nothing is left out."""
    field = gaussians_of(any_field(COUNT, 0, 0.1), "alpha")
    for walls in ({}, {"metal": METAL, "far": sheet([60.0, 0, 0], 100.0, METAL["id"])}):
        images = [rendered(field, power, walls)[0] for power in (0.0, 0.5)]
        np.testing.assert_array_equal(*images)
        assert np.abs(images[0]).max() > 0.1


@pytest.mark.parametrize("power", [-0.1, 1.0])
def test_invalid_opaque_power_is_refused(power):
    with pytest.raises((InputError, RuntimeError), match="opaque_power"):
        mi.load_dict({"type": "wrf_traced", "opaque_power": power})
