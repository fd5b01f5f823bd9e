"""Exponents of growth."""

from wrf_mi_bench.scaling import Axis, rows, scale, verdict
from wrf_mi_bench.timing import Interval, n_log_n


def test_growth_beyond_n_log_n_is_reported(clock):
    def axis(power: float) -> Axis:
        def make(n: int):
            def call() -> None:
                clock[0] += 1e-7 * n**power

            return call

        return Axis("a", "made up", "things", (10, 100, 1000, 10000), make)

    for power, said in ((1.0, "holds"), (2.0, "does not hold")):
        found = scale(axis(power))
        assert found["sizes"] == [10, 100, 1000, 10000]
        assert rows([found])[0]["asked"].endswith(f": {said}")
    assert verdict(Interval(1.1, 1.0, 1.3), n_log_n([100, 1000])) == "holds within its interval"
    # What would take too long is left out, and said.
    slow = scale(axis(2.0), call_s=1e-3)
    assert slow["left_out"] == [1000, 10000]
    assert "1,000 left out" in rows([slow])[0]["what"]
