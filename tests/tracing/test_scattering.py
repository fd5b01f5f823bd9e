"""Diffuse scattering as a scene states it: energy, patterns, options that replace it, and files that hold it."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.constants import speed_of_light
from traced_rooms import receiver
from wrf_mi_bench.sionna_reference import sionna_paths
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.apps.checking import check_scene
from wrf_mi.apps.checking.scene_repair import repair_scene
from wrf_mi.apps.exports import ExportOptions, export
from wrf_mi.core import Antenna, InputError
from wrf_mi.scene.edit import Move, edit_scene
from wrf_mi.scene.materials import read_materials
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.sionna.scattering import scattering_of

FREQUENCY_HZ = 3.5e9
TX, RX = np.array([[4.0, -3.0, 1.0]]), np.array([3.0, 3.0, -0.5])
HALF_M = 10.0  # of the sides of the plane x = 0
NODES = 400  # of the quadrature over the plane along each side: integrals to 1e-6
SINGLE = 2e-5  # relative, of gains in single precision
SAMPLED = 0.03  # relative, of powers of `DENSE` paths: three standard deviations over seeds, 1 % for the directive lobe
NEAR_PLANE = 1e-3  # relative: Sionna RT's interaction points are some 1e-4 m off the plane
REFLECTED = TraceOptions(line_of_sight=False, transmission=False, depth=1, rays=1 << 12)
SCATTERED = replace(REFLECTED, scattering=True)
DENSE = replace(SCATTERED, rays=1 << 17)
METAL = {"relative_permittivity": 1.0, "conductivity": 1e7}
CONCRETE = {"relative_permittivity": 5.24, "conductivity": 0.1, "thickness": 0.2}
PATTERNS: dict[str, Any] = {
    "lambertian": {"scattering_pattern": "lambertian"},
    "directive": {"scattering_pattern": "directive", "alpha_r": 5},
    "backscattering": {"scattering_pattern": "backscattering", "alpha_r": 4, "alpha_i": 9, "lambda_": 0.6},
}


def element(name, value):
    tag = "string" if isinstance(value, str) else "integer" if isinstance(value, int) else "float"
    return f'<{tag} name="{name}" value="{value}"/>'


def plane(folder, name="mat-sheet", kind="radio-material", **stated):
    """Scene file of a plane with an ideal conductor, or another material, and what is stated of it."""
    folder.mkdir(parents=True, exist_ok=True)
    constants = {} if kind != "radio-material" else METAL
    numbers = "".join(element(key, value) for key, value in {**constants, **stated}.items())
    sheet(0, 0.0, (-HALF_M, HALF_M), (-HALF_M, HALF_M)).export(folder / "plane.ply")
    shape = f'<string name="filename" value="plane.ply"/><ref id="{name}" name="bsdf"/>'
    bsdf = f'<bsdf type="{kind}" id="{name}">{numbers}</bsdf>'
    file = folder / "scene.xml"
    file.write_text(f'<scene version="2.1.0">{bsdf}<shape type="ply" id="mesh-plane">{shape}</shape></scene>')
    return file


def traced(scene, options=SCATTERED, **how):
    """Paths, and powers of those that are mirrored and of those that are scattered."""
    paths = trace_paths(scene, TX, receiver(RX), options, **how).paths
    power, scattered = np.abs(paths.gain) ** 2, (paths.interactions == 2).any(axis=1)
    return paths, power[~scattered].sum(), power[scattered].sum()


def lobes(pattern, towards_in, towards_out, cosine_in):
    """Values of a pattern [...] for unit vectors [..., 3] of travel, of integral 1 over the half space, in float64."""
    if pattern["scattering_pattern"] == "lambertian":
        return towards_out[..., 0] / np.pi
    share = pattern.get("lambda_", 1.0)
    exponents = pattern["alpha_r"], pattern.get("alpha_i", 1)

    def raw(incident, leaving):
        mirrored = incident * [-1, 1, 1]
        about = (np.einsum("...x,...x->...", axis, leaving) for axis in (mirrored, -incident))
        first, second = (((1 + cosine) / 2) ** a for cosine, a in zip(about, exponents, strict=True))
        return share * first + (1 - share) * second

    # The integral over directions of the half space depends on the angle of incidence alone.
    node, weight = np.polynomial.legendre.leggauss(60)
    cosine, weight = (node + 1) / 2, weight / 2
    azimuth = 2 * np.pi * np.arange(120) / 120
    sine = np.sqrt(1 - cosine**2)[:, None]
    grid = np.stack([np.repeat(cosine[:, None], 120, 1), sine * np.cos(azimuth), sine * np.sin(azimuth)], axis=-1)
    angles = np.linspace(0, 1, 400)
    incident = np.stack([-angles, np.sqrt(1 - angles**2), np.zeros(400)], axis=-1)
    norm = [weight @ raw(direction, grid).mean(axis=1) * 2 * np.pi for direction in incident]
    return raw(towards_in, towards_out) / np.interp(cosine_in, angles, norm)


def integral(pattern, coefficient):
    """Power that the plane scatters between isotropic antennas, by quadrature (Degli-Esposti et al., 2007)."""
    node, weight = np.polynomial.legendre.leggauss(NODES)
    place = np.stack(np.broadcast_arrays(0.0, HALF_M * node[:, None], HALF_M * node), axis=-1)
    (into, near_m), (out, far_m) = (
        (way / (size := np.linalg.norm(way, axis=-1))[..., None], size) for way in (place - TX[0], RX - place)
    )
    cosine = -into[..., 0]
    density = cosine / near_m**2 * lobes(pattern, into, out, cosine) / far_m**2
    wavelength = speed_of_light / FREQUENCY_HZ
    return (wavelength * coefficient / (4 * np.pi)) ** 2 * HALF_M**2 * weight @ density @ weight


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    return open_scene(plane(tmp_path_factory.mktemp("smooth")), FREQUENCY_HZ)


@pytest.mark.parametrize("scattering", [False, True])
@pytest.mark.parametrize("coefficient", [0.0, 0.3, 0.6, 0.9])
def test_mirrored_power_is_lowered_by_the_stated_coefficient(smooth, tmp_path, coefficient, scattering):
    scene = open_scene(plane(tmp_path, scattering_coefficient=coefficient), FREQUENCY_HZ)
    mirrored = traced(scene, replace(SCATTERED, scattering=scattering))[1]
    assert mirrored / traced(smooth, REFLECTED)[1] == pytest.approx(1 - coefficient**2, rel=SINGLE)


def test_plane_that_does_not_scatter_has_no_scattered_path(smooth, caplog):
    assert len(traced(smooth)[0]) == 1
    assert "scattering has no effect" in caplog.text


@pytest.mark.parametrize("scattering", [False, True])
def test_plane_that_scatters_all_has_no_mirrored_path(tmp_path, scattering):
    scene = open_scene(plane(tmp_path, scattering_coefficient=1.0), FREQUENCY_HZ)
    paths, mirrored, scattered = traced(scene, replace(DENSE, scattering=scattering))
    assert mirrored == 0
    assert (paths.interactions == 2).any(axis=1).all()
    if scattering:
        assert scattered == pytest.approx(integral(PATTERNS["lambertian"], 1.0), rel=SAMPLED)


@pytest.mark.parametrize("name", PATTERNS)
def test_scattered_power_is_the_integral_of_the_stated_pattern(tmp_path, name):
    scene = open_scene(plane(tmp_path, scattering_coefficient=0.6, **PATTERNS[name]), FREQUENCY_HZ)
    assert traced(scene, DENSE)[2] == pytest.approx(integral(PATTERNS[name], 0.6), rel=SAMPLED)


@pytest.mark.parametrize("constants", [METAL, CONCRETE])
@pytest.mark.parametrize("name", PATTERNS)
def test_powers_are_those_of_plain_sionna_rt(tmp_path, name, constants):
    file = plane(tmp_path, scattering_coefficient=0.6, xpd_coefficient=0.2, **constants, **PATTERNS[name])
    scene = open_scene(file, FREQUENCY_HZ)
    _, gain, length, _ = sionna_paths(scene, TX, RX, SCATTERED)
    is_mirrored = length == length.min()  # no other path by the plane is as short
    power = np.abs(gain) ** 2
    _, mirrored, scattered = traced(scene)
    assert mirrored == pytest.approx(power[is_mirrored].sum(), rel=NEAR_PLANE)
    assert scattered == pytest.approx(power[~is_mirrored].sum(), rel=NEAR_PLANE)


def test_stated_share_of_scattered_power_changes_its_polarization(tmp_path):
    scene = open_scene(plane(tmp_path, scattering_coefficient=0.6, xpd_coefficient=0.25), FREQUENCY_HZ)
    total = integral(PATTERNS["lambertian"], 0.6)
    assert traced(scene, DENSE)[2] == pytest.approx(0.75 * total, rel=SAMPLED)
    crossed = traced(scene, DENSE, tx_antenna=Antenna(polarization="H"))[2]
    assert crossed == pytest.approx(0.25 * total, rel=SAMPLED)


def test_coefficient_of_the_options_replaces_the_stated_one(tmp_path, caplog):
    scene = open_scene(plane(tmp_path, scattering_coefficient=0.6), FREQUENCY_HZ)
    options = replace(SCATTERED, scattering_coefficient=0.2)
    with caplog.at_level(logging.INFO):
        replaced = traced(scene, options)
    assert "scattering_coefficient 0.2 replaces those of the scene's materials: sheet 0.6" in caplog.text
    other = open_scene(plane(tmp_path, scattering_coefficient=0.2), FREQUENCY_HZ)
    np.testing.assert_array_equal(replaced[0].gain, traced(other)[0].gain)
    assert scattering_of(scene.radio_materials["sheet"]) == {"scattering_coefficient": 0.6}


def test_coefficient_zero_of_the_options_switches_scattering_off(tmp_path):
    scene = open_scene(plane(tmp_path, scattering_coefficient=0.6), FREQUENCY_HZ)
    paths, mirrored, _ = traced(scene, replace(SCATTERED, scattering_coefficient=0.0))
    assert len(paths) == 1
    assert mirrored > traced(scene, REFLECTED)[1]


def test_recomputed_gains_have_the_present_coefficient(tmp_path):
    scene = open_scene(plane(tmp_path, scattering_coefficient=0.6), FREQUENCY_HZ)
    result = trace_paths(scene, TX, receiver(RX), REFLECTED)
    scene.radio_materials["sheet"].scattering_coefficient = 0.8
    ratio = np.abs(recompute(result, scene).paths.gain / result.paths.gain)
    np.testing.assert_allclose(ratio, 0.6 / 0.8, rtol=SINGLE)


STATED = {"scattering_coefficient": 0.6, "xpd_coefficient": 0.1, "scattering_pattern": "directive", "alpha_r": 3}


@pytest.mark.parametrize("kind", ["itu-radio-material", "diffuse"])
def test_material_named_by_itu_keeps_its_scattering(tmp_path, kind):
    file = plane(tmp_path, "mat-itu_brick", kind, **STATED, **({"type": "brick"} if kind.startswith("itu") else {}))
    assert scattering_of(open_scene(file, FREQUENCY_HZ).radio_materials["itu_brick"]) == STATED


def test_constants_of_a_material_with_a_name_of_itu_are_refused(tmp_path):
    file = plane(tmp_path, "mat-itu_brick", relative_permittivity=7.0, conductivity=0.1)
    with pytest.raises(InputError, match="<bsdf> 1 has constants and an id of ITU-R P"):
        open_scene(file, FREQUENCY_HZ)


WRONG = {
    "scattering_coefficient": (1.2, -0.1, "much"),
    "xpd_coefficient": (2.0,),
    "scattering_pattern": ("diffuse",),
    "alpha_r": (0, 1.5),
    "alpha_i": (3,),  # not of a directive pattern
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_scattering_that_a_material_cannot_have_is_refused(tmp_path, name, value):
    with pytest.raises(InputError, match=f"<bsdf> mat-itu_brick: .*{name}"):
        open_scene(plane(tmp_path, "mat-itu_brick", "diffuse", **{**STATED, name: value}), FREQUENCY_HZ)


@pytest.mark.parametrize("kind", ["radio-material", "diffuse"])
def test_corrected_and_edited_scenes_keep_what_is_stated(tmp_path, kind):
    name = "mat-itu_brick" if kind == "diffuse" else "mat-sheet"
    scene = open_scene(plane(tmp_path / "stated", name, kind, **STATED), FREQUENCY_HZ)
    folder = write_corrected_scene(tmp_path / "corrected", scene, {})
    edited = edit_scene(folder, tmp_path / "edited", [Move(("plane",), (1.0, 0.0, 0.0))])
    for place in (folder, edited):
        material = open_scene(place, FREQUENCY_HZ).objects["plane"].radio_material
        assert scattering_of(material) == STATED


def test_corrected_scene_keeps_a_material_that_is_not_the_one_of_its_name(tmp_path):
    file = plane(tmp_path / "stated", "mat-itu_brick", "diffuse", type="metal", thickness=0.1)
    scene = open_scene(file, FREQUENCY_HZ)
    assert scene.radio_materials["itu_brick"].itu_type == "metal"
    folder = write_corrected_scene(tmp_path / "corrected", scene, {})
    material = open_scene(folder, FREQUENCY_HZ).objects["plane"].radio_material
    assert float(material.conductivity[0]) == pytest.approx(1e7)


def test_pattern_of_a_class_of_its_own_is_not_written_as_another(tmp_path):
    from sionna import rt

    class Narrow(rt.LambertianPattern):
        pass

    scene = open_scene(plane(tmp_path / "stated", scattering_coefficient=0.6), FREQUENCY_HZ)
    scene.radio_materials["sheet"].scattering_pattern = Narrow()
    with pytest.raises(InputError, match="material sheet: unknown scattering_pattern 'narrow'"):
        write_corrected_scene(tmp_path / "corrected", scene, {})


def test_scattering_of_materials_yml_holds_in_the_scene(tmp_path):
    scene = open_scene(plane(tmp_path / "stated", "mat-itu_brick", "diffuse"), FREQUENCY_HZ)
    folder = write_corrected_scene(tmp_path / "folder", scene, {})
    file = folder / "materials.yml"
    file.write_text(f"{file.read_text()}scattering: {{itu_brick: {STATED}}}\n")
    assert scattering_of(open_scene(folder, FREQUENCY_HZ).radio_materials["itu_brick"]) == STATED
    assert read_materials(file).scattering == {"itu_brick": STATED}
    file.write_text(file.read_text().replace("'alpha_r': 3", "'alpha_i': 3"))
    with pytest.raises(InputError, match="scattering: itu_brick: no 'alpha_i' with a directive pattern"):
        read_materials(file)


@pytest.mark.parametrize("kind", ["radio-material", "diffuse"])
def test_exported_scene_scatters_in_plain_sionna_rt(tmp_path, kind, caplog):
    from sionna import rt

    file = plane(tmp_path / "stated", "mat-itu_brick" if kind == "diffuse" else "mat-sheet", kind, **STATED)
    export(file, "sionna", tmp_path / "exported", ExportOptions(frequency_hz=FREQUENCY_HZ))
    scene = rt.load_scene(str(tmp_path / "exported" / "scene.xml"), merge_shapes=False)
    material = scene.objects["plane"].radio_material
    assert scattering_of(material) == {name: STATED[name] for name in ("scattering_coefficient", "xpd_coefficient")}
    assert "scene.xml cannot state the scattering_pattern" in caplog.text


def test_check_names_constants_that_the_name_overrules(tmp_path):
    file = plane(tmp_path, "mat-itu_brick", relative_permittivity=7.0, scattering_coefficient=2.0)
    texts = [finding.text for finding in check_scene(file).findings if finding.kind == "material-values"]
    assert any("has constants and an id of ITU-R P.2040" in text for text in texts)
    assert any(text.startswith("scattering_coefficient is 2.0") for text in texts)


@pytest.mark.parametrize("kind", ["radio-material", "itu-radio-material", "diffuse"])
def test_repaired_scene_keeps_what_is_stated(tmp_path, kind):
    itu_type = {"type": "brick"} if kind.startswith("itu") else {}
    file = plane(tmp_path / "stated", "mat-itu_brick", kind, **STATED, **itu_type)
    repair_scene(file, tmp_path / "out")
    material = open_scene(tmp_path / "out", FREQUENCY_HZ).objects["plane"].radio_material
    assert scattering_of(material) == STATED
    assert getattr(material, "itu_type", None) == (None if kind == "radio-material" else "brick")
