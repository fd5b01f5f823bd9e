"""Scenes from XML files and dictionaries are the same; what docs/plugins.md shows runs; plugins beside Sionna RT."""

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import wrf_mi_plugins
from documents import DOCS, blocks
from plugin_fields import plain, write_run
from wrf_mi_plugins.shape import shape_parameters

from wrf_mi.backend.device import to_tensor
from wrf_mi.core import Record
from wrf_mi.runs.api import open_run

wrf_mi_plugins.register_all()
SECONDS_PER_CHILD = 300
"""A child imports Mitsuba and Sionna RT and compiles some kernels; a busy machine needs much longer."""
TX = (0.4, -0.7, 1.1)
XML = """
<scene version="3.0.0">
    <integrator type="volpath"/>
    <emitter type="wrf_gaussian_emitter" id="transmitter">
        <string name="run" value="{run}"/>
        <point name="tx_position" x="0.4" y="-0.7" z="1.1"/>
    </emitter>
    <shape type="wrf_gaussians" id="gaussians"> <ref id="transmitter"/> </shape>
    <medium type="wrf_gaussian_medium" id="air"> <ref id="transmitter"/> <float name="scale" value="2"/> </medium>
    <medium type="wrf_gaussian_medium" id="still_air">
        <string name="run" value="{run}"/>
        <point name="tx_position" x="0.4" y="-0.7" z="1.1"/>
    </medium>
    <shape type="sphere" id="stencil">
        <float name="radius" value="50"/> <bsdf type="null"/>
        <ref name="interior" id="air"/> <ref name="exterior" id="still_air"/>
    </shape>
</scene>
"""


def as_dict(run: str) -> dict[str, Any]:
    transmitter, field = {"type": "ref", "id": "transmitter"}, {"run": run, "tx_position": list(TX)}
    sides = {"interior": {"type": "ref", "id": "air"}, "exterior": {"type": "ref", "id": "still_air"}}
    return {
        "type": "scene",
        "integrator": {"type": "volpath"},
        "transmitter": {"type": "wrf_gaussian_emitter", **field},
        "gaussians": {"type": "wrf_gaussians", "emitter": transmitter},
        "air": {"type": "wrf_gaussian_medium", "emitter": transmitter, "scale": 2.0},
        "still_air": {"type": "wrf_gaussian_medium", **field},
        "stencil": {"type": "sphere", "radius": 50.0, "bsdf": {"type": "null"}, **sides},
    }


@pytest.fixture(scope="module", params=["wrf-gs", "wrf-gs+"])
def run(request: pytest.FixtureRequest, one_gateway: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    encoding = "encoding.position_octaves=2", "encoding.tx_scale_m=3"
    return write_run(tmp_path_factory.mktemp("scene") / "runs" / "first", one_gateway, request.param, *encoding)


def numbers(scene: Any) -> dict[str, np.ndarray]:
    """Every number of a scene that `mi.traverse` lists."""
    return {key: plain(value) for key, value in mi.traverse(scene) if hasattr(value, "numpy")}


def test_xml_and_dictionary_are_the_same_scene(run, monkeypatch, tmp_path):
    """The XML names the run folder relative to itself, whatever the working folder is."""
    xml = run.parents[1] / "scene.xml"
    xml.write_text(XML.format(run="runs/first"))
    monkeypatch.chdir(tmp_path)
    expected = numbers(mi.load_dict(as_dict(str(run))))
    inner = {key.replace("air.", "stencil.interior_medium.") for key in expected}
    names = {"transmitter.tx_position", "gaussians.data", "gaussians.signal", "stencil.interior_medium.scale"}
    assert names <= {*expected, *inner}
    for scene in (mi.load_file(str(xml)), mi.load_string(XML.format(run=run / "model.npz"))):
        of_xml = numbers(scene)
        assert of_xml.keys() == expected.keys()
        for key in expected:
            np.testing.assert_array_equal(of_xml[key], expected[key], key)
        (shape,) = [s for s in scene.shapes() if s.interior_medium() is not None]
        ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.Vector3f(0, 0.6, 0.8))
        inside, outside = (plain(m.optical_depth(ray)) for m in (shape.interior_medium(), shape.exterior_medium()))
        np.testing.assert_allclose(inside, 2 * outside, rtol=1e-6)


def test_shape_holds_the_gaussians_of_the_run_folder(run):
    """The parameters of the fitted model, through the model and the encoding that the configuration names."""
    scene, trained = mi.load_dict(as_dict(str(run))), open_run(run).field
    encoding, scene_numbers = scene.emitters()[0].source.field.encoding, numbers(scene)
    assert (encoding.position_octaves, encoding.tx_scale_m) == (2, 3.0)
    params = {name: to_tensor(values) for name, values in trained.params.items()}
    gaussians = trained.field.gaussians(params, to_tensor(np.array(TX)[:, None]))
    for name, values in shape_parameters(gaussians).items():
        np.testing.assert_allclose(scene_numbers[f"gaussians.{name}"], plain(values), rtol=1e-5, atol=1e-6)


def test_bad_runs_are_named(run, tmp_path):
    empty, damaged, unknown = (tmp_path / name for name in ("empty", "damaged", "unknown"))
    empty.mkdir()
    for folder in (damaged, unknown):
        shutil.copytree(run, folder)
    (damaged / "model.npz").write_bytes(b"nonsense")
    config = unknown / "config.yaml"
    config.write_text(config.read_text().replace("  model:", "  modell:"))
    for folder, message in ((empty, "no config.yaml"), (damaged, "model.npz: not readable"), (unknown, "modell")):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict({"type": "wrf_gaussian_emitter", "run": str(folder), "tx_position": list(TX)})
    with pytest.raises(RuntimeError, match="no tx_position; give x, y, z in metres"):
        mi.load_dict({"type": "wrf_gaussian_emitter", "run": str(run)})


def child(code: str) -> str:
    """What a new process prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=SECONDS_PER_CHILD)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_registration_needs_a_variant():
    code = """
import wrf_mi_plugins
def refused():
    try:
        wrf_mi_plugins.register_all()
    except Exception as error:
        print(type(error).__name__, error)
refused()
import mitsuba as mi
refused()
mi.set_variant("scalar_rgb" if "scalar_rgb" in mi.variants() else "llvm_ad_rgb")
refused()
mi.set_variant("llvm_ad_mono_polarized")
wrf_mi_plugins.register_all()
wrf_mi_plugins.register_all()
try:
    mi.load_dict({"type": "wrf_gaussian_medium"})
except RuntimeError as error:
    print("known" if "give one emitter" in str(error) else error)
"""
    *refusals, last = child(code).splitlines()
    remedy = 'call wrf_mi.backend.init(), or mi.set_variant("llvm_ad_mono_polarized")'
    for line, reason in zip(refusals, ("no variant set", "no variant set", "variant is"), strict=True):
        assert line.startswith("BackendError register_all: ")
        assert reason in line
        assert remedy in line
    assert last == "known"


def test_plugins_work_in_one_process_with_sionna_rt():
    """Sionna RT is imported first here, second in `test_plugin_integrator_walls.py`; it traces, they render."""
    code = """
import wrf_mi.backend
wrf_mi.backend.init()
import numpy as np, mitsuba as mi
from sionna import rt
import wrf_mi_plugins
wrf_mi_plugins.register_all()
scene = rt.load_scene(rt.scene.box)
scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
scene.add(rt.Transmitter("tx", mi.Point3f(-1, 0, 1)))
scene.add(rt.Receiver("rx", mi.Point3f(2, 0.5, 1)))
print(int(rt.PathSolver()(scene, max_depth=1).valid.numpy().sum()) > 3)
ones = mi.TensorXf(np.ones((1, 3)))
medium = {"type": "wrf_gaussian_medium", "centers": ones, "scales": ones, "opacity": mi.TensorXf([0.75]),
          "quaternions": mi.TensorXf(np.array([[0, 0, 0, 1.0]]))}
stencil = {"type": "sphere", "radius": 40.0, "bsdf": {"type": "null"}, "interior": medium}
scene = mi.load_dict({"type": "scene", "integrator": {"type": "volpath"}, "stencil": stencil})
ray = mi.Ray3f(mi.Point3f(-19, 1, 1), mi.Vector3f(1, 0, 0))
print(abs(float(scene.shapes()[0].interior_medium().optical_depth(ray)[0]) - np.log(4)) < 1e-3)
"""
    assert child(code).split() == ["True", "True"]


PAGE = DOCS / "plugins.md"
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
    """The names that the page's scripts leave behind, run one after the other beside a run folder.

    A warning of Mitsuba is an error, such as that of a film whose pixel format does not fit the variant.
    """
    folder = tmp_path_factory.mktemp("page")
    write_run(folder / "runs" / "first", one_gateway, "wrf-gs+")
    (xml,) = blocks(PAGE, "xml")
    (folder / "scene.xml").write_text(xml)
    left: dict[str, Any] = {"scenes": []}
    logger: Any = mi.logger()  # type: ignore[operator]
    error_level = logger.error_level()
    logger.set_error_level(mi.LogLevel.Warn)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            for number, script in enumerate(blocks(PAGE, "python")):
                exec(compile(script, f"{PAGE.name}, script {number}", "exec"), left)
                left["scenes"].append(left.get("scene"))
    finally:
        logger.set_error_level(error_level)
    return left


def test_traced_scene(names):
    """The picture follows the transmitter, and the dictionary is the XML's scene."""
    field, moved = plain(names["field"]), plain(names["moved"])
    assert field.shape == moved.shape == (90, 360, 2)
    assert np.abs(field).max() > 0.01
    assert np.abs(field - moved).max() > 1e-3
    _, of_xml, of_dict, _, _ = names["scenes"]
    params = mi.traverse(of_xml)
    params.update({"transmitter.tx_position": mi.Point3f(0.5, -0.6, 1.0)})
    np.testing.assert_allclose(plain(mi.render(of_xml)), field, atol=1e-6)
    np.testing.assert_allclose(plain(mi.render(of_dict)), field, atol=1e-6)


def test_documented_gradient_by_the_transmitter(names):
    """What the page prints is the slope of the power that is received."""
    gradient = plain(names["position"].grad)[:, 0]
    params, start = mi.traverse(names["scenes"][2]), np.array([0.5, -0.6, 1.0])
    direction = gradient / np.linalg.norm(gradient)

    def power(distance_m: float) -> float:
        where = start + distance_m * direction
        params.update({"transmitter.tx_position": mi.Point3f(*where.tolist())})
        return float((plain(mi.render(names["scenes"][2])) ** 2).mean())

    # Pixels that cross a Gaussian's edge on the way, at a hundredth of its peak, have no derivative.
    assert (power(1e-3) - power(-1e-3)) / 2e-3 == pytest.approx(np.linalg.norm(gradient), rel=0.03)


def test_powers_and_transmittance(names):
    powers = plain(names["powers"])
    assert powers.max() > 0.01
    assert powers.min() >= 0
    picture, sensor = plain(names["transmittance"]).reshape(18, 72), names["scenes"][4].sensors()[0]
    pixels = (np.stack(np.meshgrid(np.arange(72), np.arange(18)), axis=-1).reshape(-1, 2) + 0.5) / [72, 18]
    rays, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), mi.Point2f(pixels.T), mi.Point2f(0.5))
    exact = np.exp(-plain(names["air"].optical_depth(rays))).reshape(18, 72)
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
    parameters = [n for line in lines[rules[1] + 1 : rules[2]] for n in re.findall(r"``([^`]+)``", line[first_column])]
    section = re.search(rf"^## {name}\n(.*?)(?=^## |\Z)", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert section is not None
    cells = [line.split(" | ")[0] for line in section[1].splitlines() if line.startswith("| `")]
    shown = [n for cell in cells for n in re.findall(r"`([^`]+)`", cell)]
    assert shown == parameters
    assert parameters
