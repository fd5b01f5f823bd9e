"""What docs/plugins.md shows runs, and its tables are those of the plugins."""

import importlib
import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from documents import blocks
from plugin_fields import plain, write_run

from wrf_mi.core import Record

PAGE = Path(__file__).resolve().parents[2] / "docs" / "plugins.md"
CLASSES = {
    "wrf_perception_plane": "sensor.PerceptionPlane",
    "wrf_traced": "integrator.TracedField",
    "wrf_gaussian_emitter": "emitter.GaussianEmitter",
    "wrf_gaussian_medium": "medium.GaussianMedium",
}
STANDARD_ERRORS = 4.5
"""A Monte Carlo mean is off by more than this once in 150,000 times."""


@pytest.fixture(scope="module")
def names(one_gateway: Record, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the page's scripts leave behind, run one after the other beside a run folder."""
    folder = tmp_path_factory.mktemp("page")
    write_run(folder / "runs" / "first", one_gateway, "wrf-gs+")
    (xml,) = blocks(PAGE, "xml")
    (folder / "scene.xml").write_text(xml)
    found: dict[str, Any] = {"scenes": []}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for number, script in enumerate(blocks(PAGE, "python")):
            exec(compile(script, f"{PAGE.name}, script {number}", "exec"), found)
            found["scenes"].append(found.get("scene"))
    return found


def test_traced_scene(names):
    """The picture follows the transmitter, and the dictionary is the XML's scene."""
    field, moved = plain(names["field"]), plain(names["moved"])
    assert field.shape == moved.shape == (90, 360, 2)
    assert np.abs(field).max() > 0.01
    assert np.abs(field - moved).max() > 1e-3
    _, of_xml, of_dict, _, _ = names["scenes"]
    params = mi.traverse(of_xml)
    params["transmitter.tx_position"] = mi.Point3f(0.5, -0.6, 1.0)
    params.update()
    np.testing.assert_allclose(plain(mi.render(of_xml)), field, atol=1e-6)
    np.testing.assert_allclose(plain(mi.render(of_dict)), field, atol=1e-6)


def test_documented_gradient_by_the_transmitter(names):
    """What the page prints is the slope of the power that is received."""
    gradient = plain(names["position"].grad)[:, 0]
    params, start = mi.traverse(names["scenes"][2]), np.array([0.5, -0.6, 1.0])
    direction = gradient / np.linalg.norm(gradient)

    def power(distance_m: float) -> float:
        where = start + distance_m * direction
        params["transmitter.tx_position"] = mi.Point3f(*where.tolist())
        params.update()
        return float((plain(mi.render(names["scenes"][2])) ** 2).mean())

    # Pixels that cross a Gaussian's edge on the way, at a hundredth of its peak, have no derivative.
    assert (power(1e-3) - power(-1e-3)) / 2e-3 == pytest.approx(np.linalg.norm(gradient), rel=0.03)


def test_powers_and_transmittance(names):
    powers = plain(names["powers"])
    assert powers.max() > 0.01
    assert powers.min() >= 0
    scene, air = names["scenes"][4], names["air"]
    picture = plain(names["transmittance"]).reshape(18, 72)
    sensor = scene.sensors()[0]
    where = (np.stack(np.meshgrid(np.arange(72), np.arange(18)), axis=-1).reshape(-1, 2) + 0.5) / [72, 18]
    rays, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(where.T), mi.Point2f(0.5))
    exact = np.exp(-plain(air.optical_depth(rays))).reshape(18, 72)
    assert np.ptp(exact) > 0.1
    error = np.sqrt((exact * (1 - exact) / 64).sum()) / exact.size
    assert abs(picture.mean() - exact.mean()) < STANDARD_ERRORS * error


@pytest.mark.parametrize("name", CLASSES)
def test_documented_tables_match_the_plugins(name):
    """The same parameters in the page and in the docstring, in the same order."""
    module, kind = CLASSES[name].split(".")
    documented = getattr(importlib.import_module(f"wrf_mi_plugins.{module}"), kind).__doc__
    lines = documented.splitlines()
    rules = [i for i, line in enumerate(lines) if line.strip().startswith("====")]
    first_column = slice(0, lines[rules[0]].index("= ") + 1)
    own = [n for line in lines[rules[1] + 1 : rules[2]] for n in re.findall(r"``([^`]+)``", line[first_column])]
    section = re.search(rf"^## {name}\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert section is not None
    cells = [line.split(" | ")[0] for line in section[1].splitlines() if line.startswith("| `")]
    shown = [n for cell in cells for n in re.findall(r"`([^`]+)`", cell)]
    assert shown == own
    assert own
