"""Headings, positions, strengths and channels in another unit or scale, degrees among them, are suspected."""

import re
from dataclasses import replace

import numpy as np
import pytest
from checked_records import channels, strengths
from made_building import building

from wrf_mi.apps.checking import check_data
from wrf_mi.apps.checking.units import channel_phase, degrees, heading_unit, position_unit, strength_scale
from wrf_mi.core import Record


def walk(seed: int = 0) -> tuple[Record, np.ndarray]:
    record = strengths(rows=300, seed=seed)
    heading = record.tx_heading_rad
    assert heading is not None
    return record, heading + 0.3 * np.random.default_rng(seed).normal(size=len(heading))


def texts(record: Record, heading: np.ndarray) -> list[str]:
    return [text for _, text in heading_unit(replace(record, tx_heading_rad=heading))]


@pytest.mark.parametrize(
    ("wrong", "remedy"),
    [
        (lambda h: np.degrees(np.angle(np.exp(1j * h))), "if they are degrees; multiply them by pi / 180$"),
        (lambda h: np.degrees(h) % 360, "if they are degrees; multiply"),
        (lambda h: np.round(np.degrees(h)) % 360, "if they are degrees; multiply"),
        (lambda h: np.degrees(np.unwrap(h)), "if they are degrees; multiply"),
        (lambda h: np.pi / 2 - h, r"clockwise, as of a compass, or the plan is mirrored; use pi / 2"),
        (lambda h: (90 - np.degrees(h)) % 360, "degrees and run clockwise, as of a compass; use"),
    ],
    ids=["degrees", "degrees from 0", "whole degrees", "turns in degrees", "clockwise", "compass"],
)
def test_headings_in_another_unit_are_suspected_by_the_path(wrong, remedy):
    record, heading = walk()
    (text,) = texts(record, wrong(heading))
    assert text.startswith("headings range from ")
    assert re.search(remedy, text), text


def test_headings_in_radians_are_not_suspected_and_degrees_are_without_a_path():
    record, heading = walk()
    order = np.random.default_rng(1).permutation(len(record))
    mixed = replace(record, tx_pos_m=record.tx_pos_m[order], observation=record.observation[:, order])
    turns = np.unwrap(heading)
    backwards, anyhow = heading + np.pi, np.random.default_rng(0).uniform(-np.pi, np.pi, len(heading))
    for right in (heading, heading % (2 * np.pi), turns, turns + 200, backwards, anyhow):
        assert texts(record, right) == []
        assert texts(mixed, right[order]) == []
    still = replace(record, tx_pos_m=np.repeat(record.tx_pos_m[:1], len(record), axis=0))
    for pathless in (still, replace(record, tx_pos_m=record.tx_pos_m[order])):
        (text,) = texts(pathless, (np.degrees(heading) % 360)[order])
        assert text.endswith("of the steps between rows are above pi: they are degrees; multiply them by pi / 180")
    assert texts(still, np.linspace(0, 200, len(record))) == []  # thirty turns, row by row
    assert list(heading_unit(replace(record, tx_heading_rad=None))) == []


@pytest.mark.parametrize("make", [strengths, channels])
@pytest.mark.parametrize(("factor", "unit"), [(100, "centimetres"), (1000, "millimetres")])
def test_positions_in_another_unit_are_suspected(make, factor, unit):
    record = make()
    assert list(position_unit(record)) == []
    receivers = tuple(replace(one, position_m=factor * one.position_m) for one in record.receivers)
    positions = factor * record.tx_pos_m
    both = replace(record, tx_pos_m=positions, receivers=receivers)
    for wrong in (both, replace(record, tx_pos_m=positions), replace(record, receivers=receivers)):
        ((name, text),) = position_unit(wrong)
        assert name == "positions"
        assert unit in text
        assert text.endswith("give metres, of receivers and transmitters")


def test_distances_that_signals_cover_are_not_suspected():
    """A network outdoors: 14 dBm over kilometres, with carriers for each row."""
    record = strengths()
    receivers = tuple(replace(one, position_m=300 * one.position_m) for one in record.receivers)
    far = replace(record, tx_pos_m=300 * record.tx_pos_m, receivers=receivers, observation=record.observation - 50)
    carriers = np.where(np.arange(len(far)) % 2, 868e6, 915e6)
    unknown = replace(far, tx_pos_m=np.full_like(far.tx_pos_m, np.nan))
    assert [list(position_unit(one)) for one in (far, far.at_carriers(carriers), unknown)] == [[], [], []]
    ((_, text),) = position_unit(replace(far, observation=record.observation + 40).at_carriers(carriers))
    assert "dBm of radiated power" in text


LINEAR = "are powers on a linear scale; give dBm, 10 log10 of the milliwatts"


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda dbm: 10 ** (dbm / 10), LINEAR),
        (lambda dbm: 10 ** (dbm / 10 - 3), LINEAR),
        (lambda dbm: 1e9 * 10 ** (dbm / 10), LINEAR),
        (lambda dbm: np.where(dbm < -58, 0, 10 ** (dbm / 10)), LINEAR),
        (lambda dbm: -dbm, "are above 0 dBm everywhere: the minus sign is missing"),
        (lambda dbm: dbm + 107, "or they are dB above a microvolt; give dBm"),
    ],
)
def test_powers_on_another_scale_are_suspected(wrong, text):
    record = strengths()
    assert list(strength_scale(record)) == []
    ((name, found),) = strength_scale(replace(record, observation=wrong(record.observation).astype(np.float32)))
    assert name == "strengths"
    assert found.startswith("signal strengths in training rows and test rows of anchor1, anchor2, anchor3, anchor4 are")
    assert text in found


def test_receivers_and_parts_on_another_scale_are_named():
    record = strengths()
    observation = record.observation.copy()
    observation[1] = 10 ** (observation[1] / 10)
    observation[2:, -20:] *= -1
    observation[3, :20] = np.nan
    found = sorted(text for _, text in strength_scale(replace(record, observation=observation)))
    assert [text.partition(" are ")[0] for text in found] == [
        "signal strengths in test rows of anchor3, anchor4",
        "signal strengths in training rows and test rows of anchor2",
    ]
    strong = record.observation + np.float32(55)  # some rows above 0 dBm
    assert list(strength_scale(replace(record, observation=strong, official=None))) == []


def test_channels_without_phase_are_suspected():
    record = channels()
    assert list(channel_phase(record)) == []
    size = np.abs(record.observation)
    for values, what in (
        (size, "magnitudes without phase"),
        (20 * np.log10(size), r"decibels; give complex coefficients, 10^(value / 20) times their phase factor"),
        (record.observation.real, "without imaginary part"),
    ):
        ((name, text),) = channel_phase(replace(record, observation=values.astype(np.complex64)))
        assert name == "channels"
        assert what in text
    up = replace(record, uplink=size[0, :, :, None].astype(np.complex64))
    assert [text.partition(" are ")[0] for _, text in channel_phase(up)] == ["all uplink coefficients"]
    assert list(channel_phase(strengths())) == []


SALT_LAKE, SINGAPORE, LONDON, SYDNEY = (-111.8442, 40.7672), (103.8198, 1.3521), (-0.1276, 51.5072), (151.21, -33.87)
PER_DEGREE_M = 111e3


def at(record: Record, offset: tuple[float, ...], scale: float, of: str = "receivers and transmitters") -> Record:
    """The record with horizontal positions offset + scale * metres, those of some parts alone."""
    shift, factor = np.array([*offset, 0.0]), np.array([scale, scale, 1.0])
    if "receivers" in of:
        moved = tuple(replace(one, position_m=shift + factor * one.position_m) for one in record.receivers)
        record = replace(record, receivers=moved)
    return replace(record, tx_pos_m=shift + factor * record.tx_pos_m) if "transmitters" in of else record


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
    assert [one.name for one in report.suspicions] == ["degrees"]  # others about places wait for metres


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
    for part in ("receivers", "transmitters"):
        ((_, text),) = list(degrees(at(record, SALT_LAKE, 1 / PER_DEGREE_M, part)))
        assert text.startswith(f"{part} have x from -111.84")
    report = check_data(at(building(), (423456.0, 4512345.0), 1.0))
    (note,) = report.notes
    assert report.suspicions == ()
    assert "positions are up to 4.512e+06 m from the origin" in note
    assert "resolve 0.5 m there; subtract a common origin" in note
    assert report.lines()[0] == f"note: {note}"
    assert check_data(building()).notes == ()
