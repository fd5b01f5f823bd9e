"""Time against error beside Sionna RT's solvers and ``volprim_rf_basic``: errors, references, table, picture."""

import numpy as np
import pytest
from wrf_mi_bench import side_by_side
from wrf_mi_bench.side_by_side import OURS, SOLVER, VOLPRIM, Route, entry, error_db, measure_paths, picture, powers

RAYS = (30, 100_000)
AGREE_DB = 0.05
"""Largest mean difference of the powers of both tracers in a closed box, where Sionna RT lacks paths around an edge."""
LACKS = 0.02  # largest share of such paths, whose reflections are less than 1 cm apart
CLOSE = 1e-4  # largest error of our evaluations of a field, relative: that of the stress benchmark


@pytest.fixture(scope="module")
def box():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(side_by_side.CITY_SOURCE_M, "box", (1.0, 0.5, 2.0))
        patch.setattr(side_by_side, "CITY_HALF_M", 2.0)
        patch.setattr(side_by_side, "REPEATS", 1)
        yield measure_paths("box", 4, RAYS, RAYS[-1])


def test_both_tracers_agree_in_a_closed_box(box):
    reference = box["reference"]
    # A box has the direct path and 6 of one reflection, 18 of two and 38 of three.
    assert reference["paths"] == 4 * (1 + 6 + 18 + 38)
    assert reference["references_differ_db"] < AGREE_DB
    assert reference["theirs_lacks"] <= LACKS * reference["paths"]
    assert [reference[name] for name in ("ours_lacks", "not_confirmed", "theirs_not_confirmed")] == [0, 0, 0]


def test_errors_fall_with_the_number_of_rays(box):
    errors = {row["method"]: row["error"] for row in box["rows"]}
    for tool in (OURS, SOLVER):
        few, many = (errors[f"{tool}, {rays:,} rays"] for rays in RAYS)
        assert many < AGREE_DB < few


def test_paths_that_one_tracer_lacks_are_confirmed_and_counted(monkeypatch):
    at = Route("laboratory", 2)
    all_paths = at.traced(10_000)
    solved = at.solved(10_000)
    monkeypatch.setattr(at, "traced", lambda rays: all_paths.select(np.arange(3, len(all_paths))))
    monkeypatch.setattr(at, "solved", lambda rays: solved)
    right, reference = at.reference(1)
    assert reference["ours_lacks"] == 3
    assert reference["theirs_lacks"] == 0
    np.testing.assert_allclose(right, powers(all_paths), rtol=1e-4)


def test_map_of_cells_agrees_with_paths_to_their_centres(monkeypatch):
    monkeypatch.setitem(side_by_side.CITY_SOURCE_M, "box", (1.0, 0.5, 2.0))
    for name, value in {"CITY_HALF_M": 2.0, "CELLS": 8, "REPEATS": 1, "MAP_REFERENCE": 1_000_000}.items():
        monkeypatch.setattr(side_by_side, name, value)
    monkeypatch.setattr(side_by_side, "MAP_RAYS", (10_000,))
    monkeypatch.setattr(side_by_side, "MAP_SAMPLES", (3_000, 300_000))
    result = side_by_side.measure_map("box")
    traced, few, many = (row["error"] for row in result["rows"])
    assert traced < 0.1
    assert many < 0.1 < few
    assert result["reference"]["references_differ_db"] < 0.1


def test_fields_are_those_of_the_oracle(monkeypatch):
    monkeypatch.setattr(side_by_side, "FIELD_REPEATS", 1)
    errors = {row["method"]: row["error"] for row in side_by_side.measure_field(100)["rows"]}
    assert errors.pop(VOLPRIM) < 0.5
    assert max(errors.values()) < CLOSE


def test_error_in_decibel_counts_lacking_values_apart():
    assert error_db(np.array([1.0, 20.0, 0.0]), np.array([1.0, 10.0, 2.0])) == pytest.approx((5 * np.log10(2), 1 / 3))


def test_picture_has_a_panel_for_each_case_and_a_line_for_each_program():
    rows = [
        entry(f"paths, {place}", f"{tool}, {n} rays", n, 1 / n)
        for place in "ab"
        for tool in (OURS, SOLVER)
        for n in (1, 9)
    ]
    figure = picture(rows)
    assert [axes.get_title() for axes in figure.axes] == ["paths, a", "paths, b"]
    assert [len(axes.lines) for axes in figure.axes] == [2, 2]
    assert side_by_side.table(rows).count("\n") == 9
