"""Traces in threads of one process, alone, in a batch and repeated have the same paths and gains."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier, Event, local
from typing import Any

import numpy as np
import pytest
from traced_rooms import FREQUENCY_HZ, THICKNESS_M, inside, receiver

from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

THREADS = 4
TX = inside(3)
OPTIONS = TraceOptions(depth=2, rays=1 << 12)
SCATTERED = replace(OPTIONS, scattering=True, scattering_coefficient=0.4, rays=1 << 10)
DIFFRACTED = replace(OPTIONS, diffraction=True)


def traced(scene, options=OPTIONS, tx=TX):
    return trace_paths(scene, tx, receiver([1.0, 1.0, 1.0]), options).paths


def assert_equal(paths, expected):
    np.testing.assert_equal(vars(paths), vars(expected))


def in_threads(work):
    """Results of the work of each thread; all begin together."""
    barrier = Barrier(THREADS)

    def begun(number):
        barrier.wait()
        return work(number)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(begun, range(THREADS)))


def test_fields_are_corrected_while_other_threads_enter_and_leave(divided_xml, monkeypatch):
    from sionna.rt.path_solvers.field_calculator import FieldCalculator

    scenes = [open_scene(divided_xml, FREQUENCY_HZ, THICKNESS_M) for _ in range(THREADS)]
    entered, left = ([Event() for _ in scenes] for _ in range(2))
    calculate, expected, thread = FieldCalculator.__call__, traced(scenes[0]), local()

    # The threads enter one after the other, and leave in that order once all have entered.
    def in_turn(self, **arguments):
        entered[thread.number].set()
        entered[-1].wait()
        if thread.number:
            left[thread.number - 1].wait()
        return calculate(self, **arguments)

    def work(number):
        thread.number = number
        if number:
            entered[number - 1].wait()
        try:
            return traced(scenes[number])
        finally:
            left[number].set()

    monkeypatch.setattr(FieldCalculator, "__call__", in_turn)
    for paths in in_threads(work):
        assert_equal(paths, expected)


def test_correction_ends_with_its_block_in_every_thread():
    import mitsuba as mi
    from sionna.rt.radio_materials import radio_material

    from wrf_mi.tracing.sionna.path_solver import corrected

    def passed(_):
        """TE through a sheet at grazing incidence, where the differences of Sionna RT's coefficients vanish."""
        complex_type: Any = mi.Complex2f
        sheet = mi.Float(1e-7), complex_type(6.31, -0.0026), mi.Float(1e-9), mi.Float(0.125)
        return float(abs(radio_material.itu_coefficients_single_layer_slab(*sheet)[2])[0])

    def both(_):
        before = passed(None)
        with corrected():
            within = passed(None)
        return before, within, passed(None)

    expected = both(None)
    assert expected[0] == expected[2] != expected[1]
    assert in_threads(both) == [expected] * THREADS


@pytest.mark.parametrize("options", [OPTIONS, SCATTERED, DIFFRACTED], ids=["specular", "scattered", "diffracted"])
def test_threads_that_share_a_scene_have_the_paths_of_one(divided, options):
    expected = traced(divided, options)
    for paths in in_threads(lambda _: traced(divided, options)):
        assert_equal(paths, expected)


def test_threads_that_share_a_scene_keep_their_scattering_coefficients(divided):
    options = [replace(SCATTERED, scattering_coefficient=0.2 * (1 + number)) for number in range(THREADS)]
    expected = [traced(divided, each) for each in options]
    for paths, alone in zip(in_threads(lambda number: traced(divided, options[number])), expected, strict=True):
        assert_equal(paths, alone)
    assert all(float(m.scattering_coefficient[0]) == 0 for m in divided.radio_materials.values())


def test_threads_that_share_a_scene_keep_their_carriers(divided):
    carriers_hz = FREQUENCY_HZ * np.array([1.0, 1.5, 2.0, 2.5])

    def at(number):
        device = replace(receiver([1.0, 1.0, 1.0]), frequency_hz=carriers_hz[number])
        return trace_paths(divided, TX, device, OPTIONS).paths

    expected = [at(number) for number in range(THREADS)]
    for paths, alone in zip(in_threads(at), expected, strict=True):
        assert_equal(paths, alone)


@pytest.mark.parametrize("options", [OPTIONS, SCATTERED, DIFFRACTED], ids=["specular", "scattered", "diffracted"])
def test_transmitter_alone_has_the_paths_of_a_batch(divided, options):
    batch = traced(divided, options)
    for row, place in enumerate(TX):
        alone, of_row = traced(divided, options, place[None]), batch.select(batch.tx == row)
        for name in ("gain", "length_m", "interactions", "vertices_m", "objects", "departure", "arrival"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(of_row, name), err_msg=name)
