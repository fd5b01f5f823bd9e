"""Positions in metres of a local frame, headings, and rows of one place."""

from collections.abc import Callable

import numpy as np
import pytest
from changed_folders import refusal

from wrf_mi.apps.importing.places import find_frame, headings_rad, place_numbers, unit_scale

pyproj = pytest.importorskip("pyproj")

PLACE = np.array([[-78.9385, 36.001], [-78.9394, 36.0041], [-78.9373, 36.0030], [-78.9415, 36.0005]])
"""Longitude and latitude of places on a campus."""
AGREEMENT = 1e-4
"""Relative difference of distances in the projection from those on the ellipsoid, over half a kilometre: the map is
azimuthal equidistant about its middle, where its scale is 1 to 1e-8."""


def geodesic_m(degrees: np.ndarray) -> np.ndarray:
    """Distances from the first place to the others on the ellipsoid, by Karney's method."""
    first = np.repeat(degrees[:1], len(degrees) - 1, axis=0)
    return np.array(pyproj.Geod(ellps="WGS84").inv(*first.T, *degrees[1:].T)[2])


def web_map(degrees: np.ndarray) -> np.ndarray:
    return np.column_stack(pyproj.Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(*degrees.T))


CASES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], bool, str]] = {
    "longitude, latitude": (lambda degrees: degrees, True, ""),
    "x, y in degrees": (lambda degrees: degrees, False, ""),
    "metres of web maps": (web_map, True, "EPSG:3857"),
}


@pytest.mark.parametrize("case", CASES)
def test_local_distances_are_those_on_the_ellipsoid(case: str) -> None:
    convert, geographic, crs = CASES[case]
    frame, notes = find_frame(convert(PLACE), geographic, "", 1.0, crs)
    local_m = frame.local_m(convert(PLACE))
    np.testing.assert_allclose(np.linalg.norm(local_m[1:] - local_m[0], axis=1), geodesic_m(PLACE), rtol=AGREEMENT)
    east_north = local_m[1] - local_m[0]
    assert east_north[0] < 0 < east_north[1]  # the second place is north-west of the first
    assert "azimuthal equidistant" in notes[-1]
    assert frame.facts()["local_crs"].startswith("+proj=aeqd +lon_0=-78.9")


def test_frames_are_told_from_the_numbers() -> None:
    swapped = np.array([[40.7, -111.84], [40.701, -111.841]])  # latitude before longitude
    frame, _ = find_frame(swapped, False, "", 1.0, "")
    plain, _ = find_frame(swapped[:, ::-1], True, "", 1.0, "")
    np.testing.assert_allclose(frame.local_m(swapped), plain.local_m(swapped[:, ::-1]))
    utm = np.array([[684_321.5, 3_985_678.25], [684_400.5, 3_985_700.25]])  # metres of a map projection
    frame, notes = find_frame(utm, False, "", 1.0, "")
    np.testing.assert_array_equal(frame.local_m(utm), [[1.5, 8.25], [80.5, 30.25]])
    assert "shifted by 684320, 3985670 m" in notes[0]
    assert "EPSG:3857" in find_frame(utm, True, "", 1.0, "")[1][0]
    rng = np.random.default_rng(0)
    for origin in ([0, 0], [5, 5], [15, 3], [-8, 2]):  # metres of a room
        frame, _ = find_frame(rng.uniform(0, 3, (50, 2)) + origin, False, "", 1.0, "")
        assert frame.crs == ""


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("ft", 0.3048), ("cm", 0.01), ("", 1.0)])
def test_units_and_plans_in_metres(unit: str, metres: float) -> None:
    plan = np.array([[0.25, 0.5], [11.0, 7.5]])
    frame, notes = find_frame(plan, False, unit, unit_scale(unit, "--units"), "")
    np.testing.assert_allclose(frame.local_m(plan), plan * metres)
    assert notes == []


def test_unknown_units_and_systems_are_refused() -> None:
    refusal(unit_scale, "yard", "--units", "--units 'yard' is unknown; give one of m, mm")
    refusal(find_frame, PLACE, False, "", 1.0, "EPSG:0", "--crs: 'EPSG:0' is no coordinate reference system")


@pytest.mark.parametrize(
    ("name", "stated", "values", "expected"),
    [
        ("heading", "", [0, 90, 359], [0, np.pi / 2, np.radians(359)]),
        ("yaw", "", [0, -3.1, 6.2], [0, -3.1, 6.2]),
        ("heading_deg", "", [1, 2, 3], np.radians([1, 2, 3])),
        ("bearing", "", [0, 90, 270], [np.pi / 2, 0, -np.pi]),
        ("heading", "compass", [0, 4, 8], np.radians([90, 86, 82])),
    ],
)
def test_headings_run_from_x_towards_y(name: str, stated: str, values: list[float], expected: list[float]) -> None:
    np.testing.assert_allclose(headings_rad(np.array(values, float), name, stated)[0], expected)


def test_places_are_told_apart_by_position_and_conditions() -> None:
    xy_m = np.array([[0, 0], [1, 0], [-0.0, 0], [0, 0], [0.2, 0.1]])
    run = np.array(["a", "a", "a", "b", "a"])
    np.testing.assert_array_equal(place_numbers({"run": run}, xy_m, 0.0), [0, 1, 0, 2, 3])
    np.testing.assert_array_equal(place_numbers({"run": run}, xy_m, 0.5), [0, 1, 0, 2, 0])
