"""Run time against error: what is on the front, and what a measured method carries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from wrf_mi_bench.methods import METHODS, FittedMethod, Method, MethodInput
from wrf_mi_bench.pareto import front, full_table, measure_methods, pareto_figure, table

from wrf_mi.core import Record

HELD_MB = 200
BUSY_ROWS = 3_000_000
"""Numbers that the slow method sorts: a hundred times what the fast one does."""


def point(name: str, ms: float, error: float, **more: Any) -> dict[str, Any]:
    def interval(value: float) -> dict[str, float]:
        return {"value": value, "low": 0.9 * value, "high": 1.1 * value}

    one = {"tracing": ms, "code_generation": 0.0, "execution": 0.0, "kernels": 0, "compiled": 0}
    return {
        "name": name,
        "family": name[0],
        "ms": interval(ms),
        "error": interval(error),
        "over_reference": interval(ms),
        "split": {"first": one, "warm": one},
        "memory_mb": {"one": 1.0, "batch": 20.0},
        "stored_mb": 0.5,
        "train_seconds": 0.0,
    } | more


POINTS = [point("slow", 10, 0.01), point("fast", 1, 0.3), point("middle", 3, 0.1), point("beaten", 5, 0.2)]


def test_front_holds_the_pareto_optimal_points() -> None:
    assert front(POINTS) == ["fast", "middle", "slow"]
    assert front([*POINTS, point("best", 0.5, 0.001)]) == ["best"]
    # As good in one and better in the other is better.
    assert front([point("a", 1, 0.2), point("b", 1, 0.1), point("c", 2, 0.1)]) == ["b"]


def test_table_goes_from_fast_to_slow_and_has_memory() -> None:
    rows = table([*POINTS, point("batched", 2, 0.5, batch_ms={"value": 0.25, "low": 0.2, "high": 0.3})])
    assert [row["what"].split()[0] for row in rows] == ["fast", "batched", "middle", "beaten", "slow"]
    assert "(on the front)" in rows[0]["what"]
    assert "(on the front)" not in rows[1]["what"]
    assert rows[1]["value"] == "SSIM 0.500, 2 ms, 0.25 ms in a batch"


def test_full_table_has_memory_and_the_parts_of_a_call() -> None:
    lines = full_table(POINTS).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| **fast**", "| **middle**", "| beaten", "| **slow**"]
    expected = "| 0.700 | 1 (0.9 to 1.1) |  | 1 | 1.0 + 0.0 + 0.0 | 20 MB | 0.5 MB |  |"
    assert lines[2].removeprefix("| **fast** ") == expected


def test_picture_names_every_point_on_logarithmic_axes() -> None:
    crowd = [point(f"crowd {k}", 7 + 0.01 * k, 0.2) for k in range(5)]
    figure = pareto_figure([*POINTS, *crowd, point("batched", 2, 0.5, batch_ms={"value": 0.25})])
    (axes,) = figure.axes
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert {text.get_text() for text in axes.texts} == {p["name"] for p in [*POINTS, *crowd]} | {"batched"}
    boxes = [Text.get_window_extent(text) for text in axes.texts]  # without the lines to their points
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    # The step through the front ends at its slowest point.
    (step,) = [line for line in axes.lines if line.get_color() == "0.7"]
    assert (step.get_xdata()[-1], step.get_ydata()[-1]) == (10, 0.01)


def test_names_of_methods_are_unique_and_the_reference_is_there() -> None:
    from wrf_mi_bench.pareto import REFERENCE

    names = [method.name for method in METHODS]
    assert len(set(names)) == len(names)
    assert REFERENCE in names


def test_user_defined_method_is_measured(one_gateway: Record, tmp_path: Path) -> None:
    """One that answers truly and slowly, one that does not and fast; only the first gains nothing from batches."""
    truth = one_gateway.observation[0]
    entered: list[bool] = []

    def true(place: MethodInput) -> FittedMethod:
        def predict(tx_pos_m: np.ndarray) -> np.ndarray:
            np.sort(np.random.default_rng(0).random(BUSY_ROWS))
            np.ones(HELD_MB * 1_000_000 // 8)
            apart = np.linalg.norm(place.record.tx_pos_m[None] - tx_pos_m[:, None], axis=-1)
            return truth[apart.argmin(axis=1)]

        return FittedMethod(predict, stored_mb=3.0, train_seconds=7.0)

    def grey(place: MethodInput) -> FittedMethod:
        from contextlib import contextmanager

        @contextmanager
        def context():
            entered.append(True)
            yield

        return FittedMethod(lambda tx: np.full((len(tx), *truth.shape[1:]), 0.5), stored_mb=0.0, context=context)

    methods = [Method("true", "mine", true, batches=False), Method("grey", "mine", grey)]
    place = MethodInput(replace(one_gateway), Path("none"), tmp_path, rows=5)
    found = {one["name"]: one for one in measure_methods(place, methods, "grey", repeats=3)}
    assert found["true"]["error"]["value"] == pytest.approx(0, abs=1e-6)
    assert found["grey"]["error"]["value"] > 0.1
    assert found["true"]["over_reference"]["value"] > 5  # thousands, but for what a busy machine does to 10 us
    assert found["true"]["stored_mb"] == 3.0
    # What others in this process free meanwhile counts against it: seen to be some tens of MB after a thousand tests.
    assert found["true"]["memory_mb"]["one"] > HELD_MB / 2
    assert found["true"]["split"]["warm"]["tracing"] > found["true"]["split"]["warm"]["execution"]
    assert "batch_ms" in found["grey"]
    assert "batch_ms" not in found["true"]
    assert entered
