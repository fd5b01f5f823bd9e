"""Plan of a fit of Gaussians, which check and fit share."""

from pathlib import Path

import pytest
from made_lobes import lobes
from small_fits import settings

import wrf_mi
from wrf_mi.training.fit_plan import FitPlan


@pytest.mark.parametrize("model", ["wrf-gs", "factorised"])
def test_plan_is_built_once_for_check_and_fit(model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plans, build = [], FitPlan.__init__

    def counted(self: FitPlan, *arguments: object, **more: object) -> None:
        plans.append(self)
        build(self, *arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(FitPlan, "__init__", counted)
    wrf_mi.train(lobes((9, 36)), model, out=tmp_path / "run", settings=settings("steps=2", model=model))
    assert len(plans) == 1
