"""Strengths on another scale, degrees for metres and different units of both ends are suspected."""

from dataclasses import replace

import numpy as np
import pytest
from checked_records import strengths
from made_building import building

from wrf_mi.apps.checking import check_data
from wrf_mi.apps.checking.distances import explained, levels_db, unlike_units
from wrf_mi.apps.checking.units import degrees, strength_scale
from wrf_mi.core import Record


@pytest.mark.parametrize(
    "wrong",
    [
        lambda dbm: 10 ** (dbm / 10),
        lambda dbm: np.where(dbm < -58, 0, 10 ** (dbm / 10)),
        lambda dbm: -dbm,
        lambda dbm: dbm + 107,
        lambda dbm: 2 * (dbm + 100),
    ],
    ids=["milliwatts", "milliwatts with zeros", "no sign", "dB above a microvolt", "per cent"],
)
def test_strengths_that_are_nowhere_below_0_dbm_are_suspected(wrong):
    record = strengths()
    assert list(strength_scale(record)) == []
    observation = record.observation.copy()
    observation[1:] = wrong(observation[1:])
    ((name, text),) = strength_scale(replace(record, observation=observation))
    assert name == "strengths"
    assert text.startswith("no signal strength of anchor2, anchor3, anchor4 is below 0 dBm: they are powers on a lin")
    strong = record.observation + np.float32(55)  # some rows above 0 dBm
    assert list(strength_scale(replace(record, observation=strong))) == []


def test_a_distance_law_explains_what_it_made():
    record = strengths(noise_db=0)
    places = np.stack([receiver.position_m for receiver in record.receivers])
    distance_m = np.linalg.norm(record.tx_pos_m - places[:, None], axis=-1)
    share, exponent = explained(levels_db(record), distance_m)
    assert share == pytest.approx(1, abs=1e-5)
    assert exponent == pytest.approx(2, abs=1e-3)
    assert explained(-levels_db(record), distance_m) == (0, 0)
    observation = record.observation.copy()
    observation[0] = np.nan
    observation[1, :50] = np.nan
    share, exponent = explained(observation.astype(float), distance_m)
    assert exponent == pytest.approx(2, abs=1e-3)


@pytest.mark.parametrize(("factor", "unit"), [(0.3048, "feet"), (0.001, "millimetres")])
def test_receivers_in_another_unit_than_rows_are_suspected(factor, unit):
    record = strengths(noise_db=1)
    assert list(unlike_units(record)) == []
    receivers = tuple(replace(receiver, position_m=receiver.position_m / factor) for receiver in record.receivers)
    ((name, text),) = unlike_units(replace(record, receivers=receivers))
    assert name == "unlike-units"
    assert f"(they are in {unit})" in text
    assert list(unlike_units(replace(record, receivers=receivers[:1], observation=record.observation[:1]))) == []


SALT_LAKE, SINGAPORE, LONDON, SYDNEY = (-111.8442, 40.7672), (103.8198, 1.3521), (-0.1276, 51.5072), (151.21, -33.87)
PER_DEGREE_M = 111e3


def at(record: Record, offset: tuple[float, ...], scale: float) -> Record:
    """The record with horizontal positions offset + scale * metres."""
    shift, factor = np.array([*offset, 0.0]), np.array([scale, scale, 1.0])
    moved = tuple(replace(receiver, position_m=shift + factor * receiver.position_m) for receiver in record.receivers)
    return replace(record, receivers=moved, tx_pos_m=shift + factor * record.tx_pos_m)


@pytest.mark.parametrize("size", [1.0, 30.0, 1000.0], ids=["a building", "a campus", "a town"])
@pytest.mark.parametrize("place", [SALT_LAKE, SINGAPORE, LONDON, SYDNEY])
@pytest.mark.parametrize("step", [1, -1], ids=["longitude, latitude", "latitude, longitude"])
def test_degrees_are_suspected_in_either_order(place, step, size):
    ((name, text),) = list(degrees(at(building(), place[::step], size / PER_DEGREE_M)))
    assert name == "degrees"
    assert text.startswith("receivers and transmitters have x from ")
    assert "in degrees, of a place some" in text
    if np.abs(place).max() > 90:
        assert ("longitude, latitude" if step == 1 else "latitude, longitude") in text
    report = check_data(at(building(), place[::step], size / PER_DEGREE_M))
    assert [suspicion.name for suspicion in report.suspicions] == ["degrees"]  # others about places wait for metres


def test_positions_in_degrees_alone_are_suspected_and_map_projections_noted():
    """Single precision resolves half a metre at 4,512 km."""
    record = building()
    utm, table = ((423456.0, 4512345.0), 1.0), ((5.0, 7.0), 0.01)  # of 12 cm, seen from the corner of its room
    for offset, scale in (((0.0, 0.0), 1.0), ((40.0, 60.0), 1.0), utm, table):
        metres = at(record, offset, scale)
        metres = replace(metres, tx_pos_m=np.round(metres.tx_pos_m, 3))
        for receivers in (metres.receivers, metres.receivers[:1]):
            assert list(degrees(replace(metres, receivers=receivers))) == []
    assert list(degrees(replace(record, tx_pos_m=np.full_like(record.tx_pos_m, np.nan)))) == []
    unsurveyed = tuple(replace(receiver, position_m=np.full(3, np.nan)) for receiver in record.receivers)
    ((_, text),) = list(degrees(at(replace(record, receivers=unsurveyed), SALT_LAKE, 1 / PER_DEGREE_M)))
    assert text.startswith("transmitters have x from -111.84")
    report = check_data(at(building(), (423456.0, 4512345.0), 1.0))
    (note,) = report.notes
    assert report.suspicions == ()
    assert "positions are up to 4.512e+06 m from the origin" in note
    assert "resolve 0.5 m there; subtract a common origin" in note
    assert report.lines()[0] == f"note: {note}"
    assert check_data(building()).notes == ()
