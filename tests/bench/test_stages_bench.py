"""Benchmark of the hybrid beside its parts alone: differences by row, and the table."""

from typing import Any

import pytest
from wrf_mi_bench.stages import CALIBRATED, CELLS, JOINT, parts_of, rows_of, table


def measured(model: str, median: float, **more: Any) -> dict[str, Any]:
    score = {"median": median, "mean": median - 0.01}
    return {"model": model, "score": score, "block": "ssim", "inside_90": None, "crps": None} | more


def test_table_names_stages_the_best_part_and_those_that_are_clearly_better():
    stages = [
        {"stage": "mean", "kept": True, "held_out": 0.7, "seconds": None},
        {"stage": "correction", "kept": False, "held_out": 0.695, "seconds": 3.0},
        {"stage": "field", "kept": True, "held_out": None, "seconds": 1.0},
    ]
    hybrid = measured("hybrid", 0.9, inside_90=0.88, crps=0.02, stages=stages)
    kriging = measured("kriging", 0.92, gain=-0.02, gain_low=-0.03, gain_high=-0.01)
    idw = measured("idw", 0.7, gain=0.2, gain_low=0.1, gain_high=0.3)
    near = measured(JOINT, 0.91, gain=-0.01, gain_low=-0.03, gain_high=0.01)
    line = table(rows_of(CELLS[0], [hybrid, kriging, idw, near])).splitlines()[2]
    assert line == (
        "| rfid-lab, official, 5 rows | **0.9** (0.89) | 88% | 0.02 | mean 0.7, ~~correction 0.695~~, field "
        "| kriging 0.92 (0.91) | -0.02 (-0.03 to -0.01) | 0.92 | 0.7 | kriging |"
    )


@pytest.mark.parametrize(
    ("task", "scene", "parts"),
    [
        ("spectrum", None, ["kriging", "idw"]),
        ("spectrum", "room", ["kriging", "idw", "ray-tracing", JOINT]),
        ("rssi", "flat", ["kriging", "idw", "ray-tracing", CALIBRATED]),
    ],
)
def test_parts_are_those_of_the_task_and_the_scene(task, scene, parts):
    assert parts_of(task, scene) == parts
