"""The stress benchmark with a case or two of each row."""

import re
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from wrf_mi_bench import stress as bench_stress
from wrf_mi_bench import stress_fields, stress_joint, stress_plugins, stress_receivers, stress_rows
from wrf_mi_bench.stress_fields import HARD, StressField, image, image_row, made, reference
from wrf_mi_bench.stress_joint import joint, phases
from wrf_mi_bench.stress_losses import losses
from wrf_mi_bench.stress_receivers import of_fields
from wrf_mi_bench.stress_rows import held, worst_of

from wrf_mi.apps.commands.main import main as cli
from wrf_mi.tracing.paths.scene_parameters import SHIFT, TILT, PlaneTables

FEW = [pytest.param(part, few, id=part.__name__) for part, _, few in bench_stress.PARTS]


@pytest.mark.parametrize(("part", "few"), FEW)
def test_few_cases_of_each_part_keep_their_bounds(part, few):
    rows = part(*few)
    assert rows
    for row in rows:
        assert held(row), row
        edges = re.search(r"([\d.]+)% of the pixels lie on an edge", row["value"])
        assert edges is None or float(edges[1]) < 10
    first = rows[0]["value"]
    if part is phases:  # those of lengths in float32 exceed the bound
        assert float(first.split()[-2]) > stress_rows.PHASE
    if part is bench_stress.fits:  # some name the group that is not finite
        assert first.endswith(" 0 did neither")
        assert "4 ended finite" not in first


def test_order_of_ties_in_depth_equals_the_reference():
    """Permuted and mirrored offsets have equal distances, so that positions decide the order."""
    field = HARD["exact ties in depth"](np.random.default_rng(5))
    opaque = replace(field, opacity=np.ones(len(field.opacity)), scale_m=0 * field.scale_m + 0.5)
    truth, clear = reference(opaque, "alpha", (30, 60))
    assert len(np.unique(np.abs(truth[clear]).round(3))) > 10
    np.testing.assert_allclose(image(opaque, "alpha", (30, 60))[clear], truth[clear], atol=1e-5)


@pytest.mark.parametrize("blending", stress_fields.BLENDINGS)
def test_images_of_no_gaussians_and_of_one_pixel_equal_the_reference(blending):
    empty = image(made(0, np.random.default_rng(0)), blending, (3, 5))
    assert empty.shape == (3, 5)
    assert not empty.any()
    for seed in range(5):
        field = made(40, np.random.default_rng(seed))
        truth, clear = reference(field, blending, (1, 1))
        np.testing.assert_allclose(image(field, blending, (1, 1))[clear], truth[clear], rtol=1e-4)


OTHER_CASES = (*(name for name in stress_joint.CASES if name != stress_joint.COPLANAR), "many paths")


@pytest.mark.parametrize(
    ("names", "models"),
    [
        ([stress_joint.COPLANAR], ("array", "pixel", "CSI")),
        # Four cases compile some 600 kernels, 15 seconds. The same code and bounds, as in `wrf-mi bench stress`.
        pytest.param(OTHER_CASES, ("array", "RSSI"), marks=pytest.mark.slow),
    ],
)
def test_joint_graph_keeps_its_bounds(names, models):
    """Values and derivatives; `stress.PARTS` has the power of coplanar planes."""
    rows = joint(2, names, models)
    assert len(rows) == 2 * len(names)
    for row in rows:
        assert held(row), row


def test_joint_rows_detect_a_wrong_shift_and_a_missing_gradient(monkeypatch):
    """A shift that the graph ignores shows in values, a tilt without gradient in derivatives."""
    moved = PlaneTables.moved

    def unshifted(self: PlaneTables, parameters: Any) -> Any:
        return moved(self, {name: value for name, value in parameters.items() if name != SHIFT})

    monkeypatch.setattr(PlaneTables, "moved", unshifted)
    value, slope = joint(1, [stress_joint.COPLANAR], ["CSI"])
    assert not held(value)
    assert not held(slope)

    def untilted(self: PlaneTables, parameters: Any) -> Any:
        return moved(self, {**parameters, TILT: dr.detach(parameters[TILT])})

    monkeypatch.setattr(PlaneTables, "moved", untilted)
    value, slope = joint(1, [stress_joint.COPLANAR], ["CSI"])
    assert held(value)
    assert not held(slope)
    assert "plane.tilt" in slope["value"]


def test_receiver_rows_detect_a_wrong_frequency(monkeypatch):
    off = replace(stress_receivers.MODELS["spectrum"], frequency_hz=1.001 * stress_receivers.CARRIER_HZ)
    monkeypatch.setitem(stress_receivers.MODELS, "spectrum", off)
    missed = [row["what"] for row in of_fields(1, 1, ("random",)) if not held(row)]
    assert missed == ["receiver: Bartlett spectrum, 2 cases"]


def test_plugin_rows_detect_rays_lost_at_thin_gaussians(monkeypatch):
    """Mitsuba's ellipsoids lose rays where they are small against its unit of length."""
    from wrf_mi_plugins import acceleration

    for name, value in {"NEAREST": 1.0, "FARTHEST": 4.0, "STEP": 1e-4, "SIZE": 12.0, "SPACING": 24.0004}.items():
        monkeypatch.setattr(acceleration, name, value)
    lost = stress_plugins.plugin_row("needles", {"needles": HARD["needles, 1e6 to 1"]}, 1)
    assert worst_of(lost)[0] > 0.01
    monkeypatch.undo()
    assert held(stress_plugins.plugin_row("needles", {"needles": HARD["needles, 1e6 to 1"]}, 1))


def test_nan_is_the_worst_error():
    worst = stress_rows.Worst()
    for error, where in ((1e-6, "first"), (np.nan, "second"), (1.0, "third")):
        worst.add(error, where)
    row = worst.row("made up", 1.0)
    assert not held(row)
    assert "second" in row["value"]
    slopes = {"a": np.array([[1.0, 2.0], [-3.0, 1e-9]])}
    known = stress_rows.GradientWorst()
    known.add({"a": slopes["a"] * [[1, 1], [-1, 1]]}, slopes, {"a": np.ones((2, 2))})
    assert (known.signs, known.compared) == (1, 3)
    assert known.cosine.error == pytest.approx(1 - (1 + 4 - 9) / 14)
    assert known.norm.error == pytest.approx(0)
    known.add({"a": slopes["a"] + np.nan}, slopes, slopes)
    assert not held(known.row("made up"))


def test_quick_stress_command_prints_rows_and_fails_beyond_a_bound(monkeypatch, capsys):
    def few() -> list[dict[str, str]]:
        return [image_row("image, ordinary", {"random": lambda rng: made(20, rng)}, 1)]

    parts = ((few, (), ()), (losses, (), (1,)), (bench_stress.fits, (), (1,)))
    monkeypatch.setattr(bench_stress, "PARTS", parts)
    assert cli(["bench", "stress", "--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 1 + 6 + 1
    assert lines[2].startswith("| numbers under stress: image, ordinary, 2 cases | **worst ")
    monkeypatch.setattr(stress_fields, "IMAGE", 1e-12)
    assert cli(["bench", "stress", "--quick"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("wrf-mi: bench stress --quick: image, ordinary, 2 cases: worst ")


@pytest.mark.parametrize("names", [["operator"], ["stress", "wrf-gs+-paper"], ["nowhere"], ["stress", "--store"]])
def test_names_without_a_quick_form_are_refused(names, capsys):
    assert cli(["bench", *names, "--quick"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "stress" in line


def test_image_row_reports_an_error_beyond_its_bound():
    def off(field: StressField, blending: str, size: tuple[int, int]) -> np.ndarray:
        return image(field, blending, size) * 1.001

    worst, bound = worst_of(image_row("image, random", {"random": lambda rng: made(20, rng)}, 2, render=off))
    assert worst == pytest.approx(1e-3, rel=0.05)
    assert worst > bound
