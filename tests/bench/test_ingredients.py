"""Benchmark of the hybrid beside its ingredients: differences by row, and the table."""

from __future__ import annotations

from typing import Any

from wrf_mi_bench.ingredients import CELLS, rows_of, table


def measured(model: str, median: float, **more: Any) -> dict[str, Any]:
    score = {"median": median, "mean": median - 0.01}
    return {"model": model, "score": score, "block": "ssim", "inside_90": None, "crps": None} | more


def test_table_names_the_best_ingredient_and_those_that_are_clearly_better() -> None:
    hybrid = measured("hybrid", 0.9, inside_90=0.88, crps=0.02)
    kriging = measured("kriging", 0.92, gain=-0.02, gain_low=-0.03, gain_high=-0.01)
    idw = measured("idw", 0.7, gain=0.2, gain_low=0.1, gain_high=0.3)
    near = measured("physics", 0.91, gain=-0.01, gain_low=-0.03, gain_high=0.01)
    line = table(rows_of(CELLS[0], [hybrid, kriging, idw, near])).splitlines()[2]
    assert line == (
        "| rfid-lab, official, 5 rows | **0.9** (0.89) | 88% | 0.02 | kriging 0.92 (0.91) | -0.02 (-0.03 to -0.01) "
        "| 0.92 | 0.7 | kriging |"
    )
