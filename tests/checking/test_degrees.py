"""Longitudes and latitudes in place of metres are suspected, metres and map projections are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_building import building

from wrf_mi.checking import check_data
from wrf_mi.checking.units import degrees
from wrf_mi.core import Record

SALT_LAKE, SINGAPORE, LONDON, SYDNEY = (-111.8442, 40.7672), (103.8198, 1.3521), (-0.1276, 51.5072), (151.21, -33.87)
PER_DEGREE_M = 111e3


def at(record: Record, offset: tuple[float, ...], scale: float, of: str = "receivers and transmitters") -> Record:
    """The record with horizontal positions offset + scale * metres, those of some parts alone."""
    shift, factor = np.array([*offset, 0.0]), np.array([scale, scale, 1.0])
    if "receivers" in of:
        moved = tuple(replace(one, position_m=shift + factor * one.position_m) for one in record.receivers)
        record = replace(record, receivers=moved)
    return replace(record, tx_pos_m=shift + factor * record.tx_pos_m) if "transmitters" in of else record


def swapped(place: tuple[float, float]) -> tuple[float, float]:
    return place[::-1]


@pytest.mark.parametrize("size", [1.0, 30.0, 1000.0], ids=["a building", "a campus", "a town"])
@pytest.mark.parametrize("place", [SALT_LAKE, SINGAPORE, LONDON, SYDNEY])
@pytest.mark.parametrize("order", [tuple, swapped])
def test_degrees_are_suspected_in_either_order(place, order, size: float) -> None:
    ((name, text),) = list(degrees(at(building(), order(place), size / PER_DEGREE_M)))
    assert name == "degrees"
    assert text.startswith("receivers and transmitters have x from ")
    assert "in degrees, of a place some" in text
    if np.abs(place).max() > 90:
        assert ("longitude, latitude" if order is tuple else "latitude, longitude") in text


@pytest.mark.parametrize("of", ["receivers", "transmitters"])
def test_either_of_them_may_be_in_degrees_alone(of: str) -> None:
    ((_, text),) = list(degrees(at(building(), SALT_LAKE, 1 / PER_DEGREE_M, of)))
    assert text.startswith(f"{of} have x from -111.84")


@pytest.mark.parametrize(
    ("offset", "scale"),
    [
        ((0.0, 0.0), 1.0),
        ((40.0, 60.0), 1.0),
        ((423456.0, 4512345.0), 1.0),  # UTM
        ((5.0, 7.0), 0.01),  # a table of 12 cm, seen from the corner of its room
    ],
)
def test_metres_are_not_suspected(offset: tuple[float, float], scale: float) -> None:
    record = at(building(), offset, scale)
    metres = replace(record, tx_pos_m=np.round(record.tx_pos_m, 3))
    assert list(degrees(metres)) == []
    assert list(degrees(replace(metres, receivers=metres.receivers[:1]))) == []


def test_unknown_positions_are_not_suspected() -> None:
    record = building()
    assert list(degrees(replace(record, tx_pos_m=np.full_like(record.tx_pos_m, np.nan)))) == []


def test_other_suspicions_about_places_wait_for_metres() -> None:
    report = check_data(at(building(), SALT_LAKE, 1 / PER_DEGREE_M))
    assert [one.name for one in report.suspicions] == ["degrees"]


def test_map_projections_are_noted() -> None:
    """Single precision resolves half a metre at 4,512 km."""
    report = check_data(at(building(), (423456.0, 4512345.0), 1.0))
    (note,) = report.notes
    assert report.suspicions == ()
    assert "positions are up to 4.512e+06 m from the origin" in note
    assert "resolve 0.5 m there; subtract a common origin" in note
    assert report.lines()[0] == f"note: {note}"
    assert check_data(building()).notes == ()
