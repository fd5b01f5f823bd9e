"""Budgets of fields: measured and compared with the first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from small_fits import QUICK
from wrf_mi_bench.budget import Budget, budgets, rows_of

from wrf_mi.core import Record
from wrf_mi.training.compress import Compression


def test_budgets_are_compared_with_the_first(folder: Path, one_gateway: Record, tmp_path: Path) -> None:
    record = replace(one_gateway, source=str(folder))
    small_one = ("model=factorised", "network.terms=2", "network.width=8")
    given = {
        "large": Budget((), None),
        "small, 8": Budget(small_one, Compression(precision="8bit")),
        "fewer": Budget((), Compression(budget=5), of="large"),
    }
    schedule = (*QUICK, "steps=10", "holdout_steps_fraction=0")
    found = budgets(record, tmp_path, schedule, given)
    assert found["large"]["times_smaller"] == 1
    assert found["small, 8"]["times_smaller"] > 10
    assert found["small, 8"]["ssim_loss"] == found["large"]["ssim"]["median"] - found["small, 8"]["ssim"]["median"]
    assert [one["gaussians"] for one in found.values()] == [8, 8, 5]
    rows = rows_of(found)
    assert rows[0]["asked"] == ""
    assert "times smaller" in rows[1]["value"]
