"""How calls are timed, split and compared, on calls of known cost; growth; training steps; times of a GPU."""

import itertools
import time

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from wrf_mi_bench import timing
from wrf_mi_bench.scaling import Axis, rows, scale, verdict
from wrf_mi_bench.timing import Interval, bootstrap, exponent, interleaved, larger_half, memory_mb, ratio
from wrf_mi_scenes.divided import cluttered_room, divided_room

BUSY_S = 0.02
ARRAY_MB = 64
SLACK_MB = 16
"""What NumPy, Dr.Jit and Python's own allocator may take beside an array."""
PAGES_MB = 1
"""Pages of the process that an array may take over."""


def busy() -> None:
    time.sleep(BUSY_S)


def array() -> np.ndarray:
    return np.ones(ARRAY_MB * 1_000_000 // 8)


def test_bootstrap_interval_holds_the_median_and_narrows():
    rng = np.random.default_rng(0)
    few, many = (bootstrap(rng.normal(5, 1, n)) for n in (20, 2000))
    assert few.low < few.value < few.high
    assert few.low < 5 < few.high
    assert many.high - many.low < 0.3 * (few.high - few.low)
    assert bootstrap([3.0]) == Interval(3.0, 3.0, 3.0)
    with pytest.raises(ValueError, match="one at least"):
        bootstrap([])


def test_calls_take_turns_and_warm_up_is_not_timed(clock):
    order: list[str] = []

    def call(name: str, cost: float) -> None:
        order.append(name)
        clock[0] += cost if order.count(name) > 1 else 100.0  # the first call of each compiles

    times = interleaved({"a": lambda: call("a", 0.002), "b": lambda: call("b", 0.001)}, repeats=4, warm_up=1)
    assert order == [*"ab", *"abba" * 2]
    np.testing.assert_allclose([times["a"], times["b"]], [[2] * 4, [1] * 4])


def test_rounds_end_when_time_is_up_but_three_are_timed(clock):
    def slow() -> None:
        clock[0] += 10

    assert len(interleaved({"slow": slow}, repeats=50, warm_up=1, most_s=5)["slow"]) == 3
    assert len(interleaved({"slow": slow}, repeats=50, warm_up=1, most_s=75)["slow"]) == 7


def test_what_slows_both_calls_leaves_their_ratio(clock):
    load = itertools.count(1)

    def cost(seconds: float) -> None:
        clock[0] += seconds * ((next(load) + 1) // 2)  # the same within a round, ever more

    times = interleaved({"ours": lambda: cost(0.003), "theirs": lambda: cost(0.001)}, repeats=20, warm_up=1)
    assert times["ours"].max() > 5 * times["ours"].min()
    interval = ratio(times["ours"], times["theirs"])
    np.testing.assert_allclose([interval.low, interval.value, interval.high], 3)
    with pytest.raises(ValueError, match="as many of both"):
        ratio([1, 2], [1])


def test_history_holds_the_kernels_of_a_call():
    total_ms, history = timing.history_of(busy)
    assert total_ms >= 1e3 * BUSY_S
    assert history == []
    total_ms, (kernel,) = timing.history_of(lambda: dr.sin(dr.arange(mi.Float, 3_000_000) + 1.25))
    assert kernel["cache_hit"]
    assert 0 < kernel["execution_time"] <= total_ms


def test_memory_is_what_a_call_needs_beyond_what_was_there():
    before = array()
    for _ in range(2):  # the second time, Dr.Jit has freed arrays in store
        for call in (array, lambda: dr.arange(mi.Float, ARRAY_MB * 1_000_000 // 4) + 1):
            assert ARRAY_MB - PAGES_MB <= memory_mb(call) < ARRAY_MB + SLACK_MB
    assert memory_mb(lambda: None) < SLACK_MB
    assert before.nbytes == 1e6 * ARRAY_MB


def test_without_linux_memory_is_watched(monkeypatch, tmp_path):
    monkeypatch.setattr(timing, "RESET_PEAK", tmp_path / "missing")

    def call() -> None:
        allocated = array()
        time.sleep(BUSY_S)  # at least one look
        del allocated

    assert ARRAY_MB - PAGES_MB <= memory_mb(call) < ARRAY_MB + SLACK_MB


def test_exponent_is_that_of_the_larger_half():
    sizes = [10**k for k in range(1, 7)]
    cost = [[1000 + n**1.5] * 3 for n in sizes]  # the overhead hides the growth at first
    power = exponent(sizes, cost)
    np.testing.assert_allclose([power.low, power.value, power.high], 1.5, atol=0.01)
    assert [larger_half(n) for n in (6, 4, 3, 2)] == [slice(3, 6), slice(1, 4), slice(1, 3), slice(0, 2)]
    with pytest.raises(ValueError, match="two or more"):
        exponent([10], [[1.0]])


def test_exponent_is_less_sure_of_noisy_times():
    rng, sizes = np.random.default_rng(0), [10, 100, 1000, 10000]
    calm, noisy = (exponent(sizes, [n * rng.lognormal(0, s, 9) for n in sizes]) for s in (0.01, 0.5))
    assert noisy.high - noisy.low > 10 * (calm.high - calm.low)
    assert noisy.low < 1 < noisy.high


@pytest.mark.parametrize("count", [12, 100, 5000])
def test_rooms_of_a_number_of_triangles(count):
    walls = divided_room(count)
    assert count <= len(walls.faces) <= 1.6 * count
    np.testing.assert_allclose(walls.area, divided_room(12).area)
    np.testing.assert_allclose(walls.bounds, [[0, 0, 0], [9, 7, 3]])
    if count < 24:
        return
    clear = np.array([[2.0, 3.0, 1.5]])
    clutter = cluttered_room(count, clear)
    assert abs(len(clutter.faces) - count) <= 12
    corners = np.asarray(clutter.vertices)[len(divided_room(12).vertices) :]
    assert np.linalg.norm(corners - clear, axis=1).min() > 1.0
    np.testing.assert_allclose(clutter.area - walls.area, 60, rtol=1e-6)


def test_growth_beyond_n_log_n_is_reported(clock):
    def axis(power: float) -> Axis:
        def make(n: int):
            def call() -> None:
                clock[0] += 1e-7 * n**power

            return call

        return Axis("a", "made up", "things", (10, 100, 1000, 10000), make)

    for power, said in ((1.0, "holds"), (2.0, "does not hold")):
        growth = scale(axis(power))
        assert growth["sizes"] == [10, 100, 1000, 10000]
        assert rows([growth])[0]["asked"].endswith(f": {said}")
    assert verdict(Interval(1.1, 1.0, 1.3), timing.n_log_n([100, 1000])) == "holds within its interval"
    # What would take too long is left out, and said.
    slow = scale(axis(2.0), call_s=1e-3)
    assert slow["left_out"] == [1000, 10000]
    assert "1,000 left out" in rows([slow])[0]["what"]


SMALL = ("network.width=16", "network.layers=2", "encoding.tx_octaves=3", "encoding.position_octaves=2", "steps=1000")
