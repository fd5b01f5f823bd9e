"""The stress benchmark with a case or two of each row."""

import re
from dataclasses import replace

import numpy as np
import pytest
from wrf_mi_bench import stress
from wrf_mi_bench.stress import image, image_row, images, rendered, splatted
from wrf_mi_bench.stress_fields import BLENDINGS, HARD, made, truth
from wrf_mi_bench.stress_rows import Worst, gradient_errors, held, worst_of

from wrf_mi.apps.commands.main import main as cli

SOME = {"random": lambda rng: made(20, rng)}


@pytest.mark.parametrize(("part", "few"), [pytest.param(part, few, id=part.__name__) for part, _, few in stress.PARTS])
def test_few_cases_of_each_part_keep_their_bounds(part, few):
    rows = part(*few)
    assert rows
    for row in rows:
        assert held(row), row
        edges = re.search(r"([\d.]+)% of the pixels lie on an edge", row["value"])
        assert edges is None or float(edges[1]) < 10


def test_order_of_ties_in_depth_equals_the_reference():
    """Permuted and mirrored offsets have equal distances, so that positions decide the order."""
    field = HARD["exact ties in depth"](np.random.default_rng(5))
    opaque = replace(field, opacity=np.ones(len(field.opacity)), scale_m=0 * field.scale_m + 0.5)
    expected, clear = truth(opaque, "alpha", (30, 60))
    assert len(np.unique(np.abs(expected[clear]).round(3))) > 10
    np.testing.assert_allclose(image(opaque, "alpha", (30, 60))[clear], expected[clear], atol=1e-5)


@pytest.mark.parametrize("blending", BLENDINGS)
def test_images_of_no_gaussians_and_of_one_pixel_equal_the_reference(blending):
    assert not image(made(0, np.random.default_rng(0)), blending, (3, 5)).any()
    for seed in range(5):
        field = made(40, np.random.default_rng(seed))
        expected, clear = truth(field, blending, (1, 1))
        np.testing.assert_allclose(image(field, blending, (1, 1))[clear], expected[clear], rtol=1e-4)


def test_plugin_rows_detect_rays_lost_at_thin_gaussians(monkeypatch):
    """Mitsuba's ellipsoids lose rays where they are small against its unit of length."""
    from wrf_mi_plugins import acceleration

    needles = {"needles": HARD["needles, 1e6 to 1"]}
    for name, value in {"NEAREST": 1.0, "FARTHEST": 4.0, "STEP": 1e-4, "SIZE": 12.0, "SPACING": 24.0004}.items():
        monkeypatch.setattr(acceleration, name, value)
    assert worst_of(image_row("needles", needles, 1, by=rendered))[0] > 0.01
    monkeypatch.undo()
    assert held(image_row("needles", needles, 1, by=rendered))


def test_nan_is_the_worst_error():
    worst = Worst()
    for error, where in ((1e-6, "first"), (np.nan, "second"), (1.0, "third")):
        worst.add(error, where)
    row = worst.row("made up", 1.0)
    assert not held(row)
    assert "second" in row["value"]


def test_errors_of_derivatives_are_relative_to_the_norm_of_their_group():
    double = {"a": np.array([[3.0, 4.0]]), "b": np.array([[1e-6, 0.0]])}
    single = {"a": np.array([[3.0, 4.5]]), "b": np.array([[2e-6, 0.0]])}
    ones = {name: np.ones((1, 2)) for name in double}
    assert dict(gradient_errors(single, double, ones)) == pytest.approx({"a": 0.1, "b": 1e-6 / 5e-3})
    assert np.isnan(dict(gradient_errors({**single, "b": np.full((1, 2), np.nan)}, double, ones))["b"])


def test_quick_stress_command_prints_rows_and_fails_beyond_a_bound(monkeypatch, capsys):
    monkeypatch.setattr(stress, "HARD", {})
    monkeypatch.setattr(stress, "PARTS", ((images, (), (1, 1)),))
    assert cli(["bench", "stress", "--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 2
    assert lines[2].startswith("| numbers under stress: image, random fields, 2 cases | **worst ")
    monkeypatch.setattr(stress, "IMAGE", 1e-12)
    assert cli(["bench", "stress", "--quick"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("wrf-mi: bench stress --quick: image, random fields, 2 cases: worst ")


@pytest.mark.parametrize("names", [["operator"], ["stress", "wrf-gs+-paper"], ["nowhere"], ["stress", "--store"]])
def test_names_without_a_quick_form_are_refused(names, capsys):
    assert cli(["bench", *names, "--quick"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "stress" in line


def test_image_row_reports_an_error_beyond_its_bound():
    row = image_row("image, random", SOME, 2, by=lambda *parts: [1.001 * part for part in splatted(*parts)])
    assert worst_of(row)[0] == pytest.approx(1e-3, rel=0.05)
    assert not held(row)
