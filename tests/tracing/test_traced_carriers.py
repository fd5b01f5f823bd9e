"""Traced fields of several carriers from one search against a field of each carrier that searches for itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import CEILING, PARTITION, THICKNESS_M, WALLS, receiver, transmitters
from traced_rooms import write_xml

from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions, traced_fields
from wrf_mi.tracing.search import chains as search_module

# isort: split
import drjit as dr
import mitsuba as mi

Float64 = dr.float64_array_t(mi.Float)
Tensor64 = dr.tensor_t(Float64)

LOW_HZ, MIDDLE_HZ, HIGH_HZ = CARRIERS_HZ = 1.2e9, 2.4e9, 5.8e9
SINGLE = 2e-6
"""Of the strongest path: constants of materials and gains of the search in single precision."""
OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)
PLACE = {LOW_HZ: [0, 1, 2, 3], MIDDLE_HZ: [5, 1, 1], HIGH_HZ: [4, 3, 1, 0, 6]}
"""Transmitters of each carrier: some at several, one of them twice."""
POSITION = "receiver.array.position"


@pytest.fixture(scope="module")
def xml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xml(tmp_path_factory.mktemp("room"), {**WALLS, **CEILING, **PARTITION})


def rows() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [n, 3], headings [n] and carriers [n] of the rows, in a random order."""
    place, carrier = np.concatenate(list(PLACE.values())), np.repeat(list(PLACE), [len(p) for p in PLACE.values()])
    order = np.random.default_rng(0).permutation(len(place))
    return transmitters(7)[place[order]], np.linspace(-2, 2, len(place)), carrier[order]


def response(field: TracedField, parameters: dict[str, Any]) -> np.ndarray:
    """Sum of all paths of each transmitter, with phases."""
    paths = field(parameters)
    gain = paths.gain[0].numpy() + 1j * paths.gain[1].numpy()
    phase = np.exp(-2j * np.pi * field.frequency_hz / 299792458 * paths.length_m.numpy())
    return (gain * phase).reshape(len(field), -1).sum(axis=1)


def test_a_trace_at_another_carrier_compiles_nothing_anew(xml: Path) -> None:
    """Carrier and constants of materials are no literals of the kernels."""

    def kernels(carrier_hz: float) -> set[int]:
        scene = open_scene(xml, carrier_hz, THICKNESS_M)
        search_module._kept.clear()  # rays are shot at each
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            trace_paths(scene, transmitters(5), receiver(), OPTIONS)
            return {one["hash"] for one in dr.kernel_history([dr.KernelType.JIT])}

    assert kernels(LOW_HZ) == kernels(MIDDLE_HZ) == kernels(HIGH_HZ)


@pytest.mark.parametrize("faint", [0.0, 0.1])
def test_fields_are_those_of_a_search_for_each_carrier(faint: float, xml: Path, searches: list[int]) -> None:
    """Positions, headings, faint paths left out and lengths; the search is of each distinct position, once."""
    scene, options = open_scene(xml, MIDDLE_HZ, THICKNESS_M), TracedOptions(OPTIONS, pattern_degree=1, faint=faint)
    tx, heading, carriers = rows()
    pattern = {"pattern.transmitter": Tensor64(np.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.3]]))}
    found = traced_fields(tx, receiver(), options, Prepared(scene), heading, carriers)
    assert searches == [7]
    assert [field.frequency_hz for field in found] == list(CARRIERS_HZ)
    for field, hz in zip(found, CARRIERS_HZ, strict=True):
        at = carriers == hz
        alone = TracedField(scene, tx[at], receiver(), options, heading[at], frequency_hz=hz)
        np.testing.assert_array_equal(field.exists, alone.exists)
        expected = response(alone, pattern)
        np.testing.assert_allclose(response(field, pattern), expected, rtol=0, atol=SINGLE * np.abs(expected).max())
    assert len(searches) == 4


def test_fields_are_those_of_scenes_at_each_carrier(xml: Path) -> None:
    """Materials follow the laws of ITU-R P.2040 from the carrier of the search."""
    scene, options = open_scene(xml, MIDDLE_HZ, THICKNESS_M), TracedOptions(OPTIONS)
    tx, heading, carriers = rows()
    for field in traced_fields(tx, receiver(), options, Prepared(scene), heading, carriers):
        at, there = carriers == field.frequency_hz, open_scene(xml, field.frequency_hz, THICKNESS_M)
        expected = response(TracedField(there, tx[at], receiver(), options, heading[at]), {})
        np.testing.assert_allclose(response(field, {}), expected, rtol=0, atol=SINGLE * np.abs(expected).max())


def test_moved_receivers_are_searched_as_by_refresh(xml: Path, searches: list[int]) -> None:
    """Moved by 4 cm, more than a quarter of a wavelength at two carriers: one search from there and one as stated."""
    scene, options = open_scene(xml, MIDDLE_HZ, THICKNESS_M), TracedOptions(OPTIONS)
    tx, _, carriers = rows()
    moved = {POSITION: Tensor64([0.0, 0.04, 0.0])}
    found = traced_fields(tx, receiver(), options, Prepared(scene), None, carriers, parameters=moved)
    assert len(searches) == 2
    stated_m = receiver().position_m
    for field, hz in zip(found, CARRIERS_HZ, strict=True):
        alone = TracedField(scene, tx[carriers == hz], receiver(), options, frequency_hz=hz)
        assert alone.refresh(moved) == (hz != LOW_HZ)
        np.testing.assert_array_equal(field.searched_at_m, alone.searched_at_m)
        assert (field.searched_at_m == stated_m).all() == (hz == LOW_HZ)
        np.testing.assert_array_equal(response(field, moved), response(alone, moved))
        assert not field.refresh(moved)


def test_rows_without_carriers_have_that_of_the_scene(xml: Path) -> None:
    scene, tx = open_scene(xml, MIDDLE_HZ, THICKNESS_M), transmitters(3)
    [field] = traced_fields(tx, receiver(), TracedOptions(OPTIONS), Prepared(scene))
    assert field.frequency_hz == pytest.approx(MIDDLE_HZ)
    np.testing.assert_array_equal(
        response(field, {}), response(TracedField(scene, tx, receiver(), TracedOptions(OPTIONS)), {})
    )


def test_wrong_positions_are_refused(xml: Path) -> None:
    scene = open_scene(xml, MIDDLE_HZ, THICKNESS_M)
    for wrong in ([[1.0, 2.0]], [[1.0, 2.0, np.nan]]):
        with pytest.raises(ValueError, match="tx_pos_m has shape"):
            traced_fields(wrong, receiver(), TracedOptions(OPTIONS), Prepared(scene))
